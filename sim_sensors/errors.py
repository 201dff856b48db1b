"""Errors of the simulated sensors."""


class SensorError(ValueError):
    """An invalid scene, sensor or pose."""
