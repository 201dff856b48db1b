"""One network for all cars: the batch for stable-baselines3, the compiled network, trainings, models in fleets."""

import json
import pickle

import numpy as np
import pytest
from command_line import parkenv
from sb3_contrib import MaskablePPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.evaluation import evaluate_policy

from parkenv import make_scenario
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.network import NetworkPolicy
from parkenv.engine.records import SEARCHING
from parkenv.envs.fleet_vector import FleetVectorEnv, layers_of, network_policy
from parkenv.envs.sb3 import BatchVecEnv, ShareNetwork
from parkenv.errors import InputError
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.fleet.drivers import MixedFleet, policy_of
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, PoissonArrivals
from planners.agent import make_agent
from planners.heuristics import POLICIES
from planners.model_file import save_model

MINI = make_scenario("mini")
DEMAND = Demand(PoissonArrivals(60.0, 8 * 3600, 8.5 * 3600), ExponentialTime(480.0), ConstantTime(300.0))
LEARNERS = (DriverKind(),)


def batch(n=3, drivers=LEARNERS, reward_scale=1.0, **options):
    worlds = FleetVectorEnv(n, MINI, DEMAND, drivers, leave_full_lot=False, **options)
    return BatchVecEnv(worlds, reward_scale)


def small(algorithm, venv, **options):
    policy = {"net_arch": [16, 8]}
    return algorithm("MultiInputPolicy", venv, seed=0, device="cpu", policy_kwargs=policy, **options)


def random_actions(masks, rng):
    return np.array([rng.choice(np.flatnonzero(mask)) for mask in masks])


def test_every_episode_is_the_search_of_one_car_from_its_arrival_to_its_end():
    venv = batch(2)
    venv.seed(5)
    observed = venv.reset()
    rng, returns, lengths, ends = np.random.default_rng(0), np.zeros(2), np.zeros(2, int), 0
    fresh = np.ones(2, bool)
    for _ in range(3000):
        assert (observed["local"][fresh, 3] == 0.0).all(), "a search begins at time 0"
        assert (observed["local"][~fresh, 3] > 0.0).all()
        for i, fleet in enumerate(venv.batch.fleets):
            car = fleet.cars[venv.batch._cars[i]]
            assert car["state"] == SEARCHING
            assert car["policy"] == 0
        observed, rewards, done, infos = venv.step(random_actions(venv.action_masks(), rng))
        returns, lengths = returns + rewards, lengths + 1
        for i in np.flatnonzero(done):
            ends += 1
            assert infos[i]["total_s"] == pytest.approx(-returns[i], rel=1e-4)
            assert infos[i]["episode"] == pytest.approx({"r": -infos[i]["total_s"], "l": lengths[i]})
            assert infos[i]["terminal_observation"]["local"][3] > 0.0
            returns[i], lengths[i] = 0.0, 0
        fresh = done
    assert ends > 100
    assert (venv.batch._days > 0).all(), "day after day"


def test_the_other_cars_choose_as_the_learning_one_does():
    """A world driven through the batch equals one in which all cars follow the same policy."""
    venv = batch(1)
    model = small(MaskablePPO, venv, n_steps=8, batch_size=8)
    venv.batch.follow(model.policy)
    venv.batch.network.sampled = False
    venv.batch.network.set_layers(*layers_of(model.policy)[:1])
    venv.seed(1)
    venv.reset()
    venv.batch._begin_day(0)
    venv.batch._advance(np.zeros(1, np.int64))
    ended = []
    while venv.batch._days[0] == 0:
        actions, _ = model.predict(
            venv.batch._observations(), action_masks=venv.action_masks(), deterministic=True
        )
        _, _, done, infos = venv.step(actions)
        ended += [info["total_s"] for info in infos if done[0]]
    fleet = Fleet(
        MINI, DEMAND, drivers=[DriverKind(policy=network_policy(model.policy, 5))], leave_full_lot=False
    )
    fleet.reset(1, 0)
    fleet.run()
    wanted = fleet.cars["total_s"]
    assert len(ended) > 5
    assert set(np.round(ended, 6)) <= set(np.round(wanted, 6))


@pytest.mark.parametrize("algorithm", [PPO, MaskablePPO, DQN])
def test_a_compiled_network_drives_as_its_model_does(algorithm, tmp_path):
    venv = batch()
    model = small(algorithm, venv)
    path = tmp_path / "model.safetensors"
    save_model(model, path)
    name = {PPO: "ppo", MaskablePPO: "maskable-ppo", DQN: "dqn"}[algorithm]
    agent = make_agent(f"{name}:{path}", MINI)
    policy, none = policy_of(AgentSpec(name=f"{name}:{path}"), MINI)
    assert none is None
    assert policy.sampled == (algorithm is not DQN), "policies draw their actions in fleets"
    policy = network_policy(model.policy, 5)
    found = []
    for kind, agents in ((DriverKind(policy=policy), None), (DriverKind(), [agent])):
        fleet = Fleet(MINI, DEMAND, drivers=[kind], max_steps=60, leave_full_lot=False)
        fleet.reset(3)
        fleet.run(agents)
        found.append(np.array([fleet.cars["total_s"], fleet.cars["n_steps"], fleet.cars["slot"]]))
    np.testing.assert_array_equal(*found)


def test_drawn_actions_have_the_probabilities_of_the_policy():
    venv = batch()
    model = small(MaskablePPO, venv)
    policy = pickle.loads(pickle.dumps(network_policy(model.policy, 5, sampled=True)))
    demand = Demand(PoissonArrivals(600.0, 8 * 3600, 9 * 3600))
    fleet = Fleet(MINI, demand, drivers=[DriverKind(policy=policy)], max_steps=1, background="none")
    actual = []
    for day in range(6):
        fleet.reset(0, day)
        fleet.run()
        actual += [entry for entry, slot in zip(fleet.cars["vertex"], fleet.cars["slot"], strict=True)]
    twin = Fleet(MINI, demand, drivers=[DriverKind()], max_steps=1, background="none")
    twin.reset(0)
    car = twin.next_decision()
    observation = twin.local_observation(car)
    batched, _ = model.policy.obs_to_tensor(observation)
    wanted = model.policy.get_distribution(batched, action_masks=observation["action_mask"]).distribution
    probabilities = wanted.probs.detach().numpy()[0]
    allowed = np.flatnonzero(observation["action_mask"])
    to = {
        int(MINI.lot.neighbors[int(twin.cars["entry"][car]), a]): probabilities[a] for a in allowed if a < 4
    }
    for vertex, p in to.items():
        assert np.mean(np.array(actual) == vertex) == pytest.approx(p, abs=0.03)


def test_a_search_that_is_cut_off_says_so_and_one_that_balks_does_not():
    cut, balked = batch(max_steps=3), batch(max_steps=10_000)
    for venv, wanted in ((cut, True), (balked, False)):
        venv.seed(0)
        venv.reset()
        ends = []
        for _ in range(2000):
            masks = venv.action_masks()
            masks[:, 4] = False  # drive on
            _, _, done, infos = venv.step(masks.argmax(axis=1))
            ends += [info for info, over in zip(infos, done, strict=True) if over]
            if len(ends) > 5:
                break
        assert [info["TimeLimit.truncated"] for info in ends] == [wanted] * len(ends)
        assert not any(info["parked"] for info in ends)
        assert all(info["gave_up_s"] > 0.0 for info in ends), "in either case the car has no slot"


@pytest.mark.parametrize("algorithm", [PPO, MaskablePPO])
def test_stable_baselines3_learns_with_others_in_the_same_fleet(algorithm):
    kinds = [DriverKind(0.5), DriverKind(0.5, POLICIES["greedy-drive"])]
    venv = batch(4, kinds, reward_scale=0.01)
    model = small(algorithm, venv, n_steps=32, batch_size=64)
    before = [weights.copy() for weights, _ in venv.batch.network.layers]
    model.learn(256, callback=ShareNetwork())
    assert [w.shape for w, _ in venv.batch.network.layers] == [(16, 91), (8, 16), (5, 8)]
    assert len(before) == 1, "until then one layer of zeros: all actions alike"
    mean, _ = evaluate_policy(model, venv, n_eval_episodes=8, warn=False)
    assert mean < 0.0


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ({"n": 0}, "num_envs is 0"),
        ({"reward_scale": -1.0}, "reward_scale is -1.0"),
        ({"drivers": [DriverKind(policy=POLICIES["random"])]}, r"drivers\[0\] has a policy"),
        ({"drivers": [DriverKind(), DriverKind()]}, r"drivers\[1\] has no policy"),
        ({"k": 0}, "k is 0"),
    ],
)
def test_bad_arguments_are_named(options, wanted):
    with pytest.raises(InputError, match=wanted):
        batch(**options)


def test_layers_that_do_not_fit_are_named():
    with pytest.raises(InputError, match="want a chain from 91 numbers to 5"):
        NetworkPolicy([(np.zeros((5, 7), np.float32), np.zeros(5, np.float32))])
    with pytest.raises(InputError, match="activation is 'elu'"):
        NetworkPolicy([(np.zeros((5, 91), np.float32), np.zeros(5, np.float32))], activation="elu")


def test_members_of_a_mixed_fleet_are_those_asked_for():
    few = MixedFleet(MINI, DEMAND, share=0.25, among=AgentSpec(name="greedy-drive"))
    day = few.run_day(AgentSpec(name="random"), 0, 0)
    fleet = Fleet(
        MINI,
        DEMAND,
        drivers=[DriverKind(0.25, POLICIES["random"]), DriverKind(0.75, POLICIES["greedy-drive"])],
        leave_full_lot=False,
    )
    fleet.reset(0, 0)
    fleet.run()
    members = fleet.cars["kind"] == 0
    assert day["cars"] == members.sum()
    assert day["total_s"] == pytest.approx(fleet.cars["total_s"][members].mean())
    assert day["others_s"] == pytest.approx(fleet.cars["total_s"][~members].mean())
    assert (few.name, MixedFleet(MINI, DEMAND).name) == ("0.25 among greedy-drive", "every car")


@pytest.mark.slow
def test_a_training_by_command_and_its_model_in_fleets(tmp_path, monkeypatch):
    out = tmp_path / "out"
    options = ["--env", "fleet", "--scenario", "mini", "--arrivals-per-hour", "30", "--stay-min", "10"]
    parkenv(
        "train",
        *options,
        "--trainings",
        "2",
        "--steps",
        "60000",
        "--evaluation-episodes",
        "2",
        "--out",
        str(out),
    )
    summary = json.loads((out / "summary.json").read_text())
    assert [row["test_scenario"] for row in summary["transfer"]] == [
        "every car",
        "0.1 among greedy-drive",
    ] * 2
    assert {row["agent"] for row in summary["planners"]} == {"greedy-drive", "first-free"}
    first, last = summary["curve"][0]["total_s"], summary["curve"][-1]["total_s"]
    assert last < 0.7 * first, "it learns to park"
    assert (out / "learning_curve.png").exists()
    assert (out / "seed_1" / "curve.csv").exists()
    model = f"maskable-ppo:{out / 'seed_0' / 'model.safetensors'}"
    crowd = tmp_path / "crowd"
    parkenv(
        "fleet", "--scenario", "mini", "--agents", f"{model},greedy-drive", "--knows", "own",
        "--arrivals-per-hour", "30", "--stay-min", "10", "-n", "2", "--out", str(crowd),
    )  # fmt: skip
    rows = json.loads((crowd / "summary.json").read_text())["rows"]
    assert [row["agents"] for row in rows] == [model, "greedy-drive"]
    assert parkenv("report", out).returncode == 0
