"""Recorded drives: images, scans and poses in MCAP files and rosbags, written and read by the library rosbags.

Each picture of the first camera is a capture. What other sensors measured nearest in time, at most `PAIR_S` away,
joins it. The car's pose is interpolated to the picture's time: linearly between the poses before and after, at most
`GAP_S` apart, the heading along the shorter arc; a pose at exactly that time is taken as it is. Pictures without pose
or partner are left out. Times are those of the messages' headers, of messages without header those of the recording.
"""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError, naming
from parkenv.files.atomic_write import atomic_write, check_writable
from parkenv.files.limited_reading import parse_json
from parkenv.files.recordings import (
    COMPRESSED_IMAGE,
    IMAGE,
    Messages,
    open_recording,
    picture_in,
    require_rosbags,
    stamp_of,
)
from parkenv.files.spec_file import Spec
from parkenv.mapping.drive_calibration import CameraSpec, DriveCalibration, Lens, StereoSpec
from parkenv.mapping.grid import OccupancyGrid
from parkenv.mapping.laser_scans import Scan, common_scanner, scan_of
from parkenv.mapping.photographs import Photographs
from parkenv.mapping.store import Session
from parkenv.mapping.survey import SessionMap, Survey
from parkenv.perception.detector import Detector
from parkenv.perception.pipeline import CameraView, PerceptionPipeline
from parkenv.perception.slot_filter import SlotStates
from parkenv.world.lot import ParkingLot
from parkenv.world.week import DAY_S
from sim_sensors.camera.models import Frame, StereoFrame
from sim_sensors.errors import SensorError
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import RIG_NAMES, Capture, SensorRig, TimedCapture

PAIR_S = 0.1  # longest time between a picture and what other sensors measured with it, s
GAP_S = 2.0  # longest time between two poses that a pose is interpolated between, s
HEAD, POSE = "/parkenv/drive", "/pose"
_MONDAY_S = 1_704_067_200  # 2024-01-01; drives are recorded as if in the week from this Monday on
_NORMS = 0.5, 1.5  # of quaternions that are taken for rounded ones of norm 1, and normalised
_STRING, _POSE_2D = "std_msgs/msg/String", "geometry_msgs/msg/Pose2D"
_SCAN = "sensor_msgs/msg/LaserScan"
_TYPES = {
    "pose": (_POSE_2D, *(f"geometry_msgs/msg/{name}" for name in ("PoseStamped", "PoseWithCovarianceStamped")),
             "nav_msgs/msg/Odometry"),
    "image": (COMPRESSED_IMAGE, IMAGE),
    "scan": (_SCAN,),
}  # fmt: skip
_NO_DEPTH, _NO_IDS = np.zeros((0, 0), np.float32), np.zeros((0, 0), np.int32)


class Head(Spec, extra="ignore"):
    """What identifies a session: its key, start (s since Monday 00:00), rig and weather."""

    key: str
    time: float
    rig: str
    weather: str


@dataclass(frozen=True, eq=False)
class MappedDrive:
    session: Session  # the record for the map file
    states: SlotStates  # the filter's final estimate
    grid: OccupancyGrid  # the occupancy grid
    frames: int  # captures that were used
    corrected_m: float  # m, greatest distance between a recorded pose and what it was corrected to
    cars: list[dict[str, Any]]  # each located car: time, place, distance and slot, with standard deviations


class DriveWriter:
    def __init__(self, writer: Any, rig: SensorRig, store: Any) -> None:
        self._writer, self._rig, self._store, self._last = writer, rig, store, 0
        self._connections: dict[str, Any] = {}

    def add(self, captured: TimedCapture, vehicle: FloatArray) -> None:
        """Append a capture and the pose of the vehicle by its odometry, (3,)."""
        stamp = _MONDAY_S * 10**9 + round(captured.time * 1e9)
        x, y, yaw = (float(v) for v in vehicle)
        self._send(POSE, _POSE_2D, stamp, x=x, y=y, theta=yaw)
        capture = captured.capture
        for name, _, _ in self._rig.cameras:
            self._send_image(f"/{name}/image/compressed", stamp, capture.images[name].image)
        for name, _, _ in self._rig.stereo_cameras:
            self._send_image(f"/{name}/left/image/compressed", stamp, capture.pairs[name].left.image)
            self._send_image(f"/{name}/right/image/compressed", stamp, capture.pairs[name].right.image)
        for name, laser, _ in self._rig.lasers:
            self._send(
                f"/{name}/scan", _SCAN, stamp, header=self._header(stamp, name), angle_min=laser.start,
                angle_max=laser.start + (laser.n_beams - 1) * laser.step, angle_increment=laser.step,
                time_increment=0.0, scan_time=0.0, range_min=0.0, range_max=laser.max_range, ranges=capture.scans[name],
                intensities=np.zeros(0, np.float32),
            )  # fmt: skip

    def close(self, head: Head) -> None:
        self._send(HEAD, _STRING, self._last, data=json.dumps(head.model_dump()))

    def _send_image(self, topic: str, stamp: int, image: NDArray[np.uint8]) -> None:
        data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].ravel()
        self._send(topic, COMPRESSED_IMAGE, stamp, header=self._header(stamp, topic), format="png", data=data)

    def _send(self, topic: str, kind: str, stamp: int, **parts: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        message = self._store.types[kind](**parts)
        self._last = max(self._last, stamp)
        self._writer.write(self._connections[topic], stamp, self._store.serialize_cdr(message, kind))

    def _header(self, stamp: int, frame: str) -> Any:
        types = self._store.types
        time = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
        return types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


@contextmanager
def recording(path: Path, rig: SensorRig) -> Iterator[DriveWriter]:
    """Write a drive to an MCAP file, atomically; images are stored without loss."""
    require_recordable(path)
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    with atomic_write(path) as beside:
        folder = Path(tempfile.mkdtemp(prefix=".drive", dir=path.absolute().parent))
        try:
            with Writer(folder / "drive", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                yield DriveWriter(writer, rig, get_typestore(Stores.ROS2_HUMBLE))
            (recording,) = (folder / "drive").glob("*.mcap")
            recording.replace(beside)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def require_recordable(path: Path) -> None:
    require_rosbags()
    if path.suffix != ".mcap":
        raise InputError(f"{path}: want a name that ends in .mcap")
    check_writable(path)


@dataclass(eq=False)
class RecordedDrive:
    """A recorded drive: an MCAP file, a rosbag of ROS 2 (folder, .mcap or .db3) or of ROS 1 (.bag).

    Args:
        path: the file or folder.
        calibration: sensors and topics; None for a recording of `parkenv survey --record`.
        photographs: what takes the place of a recording; its calibration counts.
    """

    path: Path
    calibration: DriveCalibration | None = None
    photographs: Photographs | None = None
    rig: SensorRig = field(init=False)
    head: Head | None = field(init=False, default=None)
    poses: FloatArray = field(init=False)  # (n, 3) x, y, yaw in the lot
    pose_s: FloatArray = field(init=False)  # (n,) s, Unix time relative to `_start`

    def __post_init__(self) -> None:
        self._topics: dict[str, str] = {}  # by sensor: pose, image:NAME:SIDE, scan:NAME
        self._lenses: dict[str, Lens] = {}
        self._stamps: dict[str, list[int]] = {}
        self._scans: dict[str, list[NDArray[np.float32]]] = {}
        self._scanners: dict[str, LaserScanner] = {}
        self._measured: dict[str, list[Scan]] = {}
        poses: list[tuple[float, float, float]] = []
        if self.photographs is not None:
            self.calibration = self.photographs.calibration
        with self._open() as (topics, messages):
            self._plan(topics)
            wanted = {topic: key for key, topic in self._topics.items()}
            self._stamps = {key: [] for key in self._topics}
            for topic, stamp, message in messages({*wanted, HEAD}):
                if topic == HEAD:
                    content = parse_json(message.data, f"{self.path}: {HEAD}", finite=True)
                    self.head = Head.parse(
                        content if isinstance(content, dict) else {}, f"{self.path}: {HEAD}"
                    )
                    continue
                key = wanted[topic]
                self._add_stamp(key, stamp_of(message, stamp))
                if key == "pose":
                    with naming(f"{self.path}: {topic}: pose {len(poses) + 1}"):
                        poses.append(_pose_of(message))
                elif key.startswith("scan:"):
                    self._add_scan(key[5:], message)
        self._finish(np.array(poses, dtype=np.float64).reshape(-1, 3))

    @property
    def key(self) -> str:
        return self.head.key if self.head else f"{self.path.name}/{self._stamps['pose'][0]}"

    @property
    def start(self) -> float:
        if self.head is not None:
            return self.head.time
        zone = self.calibration.timezone_h * 3600.0 if self.calibration else 0.0
        return (self._stamps["pose"][0] / 1e9 + zone - _MONDAY_S) % (7.0 * DAY_S)

    @property
    def without_pose(self) -> int:
        """Number of pictures of the first camera that have no pose, and are left out."""
        return sum(self.pose_at(stamp) is None for stamp in self._stamps[self._first]) + (
            self.photographs.without_pose if self.photographs else 0
        )

    def captures(self, every: float = 0.0) -> Iterator[tuple[TimedCapture, FloatArray]]:
        """Yield captures at least `every` m apart, and the vehicle's pose of each, (3,) x, y in m and yaw in rad."""
        plan = self._frames(every)
        needed: dict[tuple[str, int], list[int]] = {}
        for k, (_, partners, _) in enumerate(plan):
            for key, index in partners.items():
                if not key.startswith("scan:"):
                    needed.setdefault((key, index), []).append(k)
        images: list[dict[str, NDArray[np.uint8]]] = [{} for _ in plan]
        count = dict.fromkeys(self._topics, -1)
        cameras = {topic: key for key, topic in self._topics.items() if key.startswith("image:")}
        done = 0
        with self._open() as (_, messages):
            for topic, _, message in messages(set(cameras)):
                key = cameras[topic]
                count[key] += 1
                for k in needed.get((key, count[key]), ()):
                    images[k][key] = self._decoded(key, message, count[key])
                while done < len(plan) and len(images[done]) == len(cameras):
                    yield self._capture(plan[done], images[done])
                    images[done] = {}
                    done += 1

    def _open(self) -> AbstractContextManager[tuple[dict[str, str], Messages]]:
        return open_recording(self.path) if self.photographs is None else self.photographs.open()

    def _plan(self, topics: dict[str, str]) -> None:
        self._topics = {"pose": self.calibration.pose if self.calibration else POSE}
        if self.calibration is not None:
            cameras: list[tuple[CameraSpec | StereoSpec, str, str]]
            cameras = [(camera, "mono", camera.topic) for camera in self.calibration.cameras]
            for pair in self.calibration.stereo_cameras:
                cameras += [(pair, "left", pair.left), (pair, "right", pair.right)]
            self._lenses = {f"image:{camera.name}:{side}": camera for camera, side, _ in cameras}
            self._topics |= {f"image:{camera.name}:{side}": topic for camera, side, topic in cameras}
            self._topics |= {f"scan:{laser.name}": laser.topic for laser in self.calibration.lasers}
        elif HEAD not in topics:
            raise InputError(
                f"{self.path}: was not made by parkenv survey --record; describe its sensors: --calibration"
            )
        else:
            for topic, kind in topics.items():
                name, _, what = topic[1:].partition("/")
                if kind == _SCAN:
                    self._topics[f"scan:{name}"] = topic
                elif kind == COMPRESSED_IMAGE:
                    side = what.partition("/")[0] if what.startswith(("left", "right")) else "mono"
                    self._topics[f"image:{name}:{side}"] = topic
        for key, topic in self._topics.items():
            kind = key.partition(":")[0]
            if topics.get(topic) not in _TYPES[kind]:
                there = ", ".join(f"{t} ({kind})" for t, kind in sorted(topics.items())[:12]) or "nothing"
                wanted = " or ".join(_TYPES[kind])
                raise InputError(f"{self.path}: has no {kind}s in {topic}, want {wanted}; it has {there}")

    def _add_stamp(self, key: str, stamp: int) -> None:
        before = self._stamps[key]
        if before and stamp <= before[-1]:
            raise InputError(
                f"{self.path}: {self._topics[key]}: time goes from {before[-1] / 1e9:.6f} to "
                f"{stamp / 1e9:.6f} s at message {len(before) + 1}, want it to rise"
            )
        before.append(stamp)

    def _add_scan(self, name: str, message: Any) -> None:
        with naming(f"{self.path}: {self._topics[f'scan:{name}']}"):
            self._measured.setdefault(name, []).append(scan_of(message))

    def _finish(self, poses: FloatArray) -> None:
        """Check that the streams have something in common, and make the rig."""
        spans = {}
        for key, stamps in self._stamps.items():
            topic = self._topics[key]
            if not stamps:
                raise InputError(f"{self.path}: {topic} has no messages")
            spans[topic] = (stamps[0] / 1e9, stamps[-1] / 1e9)
        low, high = max(s[0] for s in spans.values()), min(s[1] for s in spans.values())
        if low > high + PAIR_S:
            late, early = (t for value, k in ((low, 0), (high, 1)) for t, s in spans.items() if s[k] == value)
            raise InputError(
                f"{self.path}: {early} ends at {high:.3f} s, before {late} begins at {low:.3f} s; want streams that "
                "overlap in time: do their clocks agree?"
            )
        if not np.isfinite(poses).all():
            bad = int(np.flatnonzero(~np.isfinite(poses).all(axis=1))[0])
            raise InputError(f"{self.path}: {self._topics['pose']}: pose {bad + 1} is {poses[bad].tolist()}")
        self.poses = poses
        for name, scans in self._measured.items():
            with naming(f"{self.path}: {self._topics[f'scan:{name}']}"):
                self._scanners[name], self._scans[name] = common_scanner(scans)
        if self.calibration is None:
            if self.head is None or self.head.rig not in RIG_NAMES:
                raise InputError(f"{self.path}: {HEAD} names no rig of {', '.join(RIG_NAMES)}")
            self.rig = SensorRig.named(self.head.rig)
            self._require_rig()
        else:
            try:
                self.rig = self.calibration.rig(self._scanners)
            except (InputError, SensorError) as error:
                raise InputError(f"{self.calibration._file or 'calibration'}: {error}") from error
            at = self.calibration.origin
            if (at.x, at.y, at.yaw) != (0.0, 0.0, 0.0):
                turn = math.radians(at.yaw)
                c, s = math.cos(turn), math.sin(turn)
                x, y, yaw = poses.T
                self.poses = np.column_stack([at.x + c * x - s * y, at.y + s * x + c * y, yaw + turn])
        start = self._stamps["pose"][0]
        self.pose_s = (np.array(self._stamps["pose"], np.int64) - start) / 1e9

    def _require_rig(self) -> None:
        rig = self.rig
        wanted = {f"scan:{name}" for name, _, _ in rig.lasers}
        wanted |= {f"image:{name}:mono" for name, _, _ in rig.cameras}
        wanted |= {f"image:{name}:{side}" for name, _, _ in rig.stereo_cameras for side in ("left", "right")}
        if missing := sorted(wanted - self._topics.keys()):
            raise InputError(f"{self.path}: has no {missing[0].replace(':', ' ')}, which its rig has")
        for name, laser, _ in rig.lasers:
            if self._scanners[name].n_beams != laser.n_beams:
                raise InputError(
                    f"{self.path}: {name} has {self._scanners[name].n_beams} beams, want {laser.n_beams}"
                )

    def _frames(self, every: float) -> list[tuple[int, dict[str, int], FloatArray]]:
        """Return the stamp, the index of each sensor's part, and the pose of each capture."""
        others = {key: np.array(s, np.int64) for key, s in self._stamps.items() if key != "pose"}
        plan: list[tuple[int, dict[str, int], FloatArray]] = []
        for stamp in self._stamps[self._first]:
            nearest = {key: _nearest(stamps, stamp) for key, stamps in others.items()}
            paired = all(abs(int(others[key][i]) - stamp) <= PAIR_S * 1e9 for key, i in nearest.items())
            pose = self.pose_at(stamp)
            if not paired or pose is None:
                continue
            if plan and every > 0.0 and float(np.hypot(*(pose - plan[-1][2])[:2])) < every:
                continue
            plan.append((stamp, nearest, pose))
        if not plan:
            raise InputError(
                f"{self.path}: no picture of {self._topics[self._first]} has a pose and measurements of all "
                f"other sensors within {PAIR_S} s"
            )
        return plan

    @property
    def _first(self) -> str:
        return next(key for key in self._stamps if key.startswith("image:"))

    def pose_at(self, stamp: int) -> FloatArray | None:
        """Return the interpolated pose, (3,), at a time, ns of Unix time; None where there is none."""
        stamps = self._stamps["pose"]
        after = int(np.searchsorted(np.array(stamps, np.int64), stamp))
        if after < len(stamps) and stamps[after] == stamp:
            return np.array(self.poses[after], dtype=np.float64)
        if after in (0, len(stamps)) or stamps[after] - stamps[after - 1] > GAP_S * 1e9:
            return None
        one, two = self.poses[after - 1], self.poses[after]
        share = (stamp - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        turn = (two[2] - one[2] + math.pi) % (2.0 * math.pi) - math.pi
        return np.array([*(one[:2] + share * (two[:2] - one[:2])), one[2] + share * turn])

    def _capture(
        self, frame: tuple[int, dict[str, int], FloatArray], images: dict[str, NDArray[np.uint8]]
    ) -> tuple[TimedCapture, FloatArray]:
        stamp, partners, pose = frame
        frames = {key: Frame(image, _NO_DEPTH, _NO_DEPTH, _NO_IDS) for key, image in images.items()}
        capture = Capture(
            pose,
            {name: frames[f"image:{name}:mono"] for name, _, _ in self.rig.cameras},
            {
                name: StereoFrame(frames[f"image:{name}:left"], frames[f"image:{name}:right"])
                for name, _, _ in self.rig.stereo_cameras
            },
            {name: self._scans[name][partners[f"scan:{name}"]] for name, _, _ in self.rig.lasers},
        )
        return TimedCapture(self.start + (stamp - self._stamps["pose"][0]) / 1e9, capture), pose

    def _decoded(self, key: str, message: Any, index: int) -> NDArray[np.uint8]:
        where = f"{self.path}: {self._topics[key]}: image {index + 1}"
        image = picture_in(message, where)
        image = image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB))
        cameras = {name: camera for name, camera, _ in self.rig.cameras}
        cameras |= {name: pair.camera for name, pair, _ in self.rig.stereo_cameras}
        camera = cameras[key.split(":")[1]]
        if image.shape[:2] != (camera.height, camera.width):
            raise InputError(
                f"{where} is {image.shape[1]}×{image.shape[0]} px, want {camera.width}×{camera.height} as calibrated"
            )
        lens = self._lenses.get(key)
        if lens is not None and lens.distortion:
            image = np.asarray(cv2.undistort(image, camera.matrix, np.array(lens.distortion)))
        return image


def map_drive(
    drive: RecordedDrive,
    lot: ParkingLot,
    detector: str | Detector | None = None,
    every: float = 0.0,
    on_frame: Callable[[], None] = lambda: None,
    localise: str = "none",
) -> MappedDrive:
    """Run the perception pipeline and the mapping on a recorded drive, with captures at least `every` m apart.

    What corrects the recorded poses is `none`, or `scan-matching`, for which they are drifting odometry. `on_frame` is
    called after every capture.
    """
    if localise != "none" and not (drive.rig.lasers or drive.rig.stereo_cameras):
        raise InputError(f"localise is {localise!r}, want none: {drive.path} has no laser nor stereo camera")
    errors = drive.photographs.errors if drive.photographs else None
    mapped = SessionMap(PerceptionPipeline(drive.rig, lot, detector, errors), lot, localise)
    shifts, cars = [], []
    for captured, recorded in drive.captures(every):
        result = mapped.add(captured, recorded)
        shifts.append(np.hypot(*(result.vehicle - recorded)[:2]))
        cars += [row for view in result.views for row in _car_rows(captured.time, view, lot)]
        on_frame()
    rig, weather = (drive.head.rig, drive.head.weather) if drive.head else ("recorded", "unknown")
    session = mapped.session(drive.key, drive.start, rig, weather)
    return MappedDrive(
        session, mapped.slots.states(), mapped.grid, len(shifts), float(max(shifts, default=0.0)), cars
    )


def _car_rows(time: float, view: CameraView, lot: ParkingLot) -> Iterator[dict[str, Any]]:
    cars = view.cars
    for k, (x, y, yaw) in enumerate(cars.poses.tolist()):
        place = {"time_s": time, "camera": view.name, "x_m": x, "y_m": y, "yaw_rad": yaw}
        slot = int(view.slots[k])
        place |= {"distance_m": float(cars.distance[k]), "slot": lot.slot_ids[slot] if slot >= 0 else ""}
        if cars.distance_std is not None and cars.covariance is not None:
            spread = math.sqrt(np.trace(cars.covariance[k]) / 2.0)
            place |= {"distance_std_m": float(cars.distance_std[k]), "position_std_m": spread}
        yield {name: round(value, 3) if isinstance(value, float) else value for name, value in place.items()}


def record_drive(survey: Survey, number: int, path: Path) -> None:
    with recording(path, survey.pipeline.rig) as writer:
        driven = survey.drive(
            number, on_frame=lambda frame: writer.add(frame.result.captured, frame.odometry)
        )
        session = driven.session
        writer.close(Head(**{name: getattr(session, name) for name in ("key", "time", "rig", "weather")}))


def _pose_of(message: Any) -> tuple[float, float, float]:
    if hasattr(message, "theta"):
        return float(message.x), float(message.y), float(message.theta)
    pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
    q, at = pose.orientation, pose.position
    norm = math.hypot(q.x, q.y, q.z, q.w)
    if not _NORMS[0] <= norm <= _NORMS[1]:
        raise InputError(f"its orientation has the norm {norm:.3g}, want a quaternion of norm 1")
    # The same in any norm.
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)
    return float(at.x), float(at.y), yaw


def _nearest(stamps: IntArray, stamp: int) -> int:
    after = int(np.searchsorted(stamps, stamp))
    if after == len(stamps) or (after and stamp - stamps[after - 1] <= stamps[after] - stamp):
        return after - 1
    return after
