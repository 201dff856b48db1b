"""Recorded drives: there and back through MCAP, poses between messages, and recordings that are refused."""

import math
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from command_line import parkenv, ran, summary_of

from parkenv import InputError, make_scenario
from parkenv.files.recordings import footage_in
from parkenv.files.videos import Video
from parkenv.mapping.recordings.calibration import DriveCalibration
from parkenv.mapping.recordings.folders import source_of
from parkenv.mapping.recordings.laser_scans import common_scanner, scan_of
from parkenv.mapping.recordings.photo_options import PhotoOptions
from parkenv.mapping.recordings.poses import pose_of
from parkenv.mapping.recordings.recorded_drive import RecordedDrive
from parkenv.mapping.recordings.writer import Head, recording
from parkenv.mapping.store import MapStore
from sim_sensors.camera.models import Frame
from sim_sensors.rig import Capture, SensorRig, TimedCapture

pytest.importorskip("rosbags.rosbag2", reason="the extra bags is not installed")
from rosbags.rosbag1 import Writer as WriterOfRos1
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

WIDTH, HEIGHT = 64, 48
START = 345_600 * 10**9 + 9 * 3600 * 10**9  # Monday 9:00 of Unix time, ns
TENTH = 10**8
CALIBRATION = """
pose = "/odom"
timezone_h = 1.0
[[cameras]]
name = "right"
topic = "/camera"
width = 64
height = 48
fx = 32.0
fy = 32.0
cx = 32.0
cy = 24.0
mount = { z = 1.3, yaw = -90.0 }
[[lasers]]
name = "front"
topic = "/scan"
mount = { z = 0.5 }
"""


def image(k):
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[:, : 5 * k + 1] = (10 * k, 200, 50)
    return picture


def bag(folder, poses=11, pictures=5, pose_type="nav_msgs/msg/Odometry", shift=(), order=(), raw=True):
    """Write a rosbag of somebody's car: poses every 0.1 s, pictures every 0.2 s, scans 0.02 s after poses."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    t = store.types
    shift, order = dict(shift), dict(order)

    def header(stamp):
        return t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)), "")

    def pose(stamp, k):
        yaw = math.pi - 0.05 + 0.01 * k
        point = t["geometry_msgs/msg/Point"](0.3 * k, 1.0, 0.0)
        turned = t["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        at = t["geometry_msgs/msg/Pose"](point, turned)
        if pose_type.endswith("PoseStamped"):
            return t[pose_type](header(stamp), at)
        none, zeros = t["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0), np.zeros(36)
        twist = t["geometry_msgs/msg/TwistWithCovariance"](t["geometry_msgs/msg/Twist"](none, none), zeros)
        return t[pose_type](header(stamp), "", t["geometry_msgs/msg/PoseWithCovariance"](at, zeros), twist)

    def picture(stamp, k):
        bgr = image(k)[..., ::-1]
        if raw:
            return t["sensor_msgs/msg/Image"](header(stamp), HEIGHT, WIDTH, "bgr8", 0, 3 * WIDTH, bgr.ravel())
        data = cv2.imencode(".png", bgr)[1].ravel()
        return t["sensor_msgs/msg/CompressedImage"](header(stamp), "png", data)

    def scan(stamp, k):
        ranges = np.array([0.0, 2.0 + k, np.nan, 40.0, 5.0], np.float32)
        return t["sensor_msgs/msg/LaserScan"](
            header(stamp), -1.0, 1.0, 0.5, 0.0, 0.0, 0.1, 30.0, ranges, np.zeros(0, np.float32)
        )

    image_type = f"sensor_msgs/msg/{'Image' if raw else 'CompressedImage'}"
    kinds = {
        "/odom": (pose_type, poses, TENTH, 0, pose),
        "/camera": (image_type, pictures, 2 * TENTH, TENTH // 4, picture),
        "/scan": ("sensor_msgs/msg/LaserScan", 11, TENTH, TENTH // 5, scan),
    }
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, (kind, count, every, late, make) in kinds.items():
            if not count:
                continue
            connection = writer.add_connection(topic, kind, typestore=store)
            for i, k in enumerate(order.get(topic, range(count))):
                begin = START + late + int(shift.get(topic, 0) * 1e9)
                message = make(begin + k * every, k)
                writer.write(connection, begin + i * every, store.serialize_cdr(message, kind))
    return next(folder.glob("*.mcap"))


def calibrated(tmp_path, text=CALIBRATION):
    (tmp_path / "car.toml").write_text(text)
    return DriveCalibration.read(tmp_path / "car.toml")


@pytest.mark.parametrize("raw", [True, False])
def test_a_bag_of_somebodys_car_becomes_captures(tmp_path, raw):
    pose_type = "nav_msgs/msg/Odometry" if raw else "geometry_msgs/msg/PoseStamped"
    file = bag(tmp_path / "bag", raw=raw, pose_type=pose_type)
    drive = RecordedDrive(file, calibrated(tmp_path))
    assert drive.start == 10 * 3600.0
    captures = list(drive.captures())
    assert len(captures) == 5
    for k, (captured, pose) in enumerate(captures):
        # Pictures are taken a quarter between two poses; the heading passes π.
        x, yaw = 0.3 * (2 * k + 0.25), math.pi - 0.05 + 0.01 * (2 * k + 0.25)
        assert pose[:2] == pytest.approx([x, 1.0], abs=1e-6)
        assert math.remainder(pose[2] - yaw, 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
        assert captured.time == pytest.approx(36_000.025 + 0.2 * k)
        np.testing.assert_array_equal(captured.capture.images["right"].image, image(k))
        wanted = np.array([np.inf, 2.0 + 2 * k, np.inf, np.inf, 5.0], np.float32)
        np.testing.assert_array_equal(captured.capture.scans["front"], wanted)
    assert len(list(drive.captures(every=1.0))) == 3
    again = RecordedDrive(tmp_path / "bag", calibrated(tmp_path))  # the folder of the bag
    np.testing.assert_array_equal(again.poses, drive.poses)
    moved = calibrated(tmp_path, f"origin = {{ x = 5.0, yaw = 90.0 }}\n{CALIBRATION}")
    wanted = [4.0, 1.2, drive.poses[4, 2] + math.pi / 2]
    np.testing.assert_allclose(RecordedDrive(file, moved).poses[4], wanted, atol=1e-9)


def test_rosbags_of_ros_1_and_ros_2_hold_the_same_drive(tmp_path):
    ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
    file, sqlite = bag(tmp_path / "bag"), tmp_path / "sqlite"
    with (
        Reader(file) as reader,
        Writer(sqlite, version=9, storage_plugin=StoragePlugin.SQLITE3) as new,
        WriterOfRos1(tmp_path / "one.bag") as old,
    ):
        for topic in reader.connections:
            in_new = new.add_connection(topic.topic, topic.msgtype, typestore=ros2)
            in_old = old.add_connection(topic.topic, topic.msgtype, typestore=ros1)
            for _, stamp, data in reader.messages(connections=[topic]):
                new.write(in_new, stamp, data)
                message = ros2.deserialize_cdr(data, topic.msgtype)
                message.header = ros1.types["std_msgs/msg/Header"](0, message.header.stamp, "")
                old.write(in_old, stamp, ros1.serialize_ros1(message, topic.msgtype))
    calibration = calibrated(tmp_path)
    wanted = list(RecordedDrive(file, calibration).captures())
    for path in (sqlite, sqlite / "sqlite.db3", tmp_path / "one.bag"):
        found = list(RecordedDrive(path, calibration).captures())
        assert len(found) == len(wanted) == 5
        for sides in zip(wanted, found, strict=True):
            one, other = (
                (taken.time, pose, taken.capture.images["right"].image, taken.capture.scans["front"])
                for taken, pose in sides
            )
            np.testing.assert_equal(one, other)


def test_cars_are_searched_in_the_pictures_of_a_recording(tmp_path):
    (tmp_path / "drives").mkdir()
    bag(tmp_path / "drives/bag")
    for path in ("drives/bag/bag.mcap", "drives/bag", "drives"):
        done = ran("detect --step 2", tmp_path / path, "--out", tmp_path / "found")
        assert ":/camera: 3 frames of 1.0 s, 0 boxes" in done.stdout
    (film,) = (tmp_path / "found").glob("*_camera_cars.mp4")
    video = Video.of(film)
    assert (video.width, video.height, video.frames, video.fps) == (WIDTH, HEIGHT, 3, pytest.approx(2.5))
    (footage,), others = footage_in(tmp_path / "drives/bag")
    assert others == {}
    frames = list(footage.read())
    assert [frame.time for frame in frames] == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8])
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, image(k))
    blind = bag(tmp_path / "blind", pictures=0)
    with pytest.raises(InputError, match=r"blind.*: has no pictures, want sensor_msgs/msg/Image or .*/scan"):
        footage_in(blind)


@pytest.mark.parametrize(
    ("encoding", "reason"),
    [
        ("16UC1", "encoding is '16UC1', want rgb8"),
        ("bayer_rggb8", "encoding is 'bayer_rggb8', want rgb8"),
        ("h264", "format is 'h264', want a picture of 8 bits"),
        ("16UC1; compressedDepth png", "want a picture of 8 bits"),
        ("bayer_rggb8; png compressed bayer_rggb8", "want a picture of 8 bits"),
        ("bayer_rggb8; png compressed bgr8", None),
    ],
)
def test_topics_that_are_no_pictures_in_colour_are_listed(tmp_path, encoding, reason):
    (tmp_path / "bag").mkdir()
    store = get_typestore(Stores.ROS2_HUMBLE)
    t, raw = store.types, len(encoding) in (5, 11)
    with Writer(tmp_path / "bag/bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        header = t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](1, 0), "")
        data = cv2.imencode(".png", image(0))[1].ravel()
        color = t["sensor_msgs/msg/CompressedImage"](header, "jpeg", data)
        other = color.__class__(header, encoding, data)
        if raw:
            other = t["sensor_msgs/msg/Image"](header, 4, 4, encoding, 0, 8, np.zeros(32, np.uint8))
        for topic, message in (("/depth", other), ("/color", color)):
            connection = writer.add_connection(topic, message.__msgtype__, typestore=store)
            writer.write(connection, 10**9, store.serialize_cdr(message, message.__msgtype__))
        writer.add_connection("/silent", color.__msgtype__, typestore=store)
    done = ran("detect", tmp_path / "bag/bag", "--out", tmp_path / "found")
    left_out = summary_of(tmp_path / "found")["not_searched"]
    topics = {row["file"].split(":")[1]: row["reason"] for row in left_out}
    assert topics.pop("/silent") == "has no messages"
    assert "/color: 1 frame" in done.stdout
    assert list(topics) == (["/depth"] if reason else [])
    assert reason is None or reason in topics["/depth"]


def laser_scan(start, step, ranges, low=0.0, high=30.0):
    end = start + step * (len(ranges) - 1)
    return SimpleNamespace(
        angle_min=start, angle_max=end, angle_increment=step, range_min=low, range_max=high, ranges=ranges
    )


def test_each_scan_is_read_with_its_own_angles():
    def measured(start, step, n):
        angle = start + step * np.arange(n)
        return laser_scan(
            start, step, np.round(20.0 + np.degrees(angle) / 20.0, 4)
        )  # the range says the angle

    rad = math.radians
    messages = [
        measured(rad(-90), rad(1), 181),
        measured(rad(-80), rad(1), 171),  # begins later
        measured(rad(90), rad(-1), 181),  # clockwise
        measured(rad(-100), rad(1), 201),  # wider
        measured(rad(-90), rad(1), 180),  # a beam less
    ]
    scans = [scan_of(message) for message in messages]
    scanner, ranges = common_scanner(scans)
    assert scanner.n_beams == 201
    assert (scanner.start, scanner.step) == pytest.approx((rad(-100), rad(1)))
    for scan, _message, row in zip(scans, messages, ranges, strict=True):
        hit = np.isfinite(row)
        assert hit.sum() >= len(scan.ranges)
        off = np.abs(row - (20.0 + np.degrees(scanner.angles) / 20.0))[hit]
        assert off.max() <= 0.025 + 1e-3  # half a beam of the finest scan
    with pytest.raises(InputError, match=r"beams 0\.0174533 and 0\.0349066 rad apart, want one"):
        common_scanner([*scans, scan_of(measured(rad(-90), rad(2), 91))])
    alone, (same,) = common_scanner(scans[:1])
    assert alone.n_beams == 181
    np.testing.assert_array_equal(same, scans[0].ranges)


@pytest.mark.parametrize("n", [360, 720, 1080, 2910, 1459])
@pytest.mark.parametrize("more", [-1, 0, 1, 2])
def test_a_full_turn_may_have_both_ends(n, more):
    step = float(np.float32(2 * math.pi / n))
    message = laser_scan(float(np.float32(-math.pi)), step, np.full(n + more, 5.0))
    scanner, (ranges,) = common_scanner([scan_of(message)])
    assert scanner.n_beams == len(ranges) == min(n, n + more)
    message.ranges = np.full(n + 9, 5.0)
    with pytest.raises(InputError, match=rf"a scan has {n + 9} beams .* want {n} at most, a full turn"):
        scan_of(message)


def test_limits_are_no_hits():
    ranges = np.array([0.0, 0.05, 0.1, 29.99, 30.0, 31.0, np.inf, np.nan, -1.0], np.float32)
    wanted = [False, True, True, True, False, False, False, False, False]
    assert np.isfinite(scan_of(laser_scan(0.0, 0.1, ranges)).ranges).tolist() == wanted
    wanted[1] = False
    assert np.isfinite(scan_of(laser_scan(0.0, 0.1, ranges, low=0.1)).ranges).tolist() == wanted
    for broken in ({"step": 0.0}, {"high": math.nan}, {"start": math.inf}, {"low": math.nan}):
        with pytest.raises(InputError, match="want numbers, an increment other than 0"):
            scan_of(laser_scan(**{"start": 0.0, "step": 0.1, "ranges": ranges} | broken))


@pytest.mark.parametrize("norm", [0.9, 1.0, 1.1])
def test_orientations_of_any_near_norm_say_the_same_heading(norm):
    for yaw in np.linspace(-3.1, 3.1, 9):
        z, w = norm * math.sin(yaw / 2), norm * math.cos(yaw / 2)
        turned = SimpleNamespace(x=0.0, y=0.0, z=z, w=w)
        at = SimpleNamespace(position=SimpleNamespace(x=1.0, y=2.0), orientation=turned)
        assert pose_of(SimpleNamespace(pose=at))[:3] == pytest.approx((1.0, 2.0, yaw))
        for factor in (0.0, 0.2, 9.0, math.nan):
            at.orientation.z, at.orientation.w = z * factor, w * factor
            with pytest.raises(InputError, match=r"its orientation has the norm .*, want a quaternion"):
                pose_of(SimpleNamespace(pose=at))
        at.orientation.z, at.orientation.w = z, w


def test_the_documented_lines_make_a_folder_of_photographs_of_a_recording(tmp_path, monkeypatch):
    rig, none = SensorRig.named("camera"), (np.zeros((0, 0)),) * 2
    pictures = [np.full((480, 640, 3), 50 * k, np.uint8) for k in range(3)]
    with recording(tmp_path / "drive.mcap", rig) as writer:
        for k, picture in enumerate(pictures):
            capture = Capture(np.zeros(3), {"right": Frame(picture, *none, np.zeros((0, 0), int))}, {}, {})
            writer.add(TimedCapture(200_000.0 + k, capture), np.array([2.0 * k, 1.0, 0.1]))
        writer.close(Head(key="key", time=200_000.0, rig="camera", weather="rain"))
    monkeypatch.chdir(tmp_path)
    code = (Path(__file__).parents[1] / "docs/calibration.md").read_text().split("```py\n")[1].split("```")[0]
    exec(compile(code, "calibration.md", "exec"), {})
    taken = source_of(tmp_path / "photos", None, PhotoOptions(fov=90.0), None)
    photographed = RecordedDrive(tmp_path / "photos", source=taken)
    assert photographed.start == 200_000.0
    back = list(photographed.captures())
    np.testing.assert_allclose([pose for _, pose in back], [[2.0 * k, 1.0, 0.1] for k in range(3)])
    for (captured, _), picture in zip(back, pictures, strict=True):
        np.testing.assert_array_equal(captured.capture.images["camera"].image, picture)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"poses": 0}, r"has no poses in /odom, want .*Odometry .*; it has /camera \(sensor_msgs"),
        ({"shift": {"/odom": 100.0}}, r"/camera ends at .* before /odom begins at .*: do their clocks"),
        ({"shift": {"/scan": -3.0}}, r"/scan ends at .* before /.* begins at .*; want streams that overlap"),
        ({"order": {"/odom": [0, 1, 3, 2, 4]}}, r"/odom: time goes from .* to .* s at message 4, want it"),
        ({"order": {"/camera": [0, 2, 2]}}, r"/camera: time goes from .* to .* s at message 3, want it"),
    ],
)
def test_clocks_and_topics_that_do_not_fit_are_named_in_a_line(tmp_path, options, message):
    file = bag(tmp_path / "bag", **options)
    with pytest.raises(InputError, match=message) as caught:
        RecordedDrive(file, calibrated(tmp_path))
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)


def test_damaged_recordings_are_refused_in_a_line(tmp_path):
    whole = bag(tmp_path / "bag").read_bytes()
    calibration, file = calibrated(tmp_path), tmp_path / "bad.mcap"
    for content in (b"", b"I am text", whole[:100], whole[: len(whole) // 2], whole[:-20]):
        file.write_bytes(content)
        with pytest.raises(InputError, match=r"bad\.mcap: is not a complete recording \(.*\)") as caught:
            list(RecordedDrive(file, calibration).captures())
        assert "\n" not in str(caught.value)
    file.write_bytes(whole)
    for name, message in (
        ("bad.mcap", "was not made by parkenv survey --record, .*; describe its sensors"),
        ("none.mcap", "none.mcap: No such file"),
        ("car.toml", "car.toml: is not a complete recording"),
    ):
        with pytest.raises(InputError, match=message):
            RecordedDrive(tmp_path / name, None)
    with pytest.raises(InputError, match=r"/camera: image 1 is 64×48 px, want 96×48 as calibrated"):
        list(RecordedDrive(file, calibrated(tmp_path, CALIBRATION.replace("64", "96"))).captures())
    with pytest.raises(InputError, match=r"car\.toml: has no camera"):
        RecordedDrive(file, calibrated(tmp_path, CALIBRATION.partition("[[cameras]]")[0]))
    with pytest.raises(InputError, match=r"car\.toml: cameras\.0\.fx is -1\.0, want a number above 0"):
        calibrated(tmp_path, CALIBRATION.replace("fx = 32.0", "fx = -1.0"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rig", "errors", "localise"),
    [
        ("laser", ("--pose-noise", 0.1), "none"),
        ("laser", ("--odometry-drift", 0.05), "scan-matching"),
        ("stereo", ("--pose-noise", 0.1), "scan-matching"),
    ],
)
def test_a_recorded_survey_gives_the_same_map_to_the_last_bit(tmp_path, rig, errors, localise):
    file, words = tmp_path / "drive.mcap", ("--scenario", "mini", "--localise", localise)
    driven = ("--rig", rig, *errors, "--record", file, "--out", tmp_path / "survey")
    done = ran("survey --sessions 1 --every 5 --jobs 1", *words, *driven)
    assert "--scenario mini" in " ".join(done.stdout.split())
    ran("map-drive", file, *words, "--out", tmp_path / "mapped")
    lot, sessions = make_scenario("mini").lot, []
    for folder in ("survey", "mapped"):
        with MapStore(tmp_path / folder / "map.sqlite", lot, create=False) as store:
            sessions += store.sessions()
    one, two = sessions
    assert (one.key, one.time, one.rig, one.weather) == (two.key, two.time, two.rig, two.weather)
    np.testing.assert_array_equal(one.p_occupied, two.p_occupied)
    np.testing.assert_array_equal(one.cars, two.cars)
    assert len(one.cars) > 1
    again = parkenv("map-drive", file, *words, "--out", tmp_path / "mapped")
    assert "holds the drive" in " ".join(again.stderr.split())
