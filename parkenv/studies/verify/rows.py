"""Rows of a verification: what theory expects, what was found, and whether they agree."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

CONFIDENCE = 0.9999
"""Confidence of the interval that decides.

At 95 %, two of forty right rows would fail by chance. At this level, forty independent rows of a right program all
agree with probability 0.996.
"""
ROUNDING = 1e-9
"""Relative difference that rounding may make, where nothing is drawn at random."""


@dataclass(frozen=True)
class Row:
    """A statement of theory and what was found.

    Attributes:
        case: what is compared, with its parameters.
        expected: what theory says.
        found: what the package does; a mean where it is simulated.
        found_ci95: 95 % interval of `found`; both ends equal it if nothing is drawn at random.
        interval: interval of `found` at the level `CONFIDENCE`, widened by `tolerance`: it decides.
        tolerance: difference that is allowed besides.
        source: where the statement comes from.
    """

    case: str
    expected: float
    found: float
    found_ci95: tuple[float, float]
    interval: tuple[float, float]
    tolerance: float
    source: str

    @property
    def agrees(self) -> bool:
        """Whether what theory expects is in the interval."""
        low, high = self.interval
        return bool(low <= self.expected <= high)

    @property
    def exact(self) -> bool:
        """Whether nothing is drawn at random and no difference is allowed."""
        return self.found_ci95[0] == self.found_ci95[1] and self.tolerance == 0.0

    def columns(self) -> dict[str, Any]:
        """Return the row of `summary.json`."""
        columns = asdict(self) | {"agrees": self.agrees}
        del columns["tolerance"]
        return columns


Task = Callable[[], list[Row]]
"""Makes some rows, in any process."""


def certain_row(case: str, expected: float, found: float, source: str, tolerance: float = 0.0) -> Row:
    """Return the row of a case without chance."""
    allowed = max(tolerance, ROUNDING * abs(expected))
    found = float(found)
    interval = (found - allowed, found + allowed)
    return Row(case, float(expected), found, (found, found), interval, tolerance, source)


def mean_row(case: str, expected: float, samples: ArrayLike, source: str) -> Row:
    """Return the row of a simulated case from independent samples, (n,) numbers, n >= 2, of the expected mean.

    Intervals are Student's t; rows use means of hundreds of numbers, or of runs that are means themselves.
    """
    values = np.asarray(samples, dtype=np.float64)
    mean, error = float(values.mean()), float(values.std(ddof=1)) / math.sqrt(len(values))
    ends = []
    for confidence in (0.95, CONFIDENCE):
        half = float(stats.t.ppf(0.5 + confidence / 2.0, len(values) - 1)) * error
        ends.append((mean - half, mean + half))
    return Row(case, float(expected), mean, ends[0], ends[1], 0.0, source)


def disagreeing(rows: Sequence[Row]) -> list[Row]:
    """Return the rows where theory is outside of the interval."""
    return [row for row in rows if not row.agrees]
