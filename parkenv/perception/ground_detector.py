"""A detector for a calibrated camera: cars stand on the ground, neither in the sky nor on the own bonnet."""

import math

import numpy as np

from parkenv.compiled.arrays import Image
from parkenv.errors import InputError
from parkenv.perception.detector import Detections, Detector, GroundBand, detect_in
from parkenv.perception.ranging import CAR_HEIGHT, MARGIN, OFF_GROUND
from sim_sensors.camera.models import PinholeCamera
from sim_sensors.rig import Mount

_BONNET_M = 2.0  # m ahead of the camera, up to which there is the own car
_ROOF_M = 1.2  # m above the ground, that the roofs of cars reach


def ground_band(camera: PinholeCamera, mount: Mount) -> GroundBand:
    """Return where the boxes of cars on the ground are in a camera's pictures."""
    horizon = camera.cy + camera.fy * math.tan(mount.pitch)
    return GroundBand.of(horizon, mount.z, OFF_GROUND, CAR_HEIGHT, CAR_HEIGHT[0] + OFF_GROUND)


class GroundDetector:
    """Reports only boxes of cars on level ground ahead of the own bonnet.

    Args:
        detector: what finds the boxes; one that can look only there does so.
        camera, mount: the calibrated camera, and its place on the car.
    """

    def __init__(self, detector: Detector, camera: PinholeCamera, mount: Mount) -> None:
        self._detector, self._camera, self._mount = detector, camera, mount

    def detect(self, image: Image) -> Detections:
        camera, band = self._camera, ground_band(self._camera, self._mount)
        if image.shape[:2] != (camera.height, camera.width):
            size = f"{image.shape[1]}×{image.shape[0]}"
            raise InputError(f"a picture is {size} px, want {camera.width}×{camera.height} as calibrated")
        found = detect_in(self._detector, image, band)
        _, top, _, bottom = found.boxes.T.astype(np.float64)
        height, below = bottom - top, bottom - band.horizon
        is_cut = bottom >= (1.0 - MARGIN) * camera.height
        on_ground = (below >= band.least * height) & ((below <= band.most * height) | is_cut)
        # The roof of a car is above this row, whatever stands lower and nearer is the own car's.
        bonnet = band.horizon + camera.fy * max(self._mount.z - _ROOF_M, 0.0) / _BONNET_M
        return found.select(on_ground & (top <= bonnet))
