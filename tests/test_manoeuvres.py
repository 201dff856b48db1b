"""Scenes of manoeuvres: files of all formats, the check of footprints, levels, and what is planned and driven."""

import dataclasses
import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import shapely
from command_line import ran, refused, rows_in, summary_of
from hypothesis import given, settings
from hypothesis import strategies as st
from test_drive_env import tasks_on

from parkenv import InputError, Traffic
from parkenv.driving.collision_world import CollisionWorld, ObstacleKind, Obstacles
from parkenv.driving.levels import level_scene, levels
from parkenv.driving.scene import Contour, Scene
from parkenv.driving.scene_files import read_scene, scene_files
from parkenv.driving.vehicle import SPEED, STEERING, TPCAP, VEHICLES, VehicleParameters, advance, move_along
from parkenv.files.known_names import SCENE_LEVELS
from parkenv.lots import packaged_lot, read_lot
from parkenv.studies.runner import run
from parkenv.studies.trips.manoeuvre_study import ManoeuvreStudy
from parkenv.studies.trips.parking_runs import ParkingCase, park_all, park_once, parking_table
from parkenv.studies.workers import Workers
from planners.driving.car_path import CarPath
from planners.driving.clearance import clearance, is_collision_free, room_at
from planners.driving.hybrid_astar import SearchSettings, plan_path, why_no_path
from planners.driving.manoeuvre import park
from planners.driving.parking import ParkingAgent
from planners.driving.path_tracking import PathTracker
from planners.driving.reeds_shepp import reeds_shepp

PUBLIC = Path(__file__).parents[2] / "shared" / "data" / "manoeuvres"
# A parallel slot along x below a lane, between two blocks: 0.5 m longer than TPCAP's car.
GAP = TPCAP.length + 0.5
START, TARGET = (1.0, 3.0, 0.0), (TPCAP.rear_overhang + 0.25, 0.0, 0.0)
BLOCKS = [[[x, -1.2], [x + 6.0, -1.2], [x + 6.0, 1.1], [x, 1.1]] for x in (-6.0, GAP)]
KERB = [[-6.0, -1.3], [GAP + 6.0, -1.3]]


def tpcap_text(start, target, blocks):
    numbers = [*start, *target, len(blocks), *map(len, blocks), *np.array(blocks).ravel()]
    return ",".join(map(repr, map(float, numbers)))


def parkbench_content(lines, origin=(0.0, 0.0), frame=(0.0, 0.0), target=(0.0, 0.0, 0.0)):
    area = {"m_targetPosture": {"m_pose": list(target)}}
    request = {"m_startPosture": {"m_pose": START}, "m_targetArea": area, "m_origin": list(origin)}
    nodes = [{"nfmPolygonObjectNodes": [{"m_x": x, "m_y": y} for x, y in line]} for line in lines]
    frame = {"PlanningRequest": request, "m_nfmOrigin": list(frame), "NfmAggregatedPolygonObjects": nodes}
    return {"Frames": {"0": frame}}


def own_text(**changes):
    fields = {"start": list(START), "target": list(TARGET), "vehicle": "tpcap"} | changes
    lines = [f"{name} = {json.dumps(value)}" for name, value in fields.items()]
    lines += [f"[[obstacles]]\npolygon = {json.dumps(block)}" for block in BLOCKS]
    return "\n".join([*lines, f"[[obstacles]]\nline = {json.dumps(KERB)}"])


def test_every_format_says_the_same_scene_wherever_it_lies(tmp_path):
    far = np.array([4.0e9, -2.5e8])
    moved = [(*(np.array(pose[:2]) + far), pose[2]) for pose in (START, TARGET)]
    (tmp_path / "a1.csv").write_text(tpcap_text(START, TARGET, BLOCKS))
    (tmp_path / "a2.csv").write_text(tpcap_text(*moved, np.array(BLOCKS) + far).replace(",", "\n"))
    (tmp_path / "a3.toml").write_text(own_text())
    own = {"start": START, "target": TARGET, "vehicle": "tpcap"}
    obstacles = [*({"polygon": block} for block in BLOCKS), {"line": KERB}]
    (tmp_path / "a10.json").write_text(json.dumps(own | {"obstacles": obstacles}))
    scenes = [read_scene(file) for file in scene_files(tmp_path)]
    assert [scene.name for scene in scenes] == ["a1", "a2", "a3", "a10"]
    for scene in scenes:
        assert scene.vehicle == TPCAP
        away = far if scene.name == "a2" else 0.0
        np.testing.assert_allclose(scene.start[:2] + scene.origin - away, START[:2], atol=1e-6)
        np.testing.assert_allclose(scene.target - scene.start, np.subtract(TARGET, START), atol=1e-6)
        assert len(scene.contours) == (2 if scene.name in ("a1", "a2") else 3)
        away = shapely.Polygon(TPCAP.corners(scene.target)).distance(shapely.union_all(scene.shapes))
        assert 0.05 < away < 0.3
        assert scene.check(scene.target[None]).clearance == pytest.approx(away, abs=0.005)


def test_parkbench_is_read_in_the_frame_of_its_obstacles_without_what_lies_below_the_target(tmp_path):
    stop = [[-0.8, -1.5], [-0.8, 1.5]]  # across the parked car, and beyond its sides
    wall = [[8.0, -3.0], [8.0, 3.0]]
    content = parkbench_content([stop, wall], (5.0, 1.0), (4.0, 1.0), (-1.0, 0.0, 0.0))
    file = tmp_path / "scene.json"
    file.write_text(json.dumps(content))
    scene = read_scene(file)
    assert scene.vehicle == TPCAP
    np.testing.assert_allclose(scene.start[:2] + scene.origin, [2.0, 3.0])
    np.testing.assert_allclose(scene.target[:2] + scene.origin, [0.0, 0.0])
    left = shapely.union_all(scene.shapes)
    assert not left.intersects(shapely.Polygon(TPCAP.corners(scene.target)))
    # Either end of the wheel stop is still there, 0.4 to 0.5 m long, and the wall whole.
    assert 0.8 <= left.length - 6.0 <= 1.0
    assert read_scene(file, VEHICLES["parkbench"]).vehicle == VEHICLES["parkbench"]


@settings(max_examples=15, deadline=None)
@given(st.floats(-3.1, 3.1), st.floats(-0.3, 0.3), st.floats(-1.5, 1.5))
def test_footprints_between_two_poses_lie_on_the_arc_between_them(yaw, curvature, way):
    """A point that the car reaches between two poses is touched; the distance to one beside it is exact."""
    along = [np.array(move_along(0.0, 0.0, yaw, curvature, way * i / 100)) for i in range(101)]
    corner = TPCAP.corners(along[50])[1]  # the front right
    ahead = np.array([math.cos(along[50][2]), math.sin(along[50][2])])
    right = np.array([ahead[1], -ahead[0]])
    for point, touched in ((corner - 0.005 * (ahead + right), True), (corner + 0.1 * right, False)):
        contour = Contour(point[None], closed=False)
        scene = Scene("point", TPCAP, np.array([50.0, 0.0, 0.0]), np.array([60.0, 0.0, 0.0]), (contour,))
        found = scene.check(np.array([along[0], along[-1]]))
        away = min(shapely.Polygon(TPCAP.corners(pose)).distance(shapely.Point(point)) for pose in along)
        assert away == 0.0 or not touched
        assert found.contact == (away == 0.0) or 0.0 < away < 1e-3
        assert found.clearance == pytest.approx(away, abs=0.005)


def test_the_tightest_slot_is_left_and_entered_within_all_limits(tmp_path):
    (tmp_path / "slot.toml").write_text(own_text())
    made = park(read_scene(tmp_path / "slot.toml"))
    assert made.judged.driven, made.judged
    assert made.judged.clearance_m > 0.001
    require_limits(made.states)
    assert np.abs(made.states[:, STEERING]).max() <= TPCAP.max_steering
    assert made.states[-1, SPEED] == 0.0


def require_limits(states):
    assert np.abs(np.diff(states[:, STEERING])).max() <= TPCAP.steering_rate * 0.05 + 1e-9
    assert np.abs(np.diff(states[:, SPEED])).max() <= TPCAP.max_acceleration * 0.05 + 1e-9


@pytest.mark.parametrize("level", SCENE_LEVELS)
def test_a_level_is_a_car_and_its_margin(level):
    kind, _, how = level.partition("-")
    low, high = getattr(levels(TPCAP)[how], "along" if kind == "parallel" else "across")
    for seed in range(4):
        scene, again = (level_scene(level, seed, TPCAP) for _ in range(2))
        np.testing.assert_array_equal(scene.start, again.start)
        car = shapely.Polygon(TPCAP.corners(scene.target))
        beside = sorted(car.distance(shape) for shape in scene.shapes if shape.geom_type == "Polygon")
        assert low - 1e-6 <= beside[0] + beside[1] <= high + 1e-6


def test_scenes_are_planned_driven_and_judged(tmp_path):
    out = tmp_path / "out"
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "slot.csv").write_text(
        tpcap_text((3e6, 3.0, 0.0), (3e6 + 9.0, 0.0, 0.0), [np.add(BLOCKS[0], [3e6, 0.0])])
    )
    ran("park --jobs 1 --report --cases", tmp_path / "scenes", "--out", out)
    summary = summary_of(out)
    (row,) = summary["rows"]
    assert (row["case"], row["planned"], row["driven"], row["contact"]) == ("slot", True, True, False)
    assert summary["vehicles"] == [{"scenes": 1, **dataclasses.asdict(TPCAP)}]
    lines = rows_in(out / "trajectories.csv")
    poses = np.array([[float(line[name]) for name in ("x_m", "y_m", "yaw_rad")] for line in lines])
    assert float(lines[-1]["time_s"]) == pytest.approx(row["time_s"])
    assert math.dist(poses[-1, :2], (3e6 + 9.0, 0.0)) == pytest.approx(row["error_m"], abs=1e-5)
    blocks = shapely.polygons(np.add(BLOCKS[0], [3e6, 0.0]))
    away = shapely.distance(shapely.polygons(TPCAP.corners(poses)), blocks)
    assert 0.0 < row["clearance_m"] <= away.min() + 1e-6
    for name in ("manoeuvres_1.png", "manoeuvre.gif", "report.html"):
        assert (out / name).stat().st_size > 1000


def test_a_run_does_not_go_on_with_a_scene_that_has_changed(tmp_path):
    (tmp_path / "slot.toml").write_text(own_text())
    study = ManoeuvreStudy(cases=tmp_path / "slot.toml", figures=False, jobs=1)
    run(study, tmp_path / "out")
    run(study, tmp_path / "out", resume=True)
    (tmp_path / "slot.toml").write_text(own_text() + "\n")
    with pytest.raises(InputError, match=r"slot\.toml"):
        run(study, tmp_path / "out", resume=True)


def test_levels_are_drawn_for_a_car_in_a_file_and_a_run_says_it_again(tmp_path):
    (tmp_path / "van.toml").write_text("length = 4.9\nwheelbase = 2.9\n")
    ran("park --levels oblique-normal -n 2 --vehicle van.toml --no-figures --jobs 1 --out out", cwd=tmp_path)
    summary = summary_of(tmp_path / "out")
    assert [row["driven"] for row in summary["agents"]] == [2]
    van = VehicleParameters(length=4.9, wheelbase=2.9)
    assert summary["vehicles"] == [{"scenes": 2, **dataclasses.asdict(van)}]
    ran("run out/experiment.json --out again", cwd=tmp_path)
    first, second = (tmp_path / f / "trajectories.csv" for f in ("out", "again"))
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("many.csv", "0,0,0,9,0,0,1,1000000," + "1.0," * 2_000_000, "want at most"),
        ("empty", "", "is not there"),
    ],
    ids=["many", "empty"],
)
def test_a_bad_scene_is_one_line_and_nothing_is_written(tmp_path, name, text, said):
    if text:
        (tmp_path / name).write_text(text)
    line = refused("park --out out --cases", name, cwd=tmp_path)
    assert said in line
    assert name in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("target", "obstacles", "length", "clearance"),
    [
        ([1.0, 3.0, 0.0], [{"line": [[-5.0, -2.0], [9.0, -2.0]]}], 0.0, pytest.approx(4.1, abs=0.01)),
        ([1.0, 3.0, 0.0], [], 0.0, None),
        ([1.03, 3.0, 2 * math.pi - 0.005], [], 0.0, None),
        ([4.0, 3.0, 0.0], [], pytest.approx(3.0, abs=0.05), None),
    ],
)
def test_a_car_at_its_target_stays_and_a_scene_may_be_empty(target, obstacles, length, clearance, tmp_path):
    scene = {"start": [1.0, 3.0, 0.0], "target": target, "obstacles": obstacles}
    (tmp_path / "a.json").write_text(json.dumps(scene))
    ran("park --cases a.json --out out", cwd=tmp_path)
    (row,) = summary_of(tmp_path / "out")["rows"]
    assert (row["planned"], row["driven"], row["contact"]) == (True, True, False)
    assert (row["length_m"], row["clearance_m"]) == (length, clearance)


@pytest.mark.slow
@pytest.mark.parametrize("source", ["tpcap", "parkbench"])
def test_all_public_scenes_are_driven(source):
    if not (PUBLIC / source).exists():
        pytest.skip(f"the scenes of {source} are not in shared/data")
    for scene in map(read_scene, scene_files(PUBLIC / source)):
        assert park(scene).judged.driven, scene.name


def test_an_environment_takes_a_car_by_name_and_an_agent_of_another_car_is_refused():
    env = gym.make("parkenv/Drive-v1", lot="mini", vehicle="tpcap", obstacle_map=True)
    assert env.unwrapped.vehicle == TPCAP
    observation, _ = env.reset(seed=0)
    with pytest.raises(InputError, match="vehicle with length"):
        ParkingAgent().predict(observation)
    assert np.isfinite(ParkingAgent(TPCAP).predict(observation)[0]).all()


CAR = VehicleParameters()
LOTS = ("campus", "street", "jam", "mini")
DRAGON_LAKE = Path(__file__).parents[2] / "shared" / "data" / "dlp" / "parking_map.yml"
NO_ROOM = SearchSettings(attempts=((0.2, 0.5),), most_expansions=1, patience=0.0)
LOW, HIGH = np.array([-20.0, -20.0]), np.array([20.0, 20.0])


def planned(task, settings=None):
    things, target = task.obstacles, task.vehicle.at_rear_axle(task.target)
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
    space = clearance(CAR, np.array([[[5.0, -9.0], [5.0, 9.0]]]), np.array([2]), LOW, HIGH)
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
    state, offsets = np.array([0.0, 0.06, 0.0, 0.0, 0.0, 0.0]), []
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
    observation, _ = gym.make("parkenv/Drive-v1", lot="mini").reset(seed=0)
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
    no_room = partial(ParkingAgent, search=NO_ROOM)
    monkeypatch.setattr("parkenv.studies.trips.parking_runs.ParkingAgent", no_room)
    out = tmp_path / "park"
    done = ran("park --seed 3 --lot mini --way back-in --episodes 2 --jobs 1 --out", out)
    assert "failed: mini, seed 3" in done.stdout
    assert "no path was found" in done.stdout
    assert (out / "failures.png").exists()
    assert not (out / "parkings.png").exists()


def test_park_writes_its_table_and_pictures(tmp_path):
    out = tmp_path / "park"
    ran("park --lot mini --episodes 3 --jobs 1 --out", out)
    *kinds, overall = summary_of(out)["rows"]
    assert (overall["kind"], overall["episodes"]) == ("all", 3)
    assert sum(row["parked"] for row in kinds) == overall["parked"]
    assert len((out / "episodes.csv").read_text().splitlines()) == 4
    assert {path.name for path in out.iterdir()} >= {"parkings.png", "parking.gif"}
    assert not (out / "failures.png").exists()
