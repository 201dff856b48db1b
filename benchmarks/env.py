"""Benchmark of environment steps against peers."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.rows import Row, absent, medians, rate
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.lots import city_lot, grid_lot
from parkenv.scenarios.build import ScenarioSources, make_scenario
from parkenv.world.lot import ACTIONS, PARK, ParkingLot
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.typical_week import typical_occupancy
from parkenv.world.scenario import Scenario

BATCH = 1024
SLOTS = (10, 20)
LARGE = 10_000
NEAREST = 5
PLACES, SIZES = 100, ((2, 16), (6, 34))
"""Places of the batch with many, and the bounds of their rows and columns of slots."""
_BLOCK = 200
_DRAWN = 100
_DRIVE_STEPS = 60

Stepper = Callable[[], int]  # runs some steps and returns their number


def env_rows(
    seed: int = 0, seconds: float = 0.6, *, batch: int = BATCH, large: int = LARGE, places: int = PLACES
) -> list[Row]:
    """Return the rows of `python benchmarks/run.py env`, on one core, with random actions.

    A step is a full `step()` of one environment, alone or in a batch, including observations, infos and automatic
    resets. Actions are drawn beforehand. Gymnasium's CartPole batch is numpy on four numbers per environment, without
    a world to simulate or a belief to maintain.

    Days that differ from their forecast are compared with days that do not, in the same run. These batches drive
    without parking, 60 steps an episode: otherwise searches would be longer on full days, and remember more slots.

    Many places are grids of slots of different sizes, made by rule, of which every episode draws one; their peer is one
    grid of the same mean size.

    Environments take turns. The value of each is the median over its turns, in CPU seconds of this process, so that
    other load on the machine affects all equally.

    Args:
        seed: seed of worlds and actions.
        seconds: duration of each measurement.
        batch: number of searches in a batch.
        large: number of slots of the large lot.
        places: number of lots of the batch that changes place.
    """
    import parkenv  # noqa: F401 - registers the environments

    scenario = make_scenario(grid_lot(*SLOTS))
    days = scenario.replace(occupancy=typical_occupancy(scenario.lot).with_day_error(DayError(0.8)))
    city = make_scenario(city_lot(large, seed))
    slots = f"batch of {batch}, {scenario.lot.n_slots} slots"
    batches = {
        f"{slots}, full belief, copy=False": _ours(scenario, batch, "full", False),
        f"{slots}, full belief": _ours(scenario, batch, "full"),
        f"{slots}, p_occupied alone": _ours(scenario, batch, "occupancy"),
        f"{slots}, local k={NEAREST}": _ours(scenario, batch, "local"),
        f"batch of {batch}, {city.lot.n_slots:,} slots, local k={NEAREST}": _ours(city, batch, "local"),
    }
    lots = grids(places, seed)
    mean = round(float(np.mean([lot.n_slots for lot in lots])))
    changing = _ours([make_scenario(lot, day_error=0.8) for lot in lots], batch, "local")
    staying = _ours(make_scenario(grid_lot(8, mean // 8), day_error=0.8), batch, "local")
    cart_pole = gym.make_vec("CartPole-v1", batch, vectorization_mode="vector_entry_point")
    steppers = {case: batch_stepper(envs, len(ACTIONS), seed) for case, envs in batches.items()}
    steppers |= {"CartPole batch": batch_stepper(cart_pole, 2, seed)}
    steppers |= {
        "batch with days": batch_stepper(_driving(days, batch), PARK, seed),
        "batch of places": batch_stepper(changing, len(ACTIONS), seed),
        "batch of one place": batch_stepper(staying, len(ACTIONS), seed),
        "batch without days": batch_stepper(_driving(scenario, batch), PARK, seed),
        "Search-v2": single_stepper(gym.make("parkenv/Search-v2", scenario=scenario), seed),
        "Search-v2 with days": single_stepper(gym.make("parkenv/Search-v2", scenario=days), seed),
        "CartPole": single_stepper(gym.make("CartPole-v1"), seed),
    }
    others, missing = installed_peers(batch, seed)
    rates = measured(steppers | others, seconds)
    peers = {"gymnasium CartPole-v1 batch": rates["CartPole batch"]}
    rows: list[Row] = []
    for case in batches:
        rows += rate("batch", case, rates[case], "steps/s", **peers)
    single = {"gymnasium CartPole-v1": rates["CartPole"]} | {name: rates[name] for name in others}
    rows += rate(
        "single", f"Search-v2, {scenario.lot.n_slots} slots", rates["Search-v2"], "steps/s", **single
    )
    for part, name, without in (
        ("batch", "batch with days", "batch without days"),
        ("single", "Search-v2 with days", "Search-v2"),
    ):
        peer = {"the same without": rates[without]}
        rows += rate(part, f"{name}, day error 0.8", rates[name], "steps/s", **peer)
    case = f"batch of {batch}, {places} places of {mean} slots on average, local k={NEAREST}"
    rows += rate(
        "batch", case, rates["batch of places"], "steps/s", **{"one place": rates["batch of one place"]}
    )
    for name in missing:
        rows += absent("single", f"{name}: not installed", "steps/s")
    for case, envs in batches.items():
        rows += rate("memory", case, envs.observer.n_bytes / envs.num_envs / 1024, "KiB an environment")
    case = f"batch of {batch}, {places} places"
    rows += rate("memory", f"{case}, tables of the places", changing.table_bytes / 2**20, "MiB")
    rows += rate("memory", f"{case}, tables and environments", changing.memory_bytes / 2**20, "MiB")
    return rows


def grids(n: int, seed: int) -> list[ParkingLot]:
    """Make grids of slots with different numbers of rows and columns."""
    rng = np.random.default_rng(seed)
    rows, columns = (rng.integers(*bounds, n) for bounds in SIZES)
    return [grid_lot(int(r), int(c)) for r, c in zip(rows, columns, strict=True)]


def _ours(scenario: ScenarioSources, batch: int, observation: str, copy: bool = True) -> ParkSearchVectorEnv:
    k = NEAREST if observation == "local" else None
    return ParkSearchVectorEnv(batch, scenario, observation=observation, k=k, copy=copy)


def _driving(scenario: Scenario, batch: int) -> ParkSearchVectorEnv:
    return ParkSearchVectorEnv(batch, scenario, copy=False, max_episode_steps=_DRIVE_STEPS)


def batch_stepper(envs: gym.vector.VectorEnv[Any, Any, Any], n_actions: int, seed: int) -> Stepper:
    """Make a stepper for a batch with random actions."""
    actions = np.random.default_rng(seed).integers(0, n_actions, (_DRAWN, envs.num_envs))
    envs.reset(seed=seed)

    def step() -> int:
        for i in range(_BLOCK):
            envs.step(actions[i % _DRAWN])
        return _BLOCK * envs.num_envs

    return step


def single_stepper(env: gym.Env[Any, Any], seed: int) -> Stepper:
    """Make a stepper for one environment with random actions and a reset after each episode."""
    env.action_space.seed(seed)
    actions = [env.action_space.sample() for _ in range(10 * _BLOCK)]
    env.reset(seed=seed)

    def step() -> int:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return len(actions)

    return step


def installed_peers(batch: int, seed: int) -> tuple[dict[str, Stepper], list[str]]:
    """Return steppers of installed peers, and the names of missing peers."""
    found: dict[str, Stepper] = {}
    missing: list[str] = []
    for package, env_id in (("highway_env", "parking-v0"), ("minigrid", "MiniGrid-Empty-8x8-v0")):
        if find_spec(package) is None:
            missing.append(f"{package} {env_id}")
            continue
        import_module(package)
        found[f"{package} {env_id}"] = single_stepper(gym.make(env_id), seed)
    if find_spec("envpool") is None:
        missing.append("envpool CartPole-v1")
    else:
        pool: Any = import_module("envpool").make_gymnasium(
            "CartPole-v1", num_envs=batch, num_threads=1, seed=seed
        )
        actions = np.random.default_rng(seed).integers(0, 2, (_DRAWN, batch)).astype(np.int32)
        pool.reset()

        def step() -> int:
            for i in range(_BLOCK):
                pool.step(actions[i % _DRAWN])
            return _BLOCK * batch

        found["envpool CartPole-v1 batch"] = step
    return found, missing


def measured(steppers: dict[str, Stepper], seconds: float) -> dict[str, float]:
    """Return the steps per second of each stepper, in CPU time."""

    def rate_of(step: Stepper, _: int) -> float:
        start = time.process_time()
        return step() / (time.process_time() - start)

    return medians({name: partial(rate_of, step) for name, step in steppers.items()}, seconds, least=1)
