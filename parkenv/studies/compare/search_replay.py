"""Record searches step by step for the replay of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from parkenv.engine.state import SearchState
from parkenv.show.scene import LotScene
from parkenv.studies.compare.cases import Case
from parkenv.studies.report import AGREES_S, MOST_SLOTS, Again, Recording, ReportOptions
from parkenv.studies.results import EPISODES
from parkenv.studies.simulate import EpisodeResult, Observer, Step
from parkenv.world.cost_terms import COST_FIELDS
from parkenv.world.occupancy.process import World
from planners.agent import Agent

STEADY_S = 600.0
"""Time, s, up to which the true occupancy is recorded every second; later it is recorded only at decisions."""
FULL = 255
"""Recorded value of a belief of 1."""
SEARCHES, SENSED = 20, 4
"""Default number of replayed searches: in general, and with rendered sensors at every step."""


class Encounter(NamedTuple):
    """Several agents in the same world.

    Attributes:
        cases: one case per agent, all in one setting.
        seed: seed of the world.
    """

    cases: tuple[Case, ...]
    seed: int


class SearchReplay(NamedTuple):
    """The searches of a run.

    Attributes:
        cases: cases, each with the seeds of its searches.
        folder: folder of the run; totals are compared with those in `episodes.csv`, if it is there.
    """

    cases: Sequence[tuple[Case, Sequence[int]]]
    folder: Path

    def again(self, options: ReportOptions) -> Again:
        """See `Replay`; lots with too many slots are left out."""
        agents = options.chosen_agents([case.label for case, _ in self.cases])
        cases = [(case, seeds) for case, seeds in self.cases if case.label in agents]
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
        count = options.episodes
        if count is None:
            count = SENSED if any(case.rig is not None for case, _ in self.cases) else SEARCHES
        encounters = choose(drawn, count) if count else []
        totals = (
            {EPISODES.key(row): row["total_s"] for row in EPISODES.read(self.folder)} if encounters else {}
        )
        tasks = []
        for encounter in encounters:
            keys = [case.key(encounter.seed) for case in encounter.cases]
            tasks.append(partial(record, encounter, {key: totals[key] for key in keys if key in totals}))
        return Again(tasks, notes)


def choose(cases: Sequence[tuple[Case, Sequence[int]]], episodes: int) -> list[Encounter]:
    """Choose the first searches of each setting in turn, up to a total number; at least one world.

    Args:
        cases: cases, each with the seeds of its searches.
        episodes: number of searches to choose.
    """
    settings: dict[tuple[Any, ...], list[tuple[Case, Sequence[int]]]] = {}
    for case, seeds in cases:
        setting = tuple(v for k, v in case.columns.items() if k != "agent")
        settings.setdefault(setting, []).append((case, seeds))
    chosen: list[Encounter] = []
    count = 0
    for number in range(max((len(seeds) for _, seeds in cases), default=0)):
        for its in settings.values():
            present = tuple(case for case, seeds in its if number < len(seeds))
            if not present or (chosen and count + len(present) > episodes):
                continue
            chosen.append(Encounter(present, its[0][1][number]))
            count += len(present)
    return chosen


def record(encounter: Encounter, counted: Mapping[tuple[Any, ...], float]) -> Recording:
    """Repeat the searches of all agents of an encounter, and record them.

    Args:
        encounter: the agents and their world.
        counted: total time, s, of each search in the original run, by `Case.key`; the totals of missing searches are
            not checked.
    """
    searches, moments = [], {0.0}
    state: SearchState | None = None
    for case in encounter.cases:
        runner = case.runner()
        recorder = SearchRecorder(case.label, runner.agent)
        runner.run(encounter.seed, (recorder,))
        state, search = recorder.state, recorder.recording
        before = counted.get(case.key(encounter.seed))
        search["counted_s"] = before
        search["agrees"] = None if before is None else abs(before - search["total_s"]) <= AGREES_S
        searches.append(search)
        moments |= {centiseconds / 100.0 for centiseconds in search["t"]}
    assert state is not None
    first = encounter.cases[0]
    scenario, start = first.scenario, state.arrival.time
    longest = max(moments)
    moments |= set(np.arange(0.0, min(longest, STEADY_S), 1.0).tolist())
    world = {
        "scenario": scenario.name,
        "setting": {k: v for k, v in first.columns.items() if k != "agent"},
        "seed": encounter.seed,
        "day": state.arrival.day,
        "arrival_s": round(start, 3),
        "goal": scenario.goal,
        "view_range_m": round(float(scenario.sensor_model.view_range), 2),
        "v_walk": round(float(scenario.v_walk), 4),
        "sensors": first.rig,
        "forecast": _bytes(state.belief.forecast),
        **_truth(state.world, scenario.lot.n_slots, start, sorted(moments)),
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


class SearchRecorder(Observer):
    """Records a search for the report: times in centiseconds since the arrival, beliefs in steps of 1/255.

    Args:
        name: name of the agent.
        agent: the agent; its plans are recorded if it has `plan_preview`.

    Attributes:
        state: state of the environment, including the hidden occupancy.
        recording: recording of the finished search.
    """

    state: SearchState
    recording: Recording

    def __init__(self, name: str, agent: Agent) -> None:
        self._name = name
        self._preview_of = getattr(agent, "plan_preview", None)

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        """Record the arrival."""
        del observation
        self.state = env.unwrapped.state  # type: ignore[attr-defined]
        belief = self.state.belief
        self._known = np.array(_bytes(belief.forecast))
        self._seen = np.zeros(len(self._known), dtype=np.bool_)
        self._plan = [-1]
        self._vertex = self.state.vertex
        self._rows: dict[str, list[Any]] = {
            name: [] for name in ("t", "vertex", "failed", "belief", "seen", "action", "plan")
        }
        self._record_state(failed_s=0.0)

    def on_step(self, step: Step) -> None:
        """Record the decision, the plan that led to it, and the next state."""
        plan: list[int] = []
        if self._preview_of is not None:
            plan = list(self._preview_of(step.observation, int(step.action), step.memory).path)
        # Most plans are the remainder of the previous one; those are stored as None.
        self._rows["plan"].append(None if plan == self._plan[1:] else plan)
        self._rows["action"].append(int(step.action))
        self._plan = plan if self.state.vertex != self._vertex else [-1, *plan]
        self._vertex = self.state.vertex
        self._record_state(step.info["failed_s"])

    def on_end(self, result: EpisodeResult) -> None:
        """Add the metrics."""
        info, parked = result.info, bool(result.info["parked"])
        self.recording = {
            "agent": self._name,
            **self._rows,
            "parked": parked,
            "slot": self.state.vertex if parked else None,
            "truncated": result.truncated,
            "total_s": info["total_s"],
            "costs": {name: info[name] for name in COST_FIELDS},
            "failed_parks": int(info["failed_parks"]),
            "replans": int(getattr(result.memory, "replans", 0)),
        }

    def _record_state(self, failed_s: float) -> None:
        state, rows = self.state, self._rows
        belief = state.belief
        now = np.array(_bytes(belief.p_occupied))
        changed = np.flatnonzero(now != self._known)
        rows["t"].append(round(100 * (state.time - state.arrival.time)))
        rows["vertex"].append(state.vertex)
        rows["failed"].append(round(100 * failed_s))
        rows["belief"].append(np.stack([changed, now[changed]], axis=1).ravel().tolist())
        rows["seen"].append(np.flatnonzero(belief.observed & ~self._seen).tolist())
        self._known, self._seen = now, self._seen | belief.observed


def _bytes(p: NDArray[np.floating]) -> list[int]:
    whole: list[int] = np.round(FULL * np.asarray(p, dtype=np.float64)).astype(np.int64).tolist()
    return whole
