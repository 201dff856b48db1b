"""Calibration files of cars: which sensors are where, and in which topics of a recording."""

import math
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, naming
from parkenv.files.spec_file import Several, Spec
from parkenv.mapping.recordings.lenses import Picture, Placed
from sim_sensors.camera.models import PinholeCamera
from sim_sensors.rig import Mount

Metres = Annotated[float, Field(ge=-100.0, le=100.0)]
Degrees = Annotated[float, Field(ge=-360.0, le=360.0)]
FocalLength = Annotated[float, Field(gt=0.0, le=1e6)]
Pixel = Annotated[float, Field(ge=-1e5, le=1e5)]
Size = Annotated[int, Field(ge=16, le=10_000)]
Topic = Annotated[str, Field(min_length=1, max_length=200)]
Text = Annotated[str, Field(max_length=200)]
Name = Annotated[str, Field(min_length=1, max_length=80)]


class MountSpec(Spec):
    """Pose of a sensor on the car; the origin is on the ground below the point that the poses are of."""

    x: Metres = Field(0.0, description="Forward, m.")
    y: Metres = Field(0.0, description="To the left, m.")
    z: float = Field(1.0, gt=0.0, le=20.0, description="Above the ground, m.")
    yaw: Degrees = Field(0.0, description="Counter-clockwise from forward, degrees; -90 looks to the right.")
    pitch: Degrees = Field(0.0, description="Upwards, degrees.")
    roll: Degrees = Field(0.0, description="To the right, degrees; pictures are turned level.")

    def placed(self) -> Placed:
        yaw, pitch, roll = (math.radians(angle) for angle in (self.yaw, self.pitch, self.roll))
        return Placed(Mount(self.x, self.y, self.z, yaw, pitch), roll)


class Lens(Spec):
    """The numbers of a camera; None where a `CameraInfo` of the recording has them."""

    fx: FocalLength | None = None
    fy: FocalLength | None = None
    cx: Pixel | None = None
    cy: Pixel | None = None
    distortion: Several[float] = Field(
        (), max_length=8, description="OpenCV's k1, k2, p1, p2, k3, ...; none for images that are rectified."
    )
    fisheye: bool = Field(False, description="Whether `distortion` is of OpenCV's fisheye model, k1 to k4.")

    def picture(self, width: int | None, height: int | None) -> Picture | None:
        """Return the pictures of this lens; None if it has no numbers."""
        numbers = {"width": width, "height": height}
        numbers |= {name: getattr(self, name) for name in ("fx", "fy", "cx", "cy")}
        if all(value is None for value in numbers.values()):
            return None
        if missing := [name for name, value in numbers.items() if value is None]:
            raise InputError(f"{missing[0]} is missing, want width, height, fx, fy, cx and cy")
        camera = PinholeCamera(**numbers)  # type: ignore[arg-type]
        return Picture((camera.width, camera.height), camera.matrix, camera, self.distortion, self.fisheye)


class SizedLens(Lens):
    name: Name
    width: Size | None = None
    height: Size | None = None
    mount: MountSpec = MountSpec()


class CameraSpec(SizedLens):
    topic: Topic = Field("/pictures", description="Topic of its images; none for photographs and films.")


class RightCamera(Lens):
    """The right camera of a pair that is not rectified, as `cv2.stereoCalibrate` measures it."""

    rotation: Several[float] = Field(
        (0.0, 0.0, 0.0), min_length=3, max_length=9,
        description="OpenCV's R, nine numbers by rows, or three of a rotation vector, rad.",
    )  # fmt: skip
    translation: Several[float] = Field(
        min_length=3, max_length=3, description="OpenCV's T, m: x is below 0."
    )

    @property
    def matrix(self) -> FloatArray:
        try:
            is_vector, numbers = len(self.rotation) == 3, np.array(self.rotation)
            turn = Rotation.from_rotvec(numbers) if is_vector else Rotation.from_matrix(numbers.reshape(3, 3))
        except ValueError as error:
            raise InputError(
                f"right_camera.rotation is {self.rotation}, want a rotation of 3 or 9 numbers"
            ) from error
        return np.asarray(turn.as_matrix())


class StereoSpec(SizedLens):
    """A stereo camera; mount and numbers are those of the left camera."""

    left: Text = ""
    right: Text = ""
    baseline: float | None = Field(None, gt=0.0, le=10.0, description="m, of rectified pictures.")
    right_camera: RightCamera | None = Field(None, description="Of pictures that are not rectified.")


class LaserSpec(Spec):
    """A laser scanner in the plane of the ground, or one of point clouds, and its topic."""

    name: Name
    topic: Text = ""
    mount: MountSpec = MountSpec(z=0.5)


class LotFrame(Spec):
    """Where the origin of the poses is in the lot."""

    x: float = Field(0.0, ge=-1e6, le=1e6)
    y: float = Field(0.0, ge=-1e6, le=1e6)
    yaw: Degrees = 0.0


class DriveCalibration(Spec):
    """A calibration file: sensors, mounts, topics, and the frame of the poses."""

    pose: Topic = Field("/pose", description="Topic of the poses: Odometry, NavSatFix, ..., or /tf.")
    imu: Topic | None = Field(None, description="Imu that gives a NavSatFix its heading.")
    base: Name | None = Field(None, description="Frame of the poses in /tf.")
    base_height: Metres | None = Field(None, description="Height of that frame above the road, m.")
    origin: LotFrame = LotFrame()
    timezone_h: float = Field(0.0, ge=-14.0, le=14.0, description="Local time minus UTC, h.")
    cameras: Several[CameraSpec] = Field((), max_length=16)
    stereo_cameras: Several[StereoSpec] = Field((), max_length=16)
    lasers: Several[LaserSpec] = Field((), max_length=16)

    def only_camera(self) -> tuple[PinholeCamera, Mount]:
        """Return the camera, or the left one of a stereo pair, and its place on the car."""
        lenses = (*self.cameras, *self.stereo_cameras)
        with naming(self._file or "calibration"):
            if len(lenses) != 1:
                raise InputError(f"has {len(lenses)} cameras, want the one that took the pictures")
            picture = lenses[0].picture(lenses[0].width, lenses[0].height)
            if picture is None:
                raise InputError("its camera has no numbers, want width, height, fx, fy, cx and cy")
        return picture.camera, lenses[0].mount.placed().mount
