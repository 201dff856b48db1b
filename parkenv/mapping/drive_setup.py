"""Topics, lenses and mounts of a recording's sensors: from its calibration file, and from what the recording says."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from parkenv.errors import InputError, naming
from parkenv.files.recordings import (
    CAMERA_INFO,
    CLOUD,
    COMPRESSED_IMAGE,
    IMAGE,
    IMU,
    NAV_FIX,
    POSES,
    SCAN,
    TRANSFORMS,
    Messages,
)
from parkenv.mapping.drive_calibration import CameraSpec, DriveCalibration, LaserSpec, SizedLens, StereoSpec
from parkenv.mapping.drive_poses import FrameTree
from parkenv.mapping.lenses import Info, Picture, Placed, aligned_pair, camera_axes, require_level
from parkenv.mapping.point_clouds import BAND_MIDDLE_M, fit_road, points_of
from sim_sensors.camera.models import PinholeCamera, StereoCamera
from sim_sensors.errors import SensorError
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import Mount, SensorRig

SENSORS = {"image": (COMPRESSED_IMAGE, IMAGE), "scan": (SCAN, CLOUD)}
_LISTED = 12
_NO_PICTURES = re.compile(r"(?i)depth|disparity|mask|label")
_COLOUR = re.compile(r"(?i)colou?r|rgb|image_?0?[23]\b")
_HOW = "choose them by `topic` in a calibration file (--calibration)"
_CLOUDS_FOR_HEIGHT = 5
_LEAST_HEIGHT_M = 0.05


@dataclass
class DriveSetup:
    """The sensors of a recording: `topics` by key (`pose`, `imu`, `image:NAME:SIDE`, `scan:NAME`), and what each is."""

    topics: dict[str, str]
    pictures: dict[str, Picture] = field(default_factory=dict)  # by key
    cameras: list[tuple[str, PinholeCamera, Mount]] = field(default_factory=list)
    stereo_cameras: list[tuple[str, StereoCamera, Mount]] = field(default_factory=list)
    lasers: dict[str, Placed] = field(default_factory=dict)
    clouds: set[str] = field(default_factory=set)  # names of lasers that measure point clouds
    tree: FrameTree = field(default_factory=FrameTree)
    base: str | None = None

    def rig(self, scanners: dict[str, LaserScanner]) -> SensorRig:
        """Return the rig with the scanner of each laser, by name; clouds are scans in the vehicle's axes."""
        lasers = []
        for name, (mount, *_) in self.lasers.items():
            level = Mount(mount.x, mount.y, BAND_MIDDLE_M) if name in self.clouds else mount
            lasers.append((name, scanners[name], level))
        return SensorRig(tuple(self.cameras), tuple(self.stereo_cameras), tuple(lasers))


def set_up(
    path: Path, calibration: DriveCalibration | None, types: dict[str, str], messages: Messages
) -> DriveSetup:
    """Return the sensors; topics, lenses and mounts that the calibration leaves out are those of the recording."""
    found = _Recording(path, types, messages)
    if calibration is None and not found.of(CAMERA_INFO):
        what = "was not made by parkenv survey --record, and has no CameraInfo"
        raise found.error(f"{what}; describe its sensors: --calibration")
    given = calibration or DriveCalibration()
    chosen = found.choose(given)
    topics = {"pose": found.pose(given)}
    imu = given.imu or "".join(found.of(IMU)[:1])
    if imu and types.get(topics["pose"]) == NAV_FIX:
        topics["imu"] = imu
    with naming(path):
        base = found.tree.base(given.base or found.base(topics["pose"]))
    setup = DriveSetup(topics, tree=found.tree, base=base)
    topics |= {f"scan:{laser.name}": laser.topic for laser in chosen.lasers}
    topics |= {f"image:{camera.name}:mono": camera.topic for camera in chosen.cameras}
    for pair in chosen.stereo_cameras:
        topics |= {f"image:{pair.name}:left": pair.left, f"image:{pair.name}:right": pair.right}
    found.require(topics)
    try:
        found.place_lasers(setup, chosen)
        for camera in chosen.cameras:
            found.add_camera(setup, camera)
        for pair in chosen.stereo_cameras:
            found.add_pair(setup, pair)
    except (InputError, SensorError) as error:
        if calibration is None or str(error).startswith(str(path)):
            raise InputError(str(error)) from error
        raise InputError(f"{given._file or 'calibration'}: {error}") from error
    return setup


class _Recording:
    """What a recording says of itself: types, frames and lenses by topic, and its frames."""

    def __init__(self, path: Path, types: dict[str, str], messages: Messages) -> None:
        self._path, self._types, self._messages = path, types, messages
        self.tree, self._infos = FrameTree(), dict[str, Info]()
        self._unplaced = set[str]()  # names of sensors that no file describes
        self._base_height: float | None = None
        for topic in self.of(*TRANSFORMS):
            with naming(f"{path}: {topic}"):
                for _, _, message in messages({topic}):
                    self.tree.add(message, static="static" in topic)
        for topic in self.of(CAMERA_INFO):
            for _, _, message in islice(messages({topic}), 1):
                with naming(f"{path}: {topic}"):
                    self._infos[topic] = Info.of(message)

    def of(self, *kinds: str) -> list[str]:
        return [topic for topic, kind in sorted(self._types.items()) if kind in kinds]

    def error(self, text: str) -> InputError:
        return InputError(f"{self._path}: {text}")

    def listed(self, topics: Iterable[str] = ()) -> str:
        there = [f"{topic} ({self._types[topic]})" for topic in sorted(topics or self._types)]
        return ", ".join(there[:_LISTED]) or "nothing"

    def only(self, what: str, topics: list[str]) -> str:
        if not topics:
            raise self.error(f"has no {what}; it has {self.listed()}")
        if len(topics) > 1:
            raise self.error(f"has {len(topics)} {what}s, {self.listed(topics)}; {_HOW}")
        return topics[0]

    def require(self, topics: dict[str, str]) -> None:
        for key, topic in topics.items():
            kind = key.partition(":")[0]
            kinds = {"pose": (*POSES, NAV_FIX, *TRANSFORMS), "imu": (IMU,)}.get(kind) or SENSORS[kind]
            if self._types.get(topic) not in kinds:
                wanted = " or ".join(kinds)
                raise self.error(f"has no {kind}s in {topic}, want {wanted}; it has {self.listed()}")

    def pose(self, given: DriveCalibration) -> str:
        """Return the topic of the poses: as named, else by its type."""
        if "pose" in given.model_fields_set or given.pose in self._types:
            return given.pose
        if topics := self.of(*POSES):
            return self.only("topic of poses", topics)
        fixes, moving = self.of(NAV_FIX), [t for t in self.of(*TRANSFORMS) if "static" not in t]
        if moving and ("map" in self.tree or not fixes):
            return moving[0]
        if not fixes:
            wanted = ", ".join(kind.rpartition("/")[2] for kind in (*POSES, NAV_FIX))
            raise self.error(f"has no poses, want {wanted} or /tf; it has {self.listed()}")
        return self.only("satellite receiver", fixes)

    def base(self, pose: str) -> str | None:
        """Return the frame that poses are of, if they say it and transforms have it."""
        for _, _, message in islice(self._messages({pose}), 1):
            frame = getattr(message, "child_frame_id", "")
            if hasattr(message, "latitude"):
                frame = message.header.frame_id
            return frame.strip("/") if frame.strip("/") in self.tree else None
        return None

    def choose(self, given: DriveCalibration) -> DriveCalibration:
        """Return the calibration with the topics that it leaves out, chosen by type where there is one of a kind."""
        lasers, cameras, pairs = given.lasers, given.cameras, given.stereo_cameras
        if not (cameras or pairs or lasers):
            self._unplaced.add("laser")
            if measured := self.of(CLOUD) or self.of(SCAN):
                lasers = (LaserSpec(name="laser", topic=self.only("laser", measured)),)
        lasers = tuple(
            one if one.topic
            else one.model_copy(update={"topic": self.only("laser", self.of(SCAN, CLOUD))})
            for one in lasers
        )  # fmt: skip
        if not (cameras or pairs):
            if given._file and not self._infos:
                raise InputError(f"{given._file}: has no camera, want cameras or stereo_cameras")
            self._unplaced.add("camera")
            cameras, pairs = self._cameras(bool(lasers))
        cameras = tuple(
            one if "topic" in one.model_fields_set or one.topic in self._types
            else one.model_copy(update={"topic": self.only("camera", self._pictures())})
            for one in cameras
        )  # fmt: skip
        whole = []
        for pair in pairs:
            if not (pair.left and pair.right):
                (left, right), *_ = [*self._pairs(), ("", "")]
                if not left or len(self._pairs()) > 1:
                    raise self.error(f"{pair.name}: want `left` and `right`; it has {self.listed()}")
                pair = pair.model_copy(update={"left": left, "right": right})
            whole.append(pair)
        return given.model_copy(
            update={"cameras": cameras, "stereo_cameras": tuple(whole), "lasers": lasers}
        ).of_file(given._file)

    def _pictures(self) -> list[str]:
        """Return the topics of pictures, one of those of the same pictures."""
        topics = [topic for topic in self.of(*SENSORS["image"]) if not _NO_PICTURES.search(topic)]
        return [topic for topic in topics if topic.removesuffix("/compressed") not in {*topics} - {topic}]

    def _pairs(self) -> list[tuple[str, str]]:
        topics = self._pictures()
        pairs = [(one, other) for one in topics for other in _right_of(one) if other in topics]
        colour = [pair for pair in pairs if _COLOUR.search(pair[0])]
        return colour if len(pairs) > 1 and colour else pairs

    def _cameras(self, has_laser: bool) -> tuple[tuple[CameraSpec, ...], tuple[StereoSpec, ...]]:
        pairs, topics = self._pairs(), self._pictures()
        paired = [topic for pair in pairs for topic in pair]
        if len(pairs) == 1 and not [t for t in topics if t not in paired and not _same_view(t, paired)]:
            left, right = pairs[0]
            if has_laser:
                return (CameraSpec(name="camera", topic=left),), ()
            return (), (StereoSpec(name="camera", left=left, right=right),)
        return (CameraSpec(name="camera", topic=self.only("camera", topics)),), ()

    def _frame(self, topic: str) -> str | None:
        for _, _, message in islice(self._messages({topic}), 1):
            header = getattr(message, "header", None)
            return None if header is None else str(header.frame_id).strip("/")
        return None

    def _info(self, topic: str) -> Info | None:
        """Return the lens of a topic's pictures: of the `camera_info` beside it, or of the same frame."""
        plain = topic.removesuffix("/compressed")
        for name in (f"{plain.rpartition('/')[0]}/camera_info", f"{plain}/camera_info"):
            if name in self._infos:
                return self._infos[name]
        frame = self._frame(topic) if self._infos else None
        same = [info for info in self._infos.values() if info.frame == frame]
        return same[0] if len(same) == 1 else None

    def _place(self, setup: DriveSetup, spec: SizedLens | LaserSpec, topic: str) -> Placed:
        """Return where a sensor is: as the file says, else by the frames, else the usual place of a named sensor."""
        frame = self._frame(topic) if setup.base and "mount" not in spec.model_fields_set else None
        at = self.tree.between(setup.base, frame) if frame and setup.base else None
        if at is not None:
            axes = at[:3, :3] if isinstance(spec, LaserSpec) else camera_axes(at[:3, :3])
            return Placed.of(at[:3, 3], axes)._replace(frame_z=float(at[2, 3]))
        if spec.name in self._unplaced:
            raise self.error(f"/tf does not say where {topic} is on the vehicle; describe it: --calibration")
        return spec.mount.placed()

    def place_lasers(self, setup: DriveSetup, calibration: DriveCalibration) -> None:
        heights = []
        self._base_height = calibration.base_height
        for spec in calibration.lasers:
            placed = self._place(setup, spec, spec.topic)
            if self._types[spec.topic] == CLOUD:
                setup.clouds.add(spec.name)
                if placed.frame_z is not None and self._base_height is None:
                    heights += [z - placed.frame_z for z in self._heights(spec.topic, placed)]
            elif abs(np.cos(placed.roll)) < np.cos(np.radians(20.0)):
                raise self.error(f"{spec.topic}: is rolled by {np.degrees(placed.roll):.0f}°, want 0 or 180")
            setup.lasers[spec.name] = placed
        if self._base_height is None:
            self._base_height = float(np.median(heights)) if heights else self.tree.height(setup.base or "")
        for name, placed in setup.lasers.items():
            setup.lasers[name] = self._raised(placed, setup.topics[f"scan:{name}"])

    def _heights(self, topic: str, placed: Placed) -> list[float]:
        """Return how high above the road the sensor of point clouds is, in the first ones, m."""
        heights = []
        with naming(f"{self._path}: {topic}"):
            for _, _, message in islice(self._messages({topic}), _CLOUDS_FOR_HEIGHT):
                road = fit_road(placed.in_vehicle(points_of(message)))
                heights += [] if road is None else [-road.c]
        return heights

    def _raised(self, placed: Placed, topic: str) -> Placed:
        if placed.frame_z is None:
            return placed
        height = placed.frame_z + (self._base_height or 0.0)
        if height < _LEAST_HEIGHT_M:
            raise self.error(
                f"/tf has {topic} {height:.2f} m above the road; want `base_height` in --calibration"
            )
        m = placed.mount
        return placed._replace(mount=Mount(m.x, m.y, height, m.yaw, m.pitch))

    def add_camera(self, setup: DriveSetup, spec: CameraSpec) -> None:
        key = f"image:{spec.name}:mono"
        picture, turn = self._picture(spec, setup.topics[key], aligned=False)
        placed = self._raised(self._place(setup, spec, setup.topics[key]), setup.topics[key]).turned(turn)
        setup.pictures[key] = picture.levelled(placed.roll)
        setup.cameras.append((spec.name, picture.camera, placed.mount))

    def add_pair(self, setup: DriveSetup, spec: StereoSpec) -> None:
        keys = [f"image:{spec.name}:{side}" for side in ("left", "right")]
        topics = [setup.topics[key] for key in keys]
        left, turn = self._picture(spec, topics[0], aligned=True)
        right, baseline, other = left, spec.baseline, spec.right_camera
        if spec.fx is None:
            right, _ = self._picture(spec, topics[1], aligned=True)
            baseline = baseline or self._baseline(topics)
        elif other is not None:
            own = other.picture(spec.width, spec.height)
            if own is None:
                raise InputError(f"{spec.name}: right_camera.fx is missing")
            turned = np.asarray(other.translation, np.float64)
            left, right, baseline = aligned_pair(left, own, other.matrix, turned)
            turn = left.rotation
        elif any(spec.distortion):
            wanted = "the numbers of its right_camera, too, or rectified pictures"
            raise InputError(f"{spec.name}: has distortion, want {wanted}")
        if baseline is None:
            raise InputError(f"{spec.name}: baseline is missing, want the distance of its cameras, m")
        placed = self._raised(self._place(setup, spec, topics[0]), topics[0]).turned(turn)
        require_level(spec.name, placed.roll, 5.0)
        setup.pictures |= dict(zip(keys, (left, right), strict=True))
        setup.stereo_cameras.append((spec.name, StereoCamera(left.camera, baseline), placed.mount))

    def _picture(self, spec: CameraSpec | StereoSpec, topic: str, aligned: bool) -> tuple[Picture, Any]:
        with naming(spec.name):
            own = spec.picture(spec.width, spec.height)
        if own is not None:
            return own, np.eye(3)
        info = self._info(topic)
        if info is None:
            wanted = f"width, height, fx, fy, cx and cy of {spec.name} in a calibration file (--calibration)"
            raise self.error(f"{topic} has no CameraInfo; want {wanted}")
        with naming(f"{self._path}: {topic}"):
            return info.picture(topic, aligned)

    def _baseline(self, topics: list[str]) -> float | None:
        """Return the distance of two cameras, m: as their projections say, of which the first may be off zero, too."""
        left, right = (self._info(topic) for topic in topics)
        if left is None or right is None:
            return None
        off = [info.projection[0, 3] / info.projection[0, 0] for info in (left, right)]
        at = self.tree.between(left.frame, right.frame)
        between = 0.0 if at is None else float(np.linalg.norm(at[:3, 3]))
        return float(off[0] - off[1]) if off[0] > off[1] else between or None


def _right_of(topic: str) -> list[str]:
    """Return what the right camera of a pair may be called, whose left one has a topic."""
    sides = ("left", "right"), ("infra1", "infra2")
    names = [topic.replace(left, right) for left, right in sides if left in topic]
    for digit in re.finditer(r"(?<!\d)0*[02468](?!\d)", topic):
        number = f"{int(digit[0]) + 1:0{len(digit[0])}d}"
        names.append(f"{topic[: digit.start()]}{number}{topic[digit.end() :]}")
    return names


def _same_view(topic: str, paired: list[str]) -> bool:
    """Whether pictures are the grey or the recorded ones of cameras of the chosen pair, by their names."""
    return any(not _COLOUR.search(topic) and _COLOUR.search(one) for one in paired)
