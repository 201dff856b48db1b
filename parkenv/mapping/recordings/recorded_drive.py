"""Recorded drives: timed captures and poses from what a source reads: bags, MCAP files, folders, photographs, films.

Each picture of the first camera is a capture. What other sensors measured nearest in time joins it: the other picture
of a stereo pair at most `PAIR_S` away, another camera `CAMERAS_S`, a laser `LASER_S`, with where the vehicle was then.
The car's pose is interpolated to the picture's time: linearly between the poses before and after, at most 2 s apart,
the heading along the shorter arc; a pose at exactly that time is taken as it is. Pictures without pose or partner are
left out. Times are those of the messages' headers, of messages without header those of the recording.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError, naming
from parkenv.files.limited_reading import parse_json
from parkenv.files.recordings import TRANSFORMS, Messages, open_recording, picture_in, stamp_of
from parkenv.lots.local_frame import LocalFrame
from parkenv.mapping.odometry import between
from parkenv.mapping.recordings.calibration import DriveCalibration
from parkenv.mapping.recordings.laser_scans import Scan, common_scanner, mirrored, scan_of, without_motion
from parkenv.mapping.recordings.point_clouds import (
    SCANNER,
    CloudScan,
    Road,
    fit_road,
    points_of,
    scan_of_cloud,
)
from parkenv.mapping.recordings.poses import PoseReader, PoseTrack, placed
from parkenv.mapping.recordings.setup import set_up, set_up_survey
from parkenv.mapping.recordings.sources import Source
from parkenv.mapping.recordings.writer import HEAD, RECORDED_MONDAY_S, Head
from parkenv.perception.monocular import RangingErrors
from parkenv.world.lot import ParkingLot
from parkenv.world.week import DAY_S
from sim_sensors.camera.models import Frame, StereoFrame
from sim_sensors.rig import Capture, SensorRig, TimedCapture

# Longest times between a picture and what joins it, s: the right picture of a pair, another camera, a laser.
PAIR_S, CAMERAS_S, LASER_S = 0.001, 0.1, 0.5
FAR_M = 500.0  # farther from the lot are poses of another frame
_STILL = 1e-3, 1e-4  # m and rad in a scan, below which nothing is to correct
_NO_DEPTH, _NO_IDS = np.zeros((0, 0), np.float32), np.zeros((0, 0), np.int32)


class _Matched(NamedTuple):
    """What joins each picture of the first camera."""

    stamps: IntArray  # (n,) ns
    poses: FloatArray  # (n, 3) of the vehicle; NaN where there is none
    is_whole: BoolArray  # (n,) whether there are measurements of all sensors
    partners: dict[str, IntArray]  # (n,) index of the message of each sensor, by key
    off: dict[str, IntArray]  # (n,) ns to it


@dataclass(eq=False)
class RecordedDrive:
    """A recorded drive.

    Args:
        path: an MCAP file, a rosbag of ROS 2 (folder, .mcap or .db3) or of ROS 1 (.bag), or what `source` reads.
        calibration: sensors and topics; None where the recording says them itself.
        source: what reads the path, None for a bag; its calibration counts.
        frame: that of the lot, for poses in degrees; None for one around them.
    """

    path: Path
    calibration: DriveCalibration | None = None
    source: Source | None = None
    frame: LocalFrame | None = None
    rig: SensorRig = field(init=False)
    head: Head | None = field(init=False, default=None)
    poses: FloatArray = field(init=False)  # (n, 3) x, y, yaw in the lot
    errors: RangingErrors | None = field(init=False, default=None)  # of the poses, where they are known

    def __post_init__(self) -> None:
        source = self._source = self.source or Source(partial(open_recording, self.path))
        self.calibration, self._is_placed = source.calibration or self.calibration, self.frame is not None
        self._measured: dict[str, list[Scan]] = {}
        self._scans: dict[str, list[NDArray[np.float32]]] = {}
        with source.open() as (topics, messages):
            if HEAD in topics:
                self._read_head(messages)
            if self.head is not None and self.calibration is None:
                with naming(self.path):
                    self._setup = set_up_survey(self.head.rig, topics)
            else:
                self._setup = set_up(self.path, self.calibration, topics, messages, source)
            kind = topics.get(self._setup.topics.get("pose", ""), "")
            reader = PoseReader(kind, self._setup.tree, self._setup.base, self.frame)
            self._finish(reader, self._read(messages, reader))
        self.frame = source.frame or reader.frame
        self.errors = RangingErrors.of_poses(reader.std, 0.0) if reader.std else source.errors

    def _read_head(self, messages: Messages) -> None:
        where = f"{self.path}: {HEAD}"
        for _, _, message in messages({HEAD}):
            content = parse_json(message.data, where, finite=True)
            self.head = Head.parse(content if isinstance(content, dict) else {}, where)

    def _topic(self, key: str) -> str:
        return self._setup.topics.get(key, f"its {key}s")

    def _read(self, messages: Messages, reader: PoseReader) -> dict[str, list[int]]:
        """Read poses, scans, and the times of all."""
        keys = {topic: key for key, topic in self._setup.topics.items()}
        found: dict[str, list[int]] = {key: [] for key in keys.values()}
        wanted = {topic for topic, key in keys.items() if key != "pose" or reader.kind not in TRANSFORMS}
        for topic, recorded, message in messages(wanted):
            key, stamp = keys[topic], stamp_of(message, recorded)
            name, stamps = key.partition(":")[2], found[key]
            with naming(f"{self.path}: {topic}: message {len(stamps) + 1}"):
                if key == "pose" and not reader.add(message):
                    continue
                if key == "imu":
                    reader.add_imu(stamp, message)
                elif key.startswith("scan:") and name not in self._setup.clouds:
                    scan, hangs = scan_of(message), math.cos(self._setup.lasers[name].roll) < 0.0
                    self._measured.setdefault(name, []).append(mirrored(scan) if hangs else scan)
            if stamps and stamp <= stamps[-1]:
                raise InputError(
                    f"{self.path}: {topic}: time goes from {stamps[-1] / 1e9:.6f} to {stamp / 1e9:.6f} s at "
                    f"message {len(stamps) + 1}, want it to rise"
                )
            stamps.append(stamp)
        return found

    def _finish(self, reader: PoseReader, found: dict[str, list[int]]) -> None:
        """Check that the streams have something in common, and make poses, scans and the rig."""
        where = f"{self.path}: {self._topic('pose')}"
        with naming(where):
            found["pose"], poses = self._source.poses or reader.poses(found["pose"])
        self._stamps = {key: np.array(stamps, np.int64) for key, stamps in found.items()}
        for key, stamps in found.items():
            if not stamps:
                raise InputError(f"{self.path}: {self._topic(key)} has no messages")
        late = max(found, key=lambda key: found[key][0])
        early = min(found, key=lambda key: found[key][-1])
        low, high = found[late][0] / 1e9, found[early][-1] / 1e9
        if low > high + CAMERAS_S:
            raise InputError(
                f"{self.path}: {self._topic(early)} ends at {high:.3f} s, before {self._topic(late)} begins at "
                f"{low:.3f} s; want streams that overlap in time: do their clocks agree?"
            )
        if not (finite := np.isfinite(poses).all(axis=1)).all():
            bad = int(finite.argmin())
            raise InputError(f"{where}: pose {bad + 1} is {poses[bad, :3].tolist()}")
        if self.calibration is not None:
            at = self.calibration.origin
            moved = placed(np.array([at.x, at.y, math.radians(at.yaw)]), poses[:, :3])
            poses = np.column_stack([moved, poses[:, 3:]])
        self._track = PoseTrack(self._stamps["pose"], poses)
        self.poses = self._track.poses
        scanners = dict.fromkeys(self._setup.clouds, SCANNER)
        for name, scans in self._measured.items():
            with naming(f"{self.path}: {self._topic(f'scan:{name}')}"):
                times = found[f"scan:{name}"]
                still = [self._without_motion(name, *one) for one in zip(scans, times, strict=True)]
                scanners[name], self._scans[name] = common_scanner(still)
        with naming(self.path):
            self.rig = self._setup.rig(scanners)

    def _without_motion(self, name: str, scan: Scan, stamp: int) -> Scan:
        """Return a scan as if all its beams were measured at its stamp, the time of the first one."""
        if not scan.delay:
            return scan
        beam = np.arange(len(scan.ranges))
        late = scan.delay * (beam if scan.delay > 0.0 else beam - beam[-1])
        vehicle = self._track.at(stamp + np.rint(np.r_[0.0, late] * 1e9).astype(np.int64))
        mount = self._setup.lasers[name].mount
        sensor = placed(vehicle, np.array([mount.x, mount.y, mount.yaw]))
        moved = between(sensor[0], sensor[1:])
        is_still = np.hypot(*moved.T[:2]).max() < _STILL[0] and np.abs(moved[:, 2]).max() < _STILL[1]
        return scan if is_still or np.isnan(moved).any() else without_motion(scan, moved)

    @property
    def key(self) -> str:
        return self.head.key if self.head else f"{self.path.name}/{self._stamps['pose'][0]}"

    @property
    def start(self) -> float:
        if self.head is not None:
            return self.head.time
        zone = self.calibration.timezone_h * 3600.0 if self.calibration else 0.0
        return float((self._stamps["pose"][0] / 1e9 + zone - RECORDED_MONDAY_S) % (7.0 * DAY_S))

    @property
    def without_pose(self) -> int:
        """Number of pictures of the first camera that have no pose, and are left out."""
        return int(np.isnan(self._matched.poses[:, 0]).sum()) + self._source.without_pose

    @property
    def without_partner(self) -> int:
        """Number of pictures of the first camera with a pose but without measurements of all other sensors."""
        return int((~np.isnan(self._matched.poses[:, 0]) & ~self._matched.is_whole).sum())

    def captures(self, every: float = 0.0) -> Iterator[tuple[TimedCapture, FloatArray]]:
        """Yield captures at least `every` m apart, and the vehicle's pose of each, (3,) x, y in m and yaw in rad."""
        plan, partners = self._planned(every), self._matched.partners
        late = {key for key in partners if key.startswith("image:") or key[5:] in self._setup.clouds}
        again = {key: _shared(partners[key][plan], self._matched.off[key][plan])
                 for key in partners if key.startswith("scan:")}  # fmt: skip
        needed: dict[tuple[str, int], list[int]] = {}
        for n, k in enumerate(plan):
            for key in late:
                needed.setdefault((key, int(partners[key][k])), []).append(n)
        parts: list[dict[str, Any]] = [{} for _ in plan]
        count = dict.fromkeys(late, -1)
        keys = {self._setup.topics[key]: key for key in late}
        done = 0
        with self._source.open() as (_, messages):
            for topic, _, message in messages(set(keys)):
                key = keys[topic]
                count[key] += 1
                if takers := needed.get((key, count[key]), ()):
                    read = self._decoded if key.startswith("image:") else self._cloud
                    part = read(key, message, count[key])
                    for n in takers:
                        parts[n][key] = part
                while done < len(plan) and len(parts[done]) == len(late):
                    shared = frozenset(key[5:] for key, is_shared in again.items() if is_shared[done])
                    yield self._capture(plan[done], shared, parts[done])
                    parts[done] = {}
                    done += 1

    @cached_property
    def _matched(self) -> _Matched:
        """What joins the pictures of the first camera."""
        first = self._stamps[next(key for key in self._stamps if key.startswith("image:"))]
        found = _Matched(first, self._track.at(first), np.ones(len(first), np.bool_), {}, {})
        for key in sorted(self._stamps.keys() - {"pose", "imu"}):  # of a pair, the left camera first
            beside, most = first, LASER_S if key.startswith("scan:") else CAMERAS_S
            if key.startswith("image:") and key.endswith(":right"):
                left = f"{key[:-5]}left"
                beside, most = self._stamps[left][found.partners[left]], PAIR_S
            index = found.partners[key] = _nearest(self._stamps[key], beside)
            at = self._stamps[key][index]
            off = found.off[key] = np.abs(at - beside)
            found.is_whole[off > most * 1e9] = False
            found.is_whole[(off > CAMERAS_S * 1e9) & np.isnan(self._track.at(at)[:, 0])] = False
        return found

    def _planned(self, every: float) -> list[int]:
        """Return the numbers of the first camera's pictures that become captures."""
        plan: list[int] = []
        poses = self._matched.poses
        for k in np.flatnonzero(self._matched.is_whole & ~np.isnan(poses[:, 0])).tolist():
            if not plan or float(np.hypot(*(poses[k] - poses[plan[-1]])[:2])) >= every:
                plan.append(k)
        if not plan:
            for key, off in self._matched.off.items():
                if key.startswith("image:") and key.endswith(":right") and off.min() > PAIR_S * 1e9:
                    raise InputError(
                        f"{self.path}: no pictures of {self._topic(key)} are of the same moment as those of "
                        f"{self._topic(f'{key[:-5]}left')}: {off.min() / 1e9:.4f} s apart at least, want at most "
                        f"{PAIR_S} s"
                    )
            raise InputError(
                f"{self.path}: no picture has a pose and measurements of all other sensors: cameras within "
                f"{CAMERAS_S} s, lasers within {LASER_S} s"
            )
        return plan

    def _capture(
        self, k: int, again: frozenset[str], parts: dict[str, Any]
    ) -> tuple[TimedCapture, FloatArray]:
        stamp, pose = int(self._matched.stamps[k]), self._matched.poses[k]
        tilt = self._track.tilt(stamp)
        scans, tops, moved = {}, {}, {}

        def frame(key: str) -> Frame:
            return Frame(parts[key], _NO_DEPTH, _NO_DEPTH, _NO_IDS)

        for name, _, _ in self.rig.lasers:
            key = f"scan:{name}"
            index = self._matched.partners[key][k]
            then = self._stamps[key][index]
            where = between(pose, self._track.at(then[None])[0])
            if then != stamp and not np.isnan(where).any():
                moved[name] = where
            if name not in self._setup.clouds:
                scans[name] = self._scans[name][index]
                continue
            cloud: CloudScan = parts[key]
            scans[name], tops[name] = cloud.ranges, cloud.tops
            # What the vehicle turned between the two moments comes from the poses.
            tilt = cloud.tilt + self._track.tilt(stamp) - self._track.tilt(then)
        capture = Capture(
            pose,
            {name: frame(f"image:{name}:mono") for name, _, _ in self.rig.cameras},
            {name: StereoFrame(frame(f"image:{name}:left"), frame(f"image:{name}:right"))
             for name, _, _ in self.rig.stereo_cameras},
            scans, moved, again, tops, (float(tilt[0]), float(tilt[1])),
        )  # fmt: skip
        return TimedCapture(self.start + (stamp - int(self._stamps["pose"][0])) / 1e9, capture), pose

    def _cloud(self, key: str, message: Any, index: int) -> CloudScan:
        name = key[5:]
        placed = self._setup.lasers[name]
        with naming(f"{self.path}: {self._topic(key)}: cloud {index + 1}"):
            points = placed.in_vehicle(points_of(message))
            road = fit_road(points) or Road(0.0, 0.0, -placed.mount.z)
            return scan_of_cloud(points, road)

    def _decoded(self, key: str, message: Any, index: int) -> NDArray[np.uint8]:
        where = f"{self.path}: {self._topic(key)}: image {index + 1}"
        image = picture_in(message, where)
        image = image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB))
        picture = self._setup.pictures[key]
        width, height = picture.size
        if image.shape[:2] != (height, width):
            raise InputError(
                f"{where} is {image.shape[1]}×{image.shape[0]} px, want {width}×{height} as calibrated"
            )
        return picture.rectified(image)

    def require_near(self, lot: ParkingLot) -> None:
        """Check that the poses can be in the frame of a lot: that some are at most `FAR_M` away from it."""
        if self.frame is not None and not self._is_placed:
            raise InputError(
                f"{self.path}: its poses are in degrees, and the lot in metres; want --origin LAT,LON of its x = y = 0"
            )
        low, high = lot.slot_xy.min(axis=0), lot.slot_xy.max(axis=0)
        xy = self.poses[:, :2]
        away = float(np.hypot(*(np.clip(xy, low, high) - xy).T).min())
        if away > FAR_M:
            x, y = xy[0]
            raise InputError(
                f"{self.path}: its poses, such as {x:.0f}, {y:.0f}, are {away:,.0f} m away from the lot; want them "
                "in its frame: `origin` in the calibration, or --origin LAT,LON of its x = y = 0 for poses in degrees"
            )


def _nearest(stamps: IntArray, at: IntArray) -> IntArray:
    after = np.searchsorted(stamps, at).clip(1, None).clip(None, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(at - stamps[before] <= stamps[after] - at, before, after)


def _shared(messages: IntArray, off: IntArray) -> BoolArray:
    """Return which captures have a message that another one, nearer in time, has, too."""
    order = np.lexsort([off, messages])
    return ~np.isin(np.arange(len(order)), order[np.unique(messages[order], return_index=True)[1]])
