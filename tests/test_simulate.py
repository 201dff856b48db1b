"""`simulate`: the one episode loop, its observers, its accounting of truncation and its decision times."""

import itertools

import gymnasium as gym
import numba
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit

from parkenv import make_scenario
from parkenv.compiled.clock import seconds_spent
from parkenv.studies.simulate import Observer, simulate
from planners import make_agent

MINI = make_scenario("mini")


class Counter(Observer):
    """Records every call."""

    def __init__(self):
        self.calls = []
        self.on_reset = lambda _, observation: self.calls.append(("reset", observation))
        self.on_step = lambda step: self.calls.append(("step", step))
        self.on_end = lambda result: self.calls.append(("end", result))


class Waiting:
    """Never drives and never parks."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return int(np.flatnonzero(observation["action_mask"][:4] == 0)[0]), state


@pytest.mark.parametrize("name", ["mdp", "first-free", "oracle"])
def test_observers_see_the_whole_episode_in_order(name):
    env, one, two = gym.make("parkenv/Search-v2", scenario=MINI), Counter(), Counter()
    result = simulate(env, make_agent(name, MINI), 5, (one, two))
    assert [call for call, _ in one.calls] == ["reset", *["step"] * result.steps, "end"]
    assert [call for call, _ in two.calls] == ["reset", *["step"] * result.steps, "end"]
    (_, first), *steps, (_, ended) = one.calls
    steps = [step for _, step in steps]
    assert ended is result
    assert (result.seed, result.truncated) == (5, False)
    assert steps[0].observation is first
    for before, after in itertools.pairwise(steps):
        assert before.next_observation is after.observation
        assert not before.terminated
    last = steps[-1]
    assert last.terminated
    assert last.info == result.info
    assert last.memory is result.memory
    assert -sum(step.reward for step in steps) == pytest.approx(result.info["total_s"])


def test_a_truncated_search_is_charged_the_give_up_penalty_once():
    env = TimeLimit(gym.make("parkenv/Search-v2", scenario=MINI), 7)
    counter = Counter()
    result = simulate(env, Waiting(), 0, (counter,))
    assert result.truncated
    assert result.steps == 7
    assert result.info["gave_up_s"] == MINI.give_up_s
    assert result.info["total_s"] == pytest.approx(7 * MINI.wait_s + MINI.give_up_s)
    assert counter.calls[-2][1].info["gave_up_s"] == 0.0, "the environment's own info stays as it is"


def test_a_search_that_parks_at_the_step_limit_is_not_truncated():
    env = gym.make("parkenv/Search-v2", scenario=MINI)
    agent = make_agent("first-free", MINI)
    free = simulate(env, agent, 3)
    limited = simulate(TimeLimit(env, free.steps), agent, 3)
    assert limited.info == free.info
    assert not limited.truncated


def test_decision_times_leave_out_compilation():
    @numba.njit
    def norm(x):
        return np.sqrt((x * x).sum())

    class Compiling(Waiting):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            norm(observation["p_occupied"])
            return super().predict(observation, state, episode_start, deterministic)

    before = seconds_spent()
    result = simulate(TimeLimit(gym.make("parkenv/Search-v2", scenario=MINI), 3), Compiling(), 0)
    compiling_s = seconds_spent() - before
    assert compiling_s > 0.02
    assert min(result.decision_s) > 0.0
    assert sum(result.decision_s) < 0.5 * compiling_s
