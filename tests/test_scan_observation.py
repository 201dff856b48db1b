"""Observations of raw scans."""

import math
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest

from parkenv import InputError, make_scenario
from parkenv.envs.scan_observation import FIXED, PER_SCAN, SCANS, WAVELENGTHS_M, ScanObservation

MINI = make_scenario("mini")


def scan_env(scenario="mini"):
    return gym.make("parkenv/SearchSensors-v2", scenario=scenario, observation="scan", captures=1)


def expected(measured, goal):
    """The vector as the module describes it, of the observations so far, the newest last."""
    seen = [one for one in measured if one["count"]]
    x, y, yaw = seen[-1]["pose"][0].astype(float)
    away = np.array(goal) - (x, y)
    bearing = math.atan2(away[1], away[0]) - yaw
    elapsed = float(measured[-1]["time"][1])
    numbers = [
        elapsed / (elapsed + 60.0),
        math.cos(bearing),
        math.sin(bearing),
        1 / (1 + math.hypot(*away) / 5),
    ]
    numbers += [math.cos(yaw), math.sin(yaw)]
    for wavelength in WAVELENGTHS_M:
        for phase in (2 * math.pi * x / wavelength, 2 * math.pi * y / wavelength):
            numbers += [math.sin(phase), math.cos(phase)]
    for one in seen[: -SCANS - 1 : -1]:
        then = one["pose"][0].astype(float)
        turn, (dx, dy) = then[2] - yaw, then[:2] - (x, y)
        ahead, left = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
        numbers += [1.0, *np.clip([ahead / 30, left / 30], -1, 1), math.cos(turn), math.sin(turn)]
        edges = np.arange(73) * 1081 // 72
        nearest = [one["scan_laser"][0, a:b].min() for a, b in pairwise(edges)]
        numbers += [1.0 / (1.0 + metres / 5.0) for metres in nearest]
    return np.array(numbers + [0.0] * (FIXED + PER_SCAN * SCANS - len(numbers)))


def test_the_vector_is_as_described_and_forgets_with_each_search():
    raw, env = scan_env(), ScanObservation(scan_env())
    rng, over, goal = np.random.default_rng(0), True, MINI.lot.goals[MINI.goal]
    measured, ends = [], 0
    for _ in range(60):
        if over:
            measured = [raw.reset(seed=3 + ends)[0]]
            observation, _ = env.reset(seed=3 + ends)
        assert observation in env.observation_space
        np.testing.assert_allclose(observation["scan"], expected(measured, goal), atol=2e-5)
        action = rng.choice(np.flatnonzero(observation["action_mask"]))
        measured.append(raw.step(action)[0])
        observation, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
        ends += over
    assert ends


def test_wrong_arguments_are_named():
    with pytest.raises(InputError, match="k is 0"):
        ScanObservation(scan_env(), k=0)
    with pytest.raises(TypeError, match=r"wraps parkenv/SearchSensors-v2, not SearchEnv"):
        ScanObservation(gym.make("parkenv/Search-v2", scenario="mini"))
