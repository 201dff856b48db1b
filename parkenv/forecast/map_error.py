"""What observations say about the error of an occupancy map: a Gaussian process on the logit scale.

On day d, slot i is taken with probability sigmoid(x_i + f_i + g(hour) + L_d + S_d·nearness_i). The map gives x. Its
error f, the same on all days but for a slow drift, is a Gaussian process over slots: a common level, a slope toward the
goal, a part that is smooth in nearness, and a part of each slot's own. Its error g is smooth in the hour of the day, on
weekdays and on weekends. L_d and S_d are the day's own (the day error): all observations of a day share them,
and they are integrated out. From one day to the next, f and g move by an Ornstein-Uhlenbeck step, which forgets them.

How wrong the map is, and how fast that changes, is not known either: several priors are followed at once, weighted by
the probability that each gave to the observations so far (Bayesian model averaging).

A day's observations are added by expectation propagation (Minka 2001; Rasmussen and Williams 2006, §3.6).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.special import expit

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.files.field_types import NotNegative, NumberOrInf, Positive, Validated
from parkenv.forecast.logistic_normal import EVEN

HOURS = 24
N_HOUR_KNOTS = 2 * HOURS  # parts of g: the hours of a weekday, then those of a weekend day
# Length scales of the smooth part, in units of nearness (-1 to 1), and of g, in hours.
SMOOTH_REACH, HOUR_REACH = 0.3, 2.0
NEGLIGIBLE = 1e-6  # priors with less weight are dropped
SWEEPS = 3  # of expectation propagation; further ones change logits by less than 0.01
UPDATES = 32  # of a covariance at once


@dataclass(frozen=True)
class MapErrorPrior(Validated):
    """How wrong a map may be, before any trip: standard deviations, in logits."""

    level: NotNegative  # of the error that all slots share
    slope: NotNegative  # of the rise of the error from the middle of the lot to the goal
    smooth: NotNegative  # of the part that is smooth in nearness
    own: NotNegative  # of each slot's own part
    hour: NotNegative  # of the part that depends on the hour of the day
    # time constant of the drift, in days: after this time, 1/e of the error is left
    memory_days: Annotated[NumberOrInf, Field(gt=0.0)]
    weight: Positive = 1.0  # probability of this prior, relative to the others
    trust: NotNegative = 1.0  # factor of the map's logits; 0 if the map says nothing

    def covariance(self, nearness: FloatArray) -> FloatArray:
        """Covariance of f and g, (n + 48, n + 48), for slots of the given nearness, (n,), -1 to 1."""
        n = len(nearness)
        covariance = np.zeros((n + N_HOUR_KNOTS, n + N_HOUR_KNOTS))
        apart = (nearness[:, None] - nearness) / SMOOTH_REACH
        covariance[:n, :n] = (
            self.level**2
            + self.slope**2 * np.outer(nearness, nearness)
            + self.smooth**2 * np.exp(-0.5 * apart**2)
            + self.own**2 * np.eye(n)
        )
        hours = np.arange(HOURS)
        apart = np.abs(hours[:, None] - hours)
        near = np.exp(-0.5 * (np.minimum(apart, HOURS - apart) / HOUR_REACH) ** 2)
        for kind in range(2):
            part = slice(n + kind * HOURS, n + (kind + 1) * HOURS)
            covariance[part, part] = self.hour**2 * near
        return covariance


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the observations of one day say about k states of slots, each taken or free."""

    slots: IntArray  # (k,) int64
    hours: FloatArray  # (k,) float64, hours since Monday 00:00, when each state was observed
    # (k, 2) float64, probability of its observations if the slot was free, and if it was taken
    likelihood: FloatArray
    # (k,) float64, by how much each counts, 0 to 1; below 1 if an earlier one already says a part of it
    weight: FloatArray


class MapError:
    """The posterior of a map's error.

    Args:
        nearness: (n,) float64, -1 to 1, 1 for the slot nearest to the goal.
        priors: how wrong the map may be.

    Attributes:
        weights: (k,) float64, probability of each prior that is still followed.
        trust: (k,) float64, its factor of the map's logits.

    Examples:
        The map says 50 % for both slots. After slot 0 was taken on ten days, the map is corrected there most.

        >>> error = MapError(np.array([1.0, -1.0]), [MapErrorPrior(0.5, 0.0, 0.0, 1.0, 0.0, 1e3)])
        >>> taken = Evidence(np.array([0]), np.array([9.0]), np.array([[0.0, 1.0]]), np.ones(1))
        >>> for _ in range(10):
        ...     error.observe(taken, np.zeros((1, 1)), (0.5, 0.0))
        >>> mean, _ = error.predict(9.0)
        >>> bool(mean[0, 0] > mean[0, 1] > 0.1)
        True
    """

    def __init__(self, nearness: FloatArray, priors: Sequence[MapErrorPrior]) -> None:
        self._nearness = np.asarray(nearness, np.float64)
        self._priors = np.stack([prior.covariance(self._nearness) for prior in priors])
        self._memory_days = np.array([prior.memory_days for prior in priors])
        self.trust = np.array([prior.trust for prior in priors])
        weights = np.array([prior.weight for prior in priors])
        self._log_weights = np.log(weights / weights.sum())
        self._mean, self._covariance = np.zeros(self._priors.shape[:2]), self._priors.copy()

    @property
    def weights(self) -> FloatArray:
        return np.asarray(np.exp(self._log_weights))

    def prior_sd(self) -> FloatArray:
        n = len(self._nearness)
        variance = np.diagonal(self._priors, axis1=1, axis2=2)
        return np.asarray(np.sqrt(variance[:, :n] + variance[:, n, None]))

    def pass_days(self, days: float) -> None:
        kept = np.exp(-days / self._memory_days)
        self._mean *= kept[:, None]
        gone = kept[:, None, None] ** 2
        self._covariance = gone * self._covariance + (1.0 - gone) * self._priors

    def observe(self, evidence: Evidence, logits: FloatArray, day_error: tuple[float, float]) -> None:
        """Add the observations of one day, with the map's logits x for them, (n_priors, k).

        `day_error` are the standard deviations of level and slope of the day, logits.
        """
        if not len(evidence.slots):
            return
        parts = [(evidence.slots, np.ones(len(evidence.slots))), *self._knots(evidence.hours)]
        with_all = _summed(self._covariance[:, :, at] * part for at, part in parts)
        nearness = self._nearness[evidence.slots]
        among = _summed(with_all[:, at] * part[:, None] for at, part in parts)
        among += day_error[0] ** 2 + day_error[1] ** 2 * np.outer(nearness, nearness)
        mean = logits + _summed(self._mean[:, at] * part for at, part in parts)
        precision, location, log_evidence = _approximate(mean, among, evidence)
        # Condition on the approximate observations: their noise has the variance 1/precision.
        root = np.sqrt(precision)
        scaled = root[:, :, None] * among * root[:, None, :] + np.eye(len(nearness))
        surprise = location - precision * mean
        explained = np.einsum("kij,kj->ki", among, surprise)
        rest = np.linalg.solve(scaled, (root * explained)[:, :, None])[:, :, 0]
        self._mean += np.einsum("kdi,ki->kd", with_all, surprise - root * rest)
        half = np.linalg.solve(np.linalg.cholesky(scaled), root[:, :, None] * with_all.transpose(0, 2, 1))
        self._covariance -= half.transpose(0, 2, 1) @ half
        weights = self._log_weights + log_evidence
        weights -= weights.max()
        kept = np.exp(weights) >= NEGLIGIBLE * np.exp(weights).sum()
        self._log_weights = weights[kept] - np.log(np.exp(weights[kept]).sum())
        if not kept.all():
            for name in ("_priors", "_memory_days", "trust", "_mean", "_covariance"):
                setattr(self, name, getattr(self, name)[kept])

    def predict(self, hour: float) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance of each slot's error, (n_priors, n) each, at hours since Monday 00:00."""
        n, knots = len(self._nearness), self._knots(np.array([hour]))
        mean = self._mean[:, :n] + _summed(self._mean[:, at] * part for at, part in knots)
        with_hour = _summed(self._covariance[:, :, at[0]] * part for at, part in knots)
        of_hour = _summed(with_hour[:, at] * part for at, part in knots)
        variance = np.diagonal(self._covariance, axis1=1, axis2=2)[:, :n] + 2.0 * with_hour[:, :n] + of_hour
        return mean, variance

    def common_sd(self, hour: float) -> tuple[FloatArray, FloatArray]:
        """Return how uncertain level and slope of all slots together are, (n_priors,) each, logits."""
        n = len(self._nearness)
        level, slope = np.zeros((2, n + N_HOUR_KNOTS))
        level[:n] = 1.0 / n
        for at, part in self._knots(np.array([hour])):
            level[at] += part
        slope[:n] = self._nearness / max(float(self._nearness @ self._nearness), 1e-12)
        both = [np.sqrt(np.einsum("kd,d->k", self._covariance @ a, a)) for a in (level, slope)]
        return both[0], both[1]

    def _knots(self, hours: FloatArray) -> list[tuple[IntArray, FloatArray]]:
        """Return the two parts of g between which each of the hours, (k,), lies, and their shares, (k,) each."""
        first = len(self._nearness) + HOURS * (np.floor(hours / HOURS) % 7 >= 5)
        # Knots are in the middle of their hours.
        clock = (hours - 0.5) % HOURS
        before, part = np.floor(clock), clock % 1.0
        after = (before + 1.0) % HOURS
        return [((first + before).astype(np.int64), 1.0 - part), ((first + after).astype(np.int64), part)]


def _summed(parts: Iterable[FloatArray]) -> FloatArray:
    return reduce(np.add, parts)


def _approximate(
    mean: FloatArray, covariance: FloatArray, evidence: Evidence
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Approximate likelihoods of k states by Gaussian ones, by expectation propagation, for p priors.

    `mean`, (p, k), and `covariance`, (p, k, k), are of the logits. Return (p, k) precisions, (p, k) precision times
    location, and (p,) log evidence (of the first sweep, in which each observation is predicted from those before it).
    """
    mean, covariance = mean.copy(), covariance.copy()
    precision, location = np.zeros_like(mean), np.zeros_like(mean)
    log_evidence = np.zeros(len(mean))
    # The last updates of the covariance, each column·column'·factor, which it does not hold yet: a matrix product of
    # many is much faster than one by one.
    columns, factors, pending = np.empty((*mean.shape, UPDATES)), np.empty((len(mean), UPDATES)), 0
    for sweep in range(SWEEPS):
        for i, ((if_free, if_taken), weight) in enumerate(
            zip(evidence.likelihood, evidence.weight, strict=True)
        ):
            if pending == UPDATES:
                covariance -= (columns * factors[:, None, :]) @ columns.transpose(0, 2, 1)
                pending = 0
            late, by = columns[:, :, :pending], factors[:, :pending]
            column = covariance[:, :, i] - (late @ (late[:, i] * by)[:, :, None])[:, :, 0]
            variance = column[:, i]
            # The distribution without this observation.
            without = 1.0 / np.maximum(1.0 / variance - precision[:, i], 1e-9)
            center = without * (mean[:, i] / variance - location[:, i])
            points = center[:, None] + np.sqrt(without)[:, None] * EVEN.nodes
            p = expit(points)
            density = (if_taken * p + if_free * (1.0 - p)) ** weight * EVEN.weights
            total = np.maximum(density.sum(axis=1), 1e-300)
            if sweep == 0:
                log_evidence += np.log(total)
            new_mean = (density * points).sum(axis=1) / total
            new_variance = (density * (points - new_mean[:, None]) ** 2).sum(axis=1) / total
            # Errors of a sensor could widen the distribution; an observation never makes the map less certain.
            narrower = np.clip(new_variance, 1e-9, without * (1.0 - 1e-9))
            change = (1.0 / narrower - 1.0 / without) - precision[:, i]
            shift = new_mean / narrower - center / without - location[:, i]
            scale = 1.0 + change * variance
            mean += column * ((shift - change * mean[:, i]) / scale)[:, None]
            columns[:, :, pending], factors[:, pending] = column, change / scale
            pending += 1
            precision[:, i] += change
            location[:, i] += shift
    return precision, location, log_evidence
