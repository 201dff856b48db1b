"""Public holidays, learned: dates on which car parks were as on a Sunday a year before.

A date of the year is known by day and month; Easter and the feasts that move with it by their distance from Easter. So
no calendar of a country or a state is needed, but the first year of a record knows of no holidays.
"""

from __future__ import annotations

from collections.abc import Hashable
from datetime import date
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

_MOVING = (-2, 1, 39, 50, 60)  # Good Friday, Easter Monday, Ascension, Whit Monday, Corpus Christi
_RARE = 0.005  # share of holidays among days of which nothing is known
_OWN = 2.5  # most that the one observation of a car park itself counts, logits
_CLEAR = 6.0  # logits from which on a day is taken for a Sunday when models learn from it


def key_of(day: date) -> Hashable:
    """Return what identifies a date in every year.

    >>> key_of(date(2024, 5, 9)) == key_of(date(2023, 5, 18)), key_of(date(2024, 10, 3))
    (True, (10, 3))
    """
    after_easter = (day - _easter(day.year)).days
    return after_easter if after_easter in _MOVING else (day.month, day.day)


def _easter(year: int) -> date:
    """Return Easter Sunday of a year of the Gregorian calendar.

    The algorithm of J. Meeus, Astronomical Algorithms, 1991, chapter 8.

    >>> _easter(2024)
    datetime.date(2024, 3, 31)
    """
    golden, (century, rest) = year % 19, divmod(year, 100)
    epact = (19 * golden + century - century // 4 - (century - (century + 8) // 25 + 1) // 3 + 15) % 30
    weekday = (32 + 2 * (century % 4) + 2 * (rest // 4) - epact - rest % 4) % 7
    late = (golden + 11 * epact + 22 * weekday) // 451
    month, day = divmod(epact + weekday - 7 * late + 114, 31)
    return date(year, month, day + 1)


class SpecialDays:
    """What earlier years say of the dates of the year, for several car parks.

    Args:
        n: number of car parks.
    """

    def __init__(self, n: int) -> None:
        self._n = n
        self._known: dict[Hashable, tuple[NDArray[np.float64], float]] = {}

    def expected(self, day: date) -> NDArray[np.bool_]:
        """Return the car parks (n,) that are expected to be as on a Sunday."""
        evidence, share = self._known.get(key_of(day), (np.zeros(self._n), _RARE))
        return np.asarray(logit(share) + np.clip(evidence, -_OWN, _OWN) > 0)

    def observe(
        self, day: date, evidence: NDArray[np.float64], observed: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Take in a day, and return the car parks (n,) where it clearly was as a Sunday.

        Args:
            day: its date.
            evidence: (n,) log-likelihood of the day as a Sunday minus that as its own weekday.
            observed: (n,) whether enough was observed of it.
        """
        alike: Any = expit(logit(_RARE) + evidence)[observed]
        share = float((alike.sum() + 2 * _RARE) / (alike.size + 2))
        evidence = np.where(observed, evidence, 0.0)
        if observed.any() and day.weekday() < 5:  # a Saturday may look like a Sunday anyway
            self._known[key_of(day)] = (evidence, share)
        return np.asarray(logit(share) + evidence > _CLEAR)
