"""Recordings that nobody here made: bags that describe themselves, KITTI's folders, plain folders, and their faults."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import refused
from scipy.spatial.transform import Rotation

from parkenv import InputError
from parkenv.files.recordings import IMAGE, POSES, SCAN
from parkenv.lots.local_frame import LocalFrame
from parkenv.mapping.recordings.calibration import DriveCalibration
from parkenv.mapping.recordings.folders import source_of
from parkenv.mapping.recordings.laser_scans import Scan, mirrored, without_motion
from parkenv.mapping.recordings.lenses import Picture, Placed, aligned_pair
from parkenv.mapping.recordings.photo_options import PhotoOptions
from parkenv.mapping.recordings.point_clouds import SCANNER, fit_road, points_of, scan_of_cloud
from parkenv.mapping.recordings.recorded_drive import RecordedDrive
from parkenv.mapping.recordings.setup import set_up
from sim_sensors.camera.models import PinholeCamera
from sim_sensors.rig import Mount

pytest.importorskip("rosbags.rosbag2", reason="the extra bags is not installed")
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

START = 1_704_186_000 * 10**9  # Tuesday 9:00, ns
STORE = get_typestore(Stores.ROS2_HUMBLE)
T = {name.rpartition("/")[2]: kind for name, kind in STORE.types.items()}
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
WIDTH, HEIGHT, F = 96, 32, 50.0


def scene(roll=0.0, pitch=0.0, height=1.7):
    """A cloud in the frame of a sensor on a tilted vehicle: the road, a wall 6 m ahead and 1.5 m high, and a bridge."""
    grid = np.stack(np.meshgrid(np.arange(-16, 16, 0.2), np.arange(-6, 6, 0.2)), axis=-1).reshape(-1, 2)
    road = np.column_stack([grid, np.full(len(grid), -height)])
    across, up = np.meshgrid(np.arange(-2.0, 2.0, 0.02), np.arange(0.0, 1.501, 0.05))
    wall = np.column_stack([np.full(across.size, 6.0), across.ravel(), up.ravel() - height])
    bridge = wall + np.array([0.0, 0.0, 5.0])
    points = np.vstack([road[road[:, 0] < 6.0], wall, bridge])
    # Pitched upwards, the vehicle sees what is ahead lower.
    return (points @ Rotation.from_euler("ZYX", [0.0, -pitch, roll]).as_matrix()).astype(np.float32)


def cloud(points, stamp=START, frame="lidar", kind="f4", order="<", offset=0, width=None):
    size = offset + 3 * int(kind[1]) + 4
    dtype = np.dtype({"names": ["x", "y", "z"], "formats": [f"{order}{kind}"] * 3, "itemsize": size,
                      "offsets": [offset + k * int(kind[1]) for k in range(3)]})  # fmt: skip
    rows = np.zeros(len(points), dtype)
    for name, values in zip("xyz", points.T, strict=True):
        rows[name] = values
    fields = [T["PointField"](n, dtype.fields[n][1], {"f4": 7, "f8": 8}[kind], 1) for n in "xyz"]
    width = width or len(points)
    data = rows.view(np.uint8).copy()
    layout = (len(points) // width, width, fields, order == ">", size, width * size)
    return T["PointCloud2"](header(stamp, frame), *layout, data, True)


def header(stamp, frame):
    return T["Header"](T["Time"](*divmod(stamp, 10**9)), frame)


@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize("order", "<>")
def test_clouds_of_any_layout_are_the_same_points(kind, order):
    points = np.arange(36, dtype=np.float32).reshape(12, 3)
    points[3, 1] = np.nan
    wanted = np.delete(points, 3, axis=0)
    for offset, width in ((0, None), (5, 4)):
        found = points_of(cloud(points, kind=kind, order=order, offset=offset, width=width))
        np.testing.assert_array_equal(found, wanted)
    bad = cloud(points)
    bad.fields[2].name = "w"
    with pytest.raises(InputError, match="a cloud has the fields x, y, w, want x, y and z"):
        points_of(bad)
    bad.fields[2].name, bad.height = "z", 9
    with pytest.raises(InputError, match="a cloud has 192 bytes for 12×9 points of 16 bytes"):
        points_of(bad)


@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (2.0, 0.0), (-1.0, 1.5)])
def test_a_cloud_is_a_scan_of_what_stands_on_the_road(roll, pitch):
    points = scene(math.radians(roll), math.radians(pitch))
    road = fit_road(points)
    assert -road.c == pytest.approx(1.7, abs=0.02)
    found = scan_of_cloud(points, road)
    assert np.degrees(found.tilt) == pytest.approx([roll, pitch], abs=0.1)
    hit = np.isfinite(found.ranges)
    np.testing.assert_allclose(found.ranges[hit], 6.0 / np.cos(SCANNER.angles[hit]), atol=0.06)
    assert 90 <= hit.sum() <= 94
    np.testing.assert_allclose(found.tops[hit], 1.5, atol=0.05)
    assert np.isnan(found.tops[~hit]).all()
    with pytest.raises(InputError, match=r"the road 1\.7 m above its sensor; want .* `mount.roll = 180"):
        fit_road(points * np.float32([1, -1, -1]))
    assert fit_road(points[:20]) is None


def write(path, messages):
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for topic, stamp, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=STORE)
            writer.write(connections[topic], stamp, STORE.serialize_cdr(message, message.__msgtype__))
    return path


def quaternion(rotation):
    return T["Quaternion"](*rotation.as_quat())


def transform(parent, child, xyz, rotation, stamp=START):
    at = T["Transform"](T["Vector3"](*map(float, xyz)), quaternion(rotation))
    return T["TransformStamped"](header(stamp, parent), child, at)


def info(frame, shift=0.0):
    k, p = np.array([F, 0, 48, 0, F, 16, 0, 0, 1]), np.array([F, 0, 48, shift, 0, F, 16, 0, 0, 0, 1, 0])
    region = T["RegionOfInterest"](0, 0, 0, 0, False)
    return T["CameraInfo"](
        header(START, frame), HEIGHT, WIDTH, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, region
    )


def drive(skip=(), poses="fix", right_late=0, sides=("left",), lidar_roll=0.0, late=0):
    """The messages of a car that drives east at 5 m/s: its frames say where its sensors are."""
    turned = Rotation.from_euler("x", lidar_roll, degrees=True)
    links = [("imu", (0.0, 0.0, 0.4), Rotation.identity()), ("lidar", (1.0, 0.1, 1.3), turned)]
    camera = Rotation.from_matrix(OPTICAL)
    links += [(f"{side}_optical", (1.5, y, 1.2), camera) for side, y in (("left", 0.2), ("right", -0.3))]
    yield "/tf_static", START, T["TFMessage"]([transform("base_link", *link) for link in links])
    frame, none = LocalFrame(8.0, 48.0), T["Vector3"](0.0, 0.0, 0.0)
    for k in range(11):
        stamp = START + k * 10**8
        x, yaw = 0.5 * k, Rotation.from_euler("ZYX", [0.0, 0.02 * (k == 5), 0.0])
        (lon, lat), late_ns = frame.to_lonlat([[x, 0.0]])[0], stamp + late * 10**9
        head, still = header(stamp, "imu"), np.zeros(9)
        points = scene() * np.float32([1, *[math.cos(math.radians(lidar_roll))] * 2])
        messages = {
            "/fix": T["NavSatFix"](head, T["NavSatStatus"](0, 1), lat, lon, 0.0, np.full(9, 0.04), 2),
            "/imu": T["Imu"](head, quaternion(yaw), still, none, still, none, still),
            "/lidar": cloud(points, late_ns + 2 * 10**7),
        }
        if poses == "tf":
            del messages["/fix"], messages["/imu"]
            messages["/tf"] = T["TFMessage"](
                [transform("map", "odom", (100.0, 0.0, 0.0), Rotation.identity(), stamp),
                 transform("odom", "base_link", (x, 0.0, 0.0), yaw, stamp)]
            )  # fmt: skip
        for i, side in enumerate(sides):
            at = late_ns + (right_late if side == "right" else 0)
            grey, optical = np.full(HEIGHT * WIDTH, k, np.uint8), f"{side}_optical"
            picture = T["Image"](header(at, optical), HEIGHT, WIDTH, "mono8", 0, WIDTH, grey)
            messages[f"/{side}/image_raw"] = picture
            messages[f"/{side}/camera_info"] = info(optical, -F * 0.5 * i)
        yield from ((topic, stamp, message) for topic, message in messages.items() if topic not in skip)


def test_a_bag_that_says_all_itself_needs_no_calibration(tmp_path):
    recorded = RecordedDrive(write(tmp_path / "bag", drive()))
    ((name, camera, mount),), ((_, scanner, laser),) = recorded.rig.cameras, recorded.rig.lasers
    assert (name, camera.width, camera.fx, scanner) == ("camera", WIDTH, F, SCANNER)
    # The cloud says that its sensor is 1.7 m above the road, so base_link, which it is 1.3 m above, is 0.4 m above it.
    assert (mount.x, mount.y, mount.z) == pytest.approx((1.5, 0.2, 1.6), abs=0.02)
    assert (mount.yaw, mount.pitch) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert (laser.x, laser.y, laser.z) == pytest.approx((1.0, 0.1, 0.55))
    captures = list(recorded.captures())
    wanted = [[0.5 * k, 0.0, 0.0] for k in range(11)]
    np.testing.assert_allclose([pose for _, pose in captures], wanted, atol=1e-4)
    assert recorded.without_pose == 0
    assert recorded.errors.position > 0.2
    for k, (taken, _) in enumerate(captures[:-1]):
        assert (taken.capture.images["camera"].image == k).all()
        np.testing.assert_allclose(taken.capture.moved["laser"], [0.1, 0.0, 0.0], atol=1e-4)
        assert np.nanmax(taken.capture.tops["laser"]) == pytest.approx(1.5, abs=0.05)
    # By the cloud the road is level, 0.02 s after the vehicle nodded by 0.02 rad.
    pitch = [taken.capture.tilt[1] for taken, _ in captures[:-1]]
    assert pitch[5] == pytest.approx(-0.02 * 0.2, abs=2e-3)
    np.testing.assert_allclose(np.delete(pitch, [4, 5]), 0.0, atol=2e-3)


def test_transforms_pairs_and_hanging_sensors(tmp_path):
    both = write(tmp_path / "tf", drive(poses="tf", skip=("/lidar",), sides=("left", "right")))
    recorded = RecordedDrive(both)
    np.testing.assert_allclose(recorded.poses[:, 0], 100.0 + 0.5 * np.arange(11))
    ((_, pair, mount),) = recorded.rig.stereo_cameras
    assert (pair.baseline, pair.camera.fx, mount.z) == (pytest.approx(0.5), F, pytest.approx(1.2))
    pitch = [taken.capture.tilt[1] for taken, _ in recorded.captures()]
    assert min(pitch) == pitch[5] == pytest.approx(-0.02 * 10 / 11)
    (taken, _), *_ = RecordedDrive(write(tmp_path / "hanging", drive(lidar_roll=180.0))).captures()
    ahead = np.argmin(np.abs(SCANNER.angles))
    assert taken.capture.scans["laser"][ahead] == pytest.approx(6.0, abs=0.05)
    scan = mirrored(Scan(-1.0, 0.5, 30.0, np.float32([1, 2, 3, 4]), 0.1))
    assert (scan.start, scan.ranges.tolist(), scan.delay) == (-0.5, [4, 3, 2, 1], -0.1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"skip": ("/fix", "/imu")}, "has no poses, want Pose2D, .*NavSatFix or /tf; it has /left/c"),
        ({"skip": ("/left/camera_info",)}, "has no CameraInfo; describe its sensors: --calibration"),
        ({"sides": ("front", "rear")}, r"2 cameras, /front/image_raw \(sensor.*Image\), /rear.*; .*`topic`"),
        ({"late": 100}, "ends at .* before .* begins at .*: do their clocks agree"),
        ({"sides": ("left", "right"), "right_late": 2 * 10**7, "skip": ("/lidar",)}, r"moment .*: 0\.0200 s"),
    ],
)
def test_what_a_bag_lacks_is_said_in_a_line(tmp_path, options, message):
    path = write(tmp_path / "bag", drive(**options))
    with pytest.raises(InputError, match=message) as caught:
        list(RecordedDrive(path).captures())
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_foreign_recording_wants_a_lot_that_it_is_near(tmp_path):
    bag, fix = write(tmp_path / "bag", drive(poses="tf")), write(tmp_path / "fix", drive())
    (tmp_path / "car.toml").write_text("origin = { x = 9000.0 }")
    for words, said in (
        ((bag,), "was not made by parkenv survey; want --lot FILE with its slots, or --discover"),
        ((fix, "--scenario", "mini"), "are in degrees, and the lot in metres; want --origin LAT,LON"),
        (
            (bag, "--scenario", "mini", "--calibration", tmp_path / "car.toml"),
            "m away from the lot; want them in its frame: `origin`",
        ),
    ):
        assert said in refused("map-drive", *words, "--out", tmp_path / "out")


def test_a_pair_with_its_own_lenses_is_aligned_by_rows():
    lens = PinholeCamera(320, 240, 300.0, 300.0, 160.0, 120.0)
    left = Picture((320, 240), lens.matrix, lens, (-0.2, 0.05, 0.0, 0.0))
    right = Picture((320, 240), lens.matrix + np.diag([4.0, 4.0, 0.0]), lens, (-0.1, 0.0, 0.001, 0.0))
    turn, move = Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix(), np.array([-0.4, 0.01, 0.0])
    one, other, baseline = aligned_pair(left, right, turn, move)
    assert baseline == pytest.approx(np.linalg.norm(move))
    for point in ([0.3, 0.2, 5.0], [-0.6, -0.4, 4.0]):
        places = []
        for raw, new, r, t in ((left, one, np.eye(3), np.zeros(3)), (right, other, turn, move)):
            (at,), _ = cv2.projectPoints(np.array([point]), r, t, raw.matrix, np.array(raw.distortion))
            image = np.zeros((240, 320, 3), np.uint8)
            middle = tuple(int(v) for v in np.rint(at[0] * 16))
            cv2.circle(image, middle, 3 * 16, (255, 255, 255), -1, cv2.LINE_AA, 4)
            rows, columns = np.nonzero(new.rectified(image)[..., 0] > 100)
            places.append((columns.mean(), rows.mean()))
        (x, y), (x2, y2) = places
        assert y == pytest.approx(y2, abs=0.4)
        assert one.camera.fx * baseline / (x - x2) == pytest.approx(5.0 if point[2] == 5.0 else 4.0, rel=0.05)


def test_pictures_of_a_rolled_camera_are_turned_level():
    camera = PinholeCamera(200, 200, 200.0, 200.0, 100.0, 100.0)
    image, roll = np.zeros((200, 200, 3), np.uint8), math.radians(8.0)
    # The horizon of a camera whose right side is lower falls to the left.
    ends = [(round(100 + s * 80 * math.cos(roll)), round(100 - s * 80 * math.sin(roll))) for s in (-1, 1)]
    cv2.line(image, *ends, (255, 255, 255), 3)
    picture = Picture((200, 200), camera.matrix, camera)
    rows, columns = np.nonzero(picture.levelled(roll).rectified(image)[..., 0] > 100)
    assert np.polyfit(columns, rows, 1)[0] == pytest.approx(0.0, abs=0.005)
    assert picture.levelled(0.0).rectified(image) is image
    placed = Placed(Mount(1.0, 2.0, 1.5, 0.3, 0.1), 0.05)
    back = Placed.of(np.array([1.0, 2.0, 1.5]), placed.axes)
    assert (back.mount.yaw, back.mount.pitch, back.roll) == pytest.approx((0.3, 0.1, 0.05))


def test_a_scan_of_a_driving_car_is_as_from_where_it_began():
    angles = np.radians(np.arange(-45.0, 45.1, 0.5))
    moved = np.zeros((len(angles), 3))
    moved[:, 0] = np.linspace(0.0, 1.0, len(angles))
    ranges = (8.0 - moved[:, 0]) / np.cos(angles)  # a wall 8 m ahead
    scan = Scan(float(angles[0]), math.radians(0.5), 30.0, ranges.astype(np.float32))
    found = without_motion(scan, moved).ranges
    known = np.isfinite(found)
    assert known.mean() > 0.95
    assert np.abs(found - 8.0 / np.cos(angles))[known].max() < 0.06
    assert np.abs(ranges - 8.0 / np.cos(angles)).max() > 1.0


def kitti(folder, rectified=True):
    """A drive of KITTI's raw data: 6 pictures of the grey pair, clouds, and OXTS, 10 a second."""
    day, size = folder / "2011_09_26", (WIDTH, HEIGHT) if rectified else (WIDTH + 20, HEIGHT + 12)
    place = day / "2011_09_26_drive_0001_sync"
    texts = "".join(f"2011-09-26 13:02:{25 + k / 10:012.9f}\n" for k in range(6))
    for name in ("image_00", "image_01", "velodyne_points", "oxts"):
        (place / name / "data").mkdir(parents=True)
        (place / name / "timestamps.txt").write_text(texts)
    ll = LocalFrame(8.4, 49.0).to_lonlat([[0.0, 2.0 * k] for k in range(6)])
    for k in range(6):
        for camera in ("image_00", "image_01"):
            cv2.imwrite(str(place / camera / f"data/{k:010d}.png"), np.full(size[::-1], 40 * k, np.uint8))
        points = scene(height=1.73)
        file = place / f"velodyne_points/data/{k:010d}.bin"
        np.column_stack([points, points[:, :1]]).astype("<f4").tofile(file)
        row = np.zeros(30)
        row[[0, 1, 5, 23]] = ll[k, 1], ll[k, 0], math.pi / 2, 0.05
        (place / f"oxts/data/{k:010d}.txt").write_text(" ".join(f"{v:.10f}" for v in row))

    def lines(**parts):
        return "calib_time: 09-Jan-2012\n" + "".join(
            f"{n}: {' '.join(map(repr, np.ravel(v).tolist()))}\n" for n, v in parts.items()
        )

    cameras = {}
    for k in range(2):
        cameras |= {f"S_0{k}": [WIDTH + 20.0, HEIGHT + 12.0], f"S_rect_0{k}": [float(WIDTH), float(HEIGHT)],
                    f"R_rect_0{k}": np.eye(3),
                    f"K_0{k}": [60.0, 0, 58, 0, 60, 22, 0, 0, 1], f"D_0{k}": [-0.1, 0, 0, 0, 0],
                    f"P_rect_0{k}": [F, 0, 48, -F * 0.54 * k, 0, F, 16, 0, 0, 0, 1, 0]}  # fmt: skip
    (day / "calib_cam_to_cam.txt").write_text(lines(**cameras))
    (day / "calib_velo_to_cam.txt").write_text(lines(R=OPTICAL.T, T=-OPTICAL.T @ [0.27, 0.0, -0.08]))
    (day / "calib_imu_to_velo.txt").write_text(lines(R=np.eye(3), T=[-0.81, 0.32, -0.8]))
    return place


@pytest.mark.parametrize("rectified", [True, False])
def test_a_raw_folder_of_kitti_is_read_as_it_comes(tmp_path, rectified):
    place, options = kitti(tmp_path, rectified), PhotoOptions()
    frame = LocalFrame(8.4, 49.0)
    for path in (place, place.parent):
        recorded = RecordedDrive(path, None, source_of(path, None, options, frame), frame)
        captures = list(recorded.captures())
        wanted = [[0, 2 * k, math.pi / 2] for k in range(6)]
        np.testing.assert_allclose([pose for _, pose in captures], wanted, atol=1e-5)
    ((_, camera, mount),) = recorded.rig.cameras
    assert (camera.width, camera.height, camera.fx, camera.cx) == (WIDTH, HEIGHT, F, 48.0)
    assert (mount.x, mount.y, mount.z) == pytest.approx((1.08, -0.32, 1.65), abs=0.02)
    capture = captures[2][0].capture
    assert capture.images["camera"].image.shape == (HEIGHT, WIDTH, 3)
    assert capture.images["camera"].image[16, 48, 0] == 80
    assert capture.moved == {}
    assert capture.scans["laser"].min() == pytest.approx(6.0, abs=0.05)
    assert recorded.start % 86_400 == 13 * 3600 + 2 * 60 + 25
    (place.parent / "calib_velo_to_cam.txt").unlink()
    with pytest.raises(InputError, match=r"has no calib_velo_to_cam\.txt, want KITTI's calibration of"):
        list(RecordedDrive(place, None, source_of(place, None, options, None)).captures())


def test_an_odometry_folder_of_kitti_is_read_as_it_comes(tmp_path):
    place = tmp_path / "sequences/03"
    (tmp_path / "poses").mkdir()
    (place / "image_0").mkdir(parents=True)
    projection = f"{F} 0 48 0 0 {F} 16 0 0 0 1 0"
    (place / "calib.txt").write_text(f"P0: {projection}\nP1: {projection}\n")
    (place / "times.txt").write_text("0.0\n0.1\n0.2\n")
    with pytest.raises(InputError, match=r"sequences/03: has no poses, want .*poses/03\.txt or .*poses\.txt"):
        RecordedDrive(place, None, source_of(place, None, PhotoOptions(), None))
    (tmp_path / "poses/03.txt").write_text("".join(f"1 0 0 {-0.1 * k} 0 1 0 0 0 0 1 {k}\n" for k in range(3)))
    for k in range(3):
        cv2.imwrite(str(place / f"image_0/{k:06d}.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    recorded = RecordedDrive(place, None, source_of(place, None, PhotoOptions(), None))
    np.testing.assert_allclose(recorded.poses, [[k, 0.1 * k, 0.0] for k in range(3)], atol=1e-12)
    assert recorded.rig.cameras[0][2].z == pytest.approx(1.65)


FOLDER = """
[[cameras]]
name = "front"
topic = "left"
width = 96
height = 32
fx = 50.0
fy = 50.0
cx = 48.0
cy = 16.0
mount = { x = 1.0, z = 1.6 }
[[lasers]]
name = "band"
topic = "points"
mount = { x = 0.8, z = 1.7 }
"""


def test_a_folder_of_a_drive_and_its_calibration_file(tmp_path):
    folder = tmp_path / "drive"
    (folder / "left").mkdir(parents=True)
    (folder / "points").mkdir()
    poses = [f"{k},{START / 1e9 + k / 10:.6f},{2.0 * k},0.0,0.0" for k in range(3, 6)]
    (folder / "poses.csv").write_text("\n".join(["frame,unix_s,x,y,yaw", *poses]))
    for k in range(3, 7):
        cv2.imwrite(str(folder / f"left/{k:04d}.jpg"), np.zeros((HEIGHT, WIDTH), np.uint8))
        np.savez(folder / f"points/{k:04d}.npz", xyz_cm=np.rint(scene() * 100).astype(np.int16))
    ranges = np.full((2, 900), 5000, np.uint16)
    np.savez(folder / "scans.npz", frame=[3, 5], at_laser=ranges, angle_min=-3.1, angle_step=0.0069)
    (tmp_path / "car.toml").write_text(FOLDER)

    def read(text):
        (tmp_path / "car.toml").write_text(text)
        calibration = DriveCalibration.read(tmp_path / "car.toml")
        recorded = RecordedDrive(folder, calibration, source_of(folder, calibration, PhotoOptions(), None))
        return recorded, list(recorded.captures())

    recorded, captures = read(FOLDER)
    assert [pose[0] for _, pose in captures] == [6.0, 8.0, 10.0]
    assert recorded.without_pose == 1
    assert captures[0][0].capture.scans["band"].min() == pytest.approx(6.0, abs=0.05)
    _, captures = read(FOLDER.replace('"points"', '"scans.npz:at_laser"'))
    assert (captures[1][0].capture.scans["band"] == 5.0).all()
    pair = FOLDER.replace("[[cameras]]", "[[stereo_cameras]]\ndistortion = [0.1]\nbaseline = 0.5")
    for text, message in (
        (FOLDER.replace('"points"', '"scans.npz"'), r"scans\.npz: has angle_min, .*, want frame.*:ARRAY"),
        (FOLDER.replace('"points"', '"cloud"'), r"drive: has no folder or file 'cloud'; it has left, points"),
        (
            pair.replace('topic = "left"', 'left = "left"\nright = "left"'),
            r"car\.toml: front: has distortion, want the numbers of its right_camera",
        ),
    ):
        with pytest.raises(InputError, match=message):
            read(text)


def test_the_calibrations_of_the_page_are_read(tmp_path):
    page = (Path(__file__).parents[1] / "docs/calibration.md").read_text(encoding="utf-8")
    examples = [part.split("```")[0] for part in page.split("```toml\n")[1:]]
    for text in examples:
        (tmp_path / "car.toml").write_text(text)
        calibration = DriveCalibration.read(tmp_path / "car.toml")
        for lens in (*calibration.cameras, *calibration.stereo_cameras):
            assert lens.picture(lens.width, lens.height) is not None
    assert len(examples) == 2
    topics = {"/camera/image_raw": IMAGE, "/scan": SCAN, "/odom": POSES[-1]}
    (tmp_path / "car.toml").write_text(examples[0])
    setup = set_up(tmp_path, DriveCalibration.read(tmp_path / "car.toml"), topics, lambda _: iter(()))
    assert setup.rig({"front": SCANNER}).cameras[0][2] == Mount(0.4, 0.0, 1.3, -math.pi / 2)
