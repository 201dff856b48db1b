"""Calibration files of cars: which sensors are where, and in which topics of a recording."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from parkenv.errors import InputError
from parkenv.files.spec_file import Several, Spec
from sim_sensors.camera.models import PinholeCamera, StereoCamera
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import Mount, SensorRig

Metres = Annotated[float, Field(ge=-100.0, le=100.0)]
Degrees = Annotated[float, Field(ge=-360.0, le=360.0)]
FocalLength = Annotated[float, Field(gt=0.0, le=1e6)]
Pixel = Annotated[float, Field(ge=-1e5, le=1e5)]
Size = Annotated[int, Field(ge=16, le=10_000)]
Topic = Annotated[str, Field(min_length=1, max_length=200)]
Name = Annotated[str, Field(min_length=1, max_length=80)]


class MountSpec(Spec):
    """Pose of a sensor on the car; the origin is on the ground below the point that the poses are of."""

    x: Metres = Field(0.0, description="Forward, m.")
    y: Metres = Field(0.0, description="To the left, m.")
    z: float = Field(1.0, gt=0.0, le=20.0, description="Above the ground, m.")
    yaw: Degrees = Field(0.0, description="Counter-clockwise from forward, degrees; -90 looks to the right.")
    pitch: Degrees = Field(0.0, description="Upwards, degrees.")

    def mount(self) -> Mount:
        return Mount(self.x, self.y, self.z, math.radians(self.yaw), math.radians(self.pitch))


class Lens(Spec):
    width: Size
    height: Size
    fx: FocalLength
    fy: FocalLength
    cx: Pixel
    cy: Pixel
    distortion: Several[float] = Field(
        (), max_length=8, description="OpenCV's k1, k2, p1, p2, k3, ...; none for images that are rectified."
    )
    mount: MountSpec = MountSpec()

    def camera(self) -> PinholeCamera:
        return PinholeCamera(self.width, self.height, self.fx, self.fy, self.cx, self.cy)


class CameraSpec(Lens):
    name: Name
    topic: Topic = Field("/pictures", description="Topic of its images; none for photographs and films.")


class StereoSpec(Lens):
    """A rectified stereo camera; mount and numbers are those of the left camera."""

    name: Name
    left: Topic
    right: Topic
    baseline: float = Field(gt=0.0, le=10.0, description="m")


class LaserSpec(Spec):
    """A laser scanner in the plane of the ground, and its topic; its angles are those of its messages."""

    name: Name
    topic: Topic
    mount: MountSpec = MountSpec(z=0.5)


class LotFrame(Spec):
    """Where the origin of the poses is in the lot."""

    x: float = Field(0.0, ge=-1e6, le=1e6)
    y: float = Field(0.0, ge=-1e6, le=1e6)
    yaw: Degrees = 0.0


class DriveCalibration(Spec):
    """A calibration file: sensors, mounts, topics, and the frame of the poses."""

    pose: Topic = Field("/pose", description="PoseStamped, PoseWithCovarianceStamped, Odometry or Pose2D.")
    origin: LotFrame = LotFrame()
    timezone_h: float = Field(0.0, ge=-14.0, le=14.0, description="Local time minus UTC, h.")
    cameras: Several[CameraSpec] = Field((), max_length=16)
    stereo_cameras: Several[StereoSpec] = Field((), max_length=16)
    lasers: Several[LaserSpec] = Field((), max_length=16)

    def rig(self, lasers: dict[str, LaserScanner]) -> SensorRig:
        """Return the rig with the scanner of each laser, by name."""
        if not (self.cameras or self.stereo_cameras):
            raise InputError("has no camera, want cameras or stereo_cameras")
        return SensorRig(
            tuple((c.name, c.camera(), c.mount.mount()) for c in self.cameras),
            tuple(
                (s.name, StereoCamera(s.camera(), s.baseline), s.mount.mount()) for s in self.stereo_cameras
            ),
            tuple((s.name, lasers[s.name], s.mount.mount()) for s in self.lasers),
        )
