"""The planners of pomdp-py as agents of ours, and comparisons of planners at several times for a decision."""

import gymnasium as gym
import numpy as np
import pytest
from command_line import parkenv as command
from test_model import numbers_in

import parkenv
from benchmarks.pomdp import planners_in_time
from parkenv import InputError
from parkenv.studies.compare.figures import ComparisonResults, draw_figures
from parkenv.studies.runner import run
from planners import make_agent
from planners.heuristics.policies import POLICIES

PEERS = ("examples.pomdp_py_agents:POUCT", "examples.pomdp_py_agents:POMCP")


@pytest.fixture
def peers(monkeypatch, request):
    pytest.importorskip("pomdp_py", reason="needs the extra pomdp: pomdp-py")
    monkeypatch.chdir(request.config.rootpath)
    return PEERS


def totals(env, agent, n=8):
    return np.mean([parkenv.simulate(env, agent, seed=seed).info["total_s"] for seed in range(n)])


def test_planners_of_pomdp_py_gain_on_the_heuristic_of_their_rollouts(peers):
    scenario = parkenv.make_scenario("mini", day_error=0.8)
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    least = totals(env, make_agent("greedy-total", scenario))
    for name in peers:
        found = [totals(env, make_agent(name, scenario, simulations=60)) for _ in range(2)]
        assert found[0] < least + 0.5
        if name == PEERS[0]:  # POMCP draws with Python's own generator
            assert found[0] == found[1]


def test_no_key_of_the_world_can_be_reached_from_their_memory(peers):
    env = gym.make("parkenv/Search-v2", scenario=parkenv.make_scenario("mini"))
    for name in peers:
        agent, memory = make_agent(name, env.unwrapped.scenario, simulations=20), None
        observation, _ = env.reset(seed=3)
        for _ in range(2):
            action, memory = agent.predict(observation, memory)
            observation, *_ = env.step(action)
        record = env.unwrapped.searches.records[0]
        hidden = [record[key].tobytes() for key in ("key", "seed_state")]
        roots = (agent, memory, memory.agent.belief, memory.planner)
        assert not any(key in found for found in numbers_in(*roots) for key in hidden)


def test_one_search_of_a_batch_is_itself():
    env = gym.make("parkenv/Search-v2", scenario=parkenv.make_scenario("campus"))
    model = parkenv.model(env.unwrapped.scenario)
    belief = model.initial_belief(env.reset(seed=0)[0])
    batch, alike = (model.sample(belief, np.random.default_rng(0), 5) for _ in range(2))
    for i in range(5):
        one = batch.one(i)
        cost_s, _ = one.step(np.array([3]))
        told = one.observation()
        one.run(POLICIES["first-free"])
        assert one.over[0] == batch.over[i]
        assert cost_s[0] == alike.step(np.full(5, 3))[0][i] if i == 0 else True
        assert told.vertex == alike.observation(i).vertex
        assert told.taken.tolist() == alike.observation(i).taken.tolist()
    np.testing.assert_array_equal(batch.over, np.ones(5, bool))


def test_agents_with_a_budget_run_once_with_each_and_others_once(tmp_path):
    out = tmp_path / "run"
    study = planners_in_time(seed=0, episodes=2, budgets_ms=(2.0, 4.0)).changed(jobs=1, figures=False)
    study = study.changed(scenarios=study.scenarios[:1], agents=("belief(budget_ms=1)", "mdp", "rollout"))
    result = run(study, out)
    assert [(row["planner"], row["budget_ms"]) for row in result.rows] == [
        ("belief", 1), ("mdp", None), ("rollout", 2.0), ("rollout", 4.0),
    ]  # fmt: skip
    assert all(row["decision_ms"] >= row["budget_ms"] for row in result.rows[-2:])
    drawn = ComparisonResults(result.study.cases, result.results.rows(study.table), result.rows)
    (picture,) = draw_figures(drawn, tmp_path, ["time_against_decision_time"])
    assert picture.stat().st_size > 10_000
    more = run(study.changed(episodes=3), out, resume=True)
    assert {row["episodes"] for row in more.rows} == {3}


def test_a_budget_that_no_agent_takes_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"budget_ms is 10, and no agent takes it: mdp"):
        parkenv.compare(
            scenarios=["mini"], agents=["mdp"], grid={"budget_ms": [10.0]}, episodes=1, jobs=1,
            folder=tmp_path / "run",
        )  # fmt: skip
    done = command("compare", "--agents", "rollout", "--budget-ms", "0,x", "--out", tmp_path / "run")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "run").exists()


RAISES = """
class Raises:
    def __init__(self, problem):
        pass

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        raise ZeroDivisionError("none left")
"""


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_agent_that_raises_is_told_in_one_line(tmp_path, jobs):
    (tmp_path / f"raising_{jobs}.py").write_text(RAISES)
    done = command(
        "compare", "--scenario", "mini", "--agents", f"raising_{jobs}:Raises", "-n", 2, "--jobs", jobs, "--out",
        tmp_path / "run", "--occupancy-levels", "none", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 2
    (line,) = (one for one in done.stderr.splitlines() if "error" in one)
    assert f"raising_{jobs}:Raises fails: ZeroDivisionError: none left" in line
    assert f"raising_{jobs}.py, line 7" in line
