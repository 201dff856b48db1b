"""The parking planner: clearance against pymunk, collision-free paths, tracking, whole parking manoeuvres."""

import math
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from command_line import ran, summary_of
from hypothesis import given, settings
from hypothesis import strategies as st
from test_drive_env import tasks_on

from parkenv import InputError, Traffic
from parkenv.driving.collision_world import CollisionWorld, ObstacleKind, Obstacles
from parkenv.driving.vehicle import SPEED, STEERING, VehicleParameters, advance
from parkenv.lots import packaged_lot, read_lot
from parkenv.studies.trips.parking_runs import ParkingCase, park_all, park_once, parking_table
from parkenv.studies.workers import Workers
from planners.driving.car_path import CarPath
from planners.driving.clearance import clearance, is_collision_free, room_at
from planners.driving.hybrid_astar import SearchSettings, plan_path, why_no_path
from planners.driving.parking import ParkingAgent
from planners.driving.path_tracking import PathTracker
from planners.driving.reeds_shepp import reeds_shepp

CAR = VehicleParameters()
LOTS = ("campus", "street", "jam", "mini")
DRAGON_LAKE = Path(__file__).parents[2] / "shared" / "data" / "dlp" / "parking_map.yml"
NO_ROOM = SearchSettings(attempts=((0.2, 0.5),), most_expansions=1, patience=0.0)
LOW, HIGH = np.array([-20.0, -20.0]), np.array([20.0, 20.0])


def planned(task, settings=None):
    things = task.obstacles
    target = task.vehicle.at_rear_axle(task.target)
    return plan_path(task.vehicle, things.corners, things.n_corners, task.start[:3], target, settings)


def polygon(rng, k):
    angle = np.sort(rng.uniform(0.0, 2 * math.pi, k))
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return rng.uniform(-6.0, 6.0, 2) + rng.uniform(0.3, 2.5) * around


@given(seed=st.integers(0, 10**6), k=st.sampled_from([2, 3, 4, 8, 24]))
@settings(max_examples=60)
def test_the_planners_check_and_pymunk_agree_on_what_is_touched(seed, k):
    """If the footprint grown by a millimetre is free, pymunk reports no contact, and vice versa."""
    rng = np.random.default_rng(seed)
    things = Obstacles.of([(ObstacleKind.PARKED_CAR, polygon(rng, k)) for _ in range(4)])
    if any(len(np.unique(o.round(3), axis=0)) < len(o) for o in things.outlines()):
        return
    space = CollisionWorld(CAR, things)
    ours = clearance(CAR, things.corners, things.n_corners, LOW, HIGH)
    for _ in range(20):
        x, y, yaw = (float(v) for v in rng.uniform([-8.0, -8.0, -math.pi], [8.0, 8.0, math.pi]))
        touched = bool(space.touched(x, y, yaw))
        if is_collision_free(ours, x, y, yaw, 1e-3):
            assert not touched
        elif not is_collision_free(ours, x, y, yaw, -1e-3):
            assert touched


def test_room_is_the_distance_to_what_is_nearest():
    wall = np.array([[[5.0, -9.0], [5.0, 9.0]]])
    space = clearance(CAR, wall, np.array([2]), LOW, HIGH)
    ahead = CAR.length - CAR.rear_overhang
    assert room_at(space, 5.0 - ahead - 0.3, 0.0, 0.0, 1.0) == pytest.approx(0.3, abs=1e-3)
    assert room_at(space, 5.0 - 0.5 * CAR.width - 0.2, 0.0, math.pi / 2, 1.0) == pytest.approx(0.2, abs=1e-3)
    assert room_at(space, 4.0, 0.0, 0.0, 1.0) < 0.0
    assert not is_collision_free(space, 19.9, 0.0, 0.0, 0.0), "outside the window nothing is known"


@given(seed=st.integers(0, 10**6), lot=st.sampled_from(LOTS))
@settings(max_examples=25)
def test_a_path_leads_from_start_to_target_touches_nothing_and_can_be_steered(seed, lot):
    task = tasks_on(lot).draw(seed)
    path = planned(task)
    assert path is not None
    poses, curvature, direction = path.sampled(0.04)
    target = task.vehicle.at_rear_axle(task.target)
    np.testing.assert_allclose(poses[0], task.start[:3])
    np.testing.assert_allclose(poses[-1, :2], target[:2], atol=1e-6)
    assert math.remainder(poses[-1, 2] - target[2], 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
    space = CollisionWorld(task.vehicle, task.obstacles)
    assert not any(space.touched(*pose) for pose in poses)
    assert np.abs(curvature).max() <= 1.0 / task.vehicle.turning_radius
    assert int((np.diff(direction) != 0).sum()) == path.direction_changes
    step = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert step.sum() == pytest.approx(path.driven_m, rel=1e-3)


def test_without_anything_in_the_way_the_path_is_as_good_as_the_word():
    nothing = np.empty((0, 2, 2)), np.empty(0, dtype=np.int64)
    quick = SearchSettings(steer_m=0.0, change_m=0.0)
    for end in ([8.0, 3.0, 1.0], [-4.0, 2.0, 3.0], [0.0, 3.0, 0.0]):
        path = plan_path(CAR, *nothing, np.zeros(3), np.array(end), quick)
        radius = CAR.turning_radius * (1.0 + quick.reserve)
        length = float(np.abs(reeds_shepp(np.zeros(3), np.array(end), radius)[0]).sum())
        assert path.driven_m == pytest.approx(length, abs=1e-6)


def test_a_slot_that_is_walled_in_has_no_path():
    task = tasks_on("mini").draw(3)
    box = task.vehicle.corners(task.vehicle.at_rear_axle(task.target))
    center = box.mean(axis=0)
    walls = [(ObstacleKind.WALL, center + 1.15 * (box[[i, (i + 1) % 4]] - center)) for i in range(4)]
    closed = replace(task, obstacles=Obstacles.of(walls))
    assert planned(closed, SearchSettings(attempts=((0.05, 0.5),))) is None
    onto = replace(task, obstacles=Obstacles.of([(ObstacleKind.WALL, box[[0, 2]])]))
    assert planned(onto) is None


@pytest.mark.parametrize("lengths", [(6.0, 5.0), (-6.0, -5.0), (5.0, -7.0), (3.0, -3.0, 4.0)])
@pytest.mark.parametrize("bends", [(0.0, 0.2, 0.0), (0.22, -0.22, 0.1)])
def test_a_path_is_followed_to_the_centimetre_forward_and_in_reverse(lengths, bends):
    """Off the path by a decimetre at first, the car comes back to it, and stops where the path ends."""
    path = CarPath(np.zeros(3), np.array(lengths), np.array(bends[: len(lengths)]))
    tracker = PathTracker(CAR, path)
    state = np.array([0.0, 0.06, 0.0, 0.0, 0.0, 0.0])
    offsets = []
    for _ in range(400):
        pedal, turn = tracker.command(state[:3], state[SPEED], state[STEERING])
        if tracker.done:
            break
        offsets.append(abs(tracker.offset))
        for _ in range(2):
            advance(state, pedal, turn, CAR.limits)
    assert tracker.done
    assert max(offsets) <= 0.09
    end = path.sampled()[0][-1]
    assert np.hypot(*(state[:2] - end[:2])) < 0.06
    assert abs(state[2] - end[2]) < 0.03
    assert state[SPEED] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("lot", LOTS)
def test_the_planner_parks(lot):
    env, agent = ParkingCase(packaged_lot(lot)).environment(), ParkingAgent()
    for seed in range(3):
        row = park_once(env, agent, seed).row
        assert (row["parked"], row["reason"], row["plans"]) == (True, "", 1)
        assert row["time_s"] < 45.0


@pytest.mark.slow
def test_of_a_hundred_random_parkings_ninety_nine_succeed():
    lots = [packaged_lot(name) for name in LOTS]
    cases = [ParkingCase(lots[0], (kind,)) for kind in ("perpendicular", "oblique")]
    cases += [ParkingCase(lot) for lot in lots[1:]]
    if DRAGON_LAKE.exists():
        cases.append(ParkingCase(read_lot(DRAGON_LAKE)))
    per_case = -(-400 // len(cases))
    with Workers(1) as workers:
        rows = [p.row for some in park_all(cases, range(1000, 1000 + per_case), workers) for p in some]
    (overall,) = [row for row in parking_table(rows) if row["kind"] == "all"]
    assert overall["episodes"] >= 400
    assert overall["success"] >= 0.99
    assert overall["contacts"] <= 0.01 * overall["episodes"]
    assert {row["kind"] for row in rows} == {"perpendicular", "oblique", "parallel"}


@pytest.mark.slow
def test_the_planner_waits_for_those_who_move():
    traffic = Traffic(cars=6, pedestrians=10)
    env = gym.make("parkenv/Drive-v1", lot="campus", obstacle_map=True, traffic=traffic)
    rows = [park_once(env, ParkingAgent(), seed).row for seed in range(8)]
    assert all(row["reason"] in ("", "out of time") for row in rows)
    assert sum(row["parked"] for row in rows) >= 6


def test_an_observation_without_the_map_is_refused():
    env = gym.make("parkenv/Drive-v1", lot="mini")
    observation, _ = env.reset(seed=0)
    with pytest.raises(InputError, match="no 'cars': make the environment with obstacle_map=True"):
        ParkingAgent().predict(observation)


@pytest.mark.parametrize("change", [{"length": 4.9}, {"wheelbase": 2.9}, {"max_steering": 0.5}])
def test_what_is_made_for_a_vehicle_refuses_another_one(change):
    other = VehicleParameters(**change)
    kinds = ("perpendicular",)
    env = gym.make("parkenv/Drive-v1", lot="campus", kinds=kinds, vehicle=other, obstacle_map=True)
    observation, _ = env.reset(seed=0)
    ((name, value),) = change.items()
    refused = f"vehicle with {name} {getattr(VehicleParameters(), name):g}, this one has {value:g}"
    with pytest.raises(InputError, match=refused):
        ParkingAgent().predict(observation)
    with pytest.raises(InputError, match=refused):
        ParkingAgent().predict({key: np.stack([part, part]) for key, part in observation.items()})
    path = ParkingAgent(other).plan(observation)
    assert path is not None
    PathTracker(other, path)
    with pytest.raises(InputError, match=f"path is made for a vehicle with {name} {value:g}"):
        PathTracker(VehicleParameters(), path)


def test_where_no_path_is_the_car_stays_and_that_is_said():
    env = ParkingCase(packaged_lot("mini")).environment()
    no_room = ParkingAgent(search=NO_ROOM)
    parking = next(p for p in (park_once(env, no_room, seed) for seed in range(20)) if not p.row["parked"])
    assert parking.row["reason"].startswith("no path was found for a car, 4.26 m")
    assert (parking.row["contact"], parking.row["driven_m"]) == ("", 0.0)
    overall = parking_table([parking.row])[-1]
    assert (overall["success"], overall["contacts"]) == (0.0, 0)


@pytest.mark.parametrize(("blocked", "where"), [((0.0, 0.0), "in the slot"), ((9.0, 0.0), "where it stands")])
def test_a_pose_without_room_is_named(blocked, where):
    box = np.array([[-0.2, -0.2], [0.2, -0.2], [0.2, 0.2], [-0.2, 0.2]])[None] + np.array(blocked)
    task = (VehicleParameters(), box, np.array([4]), np.array([9.0, 0.0, 0.0]), np.zeros(3))
    assert plan_path(*task) is None
    assert where in why_no_path(*task)


def test_failures_are_named_and_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "parkenv.studies.trips.parking_runs.ParkingAgent",
        lambda vehicle: ParkingAgent(vehicle, search=NO_ROOM),
    )
    out = tmp_path / "park"
    done = ran("park --seed 3 --lot mini --way back-in --episodes 2 --jobs 1 --out", out)
    assert "failed: mini, seed 3" in done.stdout
    assert "no path was found" in done.stdout
    assert (out / "failures.png").exists()
    assert not (out / "parkings.png").exists()


def test_park_writes_its_table_and_pictures(tmp_path):
    out = tmp_path / "park"
    ran("park --lot mini --episodes 3 --out", out)
    *kinds, overall = summary_of(out)["rows"]
    assert (overall["kind"], overall["episodes"]) == ("all", 3)
    assert sum(row["parked"] for row in kinds) == overall["parked"]
    assert len((out / "episodes.csv").read_text().splitlines()) == 4
    assert {path.name for path in out.iterdir()} >= {"parkings.png", "parking.gif"}
    assert not (out / "failures.png").exists()
