"""A capture of a sensor rig and its time."""

from __future__ import annotations

from typing import NamedTuple

from sim_sensors.rig import Capture


class TimedCapture(NamedTuple):
    """Measurements of a rig at one moment."""

    time: float  # s since Monday 00:00
    capture: Capture  # images, stereo pairs and laser scans, with the true pose of the vehicle
