"""`parkenv/Drive-v1`: contract, goals, ends, tasks, determinism, state, faults."""

import json
import math
from functools import lru_cache

import gymnasium as gym
import numpy as np
import pytest
import shapely
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from lot_checks import refusal

from parkenv import InputError, Traffic
from parkenv.driving.collision_world import CollisionWorld, ObstacleKind
from parkenv.driving.parking_task import AREA, ParkingTasks
from parkenv.driving.vehicle import VehicleParameters
from parkenv.envs.drive import CONTACTS, CONTROL_S
from parkenv.envs.drive_observation import goal_errors
from parkenv.lots import packaged_lot, write_lot
from parkenv.world.lot import corner_points
from sim_sensors.laser.scanner import LaserScanner

ID = "parkenv/Drive-v1"
LOTS = ("campus", "jam", "street", "mini")
CAR = VehicleParameters()
STILL = np.zeros(2, dtype=np.float32)
CROWD = Traffic(cars=6, pedestrians=8)


def make(lot="campus", **arguments):
    return gym.make(ID, lot=lot, **arguments)


def random_drive(env, seed, steps=60):
    rng, seen = np.random.default_rng(seed), [env.reset(seed=seed)]
    for _ in range(steps):
        seen.append(env.step(rng.uniform(-1.0, 1.0, 2).astype(np.float32)))
        if seen[-1][2] or seen[-1][3]:
            break
    return seen


def placed_at(env, x, y, yaw, speed=0.0):
    """Let the first step begin where the footprint's middle has a pose in the frame of the slot."""
    env.reset(seed=0)
    state = env.unwrapped.state
    sx, sy, syaw = state.task.slot
    c, s = math.cos(syaw), math.sin(syaw)
    middle = np.array([sx + c * x - s * y, sy + s * x + c * y, syaw + yaw])
    state.vehicle[:] = [*CAR.at_rear_axle(middle), speed, 0.0, 0.0]


@lru_cache
def tasks_on(lot):
    return ParkingTasks(packaged_lot(lot))


@pytest.mark.parametrize("lot", ["campus", "street"])
@pytest.mark.parametrize(
    "extras",
    [{}, {"laser": True, "obstacle_map": True, "reward": "dense", "traffic": Traffic(cars=2, pedestrians=2)}],
)
def test_it_passes_the_checker_without_a_warning(lot, extras):
    env = make(lot, render_mode="rgb_array", **extras)
    check_env(env.unwrapped)
    env.close()


def test_the_step_limit_truncates_after_a_minute():
    env = make("mini")
    env.reset(seed=0)
    for n in range(1, 601):
        _, _, terminated, truncated, info = env.step(STILL)
        assert not terminated
        assert truncated == (n == 600)
    assert info["time_s"] == pytest.approx(60.0)
    assert not info["is_success"]


@pytest.mark.parametrize("lot", ["campus", "street"])
def test_equal_seeds_give_equal_trajectories(lot):
    one, two = make(lot, laser=True), make(lot, laser=True)
    for seed in (0, 5):
        for a, b in zip(random_drive(one, seed), random_drive(two, seed), strict=True):
            np.testing.assert_equal(a, b)
    assert not np.array_equal(one.reset(seed=1)[0]["observation"], one.reset(seed=2)[0]["observation"])


@pytest.mark.parametrize("dense", [False, True])
def test_rewards_of_batches_are_those_of_the_steps(dense):
    env = make("mini", reward="dense" if dense else "sparse")
    steps = [step for seed in range(6) for step in random_drive(env, seed, 200)[1:]]
    achieved, desired = (np.stack([s[0][key] for s in steps]) for key in ("achieved_goal", "desired_goal"))
    rewards, infos = np.array([s[1] for s in steps]), [s[4] for s in steps]
    batch = env.unwrapped.compute_reward(achieved, desired, infos)
    assert batch.dtype == np.float32
    np.testing.assert_allclose(batch, rewards, rtol=1e-6)
    assert any(i["contact"] for i in infos)
    for a, d, r, i in zip(achieved, desired, rewards, infos, strict=True):
        assert env.unwrapped.compute_reward(a, d, i) == pytest.approx(r)
        assert sum(i[name] for name in i if name.startswith("reward_")) == pytest.approx(r)
    # Goals from other steps, as in hindsight experience replay, without `contact`.
    np.testing.assert_array_equal(env.unwrapped.compute_reward(achieved, achieved, {}), 0.0)


def plainly_parked(achieved, desired):
    """The definition, by numpy and polygons."""
    yaw, wanted = (math.atan2(g[3], g[2]) for g in (achieved, desired))
    turn = abs(math.remainder(yaw - wanted, 2 * math.pi))
    near = math.dist(achieved[:2], desired[:2]) <= 0.25 and turn <= math.radians(5.0)
    size = np.array([CAR.length, CAR.width])
    slot_size = size + 2 * desired[5:7]
    car, slot = (
        shapely.Polygon(corner_points(g[None, :2], np.array([a]), *s[:, None])[0])
        for g, a, s in ((achieved, yaw, size), (desired, wanted, slot_size))
    )
    return near and slot.buffer(1e-9).contains(car) and abs(achieved[4]) <= 0.05


@given(
    x=st.floats(-0.4, 0.4),
    y=st.floats(-0.4, 0.4),
    turn=st.floats(-0.12, 0.12),
    speed=st.floats(-0.1, 0.1),
    room=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 0.5)),
    backed=st.booleans(),
)
@settings(max_examples=200)
def test_success_is_inside_the_slot_near_its_middle_straight_and_standing(x, y, turn, speed, room, backed):
    base = math.pi if backed else 0.0
    yaw = base + turn
    achieved = np.array([x, y, math.cos(yaw), math.sin(yaw), speed, *room], dtype=np.float32)
    desired = np.array([0.0, 0.0, math.cos(base), math.sin(base), 0.0, *room], dtype=np.float32)
    half = 0.5 * np.array([CAR.length, CAR.width])
    distance, angle, success = goal_errors(achieved[None], desired[None], half)
    assert distance[0] == pytest.approx(math.hypot(x, y), abs=1e-6)
    assert angle[0] == pytest.approx(abs(turn), abs=1e-6)
    clear = all(abs(v) > 1e-6 for v in (distance[0] - 0.25, angle[0] - math.radians(5.0), abs(speed) - 0.05))
    grown, shrunk = (np.r_[desired[:5], desired[5:] + d] for d in (1e-5, -1e-5))
    if clear and plainly_parked(achieved, grown) == plainly_parked(achieved, shrunk):
        assert success[0] == plainly_parked(achieved, desired)


@pytest.mark.parametrize(
    ("pose", "parked"),
    [
        ((0.0, 0.0, 0.0), True),
        ((0.2, 0.1, 0.0), True),
        ((0.3, 0.0, 0.0), False),  # too far from the middle
        ((0.0, 0.0, 0.08), True),
        ((0.0, 0.0, 0.1), False),  # askew
        ((0.0, 0.0, math.pi), False),  # the other way round
        ((0.1, 0.22, 0.07), False),  # a corner is outside
    ],
)
def test_who_stands_so_has_parked_or_not(pose, parked):
    env = make("mini", slack=3.0, ways=("nose-in",))
    placed_at(env, *pose)
    _, reward, terminated, truncated, info = env.step(STILL)
    assert (terminated, info["is_success"], info["parked"]) == (parked, parked, parked)
    assert not truncated
    assert reward == pytest.approx(0.0 if parked else -CONTROL_S)


def test_rolling_through_the_middle_is_not_parking():
    env = make("mini", slack=3.0, ways=("nose-in",))
    placed_at(env, -0.1, 0.0, 0.0, speed=0.5)
    assert not env.step(STILL)[2]
    steps = [env.step(np.array([-1.0, 0.0], dtype=np.float32)) for _ in range(3)]
    assert [s[4]["is_success"] for s in steps] == [False, False, True]


def test_a_contact_and_leaving_the_area_terminate_are_named_and_cost():
    env = make("campus", kinds=("perpendicular",), occupancy=1.0, contact_cost=50.0)
    placed_at(env, -0.2, 1.2, 0.0)
    _, reward, terminated, truncated, info = env.step(STILL)
    assert (terminated, truncated, info["is_success"]) == (True, False, False)
    assert CONTACTS[info["contact"]] in ("parked car", "kerb")
    assert reward == pytest.approx(-CONTROL_S - 50.0)
    env = make("campus", slot="C10", occupancy=0.0)
    placed_at(env, -5.5, AREA - 0.1, math.pi / 2, speed=2.0)
    _, reward, terminated, _, info = env.step(STILL)
    assert (terminated, CONTACTS[info["contact"]]) == (True, "left the area")
    assert reward == pytest.approx(-CONTROL_S - 200.0)


@given(seed=st.integers(0, 10_000), lot=st.sampled_from(LOTS))
@settings(max_examples=60)
def test_tasks_are_what_they_say(seed, lot):
    """Nothing is touched at the start nor at the target, and the slot is as large as the room says."""
    tasks = tasks_on(lot)
    task = tasks.draw(seed)
    space = CollisionWorld(task.vehicle, task.obstacles)
    assert space.touched(*task.start[:3]) == ObstacleKind.NOTHING
    assert space.touched(*task.vehicle.at_rear_axle(task.target)) == ObstacleKind.NOTHING
    i = tasks.lot.slot_ids.index(task.slot_id)
    assert task.size == (tasks.lot.slot_length[i], tasks.lot.slot_width[i])
    assert (task.room > 0.0).all()
    assert 1.0 < np.hypot(*task.in_slot_frame(task.vehicle.at_middle(task.start[:3])[:2])) < 22.0


def test_each_kind_and_way_is_drawn():
    drawn = list(map(tasks_on("campus").draw, range(40)))
    kinds, ways = ("perpendicular", "oblique"), ("nose-in", "back-in")
    assert {(t.kind, t.way) for t in drawn} == {(kind, way) for kind in kinds for way in ways}
    assert {tasks_on("street").draw(k).kind for k in range(5)} == {"parallel"}


def test_slack_clears_the_slots_beside_and_distance_moves_the_start():
    campus = packaged_lot("campus")

    def nearest(slack):
        rooms = []
        tasks = ParkingTasks(campus, kinds=("perpendicular",), occupancy=1.0, slack=slack)
        for task in map(tasks.draw, range(20)):
            cars = task.in_slot_frame(task.obstacles.only(ObstacleKind.PARKED_CAR).corners)
            rooms.append((np.abs(cars[..., 1]) - 1.25)[np.abs(cars[..., 0]) < 2.5].min())
        return min(rooms)

    assert nearest(0.0) < 0.5
    assert nearest(3.0) >= 2.9

    def start_away(distance, starts):
        tasks = ParkingTasks(campus, distance=distance, starts=starts, slack=3.0)
        drawn = list(map(tasks.draw, range(30)))
        return np.mean([math.dist(t.vehicle.at_middle(t.start[:3])[:2], t.slot[:2]) for t in drawn])

    assert start_away((2.0, 4.0), "lane") < start_away((12.0, 14.0), "lane") - 4.0
    assert start_away((0.2, 0.5), "way-out") < 0.6
    assert start_away((0.2, 0.5), "way-out") < start_away((4.0, 5.0), "way-out")


def test_the_laser_sees_the_neighbours_and_the_map_of_obstacles_holds_all_that_is_near():
    env = make(kinds=("perpendicular",), occupancy=1.0, laser=LaserScanner(noise_sd=0.0, dropout=0.0))
    scan = env.reset(seed=3)[0]["scan"]
    assert scan.shape == (1081,)
    assert 1.0 < scan.min() < 4.0
    assert "scan" not in make().reset(seed=3)[0]
    env = make("campus", obstacle_map=True)
    observation, _ = env.reset(seed=3)
    task = env.unwrapped.state.task
    cars = observation["cars"][observation["cars"][:, 0, 0] < 999.0]
    assert len(cars) == (task.obstacles.kind == ObstacleKind.PARKED_CAR).sum()
    lines = observation["lines"][observation["lines"][:, 0, 0] < 999.0]
    assert len(lines) == (task.obstacles.kind != ObstacleKind.PARKED_CAR).sum()
    c, s = math.cos(task.slot[2]), math.sin(task.slot[2])
    back = cars @ np.array([[c, s], [-s, c]]) + task.slot[:2]
    np.testing.assert_allclose(back, task.obstacles.only(ObstacleKind.PARKED_CAR).corners, atol=1e-4)


def test_others_move_keep_off_a_standing_car_and_are_seen():
    env = make("campus", traffic=CROWD, obstacle_map=True, laser=LaserScanner(noise_sd=0.0, dropout=0.0))
    moved, nearest = np.zeros(14), np.inf
    for seed in range(2):
        before = env.reset(seed=seed)[0]["movers"]
        assert before.shape == (14, 24, 2)
        for _ in range(150):
            observation, _, terminated, _, info = env.step(STILL)
            assert not terminated, info["contact"]
            moved += np.hypot(*(observation["movers"] - before).mean(axis=1).T)
            before = observation["movers"]
            nearest = min(nearest, float(np.hypot(*(before - observation["achieved_goal"][:2]).T).min()))
    assert (moved > 1.0).all()
    assert nearest < 6.0


@pytest.mark.parametrize(("number", "word"), [(0, "moving car"), (-1, "pedestrian")])
def test_running_into_one_who_moves_is_a_contact(number, word):
    env = make("campus", traffic=CROWD, occupancy=0.0)
    env.reset(seed=1)
    state = env.unwrapped.state
    x, y, _ = state.movers[number]
    state.vehicle[:] = [x - CAR.middle, y, 0.0, 0.0, 0.0, 0.0]
    assert CONTACTS[env.step(STILL)[4]["contact"]] == word


@pytest.mark.parametrize(
    ("slot", "message"),
    [
        ("A1", "slot 'A1' of lot 'campus' is 2.5 m wide"),
        (None, "no slot of the kinds .* at least 4.26 m × 2.6 m"),
    ],
)
def test_a_car_that_fits_no_slot_is_refused(slot, message):
    with pytest.raises(InputError, match=message):
        make(vehicle=VehicleParameters(width=2.6), slot=slot).reset(seed=0)


def test_actions_and_starts_that_are_none_are_refused():
    env = make("mini").unwrapped
    env.reset(seed=0)
    for action in ([math.nan, 0.0], [0.0, math.inf], [0.0], [0.0, 0.0, 0.0], 3.0, "left", None):
        assert "action is" in refusal(env.step, action)
    for start in ([0.0, math.nan, 0.0], [0.0, 0.0], "here", [1000.0, 0.0, 0.0]):
        assert "start " in refusal(env.reset, seed=0, options={"start": start})


def test_a_start_in_collision_is_refused_and_a_free_one_is_taken():
    env = make("mini", occupancy=1.0).unwrapped
    env.reset(seed=0)
    free = env.state.task.start[:3] + np.array([0.1, 0.0, 0.0])
    env.reset(seed=0, options={"start": free})
    np.testing.assert_array_equal(env.state.task.start[:3], free)
    lot = env.tasks.lot
    other = next(i for i in range(lot.n_slots) if lot.slot_ids[i] != env.state.task.slot_id)
    taken = CAR.at_rear_axle(np.array([*lot.slot_xy[other], lot.slot_yaw[other]]))
    with pytest.raises(InputError, match="the car touches a parked car there, want a free pose"):
        env.reset(seed=0, options={"start": taken})
    with pytest.raises(InputError, match="option of reset is 'begin', want one of start"):
        env.reset(options={"begin": free})


def test_a_lot_file_is_driven_in_if_it_says_how_wide_its_slots_are(tmp_path):
    path = tmp_path / "lot.geojson"
    write_lot(packaged_lot("mini"), path)
    np.testing.assert_equal(random_drive(make(path), 3), random_drive(make("mini"), 3))
    document = json.loads(path.read_text())
    slot = next(f for f in document["features"] if f["properties"]["kind"] == "slot")
    whole = dict(slot["properties"])
    del slot["properties"]["width"]
    path.write_text(json.dumps(document))
    assert "width is missing" in refusal(make, path)
    slot["properties"] = whole
    slot["geometry"] = {"type": "Point", "coordinates": [1.0, 1.0]}
    path.write_text(json.dumps(document))
    assert "slot: geometry is 'Point', want Polygon" in refusal(make, path)
