"""Training of parking agents: the training environment matches the environment, trainings resume, models drive."""

import json
import math

import gymnasium as gym
import numpy as np
import pytest
from command_line import parkenv
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import shows_color
from small_trainings import drive_training, make_small
from typer.testing import CliRunner

from parkenv import make_scenario
from parkenv.cli import app
from parkenv.driving.collision_world import CollisionWorld
from parkenv.driving.vehicle import SPEED, STATE_SIZE, YAW, VehicleParameters
from parkenv.envs.drive import DriveEnv
from parkenv.envs.sb3 import BatchVecEnv
from parkenv.errors import InputError
from parkenv.lots import packaged_lot
from parkenv.show.figures.learning_curves import COLORS, save_success_curves
from parkenv.studies.training.configs import DRIVE_CONFIGS, WAY_IN
from parkenv.studies.training.curve_file import across_seeds, read_curve
from parkenv.studies.training.drive.batch import (
    CONTACT,
    LEFT_AREA,
    PARKED,
    RUNNING,
    DriveBatch,
    PreparedTask,
)
from parkenv.studies.training.drive.env import (
    MASTERED,
    RECENT_DRIVES,
    STANDSTILL_DECISIONS,
    DriveTrainingEnv,
    TerminalGoalReplayBuffer,
    planned_path,
    slot_groups,
)
from parkenv.studies.training.drive.training import evaluate_parking, parked_on
from parkenv.studies.workers import SERIAL
from planners.driving.parking_agents import make_parking_agent
from planners.driving.policy_interface import (
    ACTION_REPEAT,
    BEAMS,
    FARTHEST_M,
    Outlines,
    PolicyInterface,
    encode_observation,
    pedal_command,
)
from planners.model_file import ModelCard

MINI, STREET = packaged_lot("mini"), packaged_lot("street")
EVALUATED = range(2_000_000, 2_000_006)
STEPS = {"ppo": 2_000, "sac": 1_000, "tqc": 1_000}


class Always:
    """A model that always decides the same."""

    def __init__(self, *action):
        self.action = np.array(action, dtype=np.float32)

    def predict(self, observation, **_):
        return np.tile(self.action, (len(observation["observation"]), 1)), None


def training_of(algorithm, steps, every=None, lots=(MINI,)):
    return drive_training(algorithm, steps, every or steps // 2, lots, len(EVALUATED))


FULL_SIZE = dict(DRIVE_CONFIGS)


@pytest.fixture(scope="module", autouse=True)
def small():
    """The training configs, with networks and batches that are fast to train."""
    with pytest.MonkeyPatch.context() as patch:
        make_small(patch)
        yield


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=[pytest.mark.slow] * (name == "tqc")) for name in sorted(STEPS)],
)
def trained(request, tmp_path_factory):
    """A short training of each algorithm, and its folder."""
    folder = tmp_path_factory.mktemp(request.param)
    training_of(request.param, STEPS[request.param]).train(0, folder)
    return request.param, folder


# The training environment


@pytest.mark.parametrize("lot", [MINI, STREET, packaged_lot("campus")], ids=lambda lot: lot.name)
def test_the_batch_drives_as_the_environment_does(lot):
    n, rng = 8, np.random.default_rng(0)
    envs = [DriveEnv(lot=lot, obstacle_map=True, reward="dense") for _ in range(n)]
    batch, pedals = DriveBatch(n), PolicyInterface(VehicleParameters()).pedals
    for i, env in enumerate(envs):
        env.tasks = envs[0].tasks
        env.reset(seed=i)
        batch.start(i, PreparedTask(env.task))
    bias = rng.normal(0.0, 0.6, (n, 2))
    compared = 0
    for _ in range(60):
        actions = np.clip(bias + rng.normal(0.0, 0.5, (n, 2)), -1.0, 1.0).astype(np.float32)
        before = batch.status.copy()
        batch.drive(actions)
        seen = batch.observation()
        for i in np.flatnonzero(before == RUNNING):
            env, reward = envs[i], 0.0
            for _ in range(ACTION_REPEAT):
                pedal = pedal_command(actions[i], env.state.vehicle[SPEED], pedals)
                observation, seconds, over, _, info = env.step([pedal, actions[i, 1]])
                reward += seconds
                if over:
                    break
            failed = LEFT_AREA if info["contact"] == "left the area" else CONTACT
            wanted = PARKED if info["is_success"] else failed if info["contact"] else RUNNING
            assert batch.status[i] == wanted
            assert batch.time[i] == pytest.approx(info["time_s"])
            np.testing.assert_allclose(seen["achieved_goal"][i], observation["achieved_goal"], atol=1e-4)
            np.testing.assert_array_equal(seen["desired_goal"][i], observation["desired_goal"])
            assert -batch.took[i] - batch.approach[i] - 200.0 * (wanted >= CONTACT) == pytest.approx(reward)
            compared += 1
    assert compared > 100
    assert (batch.status >= CONTACT).sum() >= 3


def first_contact(touches, clear, blocked):
    """Halve the way between a clear and a blocked pose until it begins to touch."""
    for _ in range(40):
        middle = 0.5 * (clear + blocked)
        clear, blocked = (clear, middle) if touches(middle) else (middle, blocked)
    return blocked


@pytest.mark.parametrize("lot", [MINI, STREET, packaged_lot("campus")], ids=lambda lot: lot.name)
def test_contacts_begin_where_they_do_in_pymunk(lot):
    rng = np.random.default_rng(0)
    for key in range(4):
        task = DriveEnv(lot=lot).tasks.draw(key)
        space, batch = CollisionWorld(task.vehicle, task.obstacles), DriveBatch(1)
        c, s = math.cos(task.slot[2]), math.sin(task.slot[2])

        def touches(pose, batch=batch, task=task):
            """Stand at a pose in the slot's frame for one decision."""
            batch.start(0, PreparedTask(task), pose)
            batch.state[0, SPEED] = 0.0
            batch.drive(np.zeros((1, 2), np.float32))
            return batch.status[0] == CONTACT

        def touches_in_pymunk(pose, space=space, task=task, c=c, s=s):
            x, y, yaw = pose.tolist()
            east, north = task.slot[0] + c * x - s * y, task.slot[1] + s * x + c * y
            return bool(space.touched(east, north, yaw + task.slot[2]))

        found = 0
        while found < 10:
            clear, blocked = rng.uniform(-7.0, 7.0, (2, 3))
            blocked[2] = clear[2]
            assert touches(clear) == touches_in_pymunk(clear)
            if touches(clear) or not touches(blocked):
                continue
            poses = [first_contact(test, clear, blocked) for test in (touches, touches_in_pymunk)]
            assert np.hypot(*(poses[0] - poses[1])[:2]) < 1e-5
            found += 1


def test_a_drive_that_stands_in_its_slot_has_parked():
    env = DriveEnv(lot=MINI, obstacle_map=True)
    env.reset(seed=0)
    task = PreparedTask(env.task)
    task.start = np.zeros(STATE_SIZE)
    task.start[2] = math.atan2(task.desired[3], task.desired[2])
    task.start[:2] = -env.vehicle.middle * task.desired[2:4]
    batch = DriveBatch(1)
    batch.start(0, task)
    batch.drive(np.zeros((1, 2), np.float32))
    assert batch.status[0] == PARKED
    assert batch.took[0] == 0.0


# Observations and actions


@given(
    x=st.floats(-3, 3), y=st.floats(-3, 3), yaw=st.floats(-4, 4), gap=st.floats(0.0, 8.0), turned=st.floats(-4, 4)
)  # fmt: skip
@settings(max_examples=60)
def test_room_is_measured_from_the_cars_outline_wherever_it_stands(x, y, yaw, gap, turned):
    """A long wall across the way, `gap` before the car's front; the car and the wall are moved and turned together."""
    view = PolicyInterface(VehicleParameters())
    front = view.half[0] + gap
    wall = np.array([[front, -50.0, front, 50.0]])
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, s], [-s, c]])
    edges = (wall.reshape(2, 2) @ turn + (x, y)).reshape(1, 4)
    circle = np.array([[*edges.reshape(2, 2).mean(axis=0), 50.1]])
    state = np.zeros(STATE_SIZE)
    state[YAW] = yaw
    seen = np.empty(8 + BEAMS, np.float32)
    encode_observation(
        np.array([x, y]), state, (edges, np.array([0, 1]), circle), view.body, np.zeros(5), seen
    )
    room = 1.0 / seen[8:] - 1.0
    angle = 2.0 * math.pi / BEAMS * np.arange(BEAMS)
    with np.errstate(divide="ignore"):
        expected = np.where(np.cos(angle) > 1e-6, front / np.cos(angle), np.inf) - view.body
    np.testing.assert_allclose(room, np.clip(expected, 0.0, FARTHEST_M), rtol=1e-4, atol=1e-4)


def test_outlines_are_those_of_the_map():
    env = DriveEnv(lot=STREET, obstacle_map=True)
    observation, _ = env.reset(seed=3)
    outlines = Outlines.of_map(observation["cars"], observation["lines"])
    obstacles = env.task.obstacles
    assert len(outlines.circle) == len(obstacles)
    closed = np.where(obstacles.n_corners > 2, obstacles.n_corners, 1)
    assert len(outlines.edges) == closed.sum() == outlines.first[-1]
    for i, (start, end) in enumerate(zip(outlines.first, outlines.first[1:], strict=False)):
        ends = outlines.edges[start:end].reshape(-1, 2)
        reach = np.hypot(*(ends - outlines.circle[i, :2]).T)
        assert reach.max() == pytest.approx(outlines.circle[i, 2])


@pytest.mark.parametrize(("asked", "reached"), [(1.0, 2.0), (-1.0, -1.5), (0.19, 0.0), (0.6, 1.0)])
def test_a_decision_asks_for_a_speed_and_gets_it(asked, reached):
    task = DriveEnv(lot=MINI).tasks.draw(0)
    batch = DriveBatch(1)
    batch.start(0, PreparedTask(task))
    batch._drives.n_obstacles[0] = 0  # nothing in the way
    batch.state[0, SPEED] = 0.7
    for _ in range(6):
        batch.drive(np.array([[asked, 0.0]], np.float32))
    assert batch.state[0, SPEED] == pytest.approx(reached, abs=0.02)


# Curriculum


def training_env(algorithm, n=4, lots=(MINI, STREET), levels=None):
    return BatchVecEnv(DriveTrainingEnv(n, slot_groups(lots), DRIVE_CONFIGS[algorithm], levels))


def test_places_are_the_kinds_of_slots_that_there_are():
    lots = (STREET, packaged_lot("campus"), MINI)
    assert [(p.lot.name, p.kind) for p in slot_groups(lots)] == [
        ("campus", "perpendicular"), ("mini", "perpendicular"), ("campus", "oblique"), ("street", "parallel"),
    ]  # fmt: skip


def test_equal_seeds_give_equal_episodes_and_report_their_ends():
    several = [training_env("ppo", 6) for _ in range(2)]
    rng, ends = np.random.default_rng(1), 0
    for env in several:
        env.seed(5)
    first, second = (env.reset() for env in several)
    for _ in range(160):
        for name in first:
            np.testing.assert_array_equal(first[name], second[name])
        actions = rng.uniform(-1.0, 1.0, (6, 2)).astype(np.float32)
        (first, rewards, done, infos), (second, *_) = (env.step(actions) for env in several)
        assert (rewards < 0.0).sum() >= 6 - done.sum()
        for i in np.flatnonzero(done):
            ends += 1
            end = infos[i]["terminal_observation"]
            assert not np.array_equal(end["achieved_goal"], first["achieved_goal"][i])
            assert infos[i]["TimeLimit.truncated"] != (infos[i]["is_success"] or infos[i]["contact"])
        assert all(not infos[i] for i in np.flatnonzero(~done))
    assert ends > 6


def test_a_level_is_mastered_by_parking_and_by_nothing_else():
    env = training_env("ppo")
    for _ in range(RECENT_DRIVES):
        env.batch._record_outcome("parallel", 0, True)
        env.batch._record_outcome("perpendicular", 5, True)  # of another level
    assert env.batch.levels == {"perpendicular": 0, "parallel": 1}
    for k in range(3 * RECENT_DRIVES):
        env.batch._record_outcome("parallel", 1, k % 100 < 100 * MASTERED - 1)
    assert env.batch.levels["parallel"] == 1
    for _ in range(RECENT_DRIVES * 20):
        env.batch._record_outcome("parallel", env.batch.levels["parallel"], True)
    assert env.batch.levels["parallel"] == len(DRIVE_CONFIGS["ppo"].curriculum) - 1


def test_levels_make_tasks_harder():
    """At the first level the car is in its slot or just before it; at the last one it is on the lane."""
    away = []
    for level in (0, len(DRIVE_CONFIGS["ppo"].curriculum) - 1):
        env = training_env("ppo", 64, levels=dict.fromkeys(("perpendicular", "parallel"), level))
        env.seed(0)
        seen = env.reset()
        away.append(np.median(np.hypot(*seen["achieved_goal"][:, :2].T)))
    assert away[0] < 2.0 < 5.0 < away[1]


@pytest.mark.parametrize("place", slot_groups((MINI, STREET)), ids=lambda place: place.kind)
def test_the_way_in_leads_from_the_slot_back_to_the_start_and_touches_nothing(place):
    for key in range(4):
        task = place.tasks().draw(key)
        way, space = planned_path(task), CollisionWorld(task.vehicle, task.obstacles)
        desired = PreparedTask(task).desired
        middle = task.vehicle.at_middle(way[0])
        assert np.hypot(*(middle[:2] - desired[:2])) < 0.05
        assert math.cos(middle[2] - math.atan2(desired[3], desired[2])) > 0.999
        np.testing.assert_allclose(way[-1, :2], task.in_slot_frame(task.start[:2]), atol=1e-9)
        assert np.hypot(*np.diff(way[:, :2], axis=0).T).max() < 0.1 + 1e-9
        c, s = math.cos(task.slot[2]), math.sin(task.slot[2])
        for x, y, yaw in way.tolist():
            east, north = task.slot[0] + c * x - s * y, task.slot[1] + s * x + c * y
            assert not space.touched(east, north, yaw + task.slot[2])


def test_drives_on_the_way_in_begin_as_far_from_its_end_as_the_level_says():
    curriculum = DRIVE_CONFIGS["ppo"].curriculum
    level = next(i for i, stage in enumerate(curriculum) if stage.starts == WAY_IN)
    env = training_env("ppo", 64, lots=(STREET,), levels={"parallel": level})
    env.seed(1)
    env.reset()
    ways = [task.path for task in env.batch._made[env.batch._groups["parallel"][0], level].values()]
    low, high = curriculum[level].distance
    checked = 0
    for i in np.flatnonzero([at == ("parallel", level) for at in env.batch._at]):
        pose = env.batch.batch.state[i, :3]
        left = [np.flatnonzero((way == pose).all(axis=1)) for way in ways]
        (index,) = np.concatenate(left)
        assert low - 0.06 <= 0.1 * index <= high + 0.06
        checked += 1
    assert checked > 10


def test_who_stands_for_too_long_is_cut_off():
    env = training_env("ppo", 8)
    env.seed(0)
    env.reset()
    stand, creep = np.zeros((8, 2), np.float32), np.tile(np.float32([0.4, 0.0]), (8, 1))
    for _ in range(STANDSTILL_DECISIONS - 1):
        assert not env.step(stand)[2].any()
    _, _, done, infos = env.step(stand)
    assert done.all()
    assert all(info["TimeLimit.truncated"] and not info["is_success"] for info in infos)
    for _ in range(STANDSTILL_DECISIONS - 1):
        env.step(stand)
    _, _, done, infos = env.step(creep)
    assert not any(info.get("TimeLimit.truncated", False) for info in infos)
    for _ in range(STANDSTILL_DECISIONS - 2):
        assert not any(info.get("TimeLimit.truncated", False) for info in env.step(stand)[3])


def test_the_kind_that_lags_is_drawn_most():
    last = len(DRIVE_CONFIGS["ppo"].curriculum) - 1
    env = training_env("ppo", 400, levels={"perpendicular": last, "parallel": last - 3})
    env.seed(0)
    env.reset()
    parallel = sum(kind == "parallel" for kind, _ in env.batch._at)
    assert 0.72 < parallel / 400 < 0.88, "four times as often"


@pytest.mark.parametrize(
    ("make", "wanted"),
    [
        (lambda: training_env("ppo", 0), "num_envs is 0"),
        (lambda: training_env("ppo", levels={"parallel": 10}), "level of parallel slots is 10, want 0 to 9"),
        (lambda: DriveTrainingEnv(2, (), DRIVE_CONFIGS["sac"]), "at least one kind of slots"),
    ],
)
def test_bad_settings_are_refused_in_words(make, wanted):
    with pytest.raises(InputError, match=wanted):
        make()


# Hindsight experience replay


def test_relabelled_rewards_are_those_of_the_drive():
    env = training_env("sac", 32, levels=dict.fromkeys(("perpendicular", "parallel"), 0))
    env.seed(2)
    before = env.reset()
    rng, parked, contacts, given = np.random.default_rng(0), 0, 0, []
    for _ in range(300):
        actions = rng.uniform(-0.6, 0.6, (32, 2)).astype(np.float32)
        after, rewards, done, infos = env.step(actions)
        achieved = after["achieved_goal"].copy()
        for i in np.flatnonzero(done):
            achieved[i] = infos[i]["terminal_observation"]["achieved_goal"]
        again = env.env_method("compute_reward", achieved, before["desired_goal"], infos, indices=[0])[0]
        np.testing.assert_array_equal(again, rewards)
        given.append(rewards)
        parked += sum(info.get("is_success", False) for info in infos)
        contacts += sum(info.get("contact", False) for info in infos)
        before = after
    assert parked > 5
    assert contacts > 5
    config = DRIVE_CONFIGS["sac"]
    wanted = [config.reward_scale * seconds for seconds in (-0.4 - config.contact_cost, -0.4, 0.0)]
    assert np.unique(np.concatenate(given)) == pytest.approx(wanted)


def test_a_relabelled_goal_ends_the_drive_unless_something_was_touched():
    env = training_env("sac", 2, lots=(MINI,))
    env.seed(0)
    buffer = TerminalGoalReplayBuffer(
        2_000, env.observation_space, env.action_space, env, n_envs=2, device="cpu", copy_info_dict=True
    )
    rng, seen = np.random.default_rng(0), env.reset()
    for _ in range(600):
        actions = rng.uniform(-1.0, 1.0, (2, 2)).astype(np.float32)
        after, rewards, done, infos = env.step(actions)
        told = {name: values.copy() for name, values in after.items()}
        for i in np.flatnonzero(done):
            for name in told:
                told[name][i] = infos[i]["terminal_observation"][name]
        buffer.add(seen, told, actions, rewards, done, infos)
        seen = after
    np.random.seed(0)  # noqa: NPY002  (stable-baselines3 draws from it)
    batch = buffer.sample(4_000)
    rewards, done = batch.rewards.numpy().ravel(), batch.dones.numpy().ravel()
    achieved, desired = (
        batch.next_observations[f"{which}_goal"].numpy() for which in ("achieved", "desired")
    )
    reached = (achieved == desired).all(axis=1)
    config = DRIVE_CONFIGS["sac"]
    contact = np.float32(-config.reward_scale * (0.4 + config.contact_cost))
    assert (rewards == 0.0).sum() > 100
    assert done[rewards == 0.0].all()
    assert (rewards[reached] == 0.0).any()
    assert set(np.unique(rewards[reached])) <= {0.0, contact}, "a contact is no success"
    assert (rewards[reached] == contact).any()


# Trainings


def test_a_model_is_trained_evaluated_and_driven(trained):
    algorithm, folder = trained
    training = training_of(algorithm, STEPS[algorithm])
    curve = read_curve(folder / "curve.csv", ("steps", "success"))
    assert list(curve[0]) == list(training.columns)
    assert curve[0]["steps"] == 0
    assert curve[-1]["steps"] >= STEPS[algorithm]
    assert {path.name for path in folder.iterdir()} == {"checkpoint.pt", "curve.csv", "model.safetensors"}
    card = ModelCard.of_file(folder / "model.safetensors")
    assert (card.task, card.algorithm, card.scenarios) == ("drive", algorithm, ("mini",))
    best = next(row for row in curve if row["steps"] == card.steps)
    assert card.results["success"] == best["success"]
    assert card.settings["contact_cost"] == DRIVE_CONFIGS[algorithm].contact_cost
    rows = parked_on([MINI], EVALUATED, SERIAL, f"{algorithm}:{folder / 'model.safetensors'}")
    assert len(rows) == len(EVALUATED)
    assert np.mean([row["parked"] for row in rows]) == best["success"]


def test_models_of_another_task_are_refused(trained):
    algorithm, folder = trained
    from planners.agent import make_agent

    with pytest.raises(InputError, match=r"was trained to drive, not to search; `parkenv park` runs it"):
        make_agent(f"{algorithm}:{folder / 'model.safetensors'}", make_scenario("mini"))
    other = "ppo" if algorithm != "ppo" else "sac"
    with pytest.raises(InputError, match=f"is a model of {algorithm}, not of {other}"):
        make_parking_agent(f"{other}:{folder / 'model.safetensors'}")
    longer = VehicleParameters(length=4.9)
    with pytest.raises(InputError, match=r"is made for a vehicle with length 4\.26, this one has 4\.9"):
        make_parking_agent(f"{algorithm}:{folder / 'model.safetensors'}", longer)
    with pytest.raises(InputError, match="unknown agent 'mdp'; known: planner"):
        make_parking_agent("mdp")


def test_an_agent_wants_the_obstacle_map_and_serves_many_episodes(trained):
    algorithm, folder = trained
    agent = make_parking_agent(f"{algorithm}:{folder / 'model.safetensors'}")
    blind = DriveEnv(lot=MINI)
    with pytest.raises(InputError, match="obstacle_map=True"):
        agent.predict(blind.reset(seed=0)[0])
    envs = gym.vector.SyncVectorEnv([lambda: DriveEnv(lot=MINI, obstacle_map=True) for _ in range(3)])
    single = DriveEnv(lot=MINI, obstacle_map=True)
    together, _ = envs.reset(seed=[4, 5, 6])
    alone, _ = single.reset(seed=5)
    state = memory = None
    for _ in range(10):
        actions, state = agent.predict(together, state)
        action, memory = agent.predict(alone, memory)
        np.testing.assert_allclose(actions[1], action, atol=1e-5)
        together, *_ = envs.step(actions)
        alone, *_ = single.step(action)
    envs.close()


def test_the_evaluation_uses_the_environments_own_tasks():
    """Blind driving ends in the batch as in the environment."""
    training = training_of("ppo", 10, lots=(STREET,))
    status, times = evaluate_parking(Always(0.5, 0.1), training._tasks["parallel"])
    view = PolicyInterface(VehicleParameters())
    env = DriveEnv(lot=STREET, kinds=("parallel",))
    for k, seed in enumerate(EVALUATED):
        env.reset(seed=seed)
        over = False
        while not over:
            pedal = pedal_command(np.float32([0.5, 0.1]), env.state.vehicle[SPEED], view.pedals)
            *_, over, _, info = env.step([pedal, np.float32(0.1)])
        assert status[k] >= CONTACT
        assert times[k] == pytest.approx(info["time_s"])


def test_success_is_drawn_by_kind(tmp_path):
    curves = [
        [{"steps": s, "oblique_success": 0.1 * s + 0.01 * k, "parallel_success": 0.0} for s in (0, 5, 9)]
        for k in range(3)
    ]
    rows = across_seeds(curves, "oblique_success")
    assert rows[1]["oblique_success"] == pytest.approx(0.51)
    assert rows[1]["low"] < 0.51 < rows[1]["high"]
    means = {kind: across_seeds(curves, f"{kind}_success") for kind in ("oblique", "parallel")}
    path = tmp_path / "curve.png"
    save_success_curves({"sac": curves}, {"sac": means}, {"oblique": 1.0}, "a title", path)
    assert shows_color(path, COLORS[0])


# One on-policy algorithm, and one with a replay buffer.
@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_the_command_trains_and_its_models_park(tmp_path, algorithm):
    out = tmp_path / "out"
    steps = STEPS[algorithm]
    trained = parkenv(
        "train", algorithm, "--env", "drive", "--lot", "mini", "--steps", steps, "--trainings", 2,
        "--evaluate-every", steps // 2, "--evaluation-episodes", 4, "--jobs", 1, "--out", out,
    )  # fmt: skip
    assert trained.returncode == 0, trained.stderr
    summary = json.loads((out / "summary.json").read_text())
    assert [row["seed"] for row in summary["rows"]] == [0, 1]
    assert all(row["steps"] >= steps for row in summary["rows"])
    assert summary["evaluated"] == {"perpendicular": 1.0, "all": 1.0}
    assert shows_color(out / "learning_curve.png", COLORS[0])
    model = f"{algorithm}:{out / 'seed_1' / 'model.safetensors'}"
    parked = parkenv(
        "park", "--agents", f"planner,{model}", "--lot", "mini", "--episodes", 4, "--out", tmp_path / "parked"
    )
    assert parked.returncode == 0, parked.stderr
    rows = json.loads((tmp_path / "parked" / "summary.json").read_text())["rows"]
    assert {row["agent"] for row in rows} == {"planner", algorithm}
    assert (tmp_path / "parked" / algorithm / "parking.gif").stat().st_size > 10_000


@pytest.mark.slow
def test_a_short_training_learns_to_park_from_nearby(tmp_path, monkeypatch):
    """In half a minute of training it masters two levels: it parks in 60 of the last 100 drives of each."""
    monkeypatch.setitem(DRIVE_CONFIGS, "ppo", FULL_SIZE["ppo"])
    curve = training_of("ppo", 400_000, 400_000).train(0, tmp_path)
    assert curve[-1]["perpendicular_level"] >= 2.0
    near = slot_groups((MINI,))[0].tasks(slack=1.0, distance=(1.0, 6.0), starts="way-out")
    tasks = [PreparedTask(near.draw(7_000 + k)) for k in range(60)]
    standing, trained = (
        (evaluate_parking(agent, tasks)[0] == PARKED).mean()
        for agent in (Always(0.0, 0.0), make_parking_agent(f"ppo:{tmp_path / 'model.safetensors'}").model)
    )
    assert trained > standing


@pytest.mark.parametrize(
    ("agents", "wanted"),
    [("robot", "unknown agent 'robot'; known: planner"), ("sac:nowhere.zip", "nowhere.zip: No such file")],
)
def test_park_refuses_who_cannot_drive(tmp_path, agents, wanted):
    result = CliRunner().invoke(app, ["park", "--agents", agents, "--out", str(tmp_path / "p")])
    assert isinstance(result.exception, InputError)
    assert wanted in str(result.exception)
    assert not (tmp_path / "p").exists()
