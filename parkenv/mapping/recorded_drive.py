"""Recorded drives: timed captures and poses from what a source reads: bags, MCAP files, folders, photographs, films.

Each picture of the first camera is a capture. What other sensors measured nearest in time joins it: the other picture
of a stereo pair at most `PAIR_S` away, another camera `CAMERAS_S`, a laser `LASER_S`, with where the vehicle was then.
The car's pose is interpolated to the picture's time: linearly between the poses before and after, at most 2 s apart,
the heading along the shorter arc; a pose at exactly that time is taken as it is. Pictures without pose or partner are
left out. Times are those of the messages' headers, of messages without header those of the recording.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError, naming
from parkenv.files.limited_reading import parse_json
from parkenv.files.recordings import (
    COMPRESSED_IMAGE,
    NAV_FIX,
    SCAN,
    TRANSFORMS,
    Messages,
    picture_in,
    stamp_of,
)
from parkenv.lots.local_frame import LocalFrame
from parkenv.mapping.car_tracks import CarTracks, ParkedCars
from parkenv.mapping.drive_calibration import DriveCalibration
from parkenv.mapping.drive_poses import PoseReader, PoseTrack, within
from parkenv.mapping.drive_setup import DriveSetup, set_up
from parkenv.mapping.drive_sources import Bag, Source
from parkenv.mapping.drive_writer import HEAD, POSE, RECORDED_MONDAY_S, Head
from parkenv.mapping.grid import OccupancyGrid
from parkenv.mapping.laser_scans import Scan, common_scanner, mirrored, scan_of, without_motion
from parkenv.mapping.lenses import Picture
from parkenv.mapping.point_clouds import SCANNER, CloudScan, Road, fit_road, points_of, scan_of_cloud
from parkenv.mapping.store import Session
from parkenv.mapping.survey import SessionMap
from parkenv.perception.detector import Detector
from parkenv.perception.monocular import RangingErrors
from parkenv.perception.pipeline import CameraView, PerceptionPipeline, PerceptionResult
from parkenv.perception.slot_filter import SlotFilter, SlotStates
from parkenv.world.lot import ParkingLot
from parkenv.world.week import DAY_S
from sim_sensors.camera.models import Frame, StereoFrame
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import RIG_NAMES, Capture, SensorRig, TimedCapture

PAIR_S, CAMERAS_S, LASER_S = 0.001, 0.1, 0.5
"""Longest times between a picture and what joins it, s: the right picture of a pair, another camera, a laser."""
FAR_M = 500.0  # farther from the lot are poses of another frame
_STILL = 1e-3, 1e-4  # m and rad in a scan, below which nothing is to correct
_NO_DEPTH, _NO_IDS = np.zeros((0, 0), np.float32), np.zeros((0, 0), np.int32)


@dataclass(frozen=True, eq=False)
class MappedDrive:
    session: Session  # the record for the map file
    states: SlotStates  # the filter's final estimate
    grid: OccupancyGrid  # the occupancy grid
    frames: int  # captures that were used
    corrected_m: float  # m, greatest distance between a recorded pose and what it was corrected to
    parked: ParkedCars  # the cars it has passed
    cars: list[dict[str, Any]]  # of each: place, size, errors and slot
    sightings: list[dict[str, Any]]  # of each car located in a picture: the same, and the time


class _Taken(NamedTuple):
    stamp: int  # ns, of the picture
    partners: dict[str, int]  # index of the message of each sensor, by key
    pose: FloatArray
    again: frozenset[str] = frozenset()  # keys of scans that belong to a picture nearer in time


@dataclass(eq=False)
class RecordedDrive:
    """A recorded drive.

    Args:
        path: an MCAP file, a rosbag of ROS 2 (folder, .mcap or .db3) or of ROS 1 (.bag), or what `source` reads.
        calibration: sensors and topics; None where the recording says them itself.
        source: what reads the path, None for a bag; its calibration counts.
        frame: that of the lot, for poses in degrees; None for one around the first pose.
    """

    path: Path
    calibration: DriveCalibration | None = None
    source: Source | None = None
    frame: LocalFrame | None = None
    rig: SensorRig = field(init=False)
    head: Head | None = field(init=False, default=None)
    poses: FloatArray = field(init=False)  # (n, 3) x, y, yaw in the lot
    pose_s: FloatArray = field(init=False)  # (n,) s, Unix time relative to `_start`
    errors: RangingErrors | None = field(init=False, default=None)  # of the poses, where they are known

    def __post_init__(self) -> None:
        source = self.source or Bag(self.path)
        self._source, self.calibration = source, source.calibration or self.calibration
        self._measured: dict[str, list[Scan]] = {}
        self._scans: dict[str, list[NDArray[np.float32]]] = {}
        self._scanners: dict[str, LaserScanner] = {}
        with source.open() as (topics, messages):
            is_survey = self.calibration is None and HEAD in topics
            if is_survey:
                self._setup = _setup_of_survey(topics)
            else:
                self._setup = set_up(self.path, self.calibration, topics, messages)
            self._topics = self._setup.topics
            kind = topics.get(self._topics["pose"], "")
            reader = PoseReader(kind, self._setup.tree, self._setup.base, self.frame)
            self._read(messages, reader)
            if is_survey and (self.head is None or self.head.rig not in RIG_NAMES):
                raise InputError(f"{self.path}: {HEAD} names no rig of {', '.join(RIG_NAMES)}")
            self._finish(reader)
        self.errors = source.errors
        self.frame = source.frame or (reader.frame if kind == NAV_FIX else self.frame)
        if kind == NAV_FIX and reader.std:
            self.errors = RangingErrors.of_poses(reader.std, 0.0)

    def _read(self, messages: Messages, reader: PoseReader) -> None:
        """Read poses, scans, and the times of all."""
        wanted = {topic: key for key, topic in self._topics.items()}
        self._stamps: dict[str, list[int]] = {key: [] for key in self._topics}
        for topic, recorded, message in messages(
            {*wanted, HEAD} - ({self._topics["pose"]} if reader.kind in TRANSFORMS else set())
        ):
            if topic == HEAD:
                content = parse_json(message.data, f"{self.path}: {HEAD}", finite=True)
                self.head = Head.parse(content if isinstance(content, dict) else {}, f"{self.path}: {HEAD}")
                continue
            key, stamp = wanted[topic], stamp_of(message, recorded)
            name = key.partition(":")[2]
            with naming(f"{self.path}: {topic}: message {len(self._stamps[key]) + 1}"):
                if key == "pose" and not reader.add(message):
                    continue
                if key == "imu":
                    reader.add_imu(stamp, message)
                elif key.startswith("scan:") and name not in self._setup.clouds:
                    scan = scan_of(message)
                    hangs = (
                        math.cos(self._setup.lasers[name].roll) < 0.0 if name in self._setup.lasers else False
                    )
                    self._measured.setdefault(name, []).append(mirrored(scan) if hangs else scan)
            self._add_stamp(key, stamp)

    @property
    def key(self) -> str:
        return self.head.key if self.head else f"{self.path.name}/{self._stamps['pose'][0]}"

    @property
    def start(self) -> float:
        if self.head is not None:
            return self.head.time
        zone = self.calibration.timezone_h * 3600.0 if self.calibration else 0.0
        return (self._stamps["pose"][0] / 1e9 + zone - RECORDED_MONDAY_S) % (7.0 * DAY_S)

    @property
    def without_pose(self) -> int:
        """Number of pictures of the first camera that have no pose, and are left out."""
        stamps = self._stamps[self._first]
        return sum(self.pose_at(stamp) is None for stamp in stamps) + self._source.without_pose

    @property
    def without_partner(self) -> int:
        """Number of pictures of the first camera with a pose but without measurements of all other sensors."""
        stamps = [stamp for stamp in self._stamps[self._first] if self.pose_at(stamp) is not None]
        return sum(self._partners(stamp) is None for stamp in stamps)

    def captures(self, every: float = 0.0) -> Iterator[tuple[TimedCapture, FloatArray]]:
        """Yield captures at least `every` m apart, and the vehicle's pose of each, (3,) x, y in m and yaw in rad."""
        plan = self._frames(every)
        late = {key for key in self._topics if key.startswith("image:") or key[5:] in self._setup.clouds}
        needed: dict[tuple[str, int], list[int]] = {}
        for k, taken in enumerate(plan):
            for key in late:
                needed.setdefault((key, taken.partners[key]), []).append(k)
        parts: list[dict[str, Any]] = [{} for _ in plan]
        count = dict.fromkeys(self._topics, -1)
        keys = {self._topics[key]: key for key in late}
        done = 0
        with self._source.open() as (_, messages):
            for topic, _, message in messages(set(keys)):
                key = keys[topic]
                count[key] += 1
                if takers := needed.get((key, count[key]), ()):
                    read = self._decoded if key.startswith("image:") else self._cloud
                    part = read(key, message, count[key])
                    for k in takers:
                        parts[k][key] = part
                while done < len(plan) and len(parts[done]) == len(late):
                    yield self._capture(plan[done], parts[done])
                    parts[done] = {}
                    done += 1

    def _add_stamp(self, key: str, stamp: int) -> None:
        before = self._stamps[key]
        if before and stamp <= before[-1]:
            raise InputError(
                f"{self.path}: {self._topics[key]}: time goes from {before[-1] / 1e9:.6f} to "
                f"{stamp / 1e9:.6f} s at message {len(before) + 1}, want it to rise"
            )
        before.append(stamp)

    def _finish(self, reader: PoseReader) -> None:
        """Check that the streams have something in common, and make poses, scans and the rig."""
        with naming(f"{self.path}: {self._topics['pose']}"):
            self._stamps["pose"], poses = reader.poses(self._stamps["pose"])
        spans = {}
        for key, stamps in self._stamps.items():
            topic = self._topics[key]
            if not stamps:
                raise InputError(f"{self.path}: {topic} has no messages")
            spans[topic] = (stamps[0] / 1e9, stamps[-1] / 1e9)
        low, high = max(s[0] for s in spans.values()), min(s[1] for s in spans.values())
        if low > high + CAMERAS_S:
            late = next(topic for topic, span in spans.items() if span[0] == low)
            early = next(topic for topic, span in spans.items() if span[1] == high)
            raise InputError(
                f"{self.path}: {early} ends at {high:.3f} s, before {late} begins at {low:.3f} s; want streams that "
                "overlap in time: do their clocks agree?"
            )
        if not np.isfinite(poses).all():
            bad = int(np.flatnonzero(~np.isfinite(poses).all(axis=1))[0])
            raise InputError(
                f"{self.path}: {self._topics['pose']}: pose {bad + 1} is {poses[bad, :3].tolist()}"
            )
        at = self.calibration.origin if self.calibration else None
        if at is not None and (at.x, at.y, at.yaw) != (0.0, 0.0, 0.0):
            turn = math.radians(at.yaw)
            c, s = math.cos(turn), math.sin(turn)
            x, y, yaw = poses.T[:3]
            poses = np.column_stack([at.x + c * x - s * y, at.y + s * x + c * y, yaw + turn, poses[:, 3:]])
        self._track = PoseTrack(self._stamps["pose"], poses)
        self.poses = self._track.poses
        start = self._stamps["pose"][0]
        self.pose_s = (np.array(self._stamps["pose"], np.int64) - start) / 1e9
        self._scanners = dict.fromkeys(self._setup.clouds, SCANNER)
        for name, scans in self._measured.items():
            with naming(f"{self.path}: {self._topics[f'scan:{name}']}"):
                stamps = self._stamps[f"scan:{name}"]
                still = [self._without_motion(name, one, at) for one, at in zip(scans, stamps, strict=True)]
                self._scanners[name], self._scans[name] = common_scanner(still)
        if self.head is not None and self.calibration is None:
            self._be_a_survey(self.head)
        else:
            self.rig = self._setup.rig(self._scanners)

    def _be_a_survey(self, head: Head) -> None:
        rig = self.rig = SensorRig.named(head.rig)
        cameras = [(f"image:{name}:mono", camera) for name, camera, _ in rig.cameras]
        for name, pair, _ in rig.stereo_cameras:
            cameras += [(f"image:{name}:{side}", pair.camera) for side in ("left", "right")]
        wanted = {f"scan:{name}" for name, _, _ in rig.lasers} | {key for key, _ in cameras}
        if missing := sorted(wanted - self._topics.keys()):
            raise InputError(f"{self.path}: has no {missing[0].replace(':', ' ')}, which its rig has")
        for name, laser, _ in rig.lasers:
            if self._scanners[name].n_beams != laser.n_beams:
                raise InputError(
                    f"{self.path}: {name} has {self._scanners[name].n_beams} beams, want {laser.n_beams}"
                )
        self._setup.pictures = {key: Picture((c.width, c.height), c.matrix, c) for key, c in cameras}

    def _without_motion(self, name: str, scan: Scan, stamp: int) -> Scan:
        """Return a scan as if all its beams were measured at its stamp, the time of the first one."""
        placed = self._setup.lasers.get(name)
        if not scan.delay or placed is None or self.pose_at(stamp) is None:
            return scan
        beam = np.arange(len(scan.ranges))
        late = scan.delay * (beam if scan.delay > 0.0 else beam - beam[-1])
        vehicle = self._track.during(np.concatenate([[0.0], late * 1e9]) + float(stamp))
        m = placed.mount
        c, s = np.cos(vehicle[:, 2]), np.sin(vehicle[:, 2])
        sensor = vehicle + np.column_stack([c * m.x - s * m.y, s * m.x + c * m.y, np.full(len(c), m.yaw)])
        moved = within(sensor[0], sensor[1:])
        if np.hypot(*moved.T[:2]).max() < _STILL[0] and np.abs(moved[:, 2]).max() < _STILL[1]:
            return scan
        return without_motion(scan, moved)

    def _partners(self, stamp: int) -> dict[str, int] | None:
        """Return the index of each sensor's message that joins a picture of the first camera; None if one lacks."""
        found: dict[str, int] = {}
        for key, stamps in self._arrays.items():
            beside, most = stamp, CAMERAS_S
            if key.startswith("scan:"):
                most = LASER_S
            elif key.endswith(":right"):
                left = f"{key.rpartition(':')[0]}:left"
                beside, most = int(self._arrays[left][found[left]]), PAIR_S
            found[key] = _nearest(stamps, beside)
            off = abs(int(stamps[found[key]]) - beside)
            if off > most * 1e9 or (off > CAMERAS_S * 1e9 and self.pose_at(int(stamps[found[key]])) is None):
                return None
        return found

    @property
    def _arrays(self) -> dict[str, IntArray]:
        """Stamps of the sensors; the left camera of a pair is before the right one."""
        if not hasattr(self, "_as_arrays"):
            keys = sorted(key for key in self._stamps if key not in ("pose", "imu"))
            self._as_arrays = {key: np.array(self._stamps[key], np.int64) for key in keys}
        return self._as_arrays

    def _frames(self, every: float) -> list[_Taken]:
        plan: list[_Taken] = []
        for stamp in self._stamps[self._first]:
            pose = self.pose_at(stamp)
            partners = None if pose is None else self._partners(stamp)
            if pose is None or partners is None:
                continue
            if plan and every > 0.0 and float(np.hypot(*(pose - plan[-1].pose)[:2])) < every:
                continue
            plan.append(_Taken(stamp, partners, pose))
        if not plan:
            self._refuse_pairs()
            raise InputError(
                f"{self.path}: no picture of {self._topics[self._first]} has a pose and measurements of all "
                f"other sensors: cameras within {CAMERAS_S} s, lasers within {LASER_S} s"
            )
        nearest: dict[tuple[str, int], tuple[int, int]] = {}
        for k, taken in enumerate(plan):
            for key, index in taken.partners.items():
                off = abs(int(self._arrays[key][index]) - taken.stamp)
                nearest[key, index] = min(nearest.get((key, index), (off, k)), (off, k))
        return [
            taken._replace(
                again=frozenset(key for key, i in taken.partners.items() if nearest[key, i][1] != k)
            )
            for k, taken in enumerate(plan)
        ]

    def _refuse_pairs(self) -> None:
        for key, stamps in self._arrays.items():
            if key.endswith(":right"):
                left = self._arrays[f"{key.rpartition(':')[0]}:left"]
                least = (
                    min(abs(int(stamps[_nearest(stamps, int(stamp))]) - int(stamp)) for stamp in left) / 1e9
                )
                if least > PAIR_S:
                    raise InputError(
                        f"{self.path}: no pictures of {self._topics[key]} are of the same moment as those of "
                        f"{self._topics[f'{key[:-5]}left']}: {least:.4f} s apart at least, want at most {PAIR_S} s"
                    )

    @property
    def _first(self) -> str:
        return next(key for key in self._stamps if key.startswith("image:"))

    def pose_at(self, stamp: int) -> FloatArray | None:
        """Return the interpolated pose, (3,), at a time, ns of Unix time; None where there is none."""
        return self._track.at(stamp)

    def _capture(self, taken: _Taken, parts: dict[str, Any]) -> tuple[TimedCapture, FloatArray]:
        stamp, partners, pose, again = taken
        frames = {
            key: Frame(image, _NO_DEPTH, _NO_DEPTH, _NO_IDS)
            for key, image in parts.items()
            if key.startswith("image:")
        }
        scans, tops, moved = {}, {}, {}
        tilt = self._track.tilt(stamp)
        for name, _, _ in self.rig.lasers:
            key = f"scan:{name}"
            then = int(self._arrays[key][partners[key]])
            if then != stamp and (where := self._track.moved(then, pose)) is not None:
                moved[name] = where
            if name not in self._setup.clouds:
                scans[name] = self._scans[name][partners[key]]
                continue
            cloud: CloudScan = parts[key]
            scans[name], tops[name] = cloud.ranges, cloud.tops
            # What the vehicle turned between the two moments comes from the poses.
            now, before = self._track.tilt(stamp), self._track.tilt(then)
            tilt = cloud.tilt[0] + now[0] - before[0], cloud.tilt[1] + now[1] - before[1]
        capture = Capture(
            pose,
            {name: frames[f"image:{name}:mono"] for name, _, _ in self.rig.cameras},
            {
                name: StereoFrame(frames[f"image:{name}:left"], frames[f"image:{name}:right"])
                for name, _, _ in self.rig.stereo_cameras
            },
            scans, moved, frozenset(key[5:] for key in again if key.startswith("scan:")), tops, tilt,
        )  # fmt: skip
        return TimedCapture(self.start + (stamp - self._stamps["pose"][0]) / 1e9, capture), pose

    def _cloud(self, key: str, message: Any, index: int) -> CloudScan:
        name = key[5:]
        placed = self._setup.lasers[name]
        with naming(f"{self.path}: {self._topics[key]}: cloud {index + 1}"):
            points = placed.in_vehicle(points_of(message))
            road = fit_road(points) or Road(0.0, 0.0, -placed.mount.z)
            return scan_of_cloud(points, road)

    def _decoded(self, key: str, message: Any, index: int) -> NDArray[np.uint8]:
        where = f"{self.path}: {self._topics[key]}: image {index + 1}"
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
        low, high = lot.slot_xy.min(axis=0), lot.slot_xy.max(axis=0)
        xy = self.poses[:, :2]
        away = float(np.hypot(*(np.clip(xy, low, high) - xy).T).min())
        if away > FAR_M:
            x, y = xy[0]
            raise InputError(
                f"{self.path}: its poses, such as {x:.0f}, {y:.0f}, are {away:,.0f} m away from the lot; want them "
                "in its frame: `origin` in the calibration, or --origin LAT,LON of its x = y = 0 for poses in degrees"
            )


def _setup_of_survey(types: dict[str, str]) -> DriveSetup:
    """Return the topics of a recording of `parkenv survey --record`, whose rig its head names."""
    topics = {"pose": POSE}
    for topic, kind in types.items():
        name, _, what = topic[1:].partition("/")
        if kind == SCAN:
            topics[f"scan:{name}"] = topic
        elif kind == COMPRESSED_IMAGE:
            side = what.partition("/")[0] if what.startswith(("left", "right")) else "mono"
            topics[f"image:{name}:{side}"] = topic
    return DriveSetup(topics)


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
    require_ranges(drive, localise)
    mapped = SessionMap(
        PerceptionPipeline(drive.rig, lot, detector, drive.errors, on_streets=drive.head is None),
        lot,
        localise,
    )
    captures = drive.captures(every)
    return mapped_drive(drive, lot, mapped, ((mapped.add(*one), one[1]) for one in captures), on_frame)


def require_ranges(drive: RecordedDrive, localise: str) -> None:
    if localise != "none" and not (drive.rig.lasers or drive.rig.stereo_cameras):
        raise InputError(f"localise is {localise!r}, want none: {drive.path} has no laser nor stereo camera")


def mapped_drive(
    drive: RecordedDrive,
    lot: ParkingLot,
    mapped: SessionMap,
    results: Iterable[tuple[PerceptionResult, FloatArray]],
    on_frame: Callable[[], None] = lambda: None,
) -> MappedDrive:
    """Return what a session mapped, from the result of each capture and its recorded pose."""
    shifts, tracks = [], CarTracks()
    sightings: list[dict[str, Any]] = []
    for result, recorded in results:
        shifts.append(np.hypot(*(result.vehicle - recorded)[:2]))
        for view in result.views:
            tracks.add(result.captured.time, view)
            sightings += _sightings(result.captured.time, view, lot)
        on_frame()
    rig, weather = (drive.head.rig, drive.head.weather) if drive.head else ("recorded", "unknown")
    session = mapped.session(drive.key, drive.start, rig, weather)
    parked = tracks.cars(drive.poses[:, :2])
    return MappedDrive(
        session, mapped.slots.states(), mapped.grid, len(shifts), float(max(shifts, default=0.0)), parked,
        list(_rows_of(parked, lot, mapped.slots)), sightings,
    )  # fmt: skip


def _rows_of(parked: ParkedCars, lot: ParkingLot, slots: SlotFilter) -> Iterator[dict[str, Any]]:
    of_slots = slots.slots_of(parked.located).tolist()
    columns = (
        parked.time,
        parked.xy,
        parked.yaw,
        parked.size,
        parked.std,
        parked.probability,
        parked.distance,
    )
    names = (
        "time_s",
        "x_m",
        "y_m",
        "yaw_rad",
        "length_m",
        "width_m",
        "position_std_m",
        "probability",
        "distance_m",
    )
    for row, n, slot in zip(
        np.column_stack(columns).tolist(), parked.sightings.tolist(), of_slots, strict=True
    ):
        place: dict[str, Any] = {name: round(value, 3) for name, value in zip(names, row, strict=True)}
        yield place | {"sightings": n, "slot": lot.slot_ids[slot] if slot >= 0 else ""}


def _sightings(time: float, view: CameraView, lot: ParkingLot) -> Iterator[dict[str, Any]]:
    cars = view.cars
    for k, (x, y, yaw) in enumerate(cars.poses.tolist()):
        place = {"time_s": time, "camera": view.name, "x_m": x, "y_m": y, "yaw_rad": yaw}
        slot = int(view.slots[k])
        place |= {"probability": float(cars.probability[k]), "distance_m": float(cars.distance[k])}
        place |= {"slot": lot.slot_ids[slot] if slot >= 0 else ""}
        if cars.distance_std is not None and cars.covariance is not None:
            spread = math.sqrt(np.trace(cars.covariance[k]) / 2.0)
            place |= {"distance_std_m": float(cars.distance_std[k]), "position_std_m": spread}
        yield {name: round(value, 3) if isinstance(value, float) else value for name, value in place.items()}


def _nearest(stamps: IntArray, stamp: int) -> int:
    after = int(np.searchsorted(stamps, stamp))
    if after == len(stamps) or (after and stamp - stamps[after - 1] <= stamps[after] - stamp):
        return after - 1
    return after
