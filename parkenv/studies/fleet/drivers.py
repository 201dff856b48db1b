"""Agents that drive the cars of a fleet, its demand, and its days as a log that single searches replay."""

import csv
import gzip
from collections.abc import Iterator, Mapping
from datetime import datetime, timedelta
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.policy import CompiledPolicy
from parkenv.errors import InputError, require
from parkenv.files.atomic_write import atomic_write
from parkenv.files.known_names import SAME_SLOTS
from parkenv.scenarios.build import build
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.setting import COUNTED, GIVEN, times_demanded
from parkenv.studies.study import Progress
from parkenv.world.demand import (
    ConstantTime,
    Demand,
    ExponentialTime,
    FollowingArrivals,
    PoissonArrivals,
    TownDemand,
    weights_of_all,
)
from parkenv.world.scenario import Drivers, Scenario
from parkenv.world.week import HOUR_S
from planners.agent import ClairvoyantAgent, make_agent
from planners.heuristics import POLICIES
from planners.heuristics.agents import TargetAgent
from planners.model_file import LearnedAgent
from planners.names import EXPECTS_RIVALS


def policy_of(
    spec: AgentSpec, scenario: Scenario, arrivals_per_hour: float | str | None = None
) -> tuple[CompiledPolicy | None, Any]:
    """Return the compiled policy of an agent, or else the agent itself, which decides in Python.

    Heuristics are compiled. An agent that expects rivals gets how many cars arrive in an hour, if that is a number, as
    by a forecast of traffic.
    """
    if not spec.options and spec.name in POLICIES:
        return POLICIES[spec.name], None
    expects = spec.name == EXPECTS_RIVALS and not isinstance(arrivals_per_hour, str | None)
    known = {"arrivals_per_hour": arrivals_per_hour} if expects else {}
    agent = make_agent(spec.name, scenario, **known | spec.options)
    if spec.name in POLICIES and isinstance(agent, TargetAgent):
        return agent.compiled_policy(), None
    require(
        not isinstance(agent, ClairvoyantAgent),
        f"agent {spec.label!r} knows the future of single searches, and drives no fleet",
    )
    if isinstance(agent, LearnedAgent) or not scenario.has_rules:
        return None, agent  # learned agents observe costs themselves
    return None, AgentsByStay(spec, scenario, known)


def compiled_policy_of(spec: AgentSpec, scenario: Scenario) -> CompiledPolicy:
    policy, _ = policy_of(spec, scenario)
    if policy is None:
        raise InputError(f"--agents is {spec.label!r}, want a compiled one, such as usual")
    return policy


class AgentsByStay:
    def __init__(self, spec: AgentSpec, scenario: Scenario, known: Mapping[str, Any]) -> None:
        self._spec, self._scenario, self._options = spec, scenario, {**known, **spec.options}

    def predict(self, observation: Any, state: Any = None) -> tuple[Any, Any]:
        if state is None:  # the car's first decision
            *driver, walks = observation["driver"]
            own = self._scenario.of_driver(Drivers(*driver), walks)
            state = make_agent(self._spec.name, own, **self._options), None
        agent, memory = state
        action, memory = agent.predict(observation, memory)
        return action, (agent, memory)


def demand_in(
    scenario: Scenario, per_hour: float | str, stay_s: float, patience_s: float
) -> Demand | TownDemand:
    """Return the demand of a number of cars an hour, see `rate_of`, in the hours of a scenario.

    A number is the mean over the hours of all purposes that a scenario has. Without a demand of its own, stays, s, are
    exponential; in a lot with weights, cars choose entries and goals by these, else they go to the scenario's goal.
    """
    window, own = scenario.arrival, scenario.demand
    require(
        window.end_s > window.start_s,
        f"the arrivals of {scenario.name!r} are at one time, want hours in which cars arrive; "
        "set --hours, e.g. 08:00-12:00",
    )
    require(
        own is not None or per_hour != GIVEN,
        f"scenario {scenario.name!r} has no demand of its own, want cars an hour",
    )
    if own is not None and per_hour != COUNTED:
        if isinstance(per_hour, str):
            return own.scaled(times_demanded(per_hour))
        return own.scaled(per_hour * (window.end_s - window.start_s) / HOUR_S / own.expected)
    stay = ExponentialTime(stay_s)
    arrivals: PoissonArrivals | FollowingArrivals
    if isinstance(per_hour, str):
        arrivals = FollowingArrivals(scenario.occupancy, window, stay, times_demanded(per_hour))
    else:
        arrivals = PoissonArrivals(per_hour, window.start_s, window.end_s)
    entries = weights_of_all(scenario.lot.entry_weights) if scenario.entry is None else ()
    goals = weights_of_all(scenario.lot.goal_weights)
    return Demand(arrivals, stay, ConstantTime(patience_s), entry_weights=entries, goal_weights=goals)


# Days of a fleet have no date; in a log the first is in this week, the next one a week later.
FIRST_MONDAY = datetime(2024, 1, 1)
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

    A counted facility is taken while it is full. Of the rounds of days the last one is recorded: drivers expect a
    typical week in the first, and then what the days of the round before were like.
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
    # Slot, second of the day and whether it is taken, by slot and time, of a day whose searches are over.
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
