"""Parametric vehicles: bodies, cabins, parts."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim_sensors.vehicles.vehicle import VehicleModel

_MODULES = {"VehicleModel": "vehicle"}

__all__ = ["VehicleModel"]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
