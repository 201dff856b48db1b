"""Days of a fleet as a log of occupancy, which single searches replay: the others that take a town's slots."""

from __future__ import annotations

import csv
import gzip
from collections.abc import Iterator
from datetime import datetime, timedelta
from io import StringIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.errors import InputError
from parkenv.files.atomic_write import atomic_write
from parkenv.scenarios.build import build
from parkenv.scenarios.spec import SAME_SLOTS, ScenarioSpec
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.fleet.drivers import compiled_policy_of
from parkenv.studies.study import Progress

FIRST_MONDAY = datetime(2024, 1, 1)
"""Days of a fleet have no date; in a log the first is in this week, the next one a week later."""
_BEFORE_S = 1  # between the last observation of a state and the next state


def record_days(
    spec: ScenarioSpec,
    path: Path,
    *,
    agent: AgentSpec,
    days: int,
    rounds: int,
    seed: int,
    progress: Progress = lambda *_: None,
) -> int:
    """Drive days of a scenario's own demand, and write which slots are taken as a log; return its number of lines.

    A counted facility is taken while it is full. The log has each slot at the beginning of the day, and whenever it
    changes, to the second.

    The days are driven in rounds, of which the last one is recorded: drivers expect a typical week in the first, and
    then what the days of the round before were like.
    """
    occupancy: object = "typical"
    for number in range(rounds):
        scenario = build(spec.changed(occupancy=occupancy))
        if scenario.demand is None:
            raise InputError(f"{spec.source}: has no demand, want tables such as [demand.shoppers]")
        policy = compiled_policy_of(agent, scenario)
        fleet = Fleet(scenario, scenario.demand, drivers=[DriverKind(policy=policy)], leave_full_lot=False)
        lines = []
        for day in range(days):
            fleet.reset(seed, day)
            fleet.run()
            midnight = FIRST_MONDAY + timedelta(weeks=day, days=fleet.day.weekday)
            lines += [
                ((midnight + timedelta(seconds=second)).isoformat(), scenario.lot.slot_ids[slot], int(taken))
                for slot, second, taken in observations(fleet)
            ]
            progress("Days", number * days + day + 1, rounds * days)
        text = StringIO()
        csv.writer(text, lineterminator="\n").writerows([("datetime", "slot_id", "occupied"), *lines])
        content = text.getvalue().encode()
        with atomic_write(path) as beside:
            # Without the time of writing, so that equal days make equal files.
            beside.write_bytes(gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)
        occupancy = {"log": str(path), "mapping": SAME_SLOTS}
    return len(lines)


def observations(fleet: Fleet) -> Iterator[tuple[int, int, bool]]:
    """Yield slot, second of the day and whether it is taken, by slot and time, of a day whose searches are over."""
    lot, window = fleet.scenario.lot, fleet.scenario.arrival
    midnight = fleet.begin - window.start_s
    cars = fleet.cars[fleet.cars["slot"] >= 0]
    came, left = cars["ended_at"] - midnight, cars["ended_at"] + cars["stay_s"] - midnight
    slot = np.concatenate([cars["slot"], cars["slot"]]).astype(np.int64)
    second = np.ceil(np.concatenate([came, left])).astype(np.float64)
    change = np.repeat([1, -1], len(cars))
    # A car that leaves makes room before another one comes.
    order = np.lexsort((change, second, slot))
    slot, second, change = slot[order], second[order], change[order]
    begin, end = int(window.start_s), int(window.end_s)
    first: NDArray[np.int64] = np.searchsorted(slot, np.arange(lot.n_slots + 1))
    for number in range(lot.n_slots):
        rows = slice(first[number], first[number + 1])
        times, cars_there = second[rows], np.cumsum(change[rows])
        full = cars_there >= lot.capacity[number]
        at_begin = np.searchsorted(times, begin, side="right")
        state = bool(full[at_begin - 1]) if at_begin else False
        yield number, begin, state
        last = begin
        for moment, now in zip(times[at_begin:].tolist(), full[at_begin:].tolist(), strict=True):
            if moment >= end:
                break
            if now != state:
                if moment - _BEFORE_S > last:
                    yield number, int(moment) - _BEFORE_S, state
                yield number, int(moment), now
                state, last = now, int(moment)
        if last < end - 1:
            yield number, end - 1, state
