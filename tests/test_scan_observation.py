"""Observations of raw scans: what is observed, and models of them."""

import math
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from sb3_contrib import MaskablePPO

from parkenv import InputError, make_scenario
from parkenv.envs.local_observation import LocalObservation
from parkenv.envs.sb3 import SearchVecEnv
from parkenv.envs.scan_observation import FIXED, PER_SCAN, SCANS, WAVELENGTHS_M, ScanObservation, scans_space
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.cases import Case
from parkenv.studies.fleet.drivers import policy_of
from parkenv.studies.simulate import make_search, simulate
from parkenv.studies.trips.driven_search import DrivenSearch
from planners.agent import make_agent
from planners.model_file import FIXED_OF_SCANS, NUMBERS_PER_SCAN, save_model

MINI = make_scenario("mini")
SEEDS = range(2_000_000, 2_000_002)


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
        for metres in (x, y):
            numbers += [
                math.sin(2 * math.pi * metres / wavelength),
                math.cos(2 * math.pi * metres / wavelength),
            ]
    for one in seen[: -SCANS - 1 : -1]:
        then = one["pose"][0].astype(float)
        turn, (dx, dy) = then[2] - yaw, then[:2] - (x, y)
        ahead, left = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
        numbers += [1.0, *np.clip([ahead / 30, left / 30], -1, 1), math.cos(turn), math.sin(turn)]
        edges = np.arange(73) * 1081 // 72
        nearest = [one["scan.laser"][0, a:b].min() for a, b in pairwise(edges)]
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


def test_a_batch_observes_what_single_searches_observe_and_continues_from_a_state():
    batch, env = ParkSearchVectorEnv(3, "campus", "scan"), ScanObservation(scan_env("campus"))
    observed, one = batch.reset(seed=5)[0], env.reset(seed=7)[0]
    rng, done, seen = np.random.default_rng(0), [], []
    for step in range(12):
        np.testing.assert_allclose(observed["scan"][2], one["scan"], atol=1e-5)
        if step == 6:
            state = batch.get_state()
        done.append(np.array([rng.choice(np.flatnonzero(mask[:4])) for mask in observed["action_mask"]]))
        observed, one = batch.step(done[-1])[0], env.step(done[-1][2])[0]
        seen.append(observed["scan"])
    other = ParkSearchVectorEnv(3, "campus", "scan")
    other.set_state(state)
    for actions, wanted in zip(done[6:], seen[6:], strict=True):
        np.testing.assert_array_equal(other.step(actions)[0]["scan"], wanted)


def test_sizes_are_those_of_model_files():
    assert (FIXED_OF_SCANS, NUMBERS_PER_SCAN) == (FIXED, PER_SCAN)
    assert SearchVecEnv(2, "mini", observation="scan").observation_space == scans_space(SCANS)


def model_of_scans(path):
    model = MaskablePPO("MultiInputPolicy", SearchVecEnv(2, "mini", observation="scan"), n_steps=8, seed=0)
    save_model(model, path, scenarios=["mini"])
    return f"maskable-ppo:{path}"


def test_a_model_searches_in_the_worlds_of_all_agents(tmp_path):
    file = tmp_path / "model.safetensors"
    agent = make_agent(model_of_scans(file), MINI)
    assert (agent.card.observation, agent.card.k, agent.card.scenarios) == ("scan-1", SCANS, ("mini",))
    env = make_search(MINI, agent, max_episode_steps=60)
    planned = make_search(MINI, make_agent("mdp", MINI))
    for seed in SEEDS:
        simulate(env, agent, seed)
        planned.reset(seed=seed)
        assert env.unwrapped.state.key == planned.unwrapped.state.key


def test_a_model_needs_scans(tmp_path):
    name = model_of_scans(tmp_path / "model.safetensors")
    agent = make_agent(name, MINI)
    observation, _ = LocalObservation(gym.make("parkenv/Search-v2", scenario=MINI)).reset(seed=0)
    with pytest.raises(
        InputError, match=r"wants observations of .*\.ScanObservation, got local, action_mask"
    ):
        agent.predict(observation)
    with pytest.raises(InputError, match="observes 338 numbers, got 184 for its k = 4"):
        agent.predict(ScanObservation(scan_env(), k=2).reset(seed=0)[0])
    with pytest.raises(InputError, match="observes laser scans, which the cars of a fleet do not have"):
        policy_of(AgentSpec(name=name), MINI)
    with pytest.raises(InputError, match="observes laser scans, this environment has none"):
        DrivenSearch(MINI, name)
    with pytest.raises(InputError, match='observation is "scan", want a rig with a laser'):
        Case(MINI, name, rig="stereo").run([0])
    with pytest.raises(TypeError, match=r"wraps parkenv/SearchSensors-v2, not ParkSearchEnv|not SearchEnv"):
        ScanObservation(gym.make("parkenv/Search-v2", scenario="mini"))
    action, _ = agent.predict(ScanObservation(scan_env()).reset(seed=0)[0])
    assert 0 <= int(action) < 5
