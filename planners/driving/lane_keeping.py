"""Lane keeping: paths of straights and arcs along a line, driven without stopping."""

from __future__ import annotations

import math

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.vehicle import VehicleParameters
from planners.driving.car_path import CarPath
from planners.driving.path_tracking import PathTracker, TrackingSettings

_STRAIGHT = 1e-5  # rad


class LaneKeeper(PathTracker):
    """Follow a path on a lane, starting at the current speed.

    Args:
        vehicle: the car.
        path: the path.
        settings: settings of the tracking.
        aside: maximum lateral acceleration, m/s²; the car slows down in turns accordingly.
    """

    def __init__(
        self,
        vehicle: VehicleParameters,
        path: CarPath,
        settings: TrackingSettings | None = None,
        aside: float = 1.8,
    ) -> None:
        super().__init__(vehicle, path, settings)
        self._set_off = True
        most = 1.5 * self._settings.acceleration
        for segment in self._segments:
            bend = np.maximum(np.abs(segment.curvature), 1e-6)
            pace = np.minimum(segment.pace, np.sqrt(aside / bend))
            step = np.diff(segment.station)
            for i in range(len(pace) - 2, -1, -1):
                pace[i] = min(pace[i], math.sqrt(pace[i + 1] ** 2 + 2.0 * most * step[i]))
            segment.pace[:] = pace


def rounded(points: FloatArray, radius: float) -> CarPath:
    """Make a path along a polyline with rounded corners.

    Args:
        points: (k, 2) m, two or more, in the order driven.
        radius: radius of the arcs, m; smaller where legs are short: an arc uses at most half of each adjacent leg.
    """
    step = np.diff(points, axis=0)
    leg = np.hypot(step[:, 0], step[:, 1])
    step, leg = step[leg > 1e-9], leg[leg > 1e-9]
    yaw = np.arctan2(step[:, 1], step[:, 0])
    lengths, curvatures = [], []
    taken = 0.0
    for i in range(len(leg)):
        turn = math.remainder(float(yaw[i + 1] - yaw[i]), 2.0 * math.pi) if i + 1 < len(leg) else 0.0
        cut = 0.0
        if abs(turn) > _STRAIGHT:
            cut = min(radius * math.tan(0.5 * abs(turn)), 0.5 * leg[i], 0.5 * leg[i + 1])
        lengths.append(float(leg[i]) - taken - cut)
        curvatures.append(0.0)
        if cut > 0.0:
            arc = cut / math.tan(0.5 * abs(turn))
            lengths.append(arc * abs(turn))
            curvatures.append(math.copysign(1.0 / arc, turn))
        taken = cut
    start = np.array([*points[0], yaw[0]])
    return CarPath(start, np.array(lengths), np.array(curvatures))


def joined(first: CarPath, second: CarPath) -> CarPath:
    """Concatenate two paths; the second starts where the first ends."""
    return CarPath(
        first.start,
        np.r_[first.length, second.length],
        np.r_[first.curvature, second.curvature],
        first.expansions + second.expansions,
        min(first.margin, second.margin),
    )
