"""Scenes: plain arrays and lots in, meshes and footprints out; changing one vehicle leaves the rest alone."""

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest
import shapely
from command_line import ran, rows_in, summary_of
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import LineString, Polygon

from parkenv.driving.levels import level_scene
from parkenv.driving.road_users import Crossing, CrossingTraffic, caused_contact
from parkenv.driving.scene_files import read_scene
from parkenv.driving.vehicle import TPCAP, VEHICLES, VehicleParameters, placed
from parkenv.errors import InputError
from planners.driving import manoeuvre
from planners.driving.manoeuvre import Manoeuvre, drive, park, paths_in_scene
from planners.driving.path_tracking import TrackingSettings
from sim_sensors import scenery
from sim_sensors.errors import SensorError
from sim_sensors.laser.footprints import ScanPlane
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.mesh import Material
from sim_sensors.scene import Scene
from sim_sensors.slot_scenes import SlotLot, slot_surroundings
from sim_sensors.surroundings import HEDGE_THICKNESS_M, Surroundings
from sim_sensors.vehicles.vehicle import VehicleModel

AROUND = {
    "buildings": [[[-5, 20], [40, 20], [40, 30], [-5, 30]]],
    "walls": [[-6, -4, -6, 9, 1.6], [0, -5, 9, -5, 0.4]],
    "trees": [[3, 17, 7], [9, 17, 8]],
    "pedestrians": [[4, 5, 0.3, 0.1]],
}


def rows_of_slots(n=20):
    xy = [[2.5 * i, y] for y in (0.0, 11.0) for i in range(n)]
    return np.array(xy), np.repeat([-np.pi / 2, np.pi / 2], n)


def lot(n=20, **options):
    return SlotLot(*rows_of_slots(n), 5.0, 2.5, **options)


def test_a_scene_holds_what_it_was_given():
    poses, bodies = [[0, 0, 0], [4, 0, 1.5], [9, 0, 0]], ["suv", None, "suv"]
    around = Surroundings(**AROUND, paved=[[[0, 0], [9, 0], [9, 9]]], markings=[[0, 0, 0, 5, 0.1]])
    scene = Scene.from_arrays(poses, [1, 2, 1], bodies, [(200, 0, 0), None, None], around)
    first, third = (scene.fleet.models[scene.vehicle_model[i]] for i in (0, 2))
    assert first.paint == (200, 0, 0)
    assert first.painted(third.paint) == third == VehicleModel.from_seed("suv", 1)
    np.testing.assert_array_equal(scene.vehicle_boxes[0], first.size)
    ids = scene.instances.ids
    assert ids[-3:].tolist() == [1, 2, 3]
    assert not ids[:-3].any()
    assert len(ids) == 3 + 1 + 2 + 2 + 1
    assert (scene.ground.markings.shape, len(scene.ground.paved)) == ((1, 5), 1)


def test_the_pool_holds_every_mesh_and_its_coarse_one():
    scene = Scene.from_arrays([[0, 0, 0], [4, 0, 1.5]], [1, 2], surroundings=Surroundings(**AROUND))
    pool = scene.pool
    n = len(pool.radius)
    assert len(pool.vertex_start) == len(pool.triangle_start) == n + 1
    assert pool.vertex_start[-1] == len(pool.vertices) == len(pool.normals)
    assert pool.triangle_start[-1] == len(pool.triangles) == len(pool.material) == len(pool.color)
    for m in range(n):
        part = pool.triangles[pool.triangle_start[m] : pool.triangle_start[m + 1]]
        size = pool.vertex_start[m + 1] - pool.vertex_start[m]
        assert part.min() == 0
        assert part.max() == size - 1
    count = np.diff(pool.triangle_start)
    vehicles = scene.instances.mesh[scene.instances.ids > 0]
    assert (count[pool.coarse[vehicles]] * 4 < count[vehicles]).all()
    assert np.array_equal(pool.coarse[pool.coarse], pool.coarse)
    of_second = slice(*pool.vertex_start[vehicles[1] :][:2])
    np.testing.assert_array_equal(pool.vertices[of_second], scene.fleet.models[1].mesh().vertices)


def test_footprints_are_where_the_vehicles_stand():
    scene = Scene.from_arrays([[10, 5, 0.7], [20, 0, 0]], [1, 2], surroundings=Surroundings(**AROUND))
    prints = scene.footprints()
    assert prints.ids[:2].tolist() == [1, 2]
    assert not prints.ids[2:].any()
    assert len(prints.ids) == 2 + 2 + 1
    model = scene.fleet.models[0]
    shape = Polygon(prints.corners[0, : prints.n_corners[0]])
    assert shape.exterior.is_ccw
    assert shape.area == pytest.approx(Polygon(model.footprint()).area)
    heading = np.array([np.cos(0.7), np.sin(0.7)])
    front = np.array([10, 5]) + heading * model.footprint()[:, 0].max()
    assert shape.distance(LineString([[10, 5], front]).interpolate(1.0, normalized=True)) < 0.05
    np.testing.assert_array_equal(prints.corners[0, : prints.n_corners[0]], scene.footprint(0))
    # The low wall is passed over, the high one is met on four sides, the building on four.
    assert len(prints.walls) == 4 + 4
    assert ScanPlane(prints.corners, prints.n_corners, prints.walls, prints.ids).n_footprints == 5


def test_hedges_are_drawn_and_met_by_the_laser():
    around = Surroundings(hedges=[[2, -3, 2, 3, 1.2], [-4, -3, -4, 3, 0.4]])
    assert len(around.standing) == 2
    walls = Scene.from_arrays(np.empty((0, 3)), [], surroundings=around).footprints().walls
    assert len(walls) == 4  # the low one is passed over
    assert walls[..., 0].min() == pytest.approx(2 - HEDGE_THICKNESS_M / 2)
    mesh = around.standing[0].mesh
    assert (mesh.material == Material.FOLIAGE).all()
    assert np.ptp(mesh.vertices[:, 2]) == pytest.approx(1.2, abs=0.1)
    assert np.abs(mesh.vertices[:, 0]).max() == pytest.approx(HEDGE_THICKNESS_M / 2, abs=0.1)


def test_changing_one_slot_leaves_every_other_array_as_it_was():
    parking = lot(seed=5)
    scene = parking.scene(np.ones(40, bool))
    pool, before, prints = scene.pool, scene.instances, scene.footprints()
    gone = scene.without_vehicle(7)
    back, other = parking.filled(gone, 7, 0), parking.filled(gone, 7, 1)
    for changed in (gone, back, other):
        assert changed.pool is pool
        assert changed.ground is scene.ground
        keep = changed.instances.ids != 8
        kept = before.ids != 8
        for name in ("mesh", "pose", "ids"):
            np.testing.assert_array_equal(getattr(changed.instances, name)[keep], getattr(before, name)[kept])
        rest = np.arange(len(prints.ids)) != 7
        np.testing.assert_array_equal(changed.footprints().corners[rest], prints.corners[rest])
    assert (gone.footprints().n_corners[7], gone.footprint(7).shape) == (0, (0, 2))
    np.testing.assert_array_equal(back.instances.pose, before.pose)
    assert not np.array_equal(other.vehicle_pose[7], scene.vehicle_pose[7])
    assert scene.vehicle_model[7] >= 0


def test_the_scan_plane_of_a_changed_scene_is_that_of_one_made_anew():
    """It is changed with the scene, one footprint at a time; scans are equal to the last bit."""
    lot = SlotLot([[3.0 * i, 0.0] for i in range(40)], 1.57, 5.0, 2.5)
    rng = np.random.default_rng(0)
    taken, number = rng.random(40) < 0.5, np.zeros(40, np.int64)
    changed = lot.scene(taken, number)
    poses = np.column_stack([rng.uniform(0, 120, 30), np.full(30, -6.0), rng.uniform(-3, 3, 30)])
    changed.scan_plane  # noqa: B018 - from here on it is changed with the scene
    for _ in range(120):
        slot = int(rng.integers(40))
        if taken[slot]:
            changed = changed.without_vehicle(slot)
        else:
            number[slot] += 1
            changed = lot.filled(changed, slot, int(number[slot]))
        taken[slot] = not taken[slot]
        assert "scan_plane" in vars(changed)
    anew = lot.scene(taken, number)
    scans = [LaserScanner().scan_with_ids(scene.scan_plane, poses) for scene in (changed, anew)]
    np.testing.assert_equal(*scans)


def test_the_car_in_a_slot_depends_on_seed_slot_and_arrival_alone():
    parking, rng = lot(seed=5), np.random.default_rng(0)
    full = parking.scene(np.ones(40, bool))
    occupied = rng.random(40) < 0.5
    some = parking.scene(occupied)
    np.testing.assert_array_equal(some.vehicle_pose[occupied], full.vehicle_pose[occupied])
    np.testing.assert_array_equal(some.vehicle_model[occupied], full.vehicle_model[occupied])
    assert (some.vehicle_model[~occupied] == -1).all()
    again = parking.scene(np.ones(40, bool), np.where(np.arange(40) == 3, 1, 0))
    assert np.flatnonzero((again.vehicle_pose != full.vehicle_pose).any(axis=1)).tolist() == [3]
    assert not np.array_equal(lot(seed=6).scene(np.ones(40, bool)).vehicle_pose, full.vehicle_pose)


def test_a_model_that_the_fleet_lacks_is_added_behind_the_others():
    scene = Scene.from_arrays([[0, 0, 0], [9, 0, 0]], [1, 2])
    pool = scene.pool
    changed = scene.with_vehicle(1, model=VehicleModel.from_seed("pickup", 77), pose=(12, 3, 1.0))
    assert changed.fleet.models[:2] == scene.fleet.models
    assert changed.vehicle_pose[1].tolist() == [12, 3, 1]
    np.testing.assert_array_equal(changed.pool.vertices[: len(pool.vertices)], pool.vertices)
    fleet = type(scene.fleet)(changed.fleet.models, Surroundings())
    whole = Scene(changed.vehicle_pose, changed.vehicle_model, fleet)
    for name in ("vertices", "triangles", "color", "vertex_start", "triangle_start", "radius", "coarse"):
        np.testing.assert_array_equal(getattr(changed.pool, name), getattr(whole.pool, name))


def test_cars_fit_do_not_overlap_and_park_as_the_manners_say_one_way_at_kerbs():
    n = 60
    for width, length in ((2.3, 5.0), (2.5, 4.6), (2.7, 6.0)):
        xy = np.column_stack([width * np.arange(n), np.zeros(n)])
        scene = SlotLot(xy, np.full(n, np.pi / 2), length, width, seed=4).scene(np.ones(n, bool))
        boxes, outlines = scene.vehicle_boxes, [Polygon(scene.footprint(i)) for i in range(n)]
        assert not any(a.intersects(b) for a, b in pairwise(outlines))
        assert boxes[:, 0].max() <= length + 0.2
        assert boxes[:, 1].max() <= width - 0.4
    xy = 50.0 * np.column_stack([np.arange(1500), np.zeros(1500)])
    scene = SlotLot(xy, np.zeros(1500), 6.5, 3.4, seed=2).scene(np.ones(1500, bool))
    offset = scene.vehicle_pose[:, :2] - xy
    turn = np.mod(scene.vehicle_pose[:, 2] + np.pi / 2, np.pi) - np.pi / 2
    assert offset.std(axis=0) == pytest.approx([0.20, 0.12], rel=0.1)
    assert turn.std() == pytest.approx(np.radians(1.5), rel=0.1)
    assert np.mean(np.abs(scene.vehicle_pose[:, 2]) > 1) == pytest.approx(0.25, abs=0.04)
    xy = np.column_stack([6.0 * np.arange(80), np.zeros(80)])
    scene = SlotLot(xy, np.zeros(80), 6.0, 2.2, True, seed=1).scene(np.ones(80, bool))
    assert np.abs(scene.vehicle_pose[:, 2]).max() < 0.1
    assert scene.vehicle_boxes[:, 0].max() <= 5.8


def test_the_lanes_of_a_lot_are_paved():
    xy, yaw = rows_of_slots(4)
    occupied = np.array([1, 0, 1, 1, 0, 0, 1, 0], bool)
    lot = SlotLot(xy, yaw, 5.0, 2.5, seed=3)
    around = slot_surroundings(lot, [[[-5, 5.5], [30, 5.5]]], **AROUND)
    scene = dataclasses.replace(lot, surroundings=around).scene(occupied)
    assert scene.present.tolist() == np.flatnonzero(occupied).tolist()
    assert len(scene.ground.markings) == 10  # five lines a row: a shared line is painted once
    assert Polygon(scene.ground.paved[0]).contains(LineString([[-5, 5.5], [30, 5.5]]))
    assert len(scene.footprints().walls) == 8


@pytest.mark.parametrize(
    "mesh",
    [
        scenery.building_mesh([[0, 0], [20, 0], [20, 12], [10, 12], [10, 8], [0, 8]], 9.0, 1),
        scenery.wall_mesh([0, 0], [5, 1], 2.0, 0.24, 1),
        scenery.hedge_mesh([0, 0], [5, 1], 1.2, 0.8, 1),
        scenery.tree_mesh(7.0, 3),
        scenery.pedestrian_mesh(0.0, 1),
        scenery.pedestrian_mesh(0.25, 2),
    ],
    ids=["building", "wall", "hedge", "tree", "striding", "passing"],
)
def test_scenery_is_turned_the_right_way_round(mesh):
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles].astype(float), 1, 0)
    face = np.cross(b - a, c - a)
    assert (np.sum(face * mesh.normals[mesh.triangles[:, 0]], axis=1) > 0).all()
    assert np.sum(a * face) > 0  # volume
    assert mesh.vertices[:, 2].min() > -0.02


def test_people_have_their_legs_inside_their_footprint():
    for phase in (0.0, 0.25, 0.6):
        mesh = scenery.pedestrian_mesh(phase, 4)
        knee = mesh.vertices[(mesh.vertices[:, 2] > 0.45) & (mesh.vertices[:, 2] < 0.55), :2]
        shape = Polygon(scenery.pedestrian_footprint(phase)).buffer(0.03)
        assert all(shape.contains(LineString([p, p + 1e-6])) for p in knee)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: Scene.from_arrays([[0, 0, 0]], [1]).with_vehicle(1), "place is 1, want 0 to 0"),
        (lambda: Scene.from_arrays([[0, 0, 0]], [1]).with_vehicle(0, pose=(0, 0, np.inf)), "pose"),
        (lambda: Scene.from_arrays([[0, 0, 0]], [1]).without_vehicle(0).with_vehicle(0), "model: place 0"),
        (lambda: lot().scene(np.ones(3, bool)), r"occupied .*want \(40,\) bool"),
        (lambda: lot().scene(np.ones(40, bool), -1), "arrivals"),
    ],
)
def test_bad_input_is_refused_with_one_clear_line(call, match):
    with pytest.raises(SensorError, match=match) as caught:
        call()
    assert "\n" not in str(caught.value)


CAR = VehicleParameters()
WALKER = Crossing("pedestrian", ((-8.0, 0.0), (8.0, 0.0)), 1.5)


def test_levels_and_road_users_are_in_the_results(tmp_path):
    levels = ("perpendicular-normal", "oblique-moving")
    ran(f"park --levels {','.join(levels)} -n 1 --seed 5 --jobs 1 --out out", cwd=tmp_path)
    rows = summary_of(tmp_path / "out")["levels"]
    assert {(row["agent"], row["level"]) for row in rows} == {("planner", its) for its in levels}
    for row in rows:
        assert (row["scenes"], row["driven"], row["contacts"], row["success"]) == (1, 1, 0, 1.0)
    assert {row["case"] for row in rows_in(tmp_path / "out" / "road_users.csv")} == {"oblique-moving-5"}
    assert (tmp_path / "out" / "manoeuvre.gif").stat().st_size > 1000


@pytest.mark.parametrize("vehicle", VEHICLES.values(), ids=VEHICLES)
def test_every_named_car_parks(vehicle):
    assert park(level_scene("perpendicular-normal", 1, vehicle)).judged.driven


@settings(max_examples=20)
@given(
    st.floats(-6.0, 6.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.sampled_from(["pedestrian", "car"])
)
def test_road_users_never_touch_a_car_that_stands(x, y, yaw, kind):
    user = dataclasses.replace(WALKER, kind=kind, way=((-14.0, 0.0), (14.0, 0.0)))
    corners, traffic = CAR.corners(np.array([x, y, yaw])), CrossingTraffic([user])
    car, along = shapely.Polygon(corners), []
    for _ in range(400):
        traffic.advance(0.05, corners, stands=True)
        assert car.distance(shapely.Polygon(traffic.outlines[0])) > 0.0
        along.append(traffic.poses[0, 0])
    ways = shapely.MultiPoint(placed(user.outline, user.poses(np.linspace(0.0, 28.0, 99))).reshape(-1, 2))
    if car.distance(ways.convex_hull) > 0.4:
        assert along[-1] == pytest.approx(14.0)
    else:
        assert along[-1] < 14.0
        assert min(np.diff(along)) < 0.0, "it gives way in the end"


def test_only_a_car_that_moves_causes_a_contact():
    others = np.tile([2.0, 0.0, 0.0], (11, 1))[:, None]
    standing = np.tile([0.0, 0.0, 0.0], (11, 1))
    passing = np.column_stack([np.full(11, 2.0), np.linspace(-9.0, 9.0, 11), np.full(11, math.pi / 2)])
    assert not caused_contact(CAR, standing, (WALKER,), others)
    assert caused_contact(CAR, passing, (WALKER,), others)
    assert not caused_contact(CAR, passing + np.array([9.0, 0.0, 0.0]), (WALKER,), others)


def test_a_car_waits_for_others_that_it_would_touch(monkeypatch):
    hit = 0
    for seed in range(4):
        scene = level_scene("oblique-moving", seed)
        path = next(paths_in_scene(scene))
        states, others = drive(scene, path, TrackingSettings())
        assert Manoeuvre(scene, path, states, 0.0, others).judged.driven
        with monkeypatch.context() as patch:
            patch.setattr(manoeuvre, "is_blocked", lambda *_: False)
            states, others = drive(scene, path, TrackingSettings())
            hit += Manoeuvre(scene, path, states, 0.0, others).judged.contact
    assert hit >= 1


def test_a_scene_in_a_file_has_road_users(tmp_path):
    (tmp_path / "s.toml").write_text(
        'start = [50.0, 3.0, 0.0]\ntarget = [57.0, 3.0, 0.0]\nvehicle = "tpcap"\n'
        '[[crossings]]\nkind = "car"\nway = [[54.0, -20.0], [54.0, 20.0]]\nspeed_mps = 2.0\nbegins_s = 1.5\n'
    )
    scene = read_scene(tmp_path / "s.toml")
    (user,) = scene.crossings
    np.testing.assert_allclose(np.array(user.way) + scene.origin, [[54.0, -20.0], [54.0, 20.0]])
    assert (scene.vehicle, user.speed, user.begins_s) == (TPCAP, 2.0, 1.5)
    (tmp_path / "s.toml").write_text((tmp_path / "s.toml").read_text().replace("2.0\n", "-2.0\n"))
    with pytest.raises(InputError, match="speed"):
        read_scene(tmp_path / "s.toml")
