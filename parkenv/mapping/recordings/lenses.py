"""Lenses of a recording's cameras: what makes pictures free of distortion, level and, in pairs, aligned by rows."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from parkenv.compiled.arrays import Float32Array, FloatArray
from parkenv.errors import InputError
from sim_sensors.camera.models import PinholeCamera
from sim_sensors.rig import Mount

# From the axes of a picture (right, down, ahead) to those of a vehicle (ahead, left, up).
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_LEVEL = 1e-6  # rad
_OFF_CENTRE = 0.1  # of the picture's size; the principal point of pictures that are not rectified is nearer
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt")


@dataclass(frozen=True, eq=False)
class Picture:
    """Pictures as they are recorded, and the camera that they become one of.

    `rotation`, (3, 3), turns directions of the recorded picture into those of `camera`.
    """

    size: tuple[int, int]  # px, width and height
    matrix: FloatArray  # (3, 3)
    camera: PinholeCamera
    distortion: tuple[float, ...] = ()
    fisheye: bool = False
    rotation: FloatArray = field(default_factory=lambda: np.eye(3))

    @property
    def coefficients(self) -> FloatArray:
        """The distortion, with zeros to the most numbers that OpenCV takes."""
        return np.pad(np.array(self.distortion, np.float64), (0, 14 - len(self.distortion)))

    @cached_property
    def _maps(self) -> tuple[NDArray[Any], NDArray[Any]] | None:
        new = self.camera
        same = self.size == (new.width, new.height) and np.array_equal(self.matrix, new.matrix)
        if same and not any(self.distortion) and np.array_equal(self.rotation, np.eye(3)):
            return None
        size, d = (new.width, new.height), self.coefficients
        if self.fisheye:
            return cv2.fisheye.initUndistortRectifyMap(
                self.matrix, d[:4], self.rotation, new.matrix, size, cv2.CV_16SC2
            )
        maps = cv2.initUndistortRectifyMap(self.matrix, d, self.rotation, new.matrix, size, cv2.CV_16SC2)
        return maps[0], maps[1]

    def rectified(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), dtype=np.uint8)

    def levelled(self, roll: float) -> Picture:
        """Return these for a camera whose right side is lower, by `roll` rad: its pictures are turned level."""
        if abs(roll) < _LEVEL:
            return self
        return replace(self, rotation=Rotation.from_euler("z", roll).as_matrix() @ self.rotation)


class Info(NamedTuple):
    """What a `CameraInfo` says."""

    size: tuple[int, int]
    matrix: FloatArray  # (3, 3)
    distortion: tuple[float, ...]
    fisheye: bool
    rotation: FloatArray  # (3, 3), of the rectification
    projection: FloatArray  # (3, 4), of rectified pictures
    rectified_size: tuple[int, int]

    @classmethod
    def of(cls, message: Any) -> Info:
        k, d, r, p = (
            np.array(getattr(message, n) if hasattr(message, n) else getattr(message, n.upper()), np.float64)
            for n in "kdrp"
        )
        size = int(message.width), int(message.height)
        sizes_fit = (k.size, r.size, p.size) == (9, 9, 12) and d.size <= 14
        if not (sizes_fit and np.isfinite(np.concatenate([k, d, r, p])).all()):
            raise InputError("has numbers that are missing or not finite, want k, d, r and p")
        if not (min(size) > 0 and k[0] > 0.0 and k[4] > 0.0):
            raise InputError(f"has the size {size} and focal lengths {k[0]:g}, {k[4]:g}, want them above 0")
        p = p.reshape(3, 4) if p[0] > 0.0 else np.column_stack([k.reshape(3, 3), np.zeros(3)])
        r = r.reshape(3, 3) if r.any() else np.eye(3)
        is_fisheye = getattr(message, "distortion_model", "") in _FISHEYE
        return cls(size, k.reshape(3, 3), tuple(d.tolist()), is_fisheye, r, p, size)

    def picture(self, topic: str) -> Picture:
        """Return what makes pictures of a topic those of a camera: rectified, unless its name or numbers say they are.

        `kitti2bag` calls rectified pictures raw, but the principal points tell.
        """
        camera = PinholeCamera(*self.rectified_size, *_numbers(self.projection))
        off = [np.abs(m[:2, 2] / self.size - 0.5).max() for m in (self.matrix, self.projection)]
        if re.search(r"(?i)(?:\b|_)rect", topic) or off[0] > _OFF_CENTRE > off[1]:
            return Picture(self.size, camera.matrix, camera)
        return Picture(self.size, self.matrix, camera, self.distortion, self.fisheye, self.rotation)


def aligned_pair(
    left: Picture, right: Picture, rotation: FloatArray, translation: FloatArray
) -> tuple[Picture, Picture, float]:
    """Align the rows of two cameras (Bouguet's method, by OpenCV), and return the baseline, m.

    `rotation`, (3, 3), and `translation`, (3,) m, take points from the left camera to the right one.
    """
    if left.fisheye or right.fisheye:
        raise InputError("has fisheye lenses, want pictures that are rectified")
    r1, r2, p1, p2, *_ = cv2.stereoRectify(
        left.matrix, left.coefficients, right.matrix, right.coefficients, left.size,
        rotation, translation.reshape(3, 1),
        flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )  # fmt: skip
    baseline = -float(p2[0, 3]) / float(p2[0, 0])
    if not baseline > 0.0:
        raise InputError(
            f"right_camera is at {translation.tolist()} m, want it right of the left one: x below 0"
        )
    camera = PinholeCamera(*left.size, *_numbers(p1))
    one, two = (replace(old, camera=camera, rotation=turn) for old, turn in ((left, r1), (right, r2)))
    return one, two, baseline


def _numbers(matrix: FloatArray) -> tuple[float, float, float, float]:
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


class Placed(NamedTuple):
    """Where a sensor is on the vehicle: its mount, and its roll, rad, positive if its right side is lower."""

    mount: Mount
    roll: float

    @classmethod
    def of(cls, position: FloatArray, axes: FloatArray) -> Placed:
        """Return the pose of a sensor; `axes`, (3, 3), are its own (ahead, left, up) in the vehicle's, in columns."""
        yaw, down, roll = Rotation.from_matrix(axes).as_euler("ZYX").tolist()
        x, y, z = position.tolist()
        return cls(Mount(x, y, z, yaw, -down), roll)

    @property
    def axes(self) -> FloatArray:
        turn = Rotation.from_euler("ZYX", [self.mount.yaw, -self.mount.pitch, self.roll])
        return np.asarray(turn.as_matrix())

    def turned(self, rotation: FloatArray) -> Placed:
        """Return the pose of the camera after its pictures were turned by `rotation`, (3, 3)."""
        if np.array_equal(rotation, np.eye(3)):
            return self
        place = np.array([self.mount.x, self.mount.y, self.mount.z])
        return Placed.of(place, self.axes @ OPTICAL @ rotation.T @ OPTICAL.T)

    def in_vehicle(self, points: Float32Array) -> Float32Array:
        """Turn points, (n, 3) m, of the sensor's frame into the axes of the vehicle; the origin stays the sensor."""
        return np.asarray(points @ self.axes.astype(np.float32).T)


def camera_axes(axes: FloatArray) -> FloatArray:
    """Return a camera's axes (ahead, left, up) from those of its frame, in columns: optical, or else the body's.

    Of the two, which REP 103 allows, it is the one whose picture stands upright.
    """
    optical = axes @ OPTICAL.T
    return optical if abs(optical[2, 2]) >= abs(axes[2, 2]) else axes
