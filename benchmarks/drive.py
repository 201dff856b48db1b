"""Benchmark of driving simulation and parking planning, on one core."""

from __future__ import annotations

import time
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.rows import Row, absent, duration, median_of, rate, seconds_each
from parkenv.driving.collision_world import CollisionWorld
from parkenv.driving.parking_task import ParkingTasks
from parkenv.driving.vehicle import advance
from parkenv.envs.drive import SUBSTEPS
from parkenv.lots import packaged_lot
from planners.driving.parking import ParkingAgent

STEPS = 100  # steps of an environment between two resets


def drive_rows(seed: int = 0, seconds: float = 0.6) -> list[Row]:
    """Return the rows of `python benchmarks/run.py drive`: physics steps, environment steps and planning.

    A physics step is 0.05 s here, including pymunk's step and contacts, and 1/15 s in highway-env's parking. Resets are
    not counted.

    Args:
        seed: seed of the tasks and the actions.
        seconds: duration of each measurement.
    """
    rows = rate("drive", "car and pymunk alone", bare_physics(seed, seconds), "physics steps/s")
    peers = {}
    if find_spec("highway_env") is not None:
        peers["highway-env parking-v0"] = highway_parking(seed, seconds)
    plain = environment_steps({}, seed, seconds)
    rows += rate("drive", "parkenv/Drive-v1", SUBSTEPS * plain, "physics steps/s", **peers)
    scan = environment_steps({"laser": True}, seed, seconds)
    rows += rate("drive", "parkenv/Drive-v1, 1081 beams a step", SUBSTEPS * scan, "physics steps/s", **peers)
    mapped = environment_steps({"obstacle_map": True}, seed, seconds)
    rows += rate("drive", "parkenv/Drive-v1, obstacle map", SUBSTEPS * mapped, "physics steps/s", **peers)
    for lot in ("campus", "street"):
        reset, plan = reset_and_plan(lot, seed, seconds)
        rows += duration("drive", f"reset, {lot}", 1e3 * reset, "ms")
        rows += duration("drive", f"plan, {lot}", 1e3 * plan, "ms")
    if not peers:
        rows += absent("drive", "highway-env parking-v0: not installed", "physics steps/s")
    return rows


def bare_physics(seed: int, seconds: float) -> float:
    """Return steps per second of a car that drives back and forth among parked cars, with contacts."""
    task = ParkingTasks(packaged_lot("campus")).draw(seed)
    space, limits = CollisionWorld(task.vehicle, task.obstacles), task.vehicle.limits
    state = task.start.copy()

    def work(i: int) -> None:
        pedal = 0.3 if i % 2 else -0.3
        for _ in range(STEPS):
            advance(state, pedal, 0.1, limits)
            space.touched(*state[:3].tolist())

    return STEPS / seconds_each(work, seconds)


def environment_steps(arguments: dict[str, Any], seed: int, seconds: float) -> float:
    """Return steps per second of `parkenv/Drive-v1`, each of two physics steps."""
    env = gym.make("parkenv/Drive-v1", disable_env_checker=True, **arguments)
    env.reset(seed=seed)
    return _steps(env, _pedalling(seed), seconds)


def highway_parking(seed: int, seconds: float) -> float:
    """Return physics steps per second of highway-env's parking-v0, each of 1/15 s."""
    import_module("highway_env")  # registers its environments
    env = gym.make("parking-v0", disable_env_checker=True)
    env.reset(seed=seed)
    config = env.unwrapped.config  # type: ignore[attr-defined]
    each = config["simulation_frequency"] / config["policy_frequency"]
    return float(each * _steps(env, _pedalling(seed), seconds))


def reset_and_plan(lot: str, seed: int, seconds: float) -> tuple[float, float]:
    """Return the median times, s, of a reset and of planning from the start."""
    env = gym.make("parkenv/Drive-v1", lot=lot, obstacle_map=True, disable_env_checker=True)
    agent = ParkingAgent()
    reset = seconds_each(lambda i: env.reset(seed=seed + i), seconds, least=20)
    seen = [env.reset(seed=seed + i)[0] for i in range(20)]
    return reset, seconds_each(lambda i: agent.plan(seen[i % len(seen)]), seconds, least=20)


def _pedalling(seed: int) -> list[Any]:
    steering = np.random.default_rng(seed).uniform(-0.3, 0.3, STEPS)
    pedal = np.where(np.arange(STEPS) % 20 < 10, 0.3, -0.3)
    return list(np.column_stack([pedal, steering]).astype(np.float32))


def _steps(env: gym.Env[Any, Any], actions: Sequence[Any], seconds: float) -> float:
    """Return steps per second, the median over runs until an episode ends."""

    def run(number: int) -> float:
        del number
        env.reset()
        done, began = 0, time.perf_counter()
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            done += 1
            if terminated or truncated:
                break
        return done / (time.perf_counter() - began)

    return median_of(run, seconds)
