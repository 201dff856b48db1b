"""The rig: where sensors sit, what they deliver together, and that they agree with one another."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from parkenv.lots import packaged_lot
from parkenv.world.lot_scene import slot_lot
from sim_sensors.camera.models import PinholeCamera
from sim_sensors.errors import SensorError
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import LEFT, RIGHT, Mount, SensorRig, poses_along

LOT = packaged_lot("mini")
POSE = np.array([*LOT.vertex_xy[2], LOT.vertex_yaw[2]])


@pytest.fixture(scope="module")
def scene():
    return slot_lot(LOT).scene(np.arange(LOT.n_slots) % 3 != 0)


def small(mount):
    return SensorRig(
        cameras=(("camera", PinholeCamera.from_field_of_view(160, 120), mount),),
        lasers=(("laser", LaserScanner(), Mount(z=0.5)),),
    )


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
    stereo = SensorRig.stereo().resized(400)
    assert stereo.stereo_cameras[0][1].camera.height == 300
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
    capture = rig.capture(scene, POSE, noise=False)
    (_, camera, _), (_, laser, _) = rig.cameras[0], rig.lasers[0]
    ranges, ids = laser.scan_with_ids(scene.scan_plane, POSE)
    np.testing.assert_array_equal(ranges, capture.scans["laser"])
    frame = capture.images["camera"]
    bearing = laser.angles - yaw
    column = camera.cx - camera.fx * np.tan(np.clip(bearing, -1.4, 1.4))
    inside = (np.abs(bearing) < 0.5) & (ids > 0)
    pixel = np.floor(column[inside]).astype(int)
    row = int(camera.cy)
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


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SensorRig(), "no sensor"),
        (lambda: SensorRig(lasers=(("a", LaserScanner(), Mount()),) * 2), "'a' is used twice"),
        (lambda: Mount(z=0.0), "z is 0.0"),
        (lambda: poses_along([[0, 0]], 1.0), "path has shape"),
        (lambda: poses_along([[0, 0], [0, 0]], 1.0), "no length"),
        (lambda: poses_along([[0, 0], [1, 0]], 0.0), "every is 0.0"),
    ],
)
def test_wrong_rigs_are_refused(make, message):
    with pytest.raises(SensorError, match=message):
        make()
