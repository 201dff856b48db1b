"""Learning agents: the batch for stable-baselines3, interruptible trainings, model metadata."""

import base64
import json
import pathlib
import pickle
import random
import tempfile
import zipfile
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from command_line import ran, refused, summary_of
from gymnasium.vector import AutoresetMode
from sb3_contrib import MaskablePPO
from small_trainings import make_small, search_training, stop_training
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecFrameStack, VecNormalize

from parkenv import make_scenario
from parkenv.envs.local_observation import LocalObservation
from parkenv.envs.sb3 import SearchVecEnv
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.errors import InputError
from parkenv.lots import grid_lot
from parkenv.studies.compare.cases import Case
from parkenv.studies.runner import run
from parkenv.studies.training.configs import SEARCH_CONFIGS
from parkenv.studies.training.curve_file import read_curve
from parkenv.studies.training.study import TrainingStudy
from parkenv.studies.training.training import TRAINING_SEEDS, episode_times
from parkenv.studies.trips.driven_search import DrivenSearch
from parkenv.world.occupancy.day_error import DayError
from planners.agent import make_agent
from planners.model_file import LearnedAgent, save_model
from planners.names import ALGORITHMS

_MINI = make_scenario("mini")
# Without full days, on which nobody parks soon, a short training is enough to learn to park.
SCENARIO = _MINI.replace(occupancy=_MINI.occupancy.with_day_error(DayError()))
two, four = partial(SearchVecEnv, 2, "mini"), partial(SearchVecEnv, 4, "mini")
made = partial(gym.make, "parkenv/Search-v2", observation="local")
EVALUATED = range(2_000_000, 2_000_020)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short training in a folder."""
    folder = tmp_path_factory.mktemp("trained")
    training = search_training("maskable-ppo", 25_000, 12_288, [SCENARIO], episodes=len(EVALUATED))
    training.train(0, folder)
    return folder


def test_the_adapter_steps_as_the_batch_does_and_tells_of_ends_as_monitor_does():
    venv, batch = (
        SearchVecEnv(6, "mini", reward_scale=0.01, max_episode_steps=25),
        ParkSearchVectorEnv(6, "mini", "local", max_episode_steps=25, autoreset_mode=AutoresetMode.SAME_STEP),
    )
    venv.seed(3)
    observed, wanted = venv.reset(), batch.reset(seed=3)[0]
    rng, returns, cut = np.random.default_rng(0), np.zeros(6), []
    for _ in range(300):
        for name in wanted:
            np.testing.assert_array_equal(observed[name], wanted[name])
        np.testing.assert_array_equal(venv.action_masks(), wanted["action_mask"] == 1)
        actions = np.array([rng.choice(np.flatnonzero(mask)) for mask in venv.action_masks()])
        observed, rewards, done, infos = venv.step(actions)
        wanted, in_seconds, terminated, truncated, told = batch.step(actions)
        np.testing.assert_allclose(rewards, 0.01 * in_seconds, rtol=1e-6)
        np.testing.assert_array_equal(done, terminated | truncated)
        returns += in_seconds
        for i in np.flatnonzero(done):
            cut.append(bool(truncated[i] and not terminated[i]))
            assert infos[i]["episode"]["r"] == pytest.approx(returns[i])
            assert infos[i]["total_s"] == pytest.approx(-returns[i])
            assert infos[i]["TimeLimit.truncated"] == cut[-1]
            end = infos[i]["terminal_observation"]
            np.testing.assert_array_equal(end["local"], told["final_obs"][i]["local"])
            returns[i] = 0.0
        assert all(not infos[i] for i in np.flatnonzero(~done))
    assert len(cut) > 6
    assert set(cut) == {False, True}


def test_a_model_learns_to_park_and_evaluate_policy_agrees_with_compare(trained):
    curve = read_curve(trained / "curve.csv", ("steps", "total_s"))
    assert [row["steps"] for row in curve] == sorted(row["steps"] for row in curve)
    assert curve[0]["steps"] == 0
    assert curve[-1]["steps"] >= 25_000
    best = min(row["total_s"] for row in curve)
    assert best < 60.0 < curve[0]["total_s"], "it parks now, and did not when it began"
    name = f"maskable-ppo:{trained / 'model.safetensors'}"
    agent = make_agent(name, SCENARIO)
    times, _ = episode_times(agent.model, SCENARIO, EVALUATED)
    assert times.mean() == pytest.approx(best)
    assert [row["total_s"] for row in Case(SCENARIO, name).run(EVALUATED)] == pytest.approx(times)
    env = LocalObservation(gym.make("parkenv/Search-v2", scenario=SCENARIO))
    env.reset(seed=EVALUATED[0])
    returns, _ = evaluate_policy(agent, env, n_eval_episodes=5, return_episode_rewards=True, warn=False)
    assert len(returns) == 5


def test_seeds_decide_networks_and_worlds(tmp_path, monkeypatch):
    make_small(monkeypatch)
    seeds = []
    monkeypatch.setattr(SearchVecEnv, "seed", lambda self, seed: seeds.append(seed))
    training = search_training("ppo", 400, 400, [SCENARIO])
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    for seed in (0, 1):
        training.train(seed, tmp_path / str(seed))
    assert not list((tmp_path / "temporary").glob("SB3-*")), "stable-baselines3 keeps a folder of logs"
    assert seeds[1::2] == [TRAINING_SEEDS, 2 * TRAINING_SEEDS], "worlds apart from those of evaluations"
    models = [(tmp_path / seed / "model.safetensors").read_bytes() for seed in "01"]
    assert models[0] != models[1]


def test_a_model_decides_on_driven_trips(trained):
    """On the lanes of the same world, it drives as in the search environment, as long as no attempt fails."""
    name = f"maskable-ppo:{trained / 'model.safetensors'}"
    search = DrivenSearch(SCENARIO, name)
    # A model of so short a training may circle; those are long searches.
    planned = {row["seed"]: row for row in Case(SCENARIO, name).run(range(6)) if row["total_s"] < 100.0}
    assert len(planned) >= 3
    trips = [search.run(seed) for seed in planned]
    assert all(trip.parked for trip in trips)
    same = [trip.slot == planned[trip.seed]["slot"] for trip in trips]
    assert sum(same) >= len(same) - 1


class Payload:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return pathlib.Path.touch, (self.mark,)


def with_header(header):
    """A file in the layout of safetensors."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text


def changed_card(**fields):
    def spoil(path, _):
        data = path.read_bytes()
        size = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + size])
        card = json.loads(header["__metadata__"]["parkenv"]) | fields
        header["__metadata__"]["parkenv"] = json.dumps(card)
        path.write_bytes(with_header(header) + data[8 + size :])

    return spoil


def written(data):
    return lambda path, _: path.write_bytes(data)


def pickled(path, mark):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", json.dumps({"policy_class": {":serialized:": encoded(mark)}}))


def encoded(mark):
    return base64.b64encode(pickle.dumps(Payload(mark))).decode()


@pytest.mark.parametrize(
    ("spoil", "wanted"),
    [
        (lambda path, _: path.write_bytes(path.read_bytes()[:-2000]), "its network cannot be read"),
        (lambda path, _: path.write_bytes(path.read_bytes()[:-4] + b"\0\0\xc0\x7f"), "has weights that are no numbers"),
        (written(b""), "no model file, or a damaged one"),
        (written(b"\xff" * 7 + b"\x00{" + b" " * 99), "no model file, or a damaged one"),
        (written(with_header(b"{" * 300_000)), "header: "),
        (written(with_header({"__metadata__": {}})), "it has no card"),
        (written(with_header({"__metadata__": {"parkenv": "[]"}})), "card is a list, want a JSON"),
        (pickled, "pickled objects, which run code"),
        (lambda path, mark: path.write_bytes(pickle.dumps(Payload(mark))), "no model file"),
        (changed_card(policy_options={"net_arch": [10**9]}), "net_arch"),
        (changed_card(policy_options={"net_arch": [64]}), "its network cannot be read"),
        (changed_card(policy_options={"activation_fn": "Module"}), "activation_fn is 'Module'"),
        (changed_card(policy="os.system"), "policy is 'os.system'"),
        (changed_card(task="drive"), "task is 'drive', want 'search'"),
        (changed_card(observation="local-0"), "observes 'local-0'"),
        (changed_card(algorithm="dqn"), "is a model of dqn, not of maskable-ppo"),
        (lambda path, _: path.unlink(), "No such file"),
    ],
)  # fmt: skip
def test_models_that_do_not_fit_are_refused_and_run_nothing(trained, tmp_path, spoil, wanted):
    path, mark = tmp_path / "model.safetensors", tmp_path / "was_run"
    path.write_bytes((trained / "model.safetensors").read_bytes())
    spoil(path, mark)
    with pytest.raises(InputError, match=wanted):
        make_agent(f"maskable-ppo:{path}", SCENARIO)
    assert not mark.exists()


@pytest.mark.parametrize(
    ("envs", "changed", "wanted"),
    [
        (two, {"activation_fn": torch.nn.Hardtanh}, "activation_fn is 'Hardtanh'"),
        (two, {"normalize_images": False}, "normalize_images"),
        (lambda: gym.make("parkenv/Search-v2", scenario="mini"), {}, "does not observe `local`"),
        (lambda: VecFrameStack(two(), 2), {}, "does not observe `local`"),
        (lambda: VecNormalize(VecNormalize(two())), {}, "wrap"),
        (lambda: gym.wrappers.TransformObservation(made(), dict, None), {}, "wrap|does not observe `local`"),
    ],
)
def test_only_models_that_can_be_described_are_saved(tmp_path, envs, changed, wanted):
    model = PPO("MultiInputPolicy", envs(), n_steps=8, batch_size=8, policy_kwargs=changed)
    with pytest.raises(InputError, match=wanted):
        save_model(model, tmp_path / "m.safetensors")
    assert not list(tmp_path.iterdir())


WRAPPED = {
    "only local": lambda: VecNormalize(four(), norm_obs_keys=["local"], clip_obs=0.7, epsilon=0.1),
    "all, as rl-zoo3": lambda: VecNormalize(VecCheckNan(four())),
    "rewards": lambda: VecNormalize(four(), norm_obs=False),
    "single": lambda: VecNormalize(DummyVecEnv([lambda: LocalObservation(gym.make("parkenv/Search-v2"))])),
}


@pytest.mark.parametrize("wrapped", WRAPPED)
@pytest.mark.parametrize("kind", [PPO, MaskablePPO])
def test_a_model_file_keeps_how_observations_were_normalised(tmp_path, wrapped, kind):
    envs = WRAPPED[wrapped]()
    model = kind("MultiInputPolicy", envs, 0.01, n_steps=32, batch_size=32, seed=0, device="cpu").learn(128)
    name = "ppo" if kind is PPO else "maskable-ppo"
    save_model(model, tmp_path / "m.safetensors")
    before = torch.get_rng_state()
    agent = make_agent(f"{name}:{tmp_path / 'm.safetensors'}", make_scenario("mini"))
    assert torch.equal(torch.get_rng_state(), before)
    raw = ParkSearchVectorEnv(50, "mini", "local")
    seen, _ = raw.reset(seed=1)
    for _ in range(5):
        masks = {} if kind is PPO else {"action_masks": seen["action_mask"]}
        actions, _ = model.predict(envs.normalize_obs(seen), deterministic=True, **masks)
        np.testing.assert_array_equal(agent.predict(seen)[0], actions)
        normalized = envs.normalize_obs(seen)["local"]
        np.testing.assert_array_equal(agent.normalization(seen)["local"], normalized, err_msg=wrapped)
        seen = raw.step(actions)[0]


def test_a_training_in_this_process_leaves_global_seeds_and_threads(tmp_path):
    torch.set_num_threads(2)
    random.seed(1), np.random.seed(1), torch.manual_seed(1)  # noqa: NPY002
    drawn = random.getstate(), np.random.get_state(), torch.get_rng_state().tolist()  # noqa: NPY002
    try:
        fields = {"steps": 100, "trainings": 1, "agents": [], "evaluation_episodes": 2, "jobs": 1}
        run(TrainingStudy.parse({"algorithm": "ppo", "scenarios": ["mini"], **fields}, ""), tmp_path)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)
    now = random.getstate(), np.random.get_state(), torch.get_rng_state().tolist()  # noqa: NPY002
    np.testing.assert_equal(now, drawn)


def test_a_checkpoint_that_does_not_fit_or_is_damaged_is_refused_and_runs_nothing(tmp_path, monkeypatch):
    make_small(monkeypatch)
    training, path = search_training("ppo", 1_100, 400, [SCENARIO]), tmp_path / "checkpoint.pt"
    stop_training(training, tmp_path, monkeypatch)
    data, mark = bytearray(path.read_bytes()), tmp_path / "was_run"
    for content, message in (
        (torch.load(path, weights_only=True) | {"parameters": {}}, "does not fit this training"),
        ({"format": "parkenv-checkpoint-3", "steps": Payload(mark)}, "no checkpoint of this version"),
    ):
        torch.save(content, path)
        with pytest.raises(InputError, match=message):
            training.train(0, tmp_path)
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match="is not as it was written"):
        training.train(0, tmp_path)
    assert not mark.exists()


LOTS = [make_scenario(grid_lot(2, 6 + i), name=f"lot{i}") for i in range(6)]
TRAININGS = {
    **{name: lambda name=name: search_training(name, 1_500, 400, [SCENARIO]) for name in SEARCH_CONFIGS},
    "many lots": lambda: search_training("ppo", 1_536, 512, LOTS, episodes=8),
}


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind != "maskable-ppo")) for kind in TRAININGS]
)
def test_a_stopped_training_goes_on_from_its_checkpoint(kind, tmp_path, monkeypatch):
    """Killed right before its third checkpoint: the evaluation before it is repeated."""
    make_small(monkeypatch)
    training = TRAININGS[kind]()
    stop_training(training, tmp_path, monkeypatch)
    before, curve = read_curve(tmp_path / "curve.csv"), training.train(0, tmp_path)
    assert repr(curve[:2]) == repr(before[:2])
    assert [row["steps"] for row in curve[:3]] == [row["steps"] for row in before]
    assert curve[-1]["steps"] >= training.spec.steps
    assert {path.name for path in tmp_path.iterdir()} == {"checkpoint.pt", "curve.csv", "model.safetensors"}
    assert repr(training.train(0, tmp_path)) == repr(curve), "a finished training is not repeated"
    if kind in SEARCH_CONFIGS:
        model = LearnedAgent(SCENARIO, kind, tmp_path / "model.safetensors").model
        times, _ = episode_times(model, SCENARIO, training.evaluation_seeds)
        assert times.mean() == min(row["total_s"] for row in curve)


def test_a_finished_training_goes_on_with_more_steps(tmp_path):
    fields = {"algorithm": "ppo", "scenarios": ["mini"], "trainings": 1, "agents": []}
    fields |= {"evaluation_episodes": 4, "jobs": 1}
    short, long = (TrainingStudy.parse({**fields, "steps": steps}, "") for steps in (600, 1_300))
    before = run(short, tmp_path).summary["curve"]
    after = run(long, tmp_path, resume=True).summary["curve"]
    assert after[: len(before)] == before, "it goes on where it was"
    assert after[-1]["steps"] >= 1_300 > before[-1]["steps"]
    (tmp_path / "seed_0" / "checkpoint.pt").unlink()
    assert run(short, tmp_path, resume=True).summary["curve"] == after, "no more than asked is nothing to do"
    with pytest.raises(InputError, match="cannot go on"):
        run(long.changed(steps=2_000), tmp_path, resume=True)


def test_observations_of_another_kind_are_refused_and_a_dead_end_is_waited_at(trained):
    agent = LearnedAgent(SCENARIO, "maskable-ppo", trained / "model.safetensors")
    env = gym.make("parkenv/Search-v2", scenario=SCENARIO)
    for observation, wanted in (
        (env.reset(seed=0)[0], r'wants observations of .*observation="local", got vertex, time'),
        (LocalObservation(env, k=7).reset(seed=0)[0], "observes 86 numbers, got 102 for its k = 5"),
    ):
        with pytest.raises(InputError, match=wanted):
            agent.predict(observation)
    masks = np.array([[0] * 5, [0, 0, 1, 0, 0]], np.int8)
    actions = agent.predict({"local": np.zeros((2, 86), np.float32), "action_mask": masks})[0]
    assert actions[1] == 2
    assert 0 <= actions[0] <= 4
    observation = gym.make("parkenv/Search-v2", scenario=SCENARIO).reset(seed=0)[0]
    observation["action_mask"][:] = 0
    lone, vertex = make_agent("random", SCENARIO), observation["vertex"]
    assert SCENARIO.lot.neighbors[vertex, lone.predict(observation)[0]] < 0
    with pytest.warns(UserWarning, match="was trained on .*, not on street$"):
        LearnedAgent(make_scenario("street"), "maskable-ppo", trained / "model.safetensors")


def test_every_algorithm_has_a_recipe():
    assert SEARCH_CONFIGS.keys() == ALGORITHMS.keys()


# One on-policy algorithm and one with a replay buffer; `TRAININGS` stops each kind.
@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["maskable-ppo", "dqn"])
def test_the_command_trains_and_its_models_can_be_compared(tmp_path, monkeypatch, algorithm):
    make_small(monkeypatch)
    out, steps = tmp_path / "out", 1_100  # two rollouts or more
    command = [
        "train", algorithm, "--scenario", "mini", "--steps", steps, "--trainings", 1,
        "--evaluate-every", 500, "--evaluation-episodes", 4, "--agents", "mdp", "--jobs", 1, "--out",
    ]  # fmt: skip
    ran(*command, out)
    assert "--resume" in refused(*command, out)
    # The curve of the first training is that of the longer run, too.
    curve = read_curve(out / "seed_0" / "curve.csv", ("steps", "total_s"))
    ran(*command, out, "--resume", "--trainings", 2)
    assert read_curve(out / "seed_0" / "curve.csv", ("steps", "total_s")) == curve
    rows = summary_of(out)["rows"]
    assert [row["seed"] for row in rows] == [0, 1]
    assert all(row["steps"] >= steps for row in rows)
    ran(
        "compare", "--scenario", "mini", "--agents", f"mdp,{algorithm}:{out / 'seed_1' / 'model.safetensors'}",
        "-n", 2, "--occupancy-levels", "none", "--no-figures", "--jobs", 1, "--out", tmp_path / "compared",
    )  # fmt: skip
