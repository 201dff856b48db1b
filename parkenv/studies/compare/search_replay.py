"""The searches of a run, run again for the replay of its page."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.engine.search_record import SearchRecord
from parkenv.show.scene import LotScene
from parkenv.studies.compare.cases import Case
from parkenv.studies.results import EPISODES
from parkenv.studies.study import AGREES_S, MOST_SLOTS, Recording, ReplayJob, ReportOptions
from parkenv.world.cost_terms import COST_FIELDS
from parkenv.world.occupancy.process import World

# Time, s, up to which the true occupancy is recorded every second; later it is recorded only at decisions.
STEADY_S = 600.0
FULL = 255  # recorded value of a belief of 1
# Default number of replayed searches: in general, and with rendered sensors at every step.
SEARCHES, SENSED = 20, 4


class Encounter(NamedTuple):
    cases: tuple[Case, ...]  # one per agent, all in one setting
    seed: int


def search_replay(
    cases: Sequence[tuple[Case, Sequence[int]]], folder: Path, options: ReportOptions
) -> ReplayJob:
    """Return the searches to run again, to compare their totals with those of the run in the folder, if it is there.

    Lots with too many slots are left out.
    """
    agents = options.chosen_agents([case.label for case, _ in cases])
    count = options.episodes
    if count is None:
        count = SENSED if any(case.rig is not None for case, _ in cases) else SEARCHES
    cases = [(case, seeds) for case, seeds in cases if case.label in agents]
    wanted = options.chosen_numbers(cases[0][1] if cases else ())
    lots = {case.scenario.name: case.scenario.lot.n_slots for case, _ in cases}
    notes = [
        f"{name} has {n} slots, more than the {MOST_SLOTS} that are drawn: no replay"
        for name, n in lots.items()
        if n > MOST_SLOTS
    ]
    drawn = [
        (case, seeds if wanted is None else wanted)
        for case, seeds in cases
        if case.scenario.lot.n_slots <= MOST_SLOTS
    ]
    encounters = choose(drawn, count) if count else []
    totals = {EPISODES.key(row): row["total_s"] for row in EPISODES.read(folder)} if encounters else {}
    tasks = []
    for encounter in encounters:
        keys = [case.key(encounter.seed) for case in encounter.cases]
        tasks.append(partial(replay, encounter, {key: totals[key] for key in keys if key in totals}))
    return ReplayJob(tasks, notes)


def choose(cases: Sequence[tuple[Case, Sequence[int]]], episodes: int) -> list[Encounter]:
    """Choose the first searches of each setting in turn, up to a total number; at least one world."""
    settings: dict[tuple[Any, ...], list[tuple[Case, Sequence[int]]]] = {}
    for case, seeds in cases:
        setting = tuple(v for k, v in case.columns.items() if k != "agent")
        settings.setdefault(setting, []).append((case, seeds))
    chosen: list[Encounter] = []
    count = 0
    for number in range(max((len(seeds) for _, seeds in cases), default=0)):
        for in_setting in settings.values():
            present = tuple(case for case, seeds in in_setting if number < len(seeds))
            if present and (not chosen or count + len(present) <= episodes):
                chosen.append(Encounter(present, in_setting[0][1][number]))
                count += len(present)
    return chosen


def replay(encounter: Encounter, counted: Mapping[tuple[Any, ...], float]) -> Recording:
    """Repeat the searches of all agents of an encounter, and record them beside the totals of `episodes.csv`."""
    first, scenario = encounter.cases[0], encounter.cases[0].scenario
    searches, moments = [], {0.0}
    for case in encounter.cases:
        record = case.runner().run(encounter.seed, moments=True)
        search = recorded(record)
        before = counted.get(case.key(encounter.seed))
        search["counted_s"] = before
        search["agrees"] = None if before is None else abs(before - search["total_s"]) <= AGREES_S
        searches.append(search)
        moments |= {centiseconds / 100.0 for centiseconds in search["t"]}
    start = record.arrival.time
    moments |= set(np.arange(0.0, min(max(moments), STEADY_S), 1.0).tolist())
    world = {
        "scenario": scenario.name,
        "setting": {k: v for k, v in first.columns.items() if k != "agent"},
        "seed": encounter.seed,
        "day": record.arrival.day,
        "arrival_s": round(start, 3),
        "goal": scenario.goal,
        "view_range_m": round(float(scenario.sensor_model.view_range), 2),
        "v_walk": round(float(scenario.v_walk), 4),
        "sensors": first.rig,
        "forecast": _bytes(record.forecast),
        **_truth(record.world, scenario.lot.n_slots, start, sorted(moments)),
        "searches": searches,
    }
    differences = [
        f"{search['agent']}, {scenario.name}, seed {encounter.seed}: run again it took {search['total_s']:.2f} s, "
        f"episodes.csv says {search['counted_s']:.2f} s"
        for search in searches
        if search["agrees"] is False
    ]
    return {"lot": LotScene.of(scenario.lot).data(), "world": world, "differences": differences}


def _truth(world: World, n_slots: int, start: float, moments: Sequence[float]) -> Recording:
    """Record the occupancy at the arrival and its changes: [centiseconds, slot, ...]."""
    everything = np.arange(n_slots)
    taken = world.occupied(everything, start)
    first, changes = taken, []
    for moment in moments[1:]:
        now = world.occupied(everything, start + moment)
        if flipped := np.flatnonzero(now != taken).tolist():
            changes.append([round(100 * moment), *flipped])
        taken = now
    return {"taken": np.flatnonzero(first).tolist(), "changes": changes}


def recorded(record: SearchRecord) -> Recording:
    """Return a search in the data of a page: times in centiseconds since the arrival, beliefs in steps of 1/255."""
    rows: dict[str, list[Any]] = {
        name: [] for name in ("t", "vertex", "failed", "belief", "seen", "action", "plan")
    }
    known = np.array(_bytes(record.forecast))
    seen, left = np.zeros(len(known), dtype=np.bool_), [-1]
    before = record.moments[0].vertex
    for number, moment in enumerate(record.moments):
        now = np.array(_bytes(moment.belief.p_occupied))
        changed = np.flatnonzero(now != known)
        rows["t"].append(round(100 * (moment.time - record.arrival.time)))
        rows["vertex"].append(moment.vertex)
        rows["failed"].append(round(100 * moment.info.get("failed_s", 0.0)))
        rows["belief"].append(np.stack([changed, now[changed]], axis=1).ravel().tolist())
        rows["seen"].append(np.flatnonzero(moment.belief.observed & ~seen).tolist())
        known, seen = now, seen | moment.belief.observed
        if number:
            rows["action"].append(moment.action)
            plan = list(moment.plan)
            # Most plans are the remainder of the previous one; those are stored as None.
            rows["plan"].append(None if plan == left[1:] else plan)
            left = plan if moment.vertex != before else [-1, *plan]
        before = moment.vertex
    metrics, parked = record.metrics, bool(record.metrics["parked"])
    return {
        "agent": record.agent,
        **rows,
        "parked": parked,
        "slot": record.path[-1] if parked else None,
        "truncated": record.truncated,
        "total_s": metrics["total_s"],
        "costs": {name: metrics[name] for name in COST_FIELDS},
        "failed_parks": int(metrics["failed_parks"]),
        "replans": metrics["replans"],
    }


def _bytes(p: NDArray[np.floating]) -> list[int]:
    whole: list[int] = np.round(FULL * np.asarray(p, dtype=np.float64)).astype(np.int64).tolist()
    return whole
