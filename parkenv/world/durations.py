"""Laws of durations, such as stays and patience, and what follows from them for the cars that are parked."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.special import ndtri

from parkenv.compiled.arrays import FloatArray
from parkenv.files.field_types import NumberOrInf, Numbers, Positive, Validated
from parkenv.world.week import HOUR_S

QUANTILES = 400  # number of equally probable stays that stand for their law


class Duration(ABC):
    """A law of durations, s, with the mean `mean_s`."""

    mean_s: float

    @abstractmethod
    def quantile(self, u: FloatArray) -> FloatArray:
        """Return the durations, (k,) s, that are exceeded with probability 1 - u, for u in (0, 1)."""


@dataclass(frozen=True)
class ConstantTime(Validated, Duration):
    """Always the same duration.

    Args:
        seconds: s, above 0; infinite: for ever.
    """

    seconds: Annotated[NumberOrInf, Field(gt=0.0)]

    @property
    def mean_s(self) -> float:  # type: ignore[override]
        """Mean, s."""
        return self.seconds

    def quantile(self, u: FloatArray) -> FloatArray:
        return np.full(len(u), float(self.seconds))


@dataclass(frozen=True)
class ExponentialTime(Validated, Duration):
    """Exponentially distributed durations.

    Args:
        mean_s: s, above 0 and finite.
    """

    mean_s: Positive

    def quantile(self, u: FloatArray) -> FloatArray:
        return -self.mean_s * np.log1p(-u)


@dataclass(frozen=True)
class LogNormalTime(Validated, Duration):
    """Log-normally distributed durations.

    Args:
        mean_s: s, above 0 and finite.
        cv: coefficient of variation, standard deviation over mean, above 0.
    """

    mean_s: Positive
    cv: Positive = 1.0

    def quantile(self, u: FloatArray) -> FloatArray:
        variance = math.log1p(self.cv**2)
        return np.asarray(self.mean_s * np.exp(math.sqrt(variance) * ndtri(u) - variance / 2))


@dataclass(frozen=True)
class EmpiricalTime(Validated, Duration):
    """Durations drawn from a list, all with equal probability.

    Args:
        values_s: s, at least one, all above 0 and finite.
    """

    values_s: Numbers[Positive]

    @property
    def mean_s(self) -> float:  # type: ignore[override]
        """Mean, s."""
        return float(np.mean(self.values_s))

    def quantile(self, u: FloatArray) -> FloatArray:
        values = np.sort(self.values_s)
        return np.asarray(values[(u * len(values)).astype(np.int64)])


def parked_share(stay: Duration, edges: FloatArray, times: FloatArray) -> FloatArray:
    """Return the expected cars at k times, (k, m), if one car an hour arrives from one edge, (m + 1,), to the next.

    The share that arrived at u and stays at t is P(stay > t - u); its integral over u is the mean of min(stay, t - u).
    """
    since = np.maximum(times[:, None] - edges, 0.0)
    stayed = np.minimum(_equally_likely(stay), since[:, :, None]).mean(axis=2)
    return np.asarray(-np.diff(stayed, axis=1) / HOUR_S)


def staying_share(stay: Duration, since_s: FloatArray) -> FloatArray:
    """Return which share of the cars that are met parked is still there after k times, (k,); see `rest_of_stay`."""
    stays = _equally_likely(stay)
    return np.asarray(1.0 - np.minimum(stays, since_s[:, None]).mean(axis=1) / stays.mean())


def _equally_likely(stay: Duration) -> FloatArray:
    return stay.quantile((np.arange(QUANTILES) + 0.5) / QUANTILES)


def rest_of_stay(stay: Duration, u: FloatArray) -> FloatArray:
    """Return what is left of the stays of cars that are met parked, (k,) s, for uniform u in (0, 1).

    Long stays are met more often, and each at a uniform moment: the law of the excess of a renewal process.
    """
    if not math.isfinite(stay.mean_s):
        return np.full(len(u), math.inf)
    stays = _equally_likely(stay)
    until = np.cumsum(stays) / stays.sum()
    met = np.minimum(np.searchsorted(until, u, side="right"), QUANTILES - 1)
    return np.asarray((until[met] - u) * stays.sum())
