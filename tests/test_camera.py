"""Pictures: deterministic, well exposed, with true depth, ids and boxes; stereo; what is refused."""

import math
import pickle
from copy import copy

import cv2
import numba
import numpy as np
import plain_sky
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plain_shading import plain_radiance
from toy_scene import box_mesh, parked_cars, random_boxes, ray_depth, toy_scene

from parkenv.perception.range_scan import disparity
from sim_sensors import SensorError, SlotLot
from sim_sensors.camera.ground_texture import ground_texture
from sim_sensors.camera.image_sensor import ImageSensor
from sim_sensors.camera.light_maps import open_sky, sunlit
from sim_sensors.camera.models import PinholeCamera, StereoCamera, camera_pose
from sim_sensors.camera.projection import project
from sim_sensors.camera.rasterizer import rasterize
from sim_sensors.camera.shading import shade
from sim_sensors.camera.shadows import light_maps
from sim_sensors.camera.sky import mirrored_sky, sky_of_view
from sim_sensors.camera.weather import PRESETS, Weather
from sim_sensors.ground_truth import View, vehicle_boxes
from sim_sensors.mesh import Material

CAMERA = PinholeCamera.from_field_of_view(320, 240)
POSE = camera_pose(0.0, 0.0, 1.4, 0.4, -0.05)


@pytest.fixture(scope="module")
def scene():
    return random_boxes(5, count=50)


@pytest.fixture(scope="module")
def row():
    """Five cars in a row 6 m to the right of a lane along x, seen from the side, the third also from behind one."""
    body, pane = box_mesh(4.3, 1.8, 1.0), box_mesh(1.6, 1.6, 0.5, Material.GLASS)
    parts, places = ((0, 0.2), (1, 1.2)), (-11.0, -5.5, 0.0, 5.5, 11.0)
    placed = [(mesh, x, -6.0, z, 0.0) for x in places for mesh, z in parts]
    return toy_scene([body, pane], placed, np.repeat(np.arange(1, 6), 2))


@pytest.mark.parametrize("preset", PRESETS)
def test_every_weather_is_deterministic_and_well_exposed(scene, preset):
    weather = Weather.draw(preset, 3)
    assert weather == Weather.draw(preset, 3)
    assert weather != Weather.draw(preset, 4)
    frame, again = (CAMERA.render(scene, POSE, weather, 7) for _ in range(2))
    assert (frame.image.shape, frame.image.dtype) == ((240, 320, 3), np.uint8)
    assert np.array_equal(frame.image, again.image)
    assert np.array_equal(frame.depth, again.depth)
    assert 60 < frame.image.mean() < 170
    assert frame.image.std() > 15
    assert np.mean(frame.image == 255) < 0.2


@pytest.mark.parametrize("preset", PRESETS)
def test_the_sky_is_that_of_plain_numpy(preset):
    weather = Weather.draw(preset, 5)
    sharp, blurred = plain_sky.sky_domes(weather)
    assert np.abs(mirrored_sky(weather) - blurred).mean() < 0.01 * blurred.mean()
    camera = PinholeCamera.from_field_of_view(160, 120)
    rotation = camera_pose(0.0, 0.0, 1.0, 2.0, 0.3)[:3, :3]
    view = sky_of_view(weather, rotation, camera.intrinsics, (160, 120))
    assert view is sky_of_view(weather, rotation.copy(), camera.intrinsics, (160, 120))
    v, u = np.mgrid[0.5:120, 0.5:160]
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    ray = ray @ rotation.T / np.linalg.norm(ray, axis=-1, keepdims=True)
    up = ray[..., 2] > 0.01
    place = (ray[..., :2] / (1.0 + ray[..., 2:]) * 0.5 + 0.5) * len(sharp) - 0.5
    plain = cv2.remap(sharp, *np.moveaxis(place.astype(np.float32), -1, 0), cv2.INTER_LINEAR)
    assert up.mean() > 0.6
    assert np.abs(view - plain)[up].mean() < 0.02 * plain[up].mean()


@pytest.mark.parametrize("preset", PRESETS)
def test_shading_is_that_of_plain_python(preset):
    paint, wall = box_mesh(4.3, 1.8, 1.4), box_mesh(3.0, 0.3, 6.0, Material.STONE)
    bush, pane = box_mesh(1.5, 1.0, 1.2, Material.FOLIAGE), box_mesh(1.5, 0.1, 1.1, Material.GLASS)
    placed = [(0, 5.0, 1.0, 0.0, 0.4), (0, 11.0, -3.0, 0.0, 1.2), (1, 14.0, 3.0, 0.0, 1.5)]
    placed += [(2, 5.0, -1.6, 0.0, 0.3), (3, 2.6, -0.4, 0.6, 1.7)]
    scene = toy_scene([paint, wall, bush, pane], placed, [1, 2, 0, 0, 3])
    camera, pose = PinholeCamera.from_field_of_view(64, 48), camera_pose(-1.0, 0.2, 1.5, 0.1, -0.1, 0.02)
    weather = Weather.draw(preset, 4)
    maps = light_maps(scene.pool, scene.instances, weather, 8.0, 0.0)
    ground = ground_texture(scene.ground)
    seen = (*camera.visibility(scene, pose), pose, camera.intrinsics, weather, ground, maps)
    shown = set(seen[0].material[np.unique(seen[1].triangle[seen[1].triangle >= 0])])
    assert shown == {Material.PAINT, Material.FOLIAGE, Material.STONE}
    assert (seen[1].pane >= 0).mean() > 0.01
    ours, plain = shade(*seen), plain_radiance(*seen)
    off = np.abs(ours - plain) / (plain + 0.1 * plain.mean())
    assert off.mean() < 0.001
    assert np.quantile(off, 0.99) < 0.02


def test_noise_follows_the_seed_geometry_does_not_and_truth_travels(scene):
    one, other = CAMERA.render(scene, POSE, seed=1), CAMERA.render(scene, POSE, seed=2)
    difference = one.image.astype(int) - other.image.astype(int)
    assert 0.3 < difference.std() < 8.0
    assert abs(difference.mean()) < 0.2
    for frame in (other, pickle.loads(pickle.dumps(one))):
        for name in ("depth", "ids", "glass_depth"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(one, name))


def test_same_bytes_on_any_number_of_threads(scene):
    weather, before = Weather.draw("rain", 1), numba.get_num_threads()
    try:
        frames = []
        for threads in sorted({1, before}):
            numba.set_num_threads(threads)
            frames.append(CAMERA.render(scene, POSE, weather, 3))
    finally:
        numba.set_num_threads(before)
    for name in ("image", "ids", "depth", "glass_depth"):
        np.testing.assert_array_equal(*(getattr(frame, name) for frame in (frames[0], frames[-1])))


def test_depth_is_of_what_is_opaque_and_ids_of_what_is_first(row):
    frame = CAMERA.render(row, camera_pose(0.0, 0.0, 1.4, -math.pi / 2))
    through = np.isfinite(frame.glass_depth)
    assert through.any()
    # The pane's near side is 5.2 m away; behind it are the ground and the sky, no car.
    assert frame.glass_depth[through].min() == pytest.approx(5.2, abs=1e-3)
    assert (frame.depth[through] > frame.glass_depth[through]).all()
    assert (frame.ids[through] > 0).all()
    assert np.isinf(frame.depth[:60]).all()
    assert (frame.ids[:60] == 0).all()
    body = (frame.ids == 3) & ~through
    assert np.median(frame.depth[body]) == pytest.approx(5.1, abs=0.05)


def test_shadows_lie_away_from_the_sun():
    scene = toy_scene([box_mesh(4.0, 2.0, 1.5)], [(0, 0.0, 0.0, 0.0, 0.0)], [1])
    weather = Weather(sun_azimuth=0.0, sun_elevation=math.radians(45.0))
    maps = light_maps(scene.pool, scene.instances, weather, 0.0, 0.0)
    # Sun from +x at 45°: the box (±2 m, 1.5 m high) throws its shadow to x = -3.5 m.
    for x, z, lit in ((-3.3, 0.0, 0.0), (-3.7, 0.0, 1.0), (2.3, 0.0, 1.0), (0.0, 1.6, 1.0)):
        assert sunlit(maps, x, 0.0, z, 0.05) == lit
    assert open_sky(maps, 0.0, 0.0) < 0.1
    assert open_sky(maps, 5.0, 0.0) > 0.99


@pytest.mark.parametrize("preset", ["low_sun", "rain"])
def test_shadows_changed_in_place_are_those_drawn_anew(preset):
    lot = SlotLot([[2.5 * i, 6.0 * j] for i in range(12) for j in range(2)], 0.5 * math.pi, 5.0, 2.5)
    weather, rng = Weather.draw(preset, 4), np.random.default_rng(0)
    scene = lot.scene(rng.random(24) < 0.6)
    first = light_maps(scene.pool, scene.instances, weather, 0.0, 0.0)
    shown = first.shadow.copy(), first.contact.copy()
    for slot in rng.integers(0, 24, 5).tolist():
        there = slot in scene.present
        scene = scene.without_vehicle(slot) if there else lot.filled(scene, slot, int(rng.integers(9)))
        changed = light_maps(scene.pool, scene.instances, weather, 0.0, 0.0)
        anew = light_maps(copy(scene.pool), scene.instances, weather, 0.0, 0.0)
        np.testing.assert_array_equal(changed.shadow, anew.shadow)
        np.testing.assert_array_equal(changed.contact, anew.contact)
    assert not np.array_equal(shown[1], changed.contact)
    # Scenes of before keep their maps.
    np.testing.assert_array_equal(shown[0], first.shadow)
    np.testing.assert_array_equal(shown[1], first.contact)


def test_boxes_of_vehicles(row):
    pose, camera = camera_pose(0.0, 0.0, 1.4, -math.pi / 2), PinholeCamera()
    boxes = vehicle_boxes(camera, row, pose, camera.render(row, pose))
    # Body and pane are two instances of one vehicle here.
    middle = boxes.ids == 3
    assert middle.any()
    left, top, right, bottom = boxes.visible_box[middle][0]
    assert (right - left) == pytest.approx(4.3 * 520.0 / 5.1, abs=1.5)
    assert left == pytest.approx(320.0 - 2.15 * 520.0 / 5.1, abs=1.5)
    assert bottom == pytest.approx(240.0 + 1.2 * 520.0 / 5.1, abs=1.5)
    assert top < 240.0
    assert (boxes.view[middle] == View.SIDE).all()
    np.testing.assert_allclose(boxes.distance[middle], 6.0)
    assert boxes.distance[0] == boxes.distance.min()


def test_hidden_vehicles_have_small_visible_fractions():
    body = box_mesh(4.0, 1.8, 1.5)
    placed = [(0, 6.0, 0.0, 0.0, math.pi / 2), (0, 12.0, 0.0, 0.0, math.pi / 2), (0, 12.0, 6.0, 0.0, 0.5)]
    scene = toy_scene([body], placed, [4, 9, 2])
    camera, pose = PinholeCamera(), camera_pose(0.0, 0.0, 1.2, 0.0)
    boxes = vehicle_boxes(camera, scene, pose, camera.render(scene, pose))
    assert boxes.ids.tolist() == [4, 9, 2]
    whole, hidden, partly = boxes.visible_fraction
    assert hidden < 0.1 < 0.8 < partly <= whole == 1.0
    assert boxes.view.tolist() == [View.SIDE, View.SIDE, View.END]


def test_stereo_measures_bodies_and_misses_windows():
    # T §3.3: through the windows a stereo camera sees what is behind, and the car seems farther than it is.
    scene, stereo = parked_cars(), StereoCamera(PinholeCamera.from_field_of_view())
    off = [], [], []
    for i in range(3):
        pose = camera_pose(-20.0 + 9.0 * i, 0.3, 1.35, -math.pi / 2, -0.04)
        pair = stereo.render_stereo(scene, pose, Weather.draw("sunny", i), i)
        shifts = disparity(pair, stereo)
        depth = stereo.camera.fx * stereo.baseline / shifts
        truth, pane = pair.left.depth, pair.left.glass_depth
        matched = (shifts > 0) & (pair.left.ids > 0)
        body = matched & np.isinf(pane)
        off[0].append(np.abs(depth - truth)[body & (truth > 5.0) & (truth < 7.0)])
        off[1].append(np.abs(depth - truth)[body & (truth > 7.0) & (truth < 10.0)])
        off[2].append((depth - pane)[matched & (pane > 5.0) & (pane < 7.0)])
    near, far, windows = (np.median(np.concatenate(part)) for part in off)
    assert near < 0.2
    assert far < 0.4 < windows


def test_camera_frame_is_right_down_forward_and_a_right_camera_stands_to_the_right():
    right = StereoCamera(baseline=0.12).right_pose(camera_pose(1.0, 2.0, 1.5, math.pi / 2))
    np.testing.assert_allclose(right[:3, 3], [1.12, 2.0, 1.5], atol=1e-12)
    pose = camera_pose(0.0, 0.0, 1.0, 0.0)
    np.testing.assert_allclose(pose[:3, :3].T, [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-12)
    assert camera_pose(0.0, 0.0, 1.0, 0.0, pitch=0.2)[2, 2] > 0.0
    # Head to the right shoulder: the camera's right axis points down.
    assert camera_pose(0.0, 0.0, 1.0, 0.0, roll=0.2)[2, 0] < 0.0


def test_exposure_holds_its_limits_and_noise_has_the_stated_deviation():
    sensor = ImageSensor(least_gain=0.5, greatest_gain=2.0)
    dark, bright, flat = (np.full((64, 64, 3), light, dtype=np.float32) for light in (1e-4, 50.0, 0.19))
    assert [sensor.gain(light) for light in (dark, bright, flat)] == [2.0, 0.5, pytest.approx(1.0)]
    quiet = ImageSensor(shot_noise=0.0, read_noise=0.0, vignetting=0.0)
    # 0.19 linear is 0.473 under the sRGB curve.
    assert np.unique(quiet.expose(flat, 0, 1.0)).tolist() == [121]
    sensor = ImageSensor(vignetting=0.0, blur=0.0)
    image = sensor.expose(np.full((200, 200, 3), 0.19, dtype=np.float32), 5, 1.0).astype(float)
    slope = 255.0 * 1.055 / 2.4 * 0.19 ** (1.0 / 2.4 - 1.0)
    expected = math.hypot(slope * math.sqrt(0.01**2 * 0.19 + 0.0008**2), math.sqrt(1.0 / 12.0))
    assert image.std() == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda _: PinholeCamera.from_field_of_view(horizontal=4.0), "field of view is 4"),
        (lambda _: Weather.draw("snow", 0), "want one of sunny"),
        (lambda _: camera_pose(math.nan, 0.0, 1.0, 0.0), "want finite"),
        (lambda row: CAMERA.render(row, POSE[:3]), r"shape \(3, 4\)"),
        (lambda row: CAMERA.render(row, 2.0 * POSE), "want a rotation"),
        (lambda row: CAMERA.render(row, camera_pose(0.0, 0.0, -0.1, 0.0)), "above the ground"),
        (lambda row: CAMERA.render(row, camera_pose(0.3, -6.1, 0.8, 0.0)), "inside vehicle 3"),
    ],
)
def test_bad_input_is_refused(row, make, message):
    with pytest.raises(SensorError, match=message):
        make(row)


def plain_camera(width=160, height=120, horizontal=1.1):
    return PinholeCamera.from_field_of_view(width, height, horizontal)


def depth_of(scene, camera, pose):
    _, seen = camera.visibility(scene, pose)
    with np.errstate(divide="ignore"):
        return 1.0 / seen.inverse_depth


@pytest.mark.parametrize("seed", range(2))
def test_depth_agrees_with_a_ray_caster(seed):
    scene, camera = random_boxes(seed), plain_camera()
    generator = np.random.default_rng(seed)
    pose = camera_pose(0.0, 0.0, 1.4, *generator.uniform((-3.0, -0.3, -0.4), (3.0, 0.2, 0.4)))
    ours, theirs = depth_of(scene, camera, pose), ray_depth(scene, camera, pose)
    assert np.array_equal(np.isinf(ours), np.isinf(theirs))
    seen = np.isfinite(theirs)
    error = np.abs(ours[seen] - theirs[seen])
    assert np.median(error) < 1e-3
    assert np.mean(error > 0.01) < 0.002


def test_a_wall_beside_and_behind_the_camera_is_clipped_not_dropped():
    # One 40 m quad of two triangles passes 0.3 m to the right of the camera, from far behind to far ahead.
    scene = toy_scene([box_mesh(40.0, 0.2, 3.0, Material.STONE)], [(0, 0.0, -0.4, 0.0, 0.0)], [0])
    camera, pose = plain_camera(), camera_pose(0.0, 0.0, 1.2, 0.0)
    ours, theirs = depth_of(scene, camera, pose), ray_depth(scene, camera, pose)
    # At the right edge the wall is 0.3 m / tan(half the field of view) away.
    assert ours[60, -1] == pytest.approx(0.3 / ((159.5 - camera.cx) / camera.fx), rel=1e-4)
    same = np.isfinite(theirs)
    assert np.abs(ours[same] - theirs[same]).max() < 1e-2


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3.0, 3.0))
@settings(max_examples=25)
def test_no_gap_where_triangles_meet(x, z, roll):
    # A finely split wall fills the view: every pixel must be on it.
    wall = box_mesh(0.5, 90.0, 60.0, Material.STONE, splits=23)
    scene = toy_scene([wall], [(0, 8.0, 0.0, -20.0, 0.0)], [0])
    camera = plain_camera(horizontal=0.9)
    _, seen = camera.visibility(scene, camera_pose(x, 0.0, 8.0 + z, 0.0, 0.0, roll))
    assert (seen.triangle >= 0).all()


def test_glass_is_found_apart_from_what_is_behind():
    pane = box_mesh(0.01, 2.0, 2.0, Material.GLASS)
    wall = box_mesh(0.5, 9.0, 9.0, Material.STONE)
    scene = toy_scene([pane, wall], [(0, 3.0, 0.0, 0.2, 0.0), (1, 6.25, 0.0, 0.0, 0.0)], [1, 0])
    _, seen = plain_camera().visibility(scene, camera_pose(0.0, 0.0, 1.2, 0.0))
    assert 1.0 / seen.inverse_depth[60, 80] == pytest.approx(6.0, abs=1e-4)
    assert 1.0 / seen.pane_inverse_depth[60, 80] == pytest.approx(2.995, abs=1e-4)
    assert (seen.n_panes[60, 80], seen.pane[60, 0]) == (2, -1)


def test_skipping_what_is_hidden_changes_nothing():
    scene, camera = parked_cars(), PinholeCamera.from_field_of_view()
    for yaw in (-math.pi / 2, 0.3):
        pose = camera_pose(-6.0, 0.3, 1.35, yaw, -0.04)
        triangles, seen = camera.visibility(scene, pose)
        never_hidden = triangles._replace(nearest=np.full_like(triangles.nearest, np.inf))
        down = -pose[2, :3] / pose[2, 3] / (camera.fx, camera.fy, 1.0)
        floor = np.array([down[0], down[1], down[2] - down[0] * camera.cx - down[1] * camera.cy])
        all_drawn = rasterize(never_hidden, (camera.width, camera.height), floor)
        for one, other in zip(seen, all_drawn, strict=True):
            assert np.array_equal(one, other)


def test_far_instances_are_drawn_coarse():
    fine, coarse = box_mesh(4.0, 2.0, 1.5, splits=8), box_mesh(4.0, 2.0, 1.5)
    placed = [(0, 6.0, 0.0, 0.0, 0.0), (0, 40.0, 3.0, 0.0, 0.0)]
    scene = toy_scene([fine, coarse], placed, [1, 2], coarse=[1, 1])
    camera, pose = plain_camera(640, 480), camera_pose(0.0, 0.0, 1.4, 0.0)
    near_fine, all_fine = (
        project(scene.pool, scene.instances, pose, camera.intrinsics, (640, 480), beyond)
        for beyond in (20.0, math.inf)
    )
    assert (near_fine.instance == 1).sum() < (all_fine.instance == 1).sum()
    assert (near_fine.instance == 0).sum() == (all_fine.instance == 0).sum()
