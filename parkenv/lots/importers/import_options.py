"""Options of an import."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.lots.local_frame import LocalFrame

NEAR_ON_GLOBE = 1.0
"""Degrees: a pair of numbers this close to the lot's position is a latitude and a longitude, otherwise metres."""


@dataclass(frozen=True)
class ImportOptions:
    """Goals, entries and bounds that complete or replace those of a file.

    Raises:
        InputError: a pair that is not two finite numbers.
    """

    # walking destinations as pairs of numbers: metres east and north in the lot's frame or, for a file with latitudes
    # and longitudes, a latitude and a longitude (any pair within a degree of the lot)
    goals: tuple[tuple[float, float], ...] = ()
    entries: tuple[tuple[float, float], ...] = ()  # places where cars enter, in the same form
    # two corners, in the same form; elements outside are not read
    bounds: tuple[tuple[float, float], tuple[float, float]] | None = None
    guess_entry: bool = False  # whether an entry that the file does not show may be guessed
    guess_goal: bool = False  # the same for goals
    with_disabled: bool = False  # whether slots for disabled drivers count as slots

    def __post_init__(self) -> None:
        for what, points in (("goal", self.goals), ("entry", self.entries), ("bounds", self.bounds or ())):
            for point in points:
                if len(point) != 2 or not np.isfinite(point).all():
                    raise InputError(f"{what} is {point!r}, want two finite numbers")

    def box(self, frame: LocalFrame | None) -> tuple[float, float, float, float] | None:
        """Return the bounds in the lot's frame: least x and y, greatest x and y, m; None without bounds.

        Raises:
            InputError: bounds without an area.
        """
        if self.bounds is None:
            return None
        corners = points_in_frame(frame, self.bounds)
        (x0, y0), (x1, y1) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
        if x1 - x0 < 1.0 or y1 - y0 < 1.0:
            raise InputError(f"bounds are {x1 - x0:.2f} × {y1 - y0:.2f} m, want an area")
        return x0, y0, x1, y1


def points_in_frame(frame: LocalFrame | None, pairs: tuple[tuple[float, float], ...]) -> FloatArray:
    """Convert pairs of numbers to metres, (n, 2), in the lot's frame.

    A pair within a degree of the frame's origin is a latitude and a longitude; any other pair is metres.
    """
    points = np.array(pairs, dtype=np.float64).reshape(-1, 2)
    if frame is None or not len(points):
        return points
    on_globe = np.all(np.abs(points - [frame.lat, frame.lon]) <= NEAR_ON_GLOBE, axis=1, keepdims=True)
    return np.where(on_globe, frame.to_xy(points[:, ::-1]), points)
