"""Sensor rigs: the sensors on a car, their poses, and their joint measurements."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.compiled.arrays import FloatArray
from sim_sensors.camera.models import Drawable, Frame, PinholeCamera, StereoCamera, StereoFrame, camera_pose
from sim_sensors.camera.weather import Weather
from sim_sensors.errors import SensorError, require_numbers
from sim_sensors.laser.footprints import ScanPlane
from sim_sensors.laser.scanner import LaserScanner

RIGHT, LEFT = -math.pi / 2, math.pi / 2
EYE_M = 1.3  # m, height of the rigs' cameras
# The rigs' camera: wide enough to see parked cars completely from 1.5 m in front of them.
WIDE = PinholeCamera.from_field_of_view(horizontal=math.pi / 2)


class Sensed(Drawable, Protocol):
    """A scene that a rig can measure: geometry for cameras, and a scan plane for lasers."""

    @property
    def scan_plane(self) -> ScanPlane:
        """Footprints and walls at knee height."""


RIG_NAMES = ("laser", "stereo", "both_sides", "camera")  # names of rigs for `SensorRig.named`


@dataclass(frozen=True)
class Mount:
    """The pose of a sensor on the vehicle: x forward, y left, z up, origin on the ground below the vehicle's centre.

    Args:
        x, y, z: m, position.
        yaw: rad, direction of the sensor, counter-clockwise from forward.
        pitch: rad, positive upwards.

    Raises:
        SensorError: a number is not finite, or the sensor is on or below the ground.
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 1.0
    yaw: float = 0.0
    pitch: float = 0.0

    def __post_init__(self) -> None:
        require_numbers(self, "x y yaw pitch")
        require_numbers(self, "z", above=0.0)

    def in_world(self, vehicle: FloatArray) -> tuple[float, float, float]:
        """Return the sensor's x, y in m and yaw in rad in the world frame, for a vehicle at (3,) x, y, yaw."""
        x, y, yaw = vehicle
        cosine, sine = math.cos(yaw), math.sin(yaw)
        return x + cosine * self.x - sine * self.y, y + sine * self.x + cosine * self.y, yaw + self.yaw

    def tilted(self, roll: float, pitch: float) -> Mount:
        """Return the mount above the road of a vehicle that rolls to the right and pitches upwards, rad.

        Examples:
            >>> Mount(yaw=RIGHT).tilted(roll=0.02, pitch=0.01).pitch
            -0.02
        """
        if not roll and not pitch:
            return self
        return replace(self, pitch=self.pitch + pitch * math.cos(self.yaw) + roll * math.sin(self.yaw))

    def camera_pose(self, vehicle: FloatArray) -> FloatArray:
        """Return the camera-to-world matrix, (4, 4), of a camera at this mount, for a vehicle at (3,) x, y, yaw."""
        x, y, yaw = self.in_world(vehicle)
        return camera_pose(x, y, self.z, yaw, self.pitch)


@dataclass(frozen=True)
class Capture:
    """Measurements of a rig at one pose.

    Attributes:
        pose: (3,) float64, x, y in m and yaw in rad of the vehicle, world frame.
        images: frame of each camera by name; a frame also contains the true depth and instance ids.
        pairs: frames of each stereo camera by name.
        scans: ranges of each laser by name, (n_beams,) float32, m, `inf` for no return, NaN where
            it is not known.
        moved: for lasers that measured at another moment than the cameras: (3,) x, y, yaw of the vehicle then, in its
            frame when the pictures were taken.
        again: lasers whose scan another capture, nearer in time, has too.
        tops: for lasers of several layers: (n_beams,) float32, m, height above the ground of the highest return of what
            each beam meets; NaN where it is not known.
        tilt: roll (to the right) and pitch (upwards) of the vehicle against the road, rad.
    """

    pose: FloatArray
    images: dict[str, Frame]
    pairs: dict[str, StereoFrame]
    scans: dict[str, NDArray[np.float32]]
    moved: dict[str, FloatArray] = field(default_factory=dict)
    again: frozenset[str] = frozenset()
    tops: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    tilt: tuple[float, float] = (0.0, 0.0)

    def vehicle_at(self, laser: str, vehicle: FloatArray) -> FloatArray:
        """Return the pose of the vehicle when a laser measured, (3,), for its pose when the pictures were taken."""
        if laser not in self.moved:
            return vehicle
        x, y, yaw = self.moved[laser].tolist()
        return np.array(Mount(x, y, yaw=yaw).in_world(vehicle))


class TimedCapture(NamedTuple):
    """Measurements of a rig at one moment."""

    time: float  # s since Monday 00:00
    capture: Capture  # images, stereo pairs and laser scans, with the true pose of the vehicle


@dataclass(frozen=True)
class SensorRig:
    """The sensors of a car and their poses.

    Args:
        cameras: name, camera and mount of each; the optical axis is the mount's forward direction.
        stereo_cameras: the same for stereo cameras; the mount is that of the left camera.
        lasers: the same for laser scanners; angle 0 is the mount's forward direction.

    Raises:
        SensorError: there is no sensor, or a name is used twice.

    Examples:
        >>> rig = SensorRig.thesis()
        >>> [name for name, _, _ in rig.cameras], [name for name, _, _ in rig.lasers]
        (['right'], ['laser'])
    """

    cameras: tuple[tuple[str, PinholeCamera, Mount], ...] = ()
    stereo_cameras: tuple[tuple[str, StereoCamera, Mount], ...] = ()
    lasers: tuple[tuple[str, LaserScanner, Mount], ...] = ()

    def __post_init__(self) -> None:
        names = [name for name, _, _ in (*self.cameras, *self.stereo_cameras, *self.lasers)]
        if not names:
            raise SensorError("the rig has no sensor, want at least one camera, stereo camera or laser")
        for name in names:
            if names.count(name) > 1:
                raise SensorError(f"sensor name {name!r} is used twice, want different names")

    @classmethod
    def named(cls, name: str) -> SensorRig:
        """Return one of the rigs in `RIG_NAMES`: `laser` is `thesis()`; the others are methods of the same name.

        Raises:
            SensorError: an unknown name.
        """
        if name not in RIG_NAMES:
            raise SensorError(f"rig is {name!r}, want one of {', '.join(RIG_NAMES)}")
        return {
            "laser": cls.thesis, "stereo": cls.stereo, "both_sides": cls.both_sides, "camera": cls.camera,
        }[name]()  # fmt: skip

    @classmethod
    def thesis(cls) -> SensorRig:
        """Return the thesis's rig (T §4.1, Fig. 4.3): a camera to the right above a 270° laser, on one axis."""
        return cls(
            cameras=(("right", WIDE, Mount(z=EYE_M, yaw=RIGHT)),),
            lasers=(("laser", LaserScanner(), Mount(z=0.5)),),
        )

    @classmethod
    def stereo(cls) -> SensorRig:
        """Return a rig with a stereo camera to the right and no laser."""
        return cls(stereo_cameras=(("right", StereoCamera(WIDE), Mount(z=EYE_M, yaw=RIGHT)),))

    @classmethod
    def camera(cls) -> SensorRig:
        """Return a rig with a camera to the right, and nothing that measures distances."""
        return cls(cameras=cls.thesis().cameras)

    @classmethod
    def both_sides(cls) -> SensorRig:
        """Return the thesis's rig with a second camera, to the left."""
        return cls(
            cameras=(("right", WIDE, Mount(z=EYE_M, yaw=RIGHT)), ("left", WIDE, Mount(z=EYE_M, yaw=LEFT))),
            lasers=(("laser", LaserScanner(), Mount(z=0.5)),),
        )

    def mirrored(self) -> SensorRig:
        """Return the rig for a car that keeps to the left: what was on its right is on its left."""

        def across(sensors: Any) -> Any:
            other = {"right": "left", "left": "right"}
            return tuple((other.get(n, n), s, replace(m, y=-m.y, yaw=-m.yaw)) for n, s, m in sensors)

        return SensorRig(across(self.cameras), across(self.stereo_cameras), across(self.lasers))

    def resized(self, width: int) -> SensorRig:
        """Return the rig with pictures of another width, px: smaller ones are drawn and looked at faster.

        Raises:
            SensorError: a width below 1.

        Examples:
            >>> SensorRig.thesis().resized(512).cameras[0][1].height
            384
        """
        stereo = tuple(
            (name, replace(pair, camera=pair.camera.resized(width)), mount)
            for name, pair, mount in self.stereo_cameras
        )
        cameras = tuple((name, camera.resized(width), mount) for name, camera, mount in self.cameras)
        return replace(self, cameras=cameras, stereo_cameras=stereo)

    def only_lasers(self) -> SensorRig:
        """Return the rig without its cameras, whose images take nearly all of a capture's time.

        Raises:
            SensorError: it has no laser.
        """
        if not self.lasers:
            raise SensorError("the rig has no laser, want at least one")
        return SensorRig(lasers=self.lasers)

    def capture(
        self, scene: Sensed, pose: ArrayLike, weather: Weather | None = None, seed: int = 0
    ) -> Capture:
        """Measure with every sensor at one pose; equal arguments give equal results.

        Args:
            scene: the surroundings, without the vehicle that carries the rig.
            pose: (3,) x, y in m and yaw in rad of the vehicle, world frame.
            weather: the light; None: a sunny day.
            seed: seed of the noise of all sensors.

        Raises:
            SensorError: the pose is not three finite numbers, or a sensor raised an error.
        """
        vehicle = np.asarray(pose, dtype=np.float64)
        if vehicle.shape != (3,) or not np.isfinite(vehicle).all():
            raise SensorError(f"vehicle pose is {vehicle.tolist()}, want finite x, y and yaw")
        images, pairs, scans = {}, {}, {}
        for i, (name, camera, mount) in enumerate(self.cameras):
            images[name] = camera.render(scene, mount.camera_pose(vehicle), weather, _seed_of(seed, 0, i))
        for i, (name, stereo, mount) in enumerate(self.stereo_cameras):
            eye = mount.camera_pose(vehicle)
            pairs[name] = stereo.render_stereo(scene, eye, weather, _seed_of(seed, 1, i))
        for i, (name, laser, mount) in enumerate(self.lasers):
            rng = np.random.default_rng([seed, 2, i])
            scans[name] = laser.scan(scene.scan_plane, mount.in_world(vehicle), rng)
        return Capture(vehicle, images, pairs, scans)

    def prepare(self, scene: Sensed, pose: FloatArray, weather: Weather | None = None) -> None:
        """Draw what captures near a pose share: sky, shadows, scan plane. Captures in several threads then read it."""
        for _, camera, mount in self.cameras:
            camera.prepare(scene, mount.camera_pose(pose), weather)
        for _, stereo, mount in self.stereo_cameras:
            eye = mount.camera_pose(pose)
            for side in (eye, stereo.right_pose(eye)):
                stereo.camera.prepare(scene, side, weather)
        if self.lasers:
            _ = scene.scan_plane


def poses_along(path: ArrayLike, every: float) -> FloatArray:
    """Return vehicle poses at equal distances along a polyline, including both ends, with headings along it.

    Args:
        path: (k, 2) m, at least two different points.
        every: m, distance between poses; the last step may be shorter.

    Returns:
        (n, 3) float64, x, y, yaw.
    """
    points = np.asarray(path, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2 or not np.isfinite(points).all():
        raise SensorError(f"path has shape {points.shape}, want (at least 2, 2) finite numbers")
    if not (math.isfinite(every) and every > 0.0):
        raise SensorError(f"every is {every} m, want a finite distance above 0")
    step = np.diff(points, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    points = points[np.r_[True, length > 0.0]]
    step, length = step[length > 0.0], length[length > 0.0]
    if not len(length):
        raise SensorError("path has no length, want two different points")
    station = np.r_[0.0, np.cumsum(length)]
    at = np.arange(0.0, station[-1], every)
    # A last step much shorter than the others is a rounding error.
    at = np.r_[at[at < station[-1] - 1e-6 * every], station[-1]]
    leg = np.clip(np.searchsorted(station, at, side="right") - 1, 0, len(length) - 1)
    xy = points[leg] + ((at - station[leg]) / length[leg])[:, None] * step[leg]
    return np.column_stack([xy, np.arctan2(step[leg, 1], step[leg, 0])])


def _seed_of(*words: int) -> int:
    return int(np.random.SeedSequence(words).generate_state(1)[0])
