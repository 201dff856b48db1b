"""Batches of searches with laser scans agree with single environments."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from test_python_world import scenario as python_scenario
from test_search_vector import recorded_scenario

import parkenv
from parkenv import InputError
from parkenv.compiled import numpy_streams
from parkenv.envs.search_vector import ScanSearchVectorEnv
from parkenv.scenarios.build import make_scenario
from parkenv.world.lot_scene import slot_lot
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import Mount, SensorRig

WORDS = ([0], [1, 2, 3], [0, 17, 2**31 + 5], [2**40 + 7, 123456789], [2**64 - 1, 2**33, 9])


@pytest.mark.parametrize("words", WORDS)
def test_streams_are_those_of_numpy(words):
    rng, state = np.random.default_rng(words), numpy_streams.generator_state(*words)
    for n in (97, 1, 3, 2**32 - 1, 65536, 2**31 + 1):
        assert numpy_streams.integer_below(state, n) == rng.integers(n)
    # Some of these are from the tails of the normal distribution.
    drawn = [numpy_streams.normal(state) for _ in range(3000)]
    np.testing.assert_array_equal(drawn, rng.standard_normal(3000))
    assert numpy_streams.unit(state) == rng.random()
    seed, pool, n = np.zeros(8, np.uint32), np.zeros(4, np.uint32), 0
    for word in words:
        n = numpy_streams.append_words(seed, n, np.uint64(word))
    numpy_streams.fill_pool(seed, n, pool)
    assert numpy_streams.first_word(pool) == np.random.SeedSequence(words).generate_state(1)[0]


def driven(n, steps, seed, **options):
    """Drive a batch and the same searches one by one at random; yield the observations of both after each step."""
    batch = ScanSearchVectorEnv(n, **options)
    single = [gym.make("parkenv/SearchSensors-v2", observation="scan", **options) for _ in range(n)]
    rng = np.random.default_rng(seed)
    observations, _ = batch.reset(seed=seed)
    yield observations, [env.reset(seed=seed + i)[0] for i, env in enumerate(single)]
    over = np.zeros(n, dtype=bool)
    for _ in range(steps):
        actions = np.array([rng.choice(np.flatnonzero(mask)) for mask in observations["action_mask"]])
        observations, rewards, terminated, truncated, _ = batch.step(actions)
        one_by_one = []
        for i, env in enumerate(single):
            if over[i]:
                one_by_one.append(env.reset()[0])
                continue
            seen, reward, ended, _, _ = env.step(actions[i])
            one_by_one.append(seen)
            assert (rewards[i], terminated[i]) == (reward, ended)
        over = terminated | truncated
        yield observations, one_by_one


@pytest.mark.parametrize(
    ("scenario", "options"),
    [
        ("mini", {"captures": 3, "every": 0.7}),
        ("street", {"rig": "both_sides"}),
        ("campus", {}),
        (recorded_scenario(), {}),
        (python_scenario(), {}),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_a_batch_measures_what_single_searches_measure(scenario, options):
    parked = several = 0
    for batch, single in driven(3, 40, 5, scenario=scenario, **options):
        for i, one in enumerate(single):
            assert set(one) == set(batch)
            for name in ("vertex", "time", "action_mask", "count", "captured_at"):
                np.testing.assert_array_equal(batch[name][i], one[name], err_msg=name)
            np.testing.assert_allclose(batch["pose"][i], one["pose"], atol=1e-5)
            off = np.abs(batch["scan.laser"][i] - one["scan.laser"])
            # A beam past an edge may hit or miss it by rounding.
            assert np.mean(off > 1e-4) < 1e-3
            parked, several = parked + (one["count"] == 0), several + (one["count"] > 1)
    assert several
    assert parked or scenario != "mini"


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
def test_searches_begin_anew_in_every_mode(mode):
    envs = gym.make_vec(
        "parkenv/SearchSensors-v2", 2, "vector_entry_point", scenario="mini", observation="scan",
        vector_kwargs={}, autoreset_mode=mode,
    )  # fmt: skip
    seen, _ = envs.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(60):
        actions = np.array([rng.choice(np.flatnonzero(mask)) for mask in seen["action_mask"]])
        seen, _, terminated, truncated, info = envs.step(actions)
        over = terminated | truncated
        if over.any():
            break
    assert over.any()
    if mode is AutoresetMode.SAME_STEP:
        assert info["final_obs"][int(np.argmax(over))]["count"] <= 4
    else:
        seen, _ = envs.reset(options={"reset_mask": over})
    fresh = gym.make("parkenv/SearchSensors-v2", scenario="mini", observation="scan")
    i = int(np.argmax(over))
    fresh.reset(seed=1 + i)
    one, _ = fresh.reset()
    assert seen["count"][i] == 1
    assert np.mean(np.abs(seen["scan.laser"][i] - one["scan.laser"]) > 1e-4) < 1e-3
    assert seen in envs.observation_space


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"observation": "full"}, "observation is 'full', want \"scan\""),
        ({"rig": "stereo"}, "0 lasers"),
        ({"traffic": parkenv.Traffic(1, 0)}, "traffic is"),
        ({"captures": 0}, "captures is 0"),
        ({"every": -1.0}, "every is -1.0"),
        ({"render_mode": "human"}, "render_mode is 'human'"),
    ],
)
def test_wrong_arguments_are_named(options, words):
    with pytest.raises(InputError) as refused:
        ScanSearchVectorEnv(2, scenario="mini", **options)
    assert words in str(refused.value)


def test_a_laser_may_be_mounted_anywhere():
    rig = SensorRig(lasers=(("front", LaserScanner(n_beams=90, step=0.03), Mount(1.5, 0.3, 0.4, 0.2)),))
    for batch, single in driven(1, 5, 2, scenario="mini", rig=rig):
        assert np.abs(batch["scan.front"][0] - single[0]["scan.front"]).max() < 1e-3


def test_cars_are_those_of_the_slots():
    from parkenv.envs.car_footprints import CarLibrary, Scratch, draw_car

    lot = slot_lot(make_scenario("street").lot)
    library, _, _ = CarLibrary.of(lot)
    work = Scratch(np.zeros(8, np.uint32), np.zeros(4, np.uint32), np.zeros(5, np.uint64), np.zeros(3))
    for slot, number in ((0, 0), (5, 3), (17, 2**31 + 9), (40, 12345)):
        pose, model = lot.arrival(slot, number)
        assert draw_car(library, slot, number, work) == model
        np.testing.assert_allclose(work.car, pose, rtol=0.0, atol=1e-12)
