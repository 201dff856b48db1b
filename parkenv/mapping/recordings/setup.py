"""Topics, lenses and mounts of a recording's sensors: from its calibration file, and from what the recording says."""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from parkenv.compiled.arrays import FloatArray
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
    open_recording,
)
from parkenv.mapping.recordings.calibration import (
    CameraSpec,
    DriveCalibration,
    LaserSpec,
    SizedLens,
    StereoSpec,
)
from parkenv.mapping.recordings.lenses import Info, Picture, Placed, aligned_pair, camera_axes
from parkenv.mapping.recordings.point_clouds import BAND_MIDDLE_M, fit_road, points_of
from parkenv.mapping.recordings.poses import FrameTree
from parkenv.mapping.recordings.sources import Source
from parkenv.mapping.recordings.writer import topics_of
from sim_sensors.camera.models import PinholeCamera, StereoCamera
from sim_sensors.errors import SensorError
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import RIG_NAMES, Mount, SensorRig

_Spec = TypeVar("_Spec", CameraSpec, LaserSpec)
SENSORS = {"image": (COMPRESSED_IMAGE, IMAGE), "scan": (SCAN, CLOUD)}
_LISTED = 12
_NO_PICTURES = re.compile(r"(?i)depth|disparity|mask|label")
_COLOUR = re.compile(r"(?i)colou?r|rgb|image_?0?[23]\b")
_HOW = "choose them by `topic` in a calibration file (--calibration)"
_CLOUDS_FOR_HEIGHT = 5
_LEAST_HEIGHT_M = 0.05
_MOST_ROLL = math.radians(5.0)  # of a stereo pair


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
    named: SensorRig | None = None  # one of `parkenv survey`

    def rig(self, scanners: dict[str, LaserScanner]) -> SensorRig:
        """Return the rig with the scanner of each laser, by name; clouds are scans in the vehicle's axes."""
        if self.named is not None:
            for name, laser, _ in self.named.lasers:
                if scanners[name].n_beams != laser.n_beams:
                    raise InputError(f"{name} has {scanners[name].n_beams} beams, want {laser.n_beams}")
            return self.named
        lasers = []
        for name, (mount, _) in self.lasers.items():
            level = Mount(mount.x, mount.y, BAND_MIDDLE_M) if name in self.clouds else mount
            lasers.append((name, scanners[name], level))
        return SensorRig(tuple(self.cameras), tuple(self.stereo_cameras), tuple(lasers))


def set_up_survey(rig: str, types: dict[str, str]) -> DriveSetup:
    """Return the sensors of a recording of `parkenv survey --record`, which names its rig."""
    if rig not in RIG_NAMES:
        raise InputError(f"names no rig of {', '.join(RIG_NAMES)}")
    named = SensorRig.named(rig)
    topics = topics_of(named)
    _require(topics, types)
    cameras = {f"image:{name}:mono": camera for name, camera, _ in named.cameras}
    for name, pair, _ in named.stereo_cameras:
        cameras |= {f"image:{name}:{side}": pair.camera for side in ("left", "right")}
    pictures = {key: Picture((c.width, c.height), c.matrix, c) for key, c in cameras.items()}
    lasers = {name: Placed(mount, 0.0) for name, _, mount in named.lasers}
    return DriveSetup(topics, pictures, lasers=lasers, named=named)


def set_up(
    path: Path,
    calibration: DriveCalibration | None,
    types: dict[str, str],
    messages: Messages,
    source: Source | None = None,
) -> DriveSetup:
    """Return the sensors; topics, lenses and mounts that the calibration leaves out are those of the recording."""
    source = source or Source(partial(open_recording, path))
    found = _Recording(path, types, messages, source)
    if calibration is None and not found.infos:
        what = "was not made by parkenv survey --record, and has no CameraInfo"
        raise found.error(f"{what}; describe its sensors: --calibration")
    given = calibration or DriveCalibration()
    chosen = found.choose(given)
    topics, base = {}, given.base
    if source.poses is None:
        topics = {"pose": found.pose(given)}
        base = base or found.base_of(topics["pose"])
        imu = given.imu or "".join(found.of(IMU)[:1])
        if imu and types.get(topics["pose"]) == NAV_FIX:
            topics["imu"] = imu
    topics |= {f"scan:{laser.name}": laser.topic for laser in chosen.lasers}
    topics |= {f"image:{camera.name}:mono": camera.topic for camera in chosen.cameras}
    for pair in chosen.stereo_cameras:
        topics |= {f"image:{pair.name}:left": pair.left, f"image:{pair.name}:right": pair.right}
    with naming(path):
        _require(topics, types)
        found.base = found.tree.base(base)
    setup = DriveSetup(topics, tree=found.tree, base=found.base)
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

    def __init__(self, path: Path, types: dict[str, str], messages: Messages, source: Source) -> None:
        self._path, self._types, self._messages = path, types, messages
        self.tree, self.infos = source.tree, dict(source.infos)
        self._unplaced = set[str]()  # names of sensors that no file describes
        self.base: str | None = None  # frame of the vehicle
        self._base_height = 0.0  # m, of it above the road
        for topic in self.of(*TRANSFORMS):
            with naming(f"{path}: {topic}"):
                for _, _, message in messages({topic}):
                    self.tree.add_message(message, static="static" in topic)
        for topic in self.of(CAMERA_INFO):
            if (message := self._first(topic)) is not None:
                with naming(f"{path}: {topic}"):
                    self.infos[topic] = Info.of(message)

    def _first(self, topic: str) -> Any:
        return next((message for _, _, message in self._messages({topic})), None)

    def of(self, *kinds: str) -> list[str]:
        return [topic for topic, kind in sorted(self._types.items()) if kind in kinds]

    def error(self, text: str) -> InputError:
        return InputError(f"{self._path}: {text}")

    def only(self, what: str, topics: list[str]) -> str:
        if not topics:
            raise self.error(f"has no {what}; it has {_listed(self._types)}")
        if len(topics) > 1:
            raise self.error(
                f"has {len(topics)} {what}s, {_listed({topic: self._types[topic] for topic in topics})}; {_HOW}"
            )
        return topics[0]

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
            raise self.error(f"has no poses, want {wanted} or /tf; it has {_listed(self._types)}")
        return self.only("satellite receiver", fixes)

    def base_of(self, pose: str) -> str | None:
        """Return the frame that poses are of, if they say it and transforms have it."""
        message = self._first(pose)
        frame = getattr(message, "child_frame_id", "")
        if hasattr(message, "latitude"):
            frame = message.header.frame_id
        return frame.strip("/") if frame.strip("/") in self.tree else None

    def choose(self, given: DriveCalibration) -> DriveCalibration:
        """Return the calibration with the topics that it leaves out, chosen by type where there is one of a kind."""
        lasers, cameras, pairs = given.lasers, given.cameras, given.stereo_cameras
        if not (cameras or pairs or lasers) and self.of(CLOUD, SCAN):
            lasers = (LaserSpec(name="laser"),)
            self._unplaced.add("laser")
        if not (cameras or pairs):
            if given._file and not self.infos:
                raise InputError(f"{given._file}: has no camera, want cameras or stereo_cameras")
            self._unplaced.add("camera")
            if len(self._pairs()) == 1 and not lasers:
                pairs = (StereoSpec(name="camera"),)
            else:
                cameras = (CameraSpec(name="camera"),)
        left = [left for left, _ in self._pairs()]
        topics = left if len(left) == 1 else self._pictures()
        lasers = tuple(self._with_topic(one, "laser", self.of(CLOUD) or self.of(SCAN)) for one in lasers)
        cameras = tuple(self._with_topic(one, "camera", topics) for one in cameras)
        pairs = tuple(one if one.left and one.right else self._with_pair(one) for one in pairs)
        chosen = {"cameras": cameras, "stereo_cameras": pairs, "lasers": lasers}
        return given.model_copy(update=chosen)

    def _with_topic(self, spec: _Spec, what: str, topics: list[str]) -> _Spec:
        if "topic" in spec.model_fields_set or spec.topic in self._types:
            return spec
        return spec.model_copy(update={"topic": self.only(what, topics)})

    def _with_pair(self, spec: StereoSpec) -> StereoSpec:
        if len(pairs := self._pairs()) != 1:
            raise self.error(f"{spec.name}: want `left` and `right`; it has {_listed(self._types)}")
        return spec.model_copy(update=dict(zip(("left", "right"), pairs[0], strict=True)))

    def _pictures(self) -> list[str]:
        """Return the topics of pictures, one of those of the same pictures."""
        topics = [topic for topic in self.of(*SENSORS["image"]) if not _NO_PICTURES.search(topic)]
        return [topic for topic in topics if topic.removesuffix("/compressed") not in {*topics} - {topic}]

    def _pairs(self) -> list[tuple[str, str]]:
        """Return the topics of stereo pairs: of several, those in colour."""
        topics = self._pictures()
        pairs = [(one, other) for one in topics for other in _right_of(one) if other in topics]
        return [pair for pair in pairs if _COLOUR.search(pair[0])] or pairs

    def _info(self, topic: str) -> Info | None:
        """Return the lens of a topic's pictures: of the `camera_info` beside it."""
        plain = topic.removesuffix("/compressed")
        names = plain, f"{plain.rpartition('/')[0]}/camera_info", f"{plain}/camera_info"
        return next((self.infos[name] for name in names if name in self.infos), None)

    def _at(self, spec: SizedLens | LaserSpec, topic: str) -> FloatArray | None:
        """Return the pose of a sensor's frame in that of the vehicle, (4, 4), if transforms count and say it."""
        if self.base is None or "mount" in spec.model_fields_set:
            return None
        header = getattr(self._first(topic), "header", None)
        return self.tree.between(self.base, header.frame_id.strip("/") if header else topic)

    def _place(self, spec: SizedLens | LaserSpec, topic: str) -> Placed:
        """Return where a sensor is: as the file says, else by the frames, else the usual place of a named sensor."""
        at = self._at(spec, topic)
        if at is None:
            if spec.name in self._unplaced:
                raise self.error(
                    f"/tf does not say where {topic} is on the vehicle; describe it: --calibration"
                )
            return spec.mount.placed()
        x, y, z = at[:3, 3] + (0.0, 0.0, self._base_height)
        if z < _LEAST_HEIGHT_M:
            raise self.error(f"/tf has {topic} {z:.2f} m above the road; want `base_height` in --calibration")
        axes = at[:3, :3] if isinstance(spec, LaserSpec) else camera_axes(at[:3, :3])
        return Placed.of(np.array([x, y, z]), axes)

    def place_lasers(self, setup: DriveSetup, calibration: DriveCalibration) -> None:
        setup.clouds |= {one.name for one in calibration.lasers if self._types[one.topic] == CLOUD}
        if calibration.base_height is not None:
            self._base_height = calibration.base_height
        else:
            clouds = [one for one in calibration.lasers if one.name in setup.clouds]
            heights = [height for one in clouds for height in self._heights(one)]
            self._base_height = float(np.median(heights or [self.tree.height(self.base or "")]))
        for spec in calibration.lasers:
            placed = setup.lasers[spec.name] = self._place(spec, spec.topic)
            if spec.name not in setup.clouds and abs(np.cos(placed.roll)) < np.cos(np.radians(20.0)):
                raise self.error(f"{spec.topic}: is rolled by {np.degrees(placed.roll):.0f}°, want 0 or 180")

    def _heights(self, spec: LaserSpec) -> Iterator[float]:
        """Yield how high above the road the vehicle's frame is, m, in the first clouds of a sensor."""
        at = self._at(spec, spec.topic)
        if at is not None:
            turn = at[:3, :3].T.astype(np.float32)
            with naming(f"{self._path}: {spec.topic}"):
                for _, _, message in islice(self._messages({spec.topic}), _CLOUDS_FOR_HEIGHT):
                    if (road := fit_road(points_of(message) @ turn)) is not None:
                        yield -road.c - float(at[2, 3])

    def add_camera(self, setup: DriveSetup, spec: CameraSpec) -> None:
        picture, turn = self._picture(spec, spec.topic)
        placed = self._place(spec, spec.topic).turned(turn)
        setup.pictures[f"image:{spec.name}:mono"] = picture.levelled(placed.roll)
        setup.cameras.append((spec.name, picture.camera, placed.mount))

    def add_pair(self, setup: DriveSetup, spec: StereoSpec) -> None:
        left, turn = self._picture(spec, spec.left)
        right, baseline, other = left, spec.baseline, spec.right_camera
        if spec.fx is None:
            right, _ = self._picture(spec, spec.right)
            infos = [self._info(topic) for topic in (spec.left, spec.right)]
            off = [info.projection[0, 3] / info.projection[0, 0] for info in infos if info is not None]
            baseline = baseline or (float(off[0] - off[1]) if off[0] > off[1] else None)
        elif other is not None:
            own = other.picture(spec.width, spec.height)
            if own is None:
                raise InputError(f"{spec.name}: right_camera.fx is missing")
            left, right, baseline = aligned_pair(left, own, other.matrix, np.array(other.translation))
            turn = left.rotation
        elif any(spec.distortion):
            wanted = "the numbers of its right_camera, too, or rectified pictures"
            raise InputError(f"{spec.name}: has distortion, want {wanted}")
        if baseline is None:
            raise InputError(f"{spec.name}: baseline is missing, want the distance of its cameras, m")
        placed = self._place(spec, spec.left).turned(turn)
        if abs(placed.roll) > _MOST_ROLL:
            raise InputError(
                f"{spec.name}: mount.roll is {np.degrees(placed.roll):.1f}, want at most 5 degrees"
            )
        setup.pictures |= {f"image:{spec.name}:left": left, f"image:{spec.name}:right": right}
        setup.stereo_cameras.append((spec.name, StereoCamera(left.camera, baseline), placed.mount))

    def _picture(self, spec: CameraSpec | StereoSpec, topic: str) -> tuple[Picture, FloatArray]:
        """Return the pictures of a camera, and by what they are turned as they become those, (3, 3)."""
        with naming(spec.name):
            own = spec.picture(spec.width, spec.height)
        if own is None:
            if (info := self._info(topic)) is None:
                wanted = (
                    f"width, height, fx, fy, cx and cy of {spec.name} in a calibration file (--calibration)"
                )
                raise self.error(f"{topic} has no CameraInfo; want {wanted}")
            own = info.picture(topic)
        return own, own.rotation


def _listed(types: dict[str, str]) -> str:
    return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(types.items())[:_LISTED]) or "nothing"


def _require(topics: dict[str, str], types: dict[str, str]) -> None:
    for key, topic in topics.items():
        kind = key.partition(":")[0]
        kinds = {"pose": (*POSES, NAV_FIX, *TRANSFORMS), "imu": (IMU,)}.get(kind) or SENSORS[kind]
        if types.get(topic) not in kinds:
            wanted = " or ".join(kinds)
            raise InputError(f"has no {kind}s in {topic}, want {wanted}; it has {_listed(types)}")


def _right_of(topic: str) -> list[str]:
    """Return what the right camera of a pair may be called, whose left one has a topic."""
    sides = ("left", "right"), ("infra1", "infra2")
    names = [topic.replace(left, right) for left, right in sides if left in topic]
    for digit in re.finditer(r"(?<!\d)0*[02468](?!\d)", topic):
        number = f"{int(digit[0]) + 1:0{len(digit[0])}d}"
        names.append(f"{topic[: digit.start()]}{number}{topic[digit.end() :]}")
    return names
