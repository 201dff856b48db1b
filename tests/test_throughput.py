"""Rows of the benchmarks, and methods of others as agents of ours."""

import gc
import json
import random
import subprocess
import sys
from importlib import import_module
from itertools import permutations
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from test_model import numbers_in

import parkenv
from benchmarks import env, fleet, planning, sensors
from benchmarks import sumo_days as sumo
from parkenv import InputError
from parkenv.lots import grid_lot
from parkenv.studies.simulate import adapt_to_agent
from planners import make_agent
from sim_sensors.laser.scanner import LaserScanner

PROGRAM = Path(__file__).parents[1] / "benchmarks" / "run.py"
KEYS = ["part", "case", "value", "unit", "peer", "peer_value", "ratio"]


def run(*words):
    return subprocess.run([sys.executable, PROGRAM, *map(str, words)], capture_output=True, text=True)


def test_a_part_writes_its_rows_and_the_help_page_names_the_parts(tmp_path):
    done = run("drive", "--seconds", 0.01, "--out", tmp_path / "b")
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "b" / "summary.json").read_text())["rows"]
    assert all(list(row) == KEYS for row in rows)
    assert {row["unit"] for row in rows} == {"physics steps/s", "ms"}
    assert all(row["value"] > 0 for row in rows if "not installed" not in row["case"])
    assert all(row["case"] in done.stdout for row in rows)
    assert "pomdp" in run("--help").stdout
    refused = run("engine")
    assert (refused.returncode, "'engine'" in refused.stderr) == (2, True)


def rows_of(part):
    if part == "sensors":
        rows = sensors.laser_rows(seconds=0.0) + sensors.camera_rows(seconds=0.0)
        return rows + sensors.search_rows(seconds=0.0, scenario="mini")
    if part == "planning":
        return planning.planning_rows(seconds=0.01, largest=2_000)
    if part == "fleet":
        return fleet.fleet_rows(seconds=0.0, worlds=2, large=400, day_cars=20, growth=(5,))
    return env.env_rows(seconds=0.0, batch=4, large=300, places=3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "parts", "missing"),
    [
        ("sensors", {"laser", "camera", "environment"}, 0),
        ("planning", {"plan", "replan", "search"}, 0),
        ("fleet", {"decisions", "day", "memory", "growth"}, 1),
        ("env", {"batch", "single", "memory"}, 3),
    ],
)
def test_parts_have_rows(part, parts, missing, monkeypatch):
    monkeypatch.setattr(env, "find_spec", lambda name: None)
    monkeypatch.setattr(sumo, "sumo_folder", lambda: None)
    rows = rows_of(part)
    assert all(list(row) == KEYS for row in rows)
    assert {row["part"] for row in rows} == parts
    absent = [row["case"] for row in rows if row["value"] is None]
    assert len(absent) == missing
    assert all(case.endswith(": not installed") for case in absent)
    assert all(row["value"] > 0 for row in rows if row["value"] is not None)


@pytest.mark.parametrize("name", ["marching", "pymunk", "embree"])
def test_peers_measure_what_the_laser_measures(name):
    scanner = getattr(sensors, f"{name}_scanner")
    tolerance = 2 * sensors.GRID_CELL if name == "marching" else 2e-3
    laser = LaserScanner()
    plane, draw = sensors.walled_lot(np.random.default_rng(3), 30)
    peer, poses = scanner(plane, laser), draw(3)
    ours, theirs = (np.minimum(s, laser.max_range) for s in (laser.scan(plane, poses), peer(poses)))
    assert ((np.abs(ours - theirs) > tolerance).mean(axis=1) < 0.05).all()
    np.testing.assert_array_equal(peer(poses), np.concatenate([peer(pose[None]) for pose in poses]))


def test_solvers_are_given_the_same_process():
    mdp = planning.forecast_process(grid_lot(2, 6), 0)
    p, n = planning.transitions(mdp), mdp.n_states
    np.testing.assert_allclose(np.asarray(p.sum(axis=1)).ravel(), 1.0)
    values = np.random.default_rng(0).normal(size=n)
    ahead = (p @ np.append(values, 0.0))[:-1].reshape(n, 5)
    np.testing.assert_allclose(mdp.rewards() + mdp.gamma * ahead, mdp.action_values(values))


PEERS = ("examples.peers.pomdp_py_agents:POUCT", "examples.peers.pomdp_py_agents:POMCP")
PAPERS = ("lmu:ReplannedMDP", "mit:StopsAhead", "mit:Impatient", "mit:Patient")
CLEANRL, MODEL = "examples.peers.cleanrl:PPO", "docs/leaderboard/models/cleanrl.safetensors"
METHODS = {f"examples.peers.{name}": {} for name in PAPERS} | {CLEANRL: {"file": MODEL}}
METHODS |= {name: {"simulations": 30} for name in (*PEERS, "examples.rollout_agent:Rollout")}


@pytest.fixture
def in_root(monkeypatch, request):
    monkeypatch.chdir(request.config.rootpath)
    monkeypatch.syspath_prepend(request.config.rootpath)


def totals(env, agent, n=8):
    return np.mean([parkenv.simulate(env, agent, seed=seed).info["total_s"] for seed in range(n)])


def agent_of(name, scenario, **options):
    if name in PEERS:
        pytest.importorskip("pomdp_py", reason="needs the extra pomdp: pomdp-py")
    if name == CLEANRL:
        pytest.importorskip("safetensors", reason="needs the extra rl: safetensors")
    return make_agent(name, scenario, **METHODS[name] | options)


def test_planners_of_pomdp_py_gain_on_the_heuristic_of_their_rollouts(in_root):
    scenario = parkenv.make_scenario("mini", day_error=0.8)
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    at_random = totals(env, make_agent("random", scenario))
    for name in PEERS:
        assert totals(env, agent_of(name, scenario, simulations=30, base="random")) < 0.6 * at_random


@pytest.mark.parametrize("name", METHODS)
def test_no_key_of_the_world_can_be_reached_from_their_memory(in_root, name):
    scenario, memory = parkenv.make_scenario("mini"), None
    agent = agent_of(name, scenario)
    env = adapt_to_agent(gym.make("parkenv/Search-v2", scenario=scenario), agent)
    observation, _ = env.reset(seed=3)
    for _ in range(2):
        action, memory = agent.predict(observation, memory)
        observation, *_ = env.step(action)
    record = env.unwrapped.searches.records[0]
    hidden = [record[key].tobytes() for key in ("key", "seed_state")]
    roots = (agent, memory, *((memory.agent.belief, memory.planner) if name in PEERS else ()))
    assert not any(key in found for found in numbers_in(*roots) for key in hidden)
    assert name == CLEANRL or type(agent.problem) is parkenv.world.scenario.SearchProblem


@pytest.mark.parametrize("name", METHODS)
def test_methods_of_others_search_and_are_seeded(in_root, name):
    scenario, found = parkenv.make_scenario("mini", day_error=0.8), []
    env = gym.make("parkenv/Search-v2", scenario=scenario)
    least = {name: totals(env, make_agent(name, scenario), 4) for name in ("belief", "random")}
    for _ in range(2):
        state, agent = random.getstate(), agent_of(name, scenario)
        found.append(totals(adapt_to_agent(env, agent), agent, 4))
        assert random.getstate() == state
        random.seed(1)
    assert found[0] == found[1]
    assert found[0] < least["random"] or name.endswith("Patient")
    if name.endswith(("StopsAhead", "ReplannedMDP")):
        assert found[0] < least["belief"] + 3.0


def test_stops_ahead_are_the_formulas_of_the_paper(in_root):
    scenario, to_lot_s, expected = parkenv.make_scenario("mini"), np.array([20.0, 10.0]), {}
    p, walk_s = np.array([0.8, 0.5]), np.array([30.0, 60.0])
    drive_s = np.array([[300.0, 15.0], [12.0, 300.0]])
    for stops in (1, 2, 3):
        agent = make_agent("examples.peers.mit:StopsAhead", scenario, stops=stops)
        agent.cost_s, agent.between_s = walk_s, drive_s
        expected[stops] = agent.expected_s(to_lot_s, p)
    assert expected[1] == pytest.approx([20 / 0.8 + 30, 10 / 0.5 + 60])
    second = (drive_s / p + walk_s).min(axis=1)
    assert expected[2] == pytest.approx(to_lot_s + p * walk_s + (1 - p) * second)
    third = (drive_s + p * walk_s + (1 - p) * second).min(axis=1)
    assert expected[3] == pytest.approx(to_lot_s + p * walk_s + (1 - p) * third)


def time_in_order(bays, between_s, p, cost_s, wait_s):
    """Return the expected time from the first bay, which is taken, on to the others, and of a wait at the last."""
    here, *then = bays
    if not then:
        return wait_s[here]
    after_s = time_in_order(then, between_s, p, cost_s, wait_s)
    return between_s[here, then[0]] + p[then[0]] * cost_s[then[0]] + (1 - p[then[0]]) * after_s


def test_the_mdp_of_bays_is_the_best_order_of_them(in_root):
    lmu, rng, n = import_module("examples.peers.lmu"), np.random.default_rng(0), 4
    for _ in range(20):
        between_s, p = rng.uniform(1, 50, (n, n)), rng.random(n)
        cost_s, wait_s = rng.uniform(5, 60, n), rng.uniform(100, 200, n)
        found = lmu.best_times(list(lmu.sets_of(n)), between_s, p, cost_s, wait_s)
        orders = [(0, *rest[:k]) for rest in permutations(range(1, n)) for k in range(n)]
        times_s = [time_in_order(bays, between_s, p, cost_s, wait_s) for bays in orders]
        assert found[0b0001, 0] == pytest.approx(min(times_s))


def test_bays_are_markov_chains_to_the_moment_of_arrival(in_root):
    agent = make_agent("examples.peers.lmu:ReplannedMDP", parkenv.make_scenario("mini"))
    belief = parkenv.belief.slot_belief.SlotBelief.of_forecast(np.full(10, 0.8), np.full(10, 1e-2))
    belief = belief.update([4], [False])
    assert agent.p_free(belief, np.full(10, 100.0)) == pytest.approx(1.0 - belief.decay(100.0).p_occupied)


def test_cars_of_a_fleet_that_share_reserve_and_adapt(in_root):
    pytest.importorskip("pettingzoo", reason="needs the extra multi: pettingzoo")
    fleet = import_module("examples.peers.lmu_fleet")
    for kind in fleet.FLEETS:
        times_s = fleet.total_times(kind, "mini", 3, seed=1)
        assert times_s == fleet.total_times(kind, "mini", 3, seed=1)
        assert len(times_s) == 3
        assert min(times_s) > 0.0


def test_a_file_without_a_policy_of_cleanrl_is_refused(in_root, tmp_path):
    safetensors = pytest.importorskip("safetensors.numpy", reason="needs the extra rl: safetensors")
    scenario, file = parkenv.make_scenario("mini"), tmp_path / "cut.safetensors"
    cut = {name: values[:3].copy() for name, values in safetensors.load_file(MODEL).items()}
    safetensors.save_file(cut, file)
    with pytest.raises(InputError, match=r"its weights and biases are \[\(86, 3\), \(3,\)"):
        make_agent(CLEANRL, scenario, file=file)
    with pytest.raises(InputError, match=r"no actor of CleanRL's ppo.py: '0.weight'"):
        make_agent(CLEANRL, scenario, file=MODEL.replace("cleanrl", "maskable-ppo"))


PIPED = "examples.peers.in_another_environment:Piped"
SERVER = """
import json, sys, time
print('hello', file=sys.stderr)
for line in sys.stdin:
    message = json.loads(line)
    mask = message.get('observation', {}).get('action_mask')
    print(ANSWER if mask else json.dumps({'ready': True}), flush=True)
"""


class FirstMove:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return int(observation["action_mask"].argmax()), state


def test_an_agent_in_a_process_of_its_own(in_root, tmp_path):
    scenario, file = parkenv.make_scenario("mini"), tmp_path / "server.py"
    env = gym.make("parkenv/Search-v2", scenario=scenario, max_episode_steps=20)
    file.write_text(SERVER.replace("ANSWER", "json.dumps({'action': mask.index(1)})"))
    agent = make_agent(PIPED, scenario, command=f"'{sys.executable} {file}'")
    found, wanted = (parkenv.simulate(env, driver, seed=1).info["total_s"] for driver in (agent, FirstMove()))
    assert found == wanted
    process = agent.process.process
    del agent
    gc.collect()
    assert process.poll() is not None


@pytest.mark.slow  # waits in vain for 5 s
def test_what_goes_wrong_in_a_process_of_its_own_is_told(in_root, tmp_path):
    scenario, file = parkenv.make_scenario("mini"), tmp_path / "server.py"
    env = gym.make("parkenv/Search-v2", scenario=scenario, max_episode_steps=20)
    for answer, message in (
        ("1 / 0", r"ended with exit code 1; its last line: ZeroDivisionError"),
        ("time.sleep(60)", r"no answer within 5 s; its last line: hello"),
        ("'parked'", r"answered 'parked\\n', want a line with a JSON object"),
        ("json.dumps({'action': 7})", r"action is 7, want 0 to 4"),
    ):
        file.write_text(SERVER.replace("ANSWER", answer))
        limit_s = 5.0 if "sleep" in answer else 60.0
        agent = make_agent(PIPED, scenario, command=f"{sys.executable} {file}", start_s=limit_s)
        with pytest.raises(InputError, match=message):
            parkenv.simulate(env, agent, seed=1)
    with pytest.raises(InputError, match="cannot be run: No such file"):
        parkenv.simulate(env, make_agent(PIPED, scenario, command="no-such-command"), seed=1)
