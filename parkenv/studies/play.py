"""Games: a person searches in the worlds of the agents, on a page that holds these worlds."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from parkenv import __version__
from parkenv.compiled.keyed_random import world_key
from parkenv.errors import InputError
from parkenv.show.report.page import terms_data
from parkenv.show.scene import LotScene
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.cases import Case, require_distinct
from parkenv.studies.report import AGREES_S, MOST_SLOTS
from parkenv.studies.simulate import STEP_LIMIT, Observer, Step
from parkenv.studies.study import Progress
from parkenv.world.occupancy.process import World
from parkenv.world.scenario import Scenario

Data = dict[str, Any]


def game_data(
    scenario: Scenario,
    agents: Sequence[AgentSpec],
    seeds: Sequence[int],
    progress: Progress = lambda *_: None,
) -> Data:
    """Return the data of a game's page: the search problem, and each world with the agents' searches in it.

    Numbers that decide what a search costs are float64, so that the page's search equals `parkenv/Search-v2`.

    Args:
        scenario: the scenario.
        agents: whom the person is compared with.
        seeds: seeds of the worlds.
        progress: called as worlds are finished.

    Raises:
        InputError: the lot is too large to draw, two agents are called the same, or a world cannot be made.
    """
    if scenario.lot.n_slots > MOST_SLOTS:
        raise InputError(f"{scenario.name} has {scenario.lot.n_slots} slots, want at most {MOST_SLOTS}")
    cases = [Case(scenario, agent.name, options=agent.options) for agent in agents]
    require_distinct(cases)
    runners, worlds = [case.runner() for case in cases], list[Data]()
    for seed in seeds:
        progress("Searching", len(worlds), len(seeds))
        drives = [_Actions() for _ in runners]
        first, *_ = [runner.run(seed, [its]) for runner, its in zip(runners, drives, strict=True)]
        forecast, start = scenario.forecast(first.arrival), first.arrival.time
        worlds.append(
            {
                "seed": seed,
                "day": first.arrival.day,
                "key": str(world_key(seed, 0)),
                "arrival_s": start,
                "entry": first.path[0],
                "forecast": _floats(forecast.p_occupied),
                "decay_rate": _floats(forecast.decay_rate),
                "taken": np.flatnonzero(first.occupied).tolist(),
                "changes": _changes(first.world, scenario.lot.n_slots, start, start + _longest_s(scenario)),
                "bound_s": first.bound_s,
                "actions": [its.taken for its in drives],
            }
        )
    problem = _problem(scenario) | {"agents": [case.label for case in cases]}
    return {"problem": problem, "parkenv": __version__, "terms": terms_data(), "worlds": worlds}


class _Actions(Observer):
    """Collects the actions of a search, a digit each; the page takes them again for its replay."""

    taken = ""

    def on_step(self, step: Step) -> None:
        """Add an action."""
        self.taken += str(int(step.action))


def _problem(scenario: Scenario) -> Data:
    """Return what does not differ between worlds, known to every driver."""
    (starts, viewed), rates = scenario.slots_in_view, scenario.sensor_rates
    exact = scenario.sensor_model.perfect
    return {
        "scenario": scenario.name,
        "lot": LotScene.of(scenario.lot).data(),
        "goal": scenario.goal,
        "view_range_m": float(scenario.sensor_model.view_range),
        "targets": scenario.lot.neighbors.ravel().tolist(),
        "seconds": _floats(scenario.edges["seconds"]),
        "walk_s": _floats(scenario.walk_s),
        "parking_cost_s": _floats(scenario.parking_cost_s),
        **{name: float(getattr(scenario, name)) for name in ("failure_s", "give_up_s")},
        "step_limit": STEP_LIMIT,
        "view_starts": starts.tolist(),
        "viewed": viewed.tolist(),
        "rates": None if exact else [_floats(rate) for rate in rates],
        # Half the width of the 95 % interval of a mean of n + 2 values, in standard errors.
        "t95": np.round(stats.t.ppf(0.975, np.arange(1, 100)), 4).tolist(),
    }


def _longest_s(scenario: Scenario) -> float:
    """Return a bound on the time of a search, s."""
    return STEP_LIMIT * float(max(scenario.edges["seconds"].max(), scenario.failure_s))


def _changes(world: World, n_slots: int, begin: float, end: float) -> Data:
    """Return when the state of each slot changes: the times, s, slot after slot, and how many each slot has."""
    changes = [_changes_of(world, slot, begin, end) for slot in range(n_slots)]
    return {"times": _floats(np.concatenate(changes)), "counts": [len(times) for times in changes]}


def _changes_of(world: World, slot: int, begin: float, end: float) -> list[float]:
    """Return the times in (begin, end] at which a slot changes, s: each is the first float64 of the new state."""
    slots, times = np.array([slot]), list[float]()
    taken = bool(world.occupied(slots, begin)[0])
    while (begin := float(world.next_change(slots, begin, end)[0])) <= end:
        # One car may follow another at once.
        if bool(world.occupied(slots, begin)[0]) != taken:
            times.append(begin)
            taken = not taken
    return times


def _floats(values: ArrayLike) -> str:
    """Return numbers as the base64 text of little-endian float64."""
    return base64.b64encode(np.asarray(values, "<f8").tobytes()).decode()


def require_same_worlds(case: Case, seeds: Sequence[int]) -> None:
    """Check that a person's searches take as long here as on the page that recorded them.

    Args:
        case: an agent `human:FILE` in a scenario.
        seeds: seeds of the worlds that it is to search.

    Raises:
        InputError: the page has no search for a seed, or it takes another time here: costs or worlds differ.
    """
    runner = case.runner()
    played: dict[int, float] = runner.agent.totals  # type: ignore[attr-defined]
    if missing := [seed for seed in seeds if seed not in played]:
        raise InputError(
            f"{case.agent} has worlds {_ranges(played)}, not {missing[0]}; want --seed and --episodes of the game"
        )
    for seed in seeds:
        total_s = float(runner.run(seed).metrics["total_s"])
        if abs(total_s - played[seed]) > AGREES_S:
            raise InputError(
                f"{case.agent}: in world {seed} total_s is {played[seed]:.6f}, want {total_s:.6f} as the actions take "
                f"in {case.scenario.name} here; the game had other worlds or costs"
            )


def _ranges(seeds: Sequence[int] | dict[int, float]) -> str:
    ordered = sorted(seeds)
    return f"{ordered[0]} to {ordered[-1]}" if len(ordered) == ordered[-1] - ordered[0] + 1 else f"{ordered}"
