"""Games: a person searches in the worlds of the agents, on a page that holds these worlds."""

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from parkenv.compiled.keyed_random import world_key
from parkenv.errors import require
from parkenv.show.report.page import terms_data
from parkenv.show.scene import LotScene
from parkenv.studies.compare.cases import Case, require_distinct
from parkenv.studies.fields import AgentSpec
from parkenv.studies.simulate import STEP_LIMIT, Observer, Step
from parkenv.studies.study import AGREES_S, MOST_SLOTS, Progress
from parkenv.world.occupancy.process import World
from parkenv.world.scenario import Scenario


class _Actions(Observer):
    taken = ""

    def on_step(self, step: Step) -> None:
        self.taken += str(int(step.action))


def game_data(
    scenario: Scenario,
    agents: Sequence[AgentSpec],
    seeds: Sequence[int],
    progress: Progress = lambda *_: None,
) -> dict[str, Any]:
    """Return the data of a game's page: the search problem, and a world for each seed with the agents' actions in it.

    What decides the cost of a search is written as float64, so that the page's search equals `parkenv/Search-v2`.
    """
    lot, actions_s = scenario.lot, scenario.edges["seconds"]
    require(lot.n_slots <= MOST_SLOTS, f"{scenario.name} has {lot.n_slots} slots, want at most {MOST_SLOTS}")
    cases = [Case(scenario, agent.name, options=agent.options) for agent in agents]
    require_distinct(cases)
    runners, worlds = [case.runner() for case in cases], list[dict[str, Any]]()
    longest_s = STEP_LIMIT * float(max(actions_s.max(), scenario.failure_s))
    for seed in seeds:
        progress("Searching", len(worlds), len(seeds))
        drives = [_Actions() for _ in runners]
        record, *_ = [runner.run(seed, [drive]) for runner, drive in zip(runners, drives, strict=True)]
        forecast, begin = scenario.forecast(record.arrival), record.arrival.time
        changes = [_changes(record.world, slot, begin, begin + longest_s) for slot in range(lot.n_slots)]
        world = {
            "seed": seed,
            "key": str(world_key(seed, 0)),
            "day": record.arrival.day,
            "arrival_s": begin,
            "entry": record.path[0],
            "forecast": _floats(forecast.p_occupied),
            "decay_rate": _floats(forecast.decay_rate),
            "taken": np.flatnonzero(record.occupied).tolist(),
            "changes": {"times": _floats(np.concatenate(changes)), "counts": [*map(len, changes)]},
            "bound_s": record.bound_s,
            "actions": [drive.taken for drive in drives],
        }
        worlds.append(world)
    starts, viewed = scenario.slots_in_view
    problem = {
        "scenario": scenario.name,
        "agents": [case.label for case in cases],
        "lot": LotScene.of(lot).data(),
        "goal": scenario.goal,
        "targets": lot.neighbors.ravel().tolist(),
        "seconds": _floats(actions_s),
        **{name: _floats(getattr(scenario, name)) for name in ("walk_s", "parking_cost_s")},
        **{name: float(getattr(scenario, name)) for name in ("failure_s", "give_up_s")},
        "step_limit": STEP_LIMIT,
        "view_range_m": float(scenario.sensor_model.view_range),
        "view_starts": starts.tolist(),
        "viewed": viewed.tolist(),
        "rates": None if scenario.sensor_model.perfect else [*map(_floats, scenario.sensor_rates)],
        # Half the width of the 95 % interval of the mean of 2, 3, ... values, in standard errors.
        "t95": np.round(stats.t.ppf(0.975, np.arange(1, 100)), 4).tolist(),
    }
    return {"terms": terms_data(), "problem": problem, "worlds": worlds}


def _changes(world: World, slot: int, begin: float, end: float) -> list[float]:
    """Return the times in (begin, end] at which a slot changes, s: each is the first float64 of the new state."""
    times, taken = list[float](), bool(world.occupied([slot], begin)[0])
    while (begin := float(world.next_change([slot], begin, end)[0])) <= end:
        # One car may follow another at once.
        if bool(world.occupied([slot], begin)[0]) != taken:
            times.append(begin)
            taken = not taken
    return times


def _floats(values: ArrayLike) -> str:
    return base64.b64encode(np.asarray(values, "<f8").tobytes()).decode()


def require_same_worlds(case: Case, seeds: Sequence[int]) -> None:
    """Check that the searches of an agent `human:FILE` take as long here as on the page that recorded them."""
    runner = case.runner()
    played: dict[int, float] = runner.agent.totals  # type: ignore[attr-defined]
    for seed in seeds:
        require(
            seed in played,
            f"{case.agent} has no world of seed {seed}, want --seed {min(played)} and --episodes {len(played)}",
        )
        total_s = float(runner.run(seed).metrics["total_s"])
        require(
            abs(total_s - played[seed]) <= AGREES_S,
            f"{case.agent}: total_s is {played[seed]:.6f}, want {total_s:.6f}, which the actions of seed {seed} "
            f"take in {case.scenario.name} here: the game had other worlds or costs",
        )
