"""Options of `gymnasium.make`, and what environments answer to wrong arguments and calls out of order."""

import json
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import flatdim
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from lot_checks import refusal
from small_lots import small_lot
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv
from test_lot import ONE_SLOT
from test_occupancy import KEY, constant_process
from test_turns import blocks

import parkenv
from parkenv import InputError, OccupancyLog, OccupancyProcess, SensorModel, lot_v0, make_agent, make_scenario
from parkenv.driving.vehicle import VehicleParameters
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.envs import flat_ids
from parkenv.envs.local_observation import LocalObservation
from parkenv.envs.sb3 import SearchVecEnv
from parkenv.envs.search import SearchEnv
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.lots import grid_lot
from parkenv.mapping.odometry import PoseNoise
from parkenv.mapping.survey import SurveySettings
from parkenv.perception.car_model import CarModel
from parkenv.perception.detector import Detections
from parkenv.perception.hog import Descriptor, cell_histograms
from parkenv.perception.range_scan import scan_from_laser
from parkenv.scenarios.calibration import Calibration
from parkenv.studies.trips.driven_car import DrivingStyle
from parkenv.studies.trips.driven_search import DrivenSearch
from parkenv.world import demand
from parkenv.world.cost_terms import REWARD_TERMS
from parkenv.world.lot import Lane, ParkingLot, Turn
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.fit import fit_constant_rates
from parkenv.world.occupancy.process import Arrival
from parkenv.world.tariff import Price, Tariff
from planners import ParkingMDP
from planners.thesis.tuning import tune_failure_cost
from sim_sensors import SensorError, SlotLot
from sim_sensors.camera.image_sensor import ImageSensor
from sim_sensors.camera.models import PinholeCamera, StereoCamera
from sim_sensors.laser.footprints import ScanPlane
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.movers import Movers
from sim_sensors.rig import Mount, SensorRig, poses_along
from sim_sensors.scene import Scene
from sim_sensors.slot_scenes import ParkingManners
from sim_sensors.surroundings import Surroundings
from sim_sensors.vehicles.vehicle import VehicleModel

SCALE, N = 0.01, 4


def make(observation="full", **options):
    return gym.make("parkenv/Search-v2", scenario=["mini", "street"], observation=observation, **options)


@pytest.mark.parametrize("observation", ["local", "occupancy"])
def test_flat_vectors_and_scaled_rewards_say_the_same(observation):
    flat, plain = make(observation, flat=True, reward_scale=SCALE), make(observation)
    check_env(flat.unwrapped, skip_render_check=True)
    rng, ended = np.random.default_rng(7), False
    (seen, _), (vector, _) = (env.reset(seed=7) for env in (plain, flat))
    while not ended:
        assert flat.observation_space.contains(vector)
        if observation == "local":
            np.testing.assert_array_equal(vector, seen["local"])
        else:
            vertex, rest = np.split(vector, [plain.observation_space["vertex"].n])
            elapsed, p_occupied = seen["time"][1], seen["p_occupied"]
            assert vector.size == flatdim(plain.observation_space) + 1
            np.testing.assert_array_equal(np.flatnonzero(vertex), seen["vertex"])
            assert rest[0] == pytest.approx(elapsed / (elapsed + 60.0))
            np.testing.assert_array_equal(rest[3 : 3 + p_occupied.size], p_occupied)
            np.testing.assert_array_equal(rest[-5:], seen["action_mask"])
        action = int(rng.choice(np.flatnonzero(seen["action_mask"])))
        seen, reward, terminated, truncated, info = plain.step(action)
        vector, scaled, *_, flat_info = flat.step(action)
        told_s = sum(flat_info[name] for name in REWARD_TERMS)
        assert scaled == pytest.approx(SCALE * reward) == pytest.approx(told_s)
        assert flat_info["total_s"] == info["total_s"]
        ended = terminated or truncated


def test_a_flat_batch_hands_out_the_end_of_its_searches():
    options = {"scenario": "mini", "observation": "occupancy", "flat": True, "reward_scale": SCALE}
    mode = {"autoreset_mode": AutoresetMode.SAME_STEP}
    batch = gym.make_vec("parkenv/Search-v2", N, "vector_entry_point", **mode, **options)
    single = gym.make_vec("parkenv/Search-v2", N, "sync", vector_kwargs=mode, **options)
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(batch.reset(seed=3)[0], single.reset(seed=3)[0])
    n_ends = 0
    for _ in range(45):
        actions = rng.integers(0, 5, N)
        ours, theirs = batch.step(actions), single.step(actions)
        for a, b in zip(ours[:4], theirs[:4], strict=True):
            np.testing.assert_allclose(a, b)
        for i in np.flatnonzero(ours[2] | ours[3]):
            np.testing.assert_array_equal(ours[4]["final_obs"][i], theirs[4]["final_obs"][i])
            terms = ours[4]["final_info"]
            assert sum(terms[name][i] for name in REWARD_TERMS) == pytest.approx(ours[1][i])
            n_ends += 1
    assert n_ends > 2


def test_ids_for_learners_that_take_no_options():
    env = gym.make("parkenv.envs.flat_ids:parkenv-flat/mini-v2")
    same = gym.make("parkenv/Search-v2", scenario="mini", **flat_ids.OPTIONS)
    np.testing.assert_array_equal(env.reset(seed=2)[0], same.reset(seed=2)[0])
    assert env.step(3)[1:3] == same.step(3)[1:3]
    assert gym.make_vec("parkenv-flat/all-v2", 2).reset(seed=2)[0].shape == (2, 86)


def kinds(info):
    """Keys of an info, with the kind of each number."""
    return {key: kinds(v) if isinstance(v, dict) else np.asarray(v).dtype.kind for key, v in info.items()}


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("Search-v2", {"scenario": ["mini", "street"]}),
        ("SearchSensors-v2", {"scenario": "mini", "observation": "scan"}),
        ("SearchPerception-v2", {"scenario": "mini", "picture_width": 100}),
        ("Drive-v1", {"lot": "mini"}),
    ],
)
def test_infos_hold_numbers_under_the_same_keys_after_reset_and_step(name, options):
    env = gym.make(f"parkenv/{name}", **options)
    _, info = env.reset(seed=0, options={"minari_autoseed": False})
    assert kinds(info) == kinds(env.step(env.action_space.sample())[4])
    assert {kind for value in kinds(info).values() for kind in value} <= {*"biuf"}


def test_infos_of_batches_and_of_cars_hold_the_same():
    single, batch = (
        gym.make_vec("parkenv/Search-v2", 3, mode, scenario=["mini", "street"])
        for mode in ("sync", "vector_entry_point")
    )
    ours, theirs = batch.reset(seed=4)[1], single.reset(seed=4)[1]
    assert kinds(ours) == kinds(theirs)
    np.testing.assert_equal(ours, theirs)
    cars = lot_v0.parallel_env(scenario="mini", cars=2)
    _, before = cars.reset(seed=0)
    for _ in range(30):
        *_, after = cars.step(dict.fromkeys(cars.agents, 3))
        assert all(kinds(info) == kinds(before["car_0"]) for info in after.values())
    assert after["car_0"]["total_s"] > 0.0


def test_policies_of_stable_baselines_learn_from_sensors():
    lasers = (("front.left", LaserScanner(n_beams=91), Mount()),)
    rig = SensorRig(lasers=lasers, cameras=SensorRig.thesis().cameras)
    seen = gym.make("parkenv/SearchSensors-v2", scenario="mini", rig=rig).observation_space
    assert {"image_right", "scan_front_left"} < set(seen)
    env = gym.make("parkenv/SearchSensors-v2", scenario="mini", rig=rig, captures=1, observation="scan")
    torch.set_num_threads(1)
    network = {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}}
    model = PPO("MultiInputPolicy", env, n_steps=100, batch_size=50, n_epochs=1, policy_kwargs=network)
    assert model.learn(200).num_timesteps == 200


def test_start_options_hold_for_the_next_reset_of_a_batch_and_wrong_ones_for_none():
    times = lambda envs: (envs.reset()["time"][:, 0] / 3600.0).round(1).tolist()  # noqa: E731
    envs = SearchVecEnv(2, "campus", observation="full")
    like = DummyVecEnv([lambda: gym.make("parkenv/Search-v2", scenario="campus")] * 2)
    envs.seed(3), like.seed(3)
    for given in ({"arrival": "Tue 08:30"}, [{"arrival": "Wed 09:00"}, {}], {}):
        envs.set_options(given), like.set_options(given)
        assert times(envs) == times(like)
    for wrong in ({"nonsense": 1}, [{"arrival": "Tue 08:30"}, {"entry": 99}], [{}]):
        envs.set_options(wrong)
        with pytest.raises(InputError, match=r"nonsense|entry|options are 1, want 2"):
            envs.reset()
    envs.set_options()
    assert times(envs) == times(like)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("Search-v2", {}),
        ("Search-v2", {"max_episode_steps": -1, "observation": "occupancy"}),
        ("Search-v2", {"max_episode_steps": 3, "observation": "local", "k": 2, "flat": True}),
        ("SearchSensors-v2", {"captures": 1, "observation": "scan", "max_episode_steps": 3}),
    ],
)
def test_make_vec_takes_what_make_takes_and_observes_the_same(name, options):
    alone = gym.make(f"parkenv/{name}", scenario="mini", **options)
    modes = ("sync", "async", "vector_entry_point") if name == "Search-v2" else ("sync",)
    for mode in (None, *modes):
        envs = gym.make_vec(f"parkenv/{name}", 2, mode, scenario="mini", **options)
        assert envs.single_observation_space == alone.observation_space
        first, many = alone.reset(seed=5)[0], envs.reset(seed=5)[0]
        for _ in range(3):
            row = {key: value[0] for key, value in many.items()} if isinstance(many, dict) else many[0]
            np.testing.assert_equal(row, first)
            first, _, *ends, _ = alone.step(3)
            many, _, terminated, truncated, _ = envs.step([3, 3] if mode == "sync" else np.array([3, 3]))
            assert [terminated[0], truncated[0]] == ends
        envs.close()
    if name == "Search-v2":
        with pytest.raises(ResetNeeded):
            envs.step(np.array([3, 3]))


OPTIONS = {f"parkenv/Search{kind}-v2": {"scenario": "mini"} for kind in ("", "Sensors", "Perception")}
OPTIONS["parkenv/SearchSensors-v2"] |= {"observation": "scan"}
OPTIONS["parkenv/Drive-v1"] = {"lot": "mini"}
MAKERS = (gym.make, lambda name, **options: gym.make_vec(name, 2, **options))
EVERY_ID = pytest.mark.parametrize("name", OPTIONS)
EVERY_LOT = pytest.mark.parametrize("make", [lot_v0.raw_env, lot_v0.parallel_env])


def test_every_registered_id_is_tested():
    assert set(OPTIONS) == {name for name in gym.registry if name.startswith("parkenv/")}


@EVERY_ID
@pytest.mark.parametrize("make", MAKERS)
def test_an_unknown_keyword_is_a_type_error_as_of_any_python_function(make, name):
    """TorchRL's `GymEnv` asks every environment for `frameskip`, and understands nothing else."""
    with pytest.raises(TypeError, match=r"\(\) got an unexpected keyword argument 'frameskip'"):
        make(name, frameskip=4, **OPTIONS[name])


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"observaton": "local"}, TypeError, "'observaton'; did you mean 'observation'"),
        ({"k": 3}, InputError, "k is 3"),
        ({"flat": True}, InputError, "flat is True"),
        ({"reward_scale": 0.0}, InputError, r"reward_scale is 0\.0"),
        ({"observation": "hidden"}, InputError, "full, occupancy, local"),
    ],
)
def test_a_wrong_argument_of_a_search_is_named(make, options, error, message):
    with pytest.raises(error, match=message):
        make("parkenv/Search-v2", scenario="mini", **options)


def started(**options):
    """A single environment and a batch refuse the same."""
    single, batch = make(), ParkSearchVectorEnv(2, ["mini", "street"])
    lines = [refusal(env.reset, seed=0, options=options) for env in (single, batch)]
    assert lines[0] == lines[1]
    raise InputError(lines[0])


def cars(**options):
    lines = [refusal(make, **options) for make in (lot_v0.raw_env, lot_v0.parallel_env)]
    assert lines[0] == lines[1]
    raise InputError(lines[0])


TAKERS = {
    "Drive": lambda **options: gym.make("parkenv/Drive-v1", **{"lot": "campus"} | options).reset(seed=0),
    "SearchSensors": lambda **options: gym.make("parkenv/SearchSensors-v2", **{"scenario": "mini"} | options),
    "batch": lambda **options: ParkSearchVectorEnv(**{"scenario": "mini"} | options),
    "start": started,
    "cars": cars,
    "agent": lambda name, **options: make_agent(name, make_scenario("mini"), **options),
    "fleet": lambda **options: Fleet("mini", **options),
    "Search": lambda **options: gym.make("parkenv/Search-v2", **{"scenario": "mini"} | options),
    "process": lambda **changes: ParkingMDP(**TWO_STATES | changes),
    "tuning": lambda **options: tune_failure_cost(**A_SEARCH | options),
    "model": lambda **changes: replace(CarModel.load("side"), **changes),
    "driven": lambda **options: DrivenSearch(make_scenario("mini"), **options),
    "trip": lambda seed: DrivenSearch(make_scenario("mini")).run(seed),
    "style": lambda **style: DrivenSearch(make_scenario("mini"), style=DrivingStyle(**style)),
    "lot": lambda **changes: ParkingLot(**ONE_SLOT | changes),
    "grid": grid_lot,
    "scene": Scene.from_arrays,
    "sight": SensorModel.named,
    "two lasers": lambda name: SensorRig(lasers=((name, LaserScanner(), Mount()),) * 2),
    "poses": poses_along,
    "car": lambda **changes: VehicleModel(**SUV | changes),
    "crop": lambda *shape: Descriptor().describe(np.zeros(shape, np.uint8)),
    "cells": lambda kind: cell_histograms(np.zeros((8, 8), kind)),
    "scan": lambda n, d: scan_from_laser(LaserScanner(), Mount(z=0.5), np.zeros(3), np.full(n, d, "f4")),
    "detections": lambda **changes: Detections(**TWO_BOXES | changes),
    "local": lambda k: LocalObservation(gym.make("parkenv/Search-v2", scenario="mini"), k),
    "turn": lambda *points: blocks([Turn(np.array(points, float))]),
    "hours": parkenv.ArrivalWindow.parse,
    "fuller": lambda arrival, level: constant_process(2, arrival, 1e-4).at_mean_occupancy(level, 0.0),
    "of demand": lambda slots, *stay_s: OccupancyProcess.from_demand(slots, np.zeros(168), *stay_s),
    "price": Price.parse,
    "look": lambda begin, t: constant_process(2, 1e-4, 1e-4).world(KEY, Arrival(begin)).occupied([0], t),
    "log": lambda **changes: OccupancyLog(**{"slot": [0], "day": [0]} | ONE_LOOK | changes),
    "looks": lambda dt, states: fit_constant_rates(dt, states, states),
}
KINDS = [SearchEnv, SearchVecEnv, SensorModel, DrivingStyle, Calibration]
KINDS += [SurveySettings, DriverKind, Lane, VehicleParameters, Movers]
KINDS += [ScanPlane, LaserScanner, SlotLot, Tariff]
KINDS += [ParkingManners, Surroundings, PinholeCamera, StereoCamera, ImageSensor, PoseNoise, SensorRig, Mount]
KINDS += [Descriptor, DayError, demand.Demand, demand.Headways, demand.PoissonArrivals, demand.ListedArrivals]
KINDS += [demand.ExponentialTime, demand.ConstantTime, parkenv.ArrivalWindow]
TAKERS |= {kind.__name__: kind for kind in KINDS}
SUV = {"body": "suv", "segment": "JC", "size": (4.5, 1.85, 1.65), "paint": (9, 9, 9), "seed": 1}
TWO_STATES = {"neighbors": [[-1, -1, -1, 1], [-1, -1, 0, -1]], "p_free": [0.5, 0.5], "failure_s": 1.0}
TWO_STATES |= {"arrival_cost_s": [1.0, 2.0], "move_s": np.ones((2, 4))}
A_SEARCH = dict(zip(("problem", "p_occupied", "vertex"), small_lot(0), strict=True))
TWO_BOXES = {"boxes": [[0, 0, 1, 1], [2, 2, 4, 4]], "probability": [0.5, 0.6]}
ONE_LOOK = {"slot_ids": ["a"], "days": ["2024-01-01"], "second": [1.0], "occupied": [1]}
BAD = json.loads(Path(__file__).with_name("bad_arguments.json").read_text(encoding="utf-8"))
"""Who takes arguments, wrong ones, and what is said of them."""


@pytest.mark.parametrize(("taker", "arguments", "said"), BAD)
def test_a_wrong_argument_is_one_line_with_what_was_wanted(taker, arguments, said):
    with pytest.raises((InputError, SensorError), match=said) as caught:
        TAKERS[taker](*arguments) if isinstance(arguments, list) else TAKERS[taker](**arguments)
    assert "\n" not in str(caught.value)


def test_other_makers_say_it_alike_and_name_what_is_near():
    for make in (lot_v0.env, lot_v0.parallel_env, lambda **k: make_scenario("mini", **k)):
        with pytest.raises(TypeError, match=r"'failure_cost'.*'failure_s'"):
            make(failure_cost=3.0)
    with pytest.raises(TypeError, match="frameskip"):
        SearchVecEnv(2, "mini", frameskip=4)


@pytest.mark.parametrize("name", ["parkenv/Search-v2", "parkenv/SearchPerception-v2"])
def test_the_local_observation_by_name_is_that_of_the_wrapper(name):
    options = OPTIONS[name] | ({"weather": "sunny", "picture_width": 160} if "Perception" in name else {})
    named = gym.make(name, observation="local", k=3, **options)
    wrapped = LocalObservation(gym.make(name, **options), k=3)
    rng = np.random.default_rng(0)
    ours, theirs = named.reset(seed=3)[0], wrapped.reset(seed=3)[0]
    for _ in range(8):
        assert named.observation_space.contains(ours)
        for key, value in theirs.items():
            np.testing.assert_array_equal(ours[key], value)
        action = int(rng.choice(np.flatnonzero(ours["action_mask"][:4])))
        (ours, *results), (theirs, *expected) = named.step(action), wrapped.step(action)
        assert results == expected


def test_a_planner_says_what_it_needs_of_a_local_observation():
    env = gym.make("parkenv/Search-v2", scenario="mini", observation="local")
    with pytest.raises(InputError, match="observation holds local, action_mask, want"):
        parkenv.simulate(env, make_agent("mdp", env.unwrapped.scenario), seed=0)


@EVERY_ID
def test_calls_out_of_order_are_refused(name):
    env = gym.make(name, **OPTIONS[name])
    action = np.zeros(2, np.float32) if "Drive" in name else 3
    with pytest.raises(ResetNeeded):
        env.step(action)
    assert "options is 3, want a dictionary or None" in refusal(env.unwrapped.reset, options=3)
    env.reset(seed=0)
    env.step(action)
    env.close()
    with pytest.raises(ResetNeeded):
        env.step(action)
    env.reset(seed=0)
    env.step(action)


@EVERY_LOT
def test_a_lot_has_no_cars_before_it_begins_and_after_its_end(make):
    env = make(scenario="mini", cars=2)
    act = {"car_0": 3} if make is lot_v0.parallel_env else 3
    for wrong in (act, {}, None):
        with pytest.raises(ResetNeeded):
            env.step(wrong)
    env.reset(seed=0)
    for wrong in (None, 7, "a"):
        assert "action" in refusal(env.step, wrong)
    env.step(act)
    env.close()
    with pytest.raises(ResetNeeded):
        env.step(act)


@pytest.mark.parametrize(
    ("make", "seeds"),
    [
        (lambda: lot_v0.raw_env(scenario="mini", cars=2), (1.5, -1, "1", True)),
        (lambda: lot_v0.parallel_env(scenario="mini", cars=2), (1.5, -1, "1", True)),
        (lambda: gym.make_vec("parkenv/Search-v2", 2, scenario="mini"), (1.5, -1, [1.5, 2], [1, -2])),
    ],
)
def test_seeds_are_whole_numbers(make, seeds):
    env = make()
    for seed in seeds:
        assert "seed is" in refusal(env.reset, seed=seed)


def test_an_empty_name_is_not_the_working_folder(tmp_path, monkeypatch):
    (tmp_path / "one.toml").write_text('lot = "mini"\n')
    monkeypatch.chdir(tmp_path)
    assert "unknown scenario ''" in refusal(make_scenario, "")
