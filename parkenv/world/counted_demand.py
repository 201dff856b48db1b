"""Demand with which car parks become as full as counted: arrivals by hour, stays, and cars that are there at first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from parkenv.compiled.arrays import FloatArray
from parkenv.world.arrivals import hours_between
from parkenv.world.durations import LogNormalTime, parked_share, staying_share

STAYS_H = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0, 14.0, 24.0)
"""Mean stays that are tried, h."""
STAY_CV = 1.0
"""Standard deviation of a stay over its mean."""
TOLERANCE = 0.005
"""Share of the places by which the fit may be off in the mean, for a longer stay."""


class FollowedCounts(NamedTuple):
    """Cars with which a car park becomes as full as counted.

    Attributes:
        per_hour: (n_hours,) cars an hour in the hours of the window.
        stay: law of their stays.
        expected: (n_hours,) cars at the ends of the hours.
    """

    per_hour: FloatArray
    stay: LogNormalTime
    expected: FloatArray


def follow_counts(
    at_first: float, cars: FloatArray, start_s: float, end_s: float, stays_h: tuple[float, ...] = STAYS_H
) -> FollowedCounts:
    """Return the arrivals with which the expected number of cars is nearest to the counts, by least squares.

    Counts say how many cars there are, not how often they change, so the stay is not in them. Of the stays that are
    tried the longest is taken with which the counts can be followed, so that the fewest cars come; if there is none,
    the one that is off least.

    Args:
        at_first: mean number of cars at the beginning of the window.
        cars: (n_hours,) mean number of cars at the end of each hour, or part of one, of the window; NaN: not counted.
        start_s: beginning of the window, s of the day.
        end_s: its end.
        stays_h: mean stays to try, h.
    """
    edges = hours_between(start_s, end_s)
    known = np.isfinite(cars)
    found = []
    for hours in sorted(stays_h, reverse=True):
        stay = LogNormalTime(3600.0 * hours, STAY_CV)
        # Those who are there at first leave after the rest of such a stay.
        rest = at_first * staying_share(stay, edges[1:] - edges[0])
        there = parked_share(stay, edges, edges[1:])
        rates, _ = nnls(there[known], (cars - rest)[known])
        expected = rest + there @ rates
        off = float(np.abs(expected - cars)[known].mean())
        found.append((off, FollowedCounts(rates, stay, expected)))
        if off <= TOLERANCE * np.nanmax(cars):
            return found[-1][1]
    return min(found, key=lambda one: one[0])[1]
