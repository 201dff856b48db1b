"""Options of `gymnasium.make` for other people's learners."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import flatdim
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from parkenv import InputError
from parkenv.envs.flat_ids import OPTIONS

SCALE = 0.01


def make(observation="full", **options):
    return gym.make("parkenv/Search-v2", scenario=["mini", "street"], observation=observation, **options)


def together(env, others, seed):
    """Act at random in one environment and repeat it in others; yield what each of them returns at every step."""
    rng = np.random.default_rng(seed)
    every = [one.reset(seed=seed) for one in (env, *others)]
    yield [(observation, 0.0, False, False, info) for observation, info in every]
    while True:
        possible = np.flatnonzero(every[0][0]["action_mask"])
        action = int(rng.choice(possible))
        every = [one.step(action) for one in (env, *others)]
        yield every
        if every[0][2] or every[0][3]:
            return


@pytest.mark.parametrize("observation", ["local", "occupancy"])
def test_flat_vectors_and_scaled_rewards_say_the_same(observation):
    options = {"observation": observation, "flat": True, "reward_scale": SCALE}
    one, plain = make(**options), make(observation)
    check_env(one.unwrapped, skip_render_check=True)
    for (seen, reward, *_, info), (vector, scaled, *_, its) in together(plain, (one,), 7):
        assert one.observation_space.contains(vector)
        assert scaled == pytest.approx(SCALE * reward)
        if its.get("reward_terms"):
            assert sum(its["reward_terms"].values()) == pytest.approx(scaled)
            assert its["total_s"] == info["total_s"]
        if observation == "local":
            np.testing.assert_array_equal(vector, seen["local"])
        else:
            assert vector.size == flatdim(plain.observation_space) + 1
            at = plain.observation_space["vertex"].n
            assert vector[:at].argmax() == seen["vertex"]
            assert vector[:at].sum() == 1.0
            assert vector[at] == pytest.approx(seen["time"][1] / (seen["time"][1] + 60.0))
            np.testing.assert_array_equal(
                vector[at + 3 : at + 3 + seen["p_occupied"].size], seen["p_occupied"]
            )
            np.testing.assert_array_equal(vector[-5:], seen["action_mask"])


def test_a_flat_batch_hands_out_the_end_of_its_searches():
    options = {"scenario": "mini", "observation": "occupancy", "flat": True, "reward_scale": SCALE}
    batch = gym.make_vec(
        "parkenv/Search-v2", 16, "vector_entry_point", autoreset_mode=AutoresetMode.SAME_STEP, **options
    )
    single = gym.make_vec(
        "parkenv/Search-v2", 16, "sync", vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP}, **options
    )
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(batch.reset(seed=3)[0], single.reset(seed=3)[0])
    n_ends = 0
    for _ in range(60):
        actions = rng.integers(0, 5, 16)
        ours, theirs = batch.step(actions), single.step(actions)
        for a, b in zip(ours[:4], theirs[:4], strict=True):
            np.testing.assert_allclose(a, b)
        for i in np.flatnonzero(ours[2] | ours[3]):
            np.testing.assert_array_equal(ours[4]["final_obs"][i], theirs[4]["final_obs"][i])
            terms = ours[4]["final_info"]["reward_terms"]
            assert sum(terms[n][i] for n in terms if not n.startswith("_")) == pytest.approx(ours[1][i])
            n_ends += 1
    assert n_ends > 10


def test_ids_for_learners_that_take_no_options():
    env, same = gym.make("parkenv.envs.flat_ids:parkenv-flat/mini-v2"), make_flat("mini")
    np.testing.assert_array_equal(env.reset(seed=2)[0], same.reset(seed=2)[0])
    assert env.step(3)[1:3] == same.step(3)[1:3]
    envs = gym.make_vec("parkenv-flat/mini-v2", 2)
    assert envs.reset(seed=2)[0].shape == (2, 86)


def make_flat(scenario):
    return gym.make("parkenv/Search-v2", scenario=scenario, **OPTIONS)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"flat": True}, "flat is True, want an observation other than full"),
        ({"reward_scale": 0.0}, "reward_scale is 0.0, want a finite number above 0"),
        ({"observation": "hidden"}, "want one of full, occupancy, local"),
    ],
)
def test_wrong_options_are_refused(options, message):
    for maker in (make, lambda **k: gym.make_vec("parkenv/Search-v2", 2, "vector_entry_point", **k)):
        with pytest.raises(InputError, match=message):
            maker(**options)
