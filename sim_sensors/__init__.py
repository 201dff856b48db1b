"""Simulated sensors of a car: cameras, stereo cameras and laser scanners in scenes of parametric vehicles.

The package contains geometry and light, but nothing about parking. Each name is loaded on first use: importing
`sim_sensors.laser` does not load the cameras.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim_sensors.errors import SensorError
    from sim_sensors.ground_truth import vehicle_boxes
    from sim_sensors.rig import Capture, Mount, SensorRig
    from sim_sensors.scene import Scene
    from sim_sensors.slot_scenes import SlotLot
    from sim_sensors.surroundings import Surroundings

_MODULES = {
    "Capture": "rig",
    "Mount": "rig",
    "Scene": "scene",
    "SensorError": "errors",
    "SensorRig": "rig",
    "SlotLot": "slot_scenes",
    "Surroundings": "surroundings",
    "vehicle_boxes": "ground_truth",
}

__all__ = [
    "Capture",
    "Mount",
    "Scene",
    "SensorError",
    "SensorRig",
    "SlotLot",
    "Surroundings",
    "vehicle_boxes",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
