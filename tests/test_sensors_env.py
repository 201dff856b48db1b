"""`parkenv/SearchSensors-v2`: raw observations of the same searches, and what else moves in the lot."""

import copy
import dataclasses
import math
import os
import subprocess
import sys

import gymnasium as gym
import numba
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon, STRtree, box, polygons
from shapely.affinity import rotate, translate

import parkenv  # noqa: F401
from parkenv import InputError, OccupancyProcess, Traffic, make_scenario
from parkenv.belief.slot_belief import SlotBelief
from parkenv.engine.sensor_sampler import PICTURE_WIDTH, SensorSampler
from parkenv.lots import packaged_lot
from parkenv.world.facility import Facility
from parkenv.world.lot_scene import LotScenes, slot_lot
from parkenv.world.traffic import LotTraffic, _Loops
from sim_sensors.camera.models import PinholeCamera
from sim_sensors.errors import SensorError
from sim_sensors.ground_truth import vehicle_boxes
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.movers import Movers
from sim_sensors.rig import LEFT, RIGHT, Mount, SensorRig, poses_along

SMALL = PinholeCamera.from_field_of_view(80, 60)
LASERS = (("laser", LaserScanner(), Mount(z=0.5)),)
SMALL_RIG = SensorRig(cameras=(("right", SMALL, Mount(z=1.1, yaw=RIGHT)),), lasers=LASERS)
LASER_ONLY = SensorRig(lasers=LASERS)
BUSY = Traffic(cars=4, pedestrians=6)
LOT = packaged_lot("mini")
POSE = np.array([*LOT.vertex_xy[2], LOT.vertex_yaw[2]])


def make(**options):
    return gym.make("parkenv/SearchSensors-v2", **{"scenario": "mini", "rig": SMALL_RIG, **options})


def drive(env, seed, actions):
    first, _ = env.reset(seed=seed)
    return [first, *(env.step(action)[0] for action in actions)]


def test_captures_drawn_side_by_side_are_those_drawn_one_by_one():
    options = {"scenario": "campus", "traffic": BUSY, "captures": 4}
    together, cores = drive(make(**options), 3, (0, 3, 1)), numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        alone = drive(make(**options), 3, (0, 3, 1))
    finally:
        numba.set_num_threads(cores)
    assert max(int(observation["count"]) for observation in alone) > 1
    for a, b in zip(together, alone, strict=True):
        assert data_equivalence(a, b, exact=True)


def test_the_search_is_that_of_the_search_environment():
    sensors, plain = make(rig=LASER_ONLY), gym.make("parkenv/Search-v2", scenario="mini")
    sensors.reset(seed=5)
    observation, _ = plain.reset(seed=5)
    rng = np.random.default_rng(0)
    for _ in range(60):
        action = rng.choice(np.flatnonzero(observation["action_mask"]))
        raw, *rest = sensors.step(action)
        observation, *plain_rest = plain.step(action)
        assert rest == plain_rest
        assert raw["vertex"] == observation["vertex"]
        assert not {"p_occupied", "belief"} & set(raw)
        if rest[1]:
            assert (raw["count"] == 0) == rest[-1]["parked"]
            break


def test_captures_lie_on_the_edge_just_driven_end_at_the_stop_and_waiting_makes_one():
    env = make(scenario="campus", rig=LASER_ONLY, captures=4, every=1.0)
    env.reset(seed=0)
    lot, before = env.unwrapped.scenario.lot, env.unwrapped.state.vertex
    counts = set()
    for _ in range(12):
        observation, *_ = env.step(int(np.flatnonzero(lot.neighbors[before] >= 0)[-1]))
        here, n = int(observation["vertex"]), int(observation["count"])
        start, end = lot.vertex_xy[before], lot.vertex_xy[here]
        shares = np.arange(1, n + 1) / n
        on_edge = start + shares[:, None] * (end - start)
        np.testing.assert_allclose(observation["pose"][:n, :2], on_edge, rtol=0, atol=1e-4)
        way = np.arctan2(*(end - start)[::-1])
        np.testing.assert_allclose(observation["pose"][: n - 1, 2], way, atol=1e-5)
        if here < lot.n_slots:
            assert observation["pose"][n - 1, 2] == np.float32(lot.vertex_yaw[here])
        assert not observation["pose"][n:].any()
        assert (np.diff(observation["captured_at"][:n]) > 0).all()
        assert n == min(max(int(np.hypot(*(end - start))), 1), 4)
        counts.add(n)
        before = here
    assert len(counts) > 1
    # Waiting makes one capture, and time goes on.
    env = make(rig=LASER_ONLY)
    start, _ = env.reset(seed=0)
    observation, *_ = env.step(int(np.flatnonzero(start["action_mask"] == 0)[0]))
    assert start["count"] == observation["count"] == 1
    np.testing.assert_array_equal(observation["pose"][0], start["pose"][0])
    assert observation["captured_at"][0] == 1.0


def test_scans_alone_are_those_beside_the_pictures():
    both, alone = make(), make(observation="scan")
    without = {name for name in both.observation_space if not name.startswith("image_")}
    assert set(alone.observation_space) == without
    for full, scan in zip(drive(both, 3, (3, 3, 3)), drive(alone, 3, (3, 3, 3)), strict=True):
        assert data_equivalence({name: full[name] for name in without}, scan, exact=True)


def test_pictures_of_another_width():
    assert make(picture_width=160).reset(seed=1)[0]["image_right"].shape[1:] == (120, 160, 3)
    assert make().unwrapped.rig is SMALL_RIG
    for wanted, width in ((None, PICTURE_WIDTH), (640, 640)):
        for name in ("SearchSensors", "SearchPerception"):
            seen = gym.make(f"parkenv/{name}-v2", scenario="mini", picture_width=wanted).unwrapped
            assert seen.rig.cameras[0][1].width == width
    for wrong in (True, 12, 3.5):
        with pytest.raises(InputError, match="picture_width is"):
            make(picture_width=wrong)


@pytest.mark.parametrize("name", ["Search", "SearchPerception"])
def test_live_counts_are_known_at_every_step(name):
    garage = Facility("P1", "garage", capacity=3, xy=(30.0, 12.0), known="live")
    scenario = make_scenario(dataclasses.replace(LOT, facilities=(garage,)))
    env = gym.make(f"parkenv/{name}-v2", scenario=scenario)
    seen, _ = env.reset(seed=0)
    for _ in range(2):
        seen, *_ = env.step(int(seen["action_mask"][:4].argmax()))
        assert SlotBelief.of_observation(seen).observed_at[-1] == pytest.approx(seen["time"][1])


def test_scenes_follow_the_world_and_do_not_depend_on_when_one_looks():
    short_stays = OccupancyProcess.from_demand(np.zeros(LOT.n_slots), np.zeros(168), 300.0)
    scenario = make_scenario("mini", occupancy=short_stays)
    slots, key = slot_lot(LOT), np.uint64(77)
    arrival = scenario.occupancy.draw_arrival(scenario.arrival, key)

    def scenes():
        return LotScenes(slots, scenario, key, scenario.occupancy.world(key, arrival))

    often, seldom = scenes(), scenes()
    world, cars = scenario.occupancy.world(key, arrival), set()
    for minute in range(0, 60, 2):
        time = arrival.time + 60.0 * minute
        scene = often.at(time)
        np.testing.assert_array_equal(
            np.isin(np.arange(LOT.n_slots), scene.present), world.occupied(np.arange(LOT.n_slots), time)
        )
        cars |= {tuple(p) for p in scene.vehicle_pose[scene.present]}
    late = seldom.at(time)
    np.testing.assert_array_equal(late.vehicle_model, scene.vehicle_model)
    np.testing.assert_array_equal(late.vehicle_pose[late.present], scene.vehicle_pose[scene.present])
    assert len(cars) > 2 * LOT.n_slots  # another car comes after one has left


@pytest.mark.parametrize("name", ["campus", "street"])
def test_traffic_keeps_to_its_ways(name):
    lot = make_scenario(name).lot
    traffic = LotTraffic(lot, 0, Traffic(cars=6, pedestrians=0), np.uint64(3), slot_lot(lot))
    slots, touching = STRtree(polygons(lot.slot_corners())), 0
    times, before = np.arange(0.0, 120.0, 2.0), None
    for time in times:
        pose = traffic.at(time).vehicle_pose
        assert len(pose) == 6
        if before is not None:
            assert (np.hypot(*(pose - before)[:, :2].T) < 4.0 * 2.0 + 0.5).all()
        before = pose
        for x, y, yaw in pose:
            # Half the car: even people who cut a corner do not drive through parked ones.
            car = translate(rotate(box(-2.0, -0.5, 2.0, 0.5), yaw, use_radians=True, origin=(0, 0)), x, y)
            touching += bool(len(slots.query(car, predicate="intersects")))
    assert touching < 0.02 * 6 * len(times)


def pose_on(loop, time):
    """x, y and yaw on a closed path, one number at a time."""
    corners = np.concatenate([loop.path, loop.path[:1]])
    station = np.r_[0.0, np.cumsum(np.hypot(*np.diff(corners, axis=0).T))]
    at = (loop.start * station[-1] + loop.speed * time) % station[-1]

    def point(s):
        return np.array([np.interp(s % station[-1], station, corners[:, i]) for i in (0, 1)])

    behind, ahead = point(at - loop.reach), point(at + loop.reach)
    chord = ahead - behind
    if np.hypot(*chord) < 0.3:
        chord = point(at + 0.01) - point(at)
    yaw = np.arctan2(chord[1], chord[0])
    return np.array([*(0.5 * (behind + ahead) + loop.aside * np.array([np.sin(yaw), -np.cos(yaw)])), yaw])


@pytest.mark.parametrize("name", ["street", "mini"])
def test_all_road_users_are_where_each_would_be_alone(name, monkeypatch):
    loops = []

    class Noted(_Loops):
        def __init__(self, given):
            loops.extend(given)
            super().__init__(given)

    monkeypatch.setattr("parkenv.world.traffic._Loops", Noted)
    lot = make_scenario(name).lot
    several = LotTraffic(lot, 0, Traffic(cars=3, pedestrians=9), np.uint64(5), slot_lot(lot))
    for time in np.linspace(0.0, 900.0, 40):
        times = time + np.arange(12.0)
        alone = [pose_on(loop, t) for loop, t in zip(loops, times, strict=True)]
        np.testing.assert_allclose(several.poses_at(times), alone, atol=1e-9)


def test_nobody_is_in_the_searching_cars_way():
    traffic = LotTraffic(LOT, 0, Traffic(cars=3, pedestrians=4), np.uint64(1), slot_lot(LOT))
    for time in np.arange(0.0, 60.0, 3.0):
        everyone = traffic.at(time)
        ego = everyone.vehicle_pose[0]
        seen = traffic.at(time, ego)
        assert seen.n_vehicles < everyone.n_vehicles
        assert (np.abs(seen.vehicle_pose[:, :2] - ego[:2]).max(axis=1) > 2.0).all()


def test_movers_are_drawn_scanned_and_numbered_after_the_parked_cars():
    parked = slot_lot(LOT).scene(np.ones(LOT.n_slots, bool))
    x, y = LOT.vertex_xy[0]
    ahead = np.array([[x, y + 4.0, 0.3]])
    walker = np.array([[x + 4.0, y, 0.0]]), np.array([0.2]), np.array([1])
    moving = parked.with_movers(Movers(ahead, np.array([2]), *walker))
    pose = np.array([x, y, 0.0])
    left, camera = Mount(z=1.1, yaw=LEFT).camera_pose(pose), PinholeCamera()
    assert LOT.n_slots + 1 in vehicle_boxes(camera, moving, left, camera.render(moving, left)).ids
    assert LOT.n_slots + 1 not in vehicle_boxes(camera, parked, left, camera.render(parked, left)).ids
    laser = LaserScanner()
    still, _ = laser.scan_with_ids(parked.scan_plane, pose)
    scan, ids = laser.scan_with_ids(moving.scan_plane, pose)
    assert (ids == LOT.n_slots + 1).sum() > 20
    assert (scan <= still).all()
    assert scan[540] < 4.0  # someone walks straight ahead
    assert ids[540] == 0


def test_moving_shadows_are_those_of_a_scene_made_anew():
    slots = slot_lot(LOT)
    parked = slots.scene(np.ones(LOT.n_slots, bool))
    x, y = LOT.vertex_xy[0]
    movers = Movers(np.array([[x + 3.0, y + 1.0, 0.1]]), np.array([4]))
    eye = Mount(z=1.1, yaw=0.0).camera_pose(np.array([x - 6.0, y, 0.0]))
    camera = PinholeCamera()
    camera.render(parked, eye)  # its shadows are kept, and the mover's are added
    kept = camera.render(parked.with_movers(movers), eye)
    fresh = camera.render(slots.scene(np.ones(LOT.n_slots, bool)).with_movers(movers), eye)
    np.testing.assert_array_equal(kept.image, fresh.image)
    ground = (kept.ids == 0) & (kept.depth < 12.0)
    without = camera.render(parked, eye).image.astype(int)
    darker = (without.sum(axis=2) - kept.image.sum(axis=2, dtype=int)) > 60
    assert (darker & ground).sum() > 300


def test_samplers_of_equal_worlds_see_the_same_whatever_was_looked_at_before():
    scenario = make_scenario("mini", traffic=BUSY)
    env = gym.make("parkenv/Search-v2", scenario=scenario).unwrapped
    env.reset(seed=0)
    eager, late = (SensorSampler(scenario, SMALL_RIG, None, 3, 0.5) for _ in range(2))
    for action in (3, 3, 3):
        before = env.state.vertex, env.state.time
        env.step(action)
        last = eager.sample_step(env.state, before)
    for a, b in zip(last, late.sample_step(env.state, before), strict=True):
        np.testing.assert_array_equal(a.capture.images["right"].image, b.capture.images["right"].image)
        np.testing.assert_array_equal(a.capture.scans["laser"], b.capture.scans["laser"])


@pytest.mark.parametrize("name", ["campus", "street", "mini"])
def test_cars_of_a_full_lot_do_not_touch(name):
    lot = make_scenario(name).lot
    for arrival in (0, 7919):
        scene = slot_lot(lot).scene(np.ones(lot.n_slots, bool), arrival)
        assert len(scene.present) == lot.n_slots
        cars = STRtree([Polygon(scene.footprint(i)) for i in scene.present])
        assert cars.query(cars.geometries, predicate="intersects").shape[1] == lot.n_slots


IN_THREADS_AND_FORKS = """
import gymnasium as gym
import numpy as np
import parkenv
env = gym.make("parkenv/SearchPerception-v2", scenario="mini", picture_width=100)
env.reset(seed=0)
for action in (0, 3, 1, 2):
    env.step(action)
envs = gym.make_vec("parkenv/SearchSensors-v2", 2, "async", scenario="mini", vector_kwargs={"context": "fork"})
envs.reset(seed=0)
envs.step(np.array([3, 3]))
envs.close()
print("done")
"""


def test_sensors_work_without_openmp_and_in_forks_after_a_step():
    """Numba's own threads are neither safe in several threads of ours, nor after a fork."""
    environment = os.environ | {"NUMBA_THREADING_LAYER": "workqueue"}
    command = [sys.executable, "-c", IN_THREADS_AND_FORKS]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout) == (0, "done\n"), done.stderr


def test_an_environment_is_copied_while_its_window_is_open(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make("parkenv/Search-v2", scenario="mini", render_mode="human").unwrapped
    env.reset(seed=0)
    twin = copy.deepcopy(env)
    assert data_equivalence(env.step(3), twin.step(3))
    env.close()
    twin.close()


@pytest.fixture(scope="module")
def scene():
    return slot_lot(LOT).scene(np.arange(LOT.n_slots) % 3 != 0)


def small(mount):
    camera = PinholeCamera.from_field_of_view(160, 120)
    return SensorRig(cameras=(("camera", camera, mount),), lasers=LASERS)


def test_mounts_turn_with_the_vehicle():
    mount = Mount(x=1.0, y=0.5, z=1.2, yaw=RIGHT)
    assert mount.in_world(np.array([10.0, 20.0, 0.0])) == pytest.approx((11.0, 20.5, -math.pi / 2))
    assert mount.in_world(np.array([10.0, 20.0, math.pi / 2])) == pytest.approx((9.5, 21.0, 0.0))


def test_smaller_pictures_show_the_same(scene):
    large, small = SensorRig.thesis(), SensorRig.thesis().resized(320)
    (_, camera, _), (_, half, _) = large.cameras[0], small.cameras[0]
    assert (half.width, half.height, half.fx) == (320, 240, camera.fx / 2)
    one, other = (rig.capture(scene, POSE, seed=1).images["right"].image for rig in (large, small))
    halved = one.reshape(240, 2, 320, 2, 3).mean(axis=(1, 3))
    assert np.abs(halved - other).mean() < 8.0
    assert SensorRig.stereo().resized(400).stereo_cameras[0][1].camera.height == 300
    with pytest.raises(SensorError, match="width is 0"):
        large.resized(0)


def test_equal_seeds_give_equal_captures_and_other_seeds_other_noise(scene):
    rig = small(Mount(z=1.1, yaw=RIGHT))
    one, same, other = (rig.capture(scene, POSE, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.images["camera"].image, same.images["camera"].image)
    np.testing.assert_array_equal(one.scans["laser"], same.scans["laser"])
    assert (one.images["camera"].image != other.images["camera"].image).any()
    assert (one.scans["laser"] != other.scans["laser"]).any()
    np.testing.assert_array_equal(one.images["camera"].depth, other.images["camera"].depth)


@pytest.mark.parametrize("yaw", [RIGHT, LEFT])
def test_beams_that_hit_a_vehicle_and_the_cameras_depth_agree(scene, yaw):
    """A level camera at the laser's height sees along its middle row what the beams measure."""
    rig = small(Mount(z=0.5, yaw=yaw))
    capture = rig.capture(scene, POSE)
    (_, camera, _), (_, laser, _) = rig.cameras[0], rig.lasers[0]
    ranges, ids = laser.scan_with_ids(scene.scan_plane, POSE)
    frame, bearing = capture.images["camera"], laser.angles - yaw
    column = camera.cx - camera.fx * np.tan(np.clip(bearing, -1.4, 1.4))
    inside = (np.abs(bearing) < 0.5) & (ids > 0)
    pixel, row = np.floor(column[inside]).astype(int), int(camera.cy)
    depth = np.minimum(frame.depth, frame.glass_depth)[row, pixel]
    same_vehicle = frame.ids[row, pixel] == ids[inside]
    off = np.abs(depth - ranges[inside] * np.cos(bearing[inside]))[same_vehicle]
    assert inside.sum() > 50
    assert same_vehicle.mean() > 0.9, "they differ at silhouettes only"
    assert np.median(off) < 0.05, "the footprint is the convex hull of the body's section"


@given(
    st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=2, max_size=6, unique=True),
    st.floats(0.3, 20.0),
)
@settings(max_examples=60)
def test_poses_lie_on_the_path_in_even_steps(points, every):
    path = np.array(points)
    if np.hypot(*np.diff(path, axis=0).T).min() < 1e-3:
        return
    poses = poses_along(path, every)
    np.testing.assert_allclose(poses[0, :2], path[0])
    np.testing.assert_allclose(poses[-1, :2], path[-1], atol=1e-6)
    hop = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert (hop <= every + 1e-6).all()
    length = np.hypot(*np.diff(path, axis=0).T).sum()
    count = length / every
    assert len(poses) == pytest.approx(count, abs=1.01) or len(poses) == math.ceil(count) + 1
