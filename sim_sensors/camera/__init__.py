"""Pinhole and stereo cameras: projection, rasterizer, shading, weather, image sensor."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim_sensors.camera.image_sensor import ImageSensor
    from sim_sensors.camera.models import Frame, PinholeCamera, StereoCamera, StereoFrame, camera_pose
    from sim_sensors.camera.weather import Weather

_MODULES = {
    "Frame": "models",
    "ImageSensor": "image_sensor",
    "PinholeCamera": "models",
    "StereoCamera": "models",
    "StereoFrame": "models",
    "Weather": "weather",
    "camera_pose": "models",
}

__all__ = ["Frame", "ImageSensor", "PinholeCamera", "StereoCamera", "StereoFrame", "Weather", "camera_pose"]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
