"""Occupancy forecast of every slot of a lot from recorded days of one class, weekdays or weekends.

In period t of day d, slot i is taken with the log-odds

    profile(t) + weekday_k(t) + drift(d) + level_d(t) + habit_i(t),

all of them Gaussian a priori, hence pooled partially: a smooth profile of the class of day, a smooth deviation of the
weekday k, a drift over the days (Ornstein-Uhlenbeck process), the day's own level, correlated over its hours, and the
slot's habit, which differs between parts of the day and so between a full and an emptier lot. Levels and habits are
fitted alternately: the levels by Laplace's approximation with the habits' uncertainty integrated out, their
hyperparameters by marginal likelihood; the habits by Newton steps, their covariance by expectation maximisation. A
slot changes rarely, so its states in successive periods say less than as many independent ones: all information is
divided by the dispersion of the residuals' sums over a part of the day (quasi-likelihood: McCullagh and Nelder,
"Generalized Linear Models", 1989, chapter 9).

The priors of the hyperparameters are weak. That of the level's standard deviation has the median 0.8 and holds 80 %
between 0.6 and 1.2. For comparison: whole days differ from the mean of the last four same weekdays by 0.77 in the
median of 99 car parks with published counts of two years, by 0.5 to 1.07 in the middle 80 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.forecast.logistic_normal import NormalQuadrature

MAX_DAYS = 60  # days to fit a forecast to, those nearest in time: others say little more

_HOURS, _WEEKDAYS = 24.0, 7
# Hyperparameters: standard deviations of the day's level, of the part that is the same at all hours and of the rest,
# logits; length over which the rest is correlated, h; standard deviations of a weekday's deviation and of the drift;
# length of the drift, days. Medians, and standard deviations of their logarithms.
_MEDIAN = np.log([0.55, 0.55, 3.0, 0.2, 0.3, 28.0])
_SPREAD = np.array([0.4, 0.4, 0.4, 0.5, 0.5, 0.5])
_PROFILE_SD, _PROFILE_CURVE_SD, _PROFILE_LENGTH = 3.0, 3.0, 3.0  # logits, logits, h
_WEEKDAY_PART, _HABIT_PART = 3.0, 1.5  # distances of the knots of linear interpolation, h
# Habits before any data: standard deviation, logits; share that is the same all day; length of the rest, h; and how
# many slots this prior counts for.
_HABIT_SD, _HABIT_CONSTANT, _HABIT_LENGTH, _HABIT_PRIOR_SLOTS = 1.5, 0.2, 2.0, 10.0
_DISPERSION, _DISPERSION_PRIOR = 3.0, 10.0  # before any data, and its weight as a sum of variances p(1 - p)
_ROUNDS, _LEVEL_STEPS, _HABIT_STEPS, _TUNING_STEPS, _CORRECTION_STEPS = 5, 4, 3, 8, 8
_MAX_STEP, _MAX_LEVEL = 2.0, 12.0  # logits
_JITTER = 1e-6
_PSEUDO_DAYS = 0.1
"""Days, half of them with the slot taken, that count beside the fitted ones.

Slots differ from the model in more ways than their habits: without these days, a forecast from few days is too certain
of single slots. On the 15 days of CNRPark-EXT, each forecast from two, three, five or all days before it, 0.1 has the
least log-loss (compared with 0, 0.02, 0.05, 0.2, 0.5, 1 and 2), or with five and more within 0.0004 of that of 0.2.
"""


class Days(NamedTuple):
    number: IntArray  # days since a fixed date
    weekday: IntArray  # 0 to 6


class SlotDays(NamedTuple):
    """Observations of m slots in the p periods of d days of one class."""

    days: Days
    taken: FloatArray  # (m, d, p) fraction of the observed part of the period in which the slot was taken
    seen: FloatArray  # (m, d, p) observed fraction of the period, 0 to 1


class SlotForecast(NamedTuple):
    p_taken: FloatArray  # (k, m, p) P(taken), the mean over what each day may be like
    # (p, k, k) covariance of the errors of the days' levels, logits²: what the days share is the fitted mean's error
    level_covariance: FloatArray
    curve_covariance: FloatArray  # (k, p, p) covariance of the error of each day's level over its periods


_COARSE, _FINE = NormalQuadrature.gauss_hermite(5), NormalQuadrature.gauss_hermite(15)


class _Solution(NamedTuple):
    """Posterior of the curves, given the working responses of a Laplace approximation."""

    evidence: float
    mean: FloatArray  # of the coefficients: profile, weekdays, drift
    precision: FloatArray
    level: FloatArray  # (d, t) log-odds of the days, without habits


@dataclass(frozen=True, eq=False)
class FittedSlotDays:
    days: Days
    periods: tuple[int, int, int]  # first and last observed period of a day, and their number
    response: FloatArray  # (d, t) working response of the levels
    information: FloatArray  # (d, t) its precision
    hyperparameters: FloatArray  # (6,) logarithms, as `_MEDIAN`
    correction: FloatArray  # (t,) logits, added to all slots
    habits: FloatArray  # (m, k) coefficients of the slots
    habit_covariance: FloatArray  # (m, k, k) of their errors
    dispersion: FloatArray  # (t,) of the states of a slot on a day

    @property
    def level_sd(self) -> float:
        return float(np.hypot(*np.exp(self.hyperparameters[:2])))

    def forecast(self, days: Days) -> SlotForecast:
        """Forecast days that were not fitted; periods in which no day was observed get the nearest one's forecast."""
        first, last, n = self.periods
        curves = _Curves.of(self.periods, self.days, days)
        solution, _ = curves.solve(self.hyperparameters, self.response, self.information)
        design = curves.design(days)
        shared = np.linalg.inv(solution.precision)
        covariance = np.einsum("jta,ab,ktb->tjk", design, shared, design, optimize=True)
        each = np.arange(len(days.number))
        day = curves.day_covariance(self.hyperparameters)
        covariance[:, each, each] += np.diag(day)[:, None]
        curve = design @ shared @ design.transpose(0, 2, 1) + day
        parts = _parts(self.periods, _HABIT_PART)
        mean = (design @ solution.mean + self.correction)[:, None] + self.habits @ parts.T
        variance = covariance[:, each, each].T[:, None] + _variance(parts, self.habit_covariance)
        at = np.clip(np.arange(n), first, last) - first
        p = _with_pseudo_days(_FINE.expit(mean, np.sqrt(variance))[0], len(self.days.number))
        return SlotForecast(p[:, :, at], covariance[at], curve[:, at][:, :, at])


def fit_slot_days(data: SlotDays) -> FittedSlotDays:
    observed = np.flatnonzero(data.seen.sum(axis=(0, 1)))
    periods = int(observed[0]), int(observed[-1]), data.seen.shape[2]
    window = slice(periods[0], periods[1] + 1)
    seen = data.seen[:, :, window]
    taken = data.taken[:, :, window] * seen
    curves, parts = _Curves.of(periods, data.days), _parts(periods, _HABIT_PART)
    m, k = len(taken), parts.shape[1]
    lag = _HABIT_PART * np.abs(np.subtract.outer(np.arange(k), np.arange(k)))
    prior = _HABIT_SD**2 * (_HABIT_CONSTANT + (1 - _HABIT_CONSTANT) * np.exp(-lag / _HABIT_LENGTH))
    pooled, habits = prior, np.zeros((m, k))
    covariance = np.tile(prior, (m, 1, 1))
    dispersion = np.full(parts.shape[0], _DISPERSION)
    hyper = _MEDIAN
    level = np.full(taken.shape[1:], np.log((taken.sum() + 1) / ((seen - taken).sum() + 1)))
    for round_ in range(_ROUNDS):
        offset, sd = (habits @ parts.T)[:, None], np.sqrt(_variance(parts, covariance))[:, None]
        for step in range(_LEVEL_STEPS * (2 if round_ == 0 else 1)):
            p, slope = _COARSE.expit(level + offset, sd)
            information = (seen * slope).sum(axis=0) / dispersion
            score = (taken - seen * p).sum(axis=0) / dispersion
            response = level + score / np.maximum(information, _JITTER)
            if step == (_LEVEL_STEPS if round_ == 0 else 0):
                hyper = curves.tune(hyper, response, information)
            change = curves.solve(hyper, response, information)[0].level - level
            level = np.clip(level + np.clip(change, -_MAX_STEP, _MAX_STEP), -_MAX_LEVEL, _MAX_LEVEL)
        precision = np.linalg.inv(pooled)
        for _ in range(_HABIT_STEPS):
            p = expit(level + (habits @ parts.T)[:, None])
            slope = (seen * p * (1 - p)).sum(axis=1) / dispersion
            curvature = np.einsum("it,ta,tb->iab", slope, parts, parts, optimize=True) + precision
            score = (taken - seen * p).sum(axis=1) / dispersion @ parts - habits @ precision
            change = np.linalg.solve(curvature, score[..., None])[..., 0]
            size = np.abs(change).max(axis=1, keepdims=True)
            habits += change * np.minimum(1.0, _MAX_STEP / np.maximum(size, _JITTER))
        covariance = np.linalg.inv(curvature)
        pooled = (habits.T @ habits + covariance.sum(axis=0) + _HABIT_PRIOR_SLOTS * prior) / (
            m + _HABIT_PRIOR_SLOTS
        )
        p, slope = _COARSE.expit(
            level + (habits @ parts.T)[:, None], np.sqrt(_variance(parts, covariance))[:, None]
        )
        sums = (((taken - seen * p) @ parts) ** 2).sum(axis=(0, 1))
        expected = (seen * slope).sum(axis=(0, 1)) @ parts**2
        weight = _DISPERSION_PRIOR
        dispersion = parts @ np.maximum((sums + weight * _DISPERSION) / (expected + weight), 1.0)
    # The mean over days of what is forecast is that of what was observed: Laplace's approximation shrinks the rare
    # state, and the variance of the level is that of all hours.
    solution, _ = curves.solve(hyper, response, information)
    mean = curves.design(data.days) @ solution.mean + (habits @ parts.T)[:, None]
    sd = np.sqrt(np.diag(curves.day_covariance(hyper)) + _variance(parts, covariance))[:, None]
    correction = np.zeros(len(parts))
    for _ in range(_CORRECTION_STEPS):
        p, slope = _COARSE.expit(mean + correction, sd)
        score = (taken - seen * _with_pseudo_days(p, len(data.days.number))).sum(axis=(0, 1))
        correction += np.clip(score / (1.0 + (seen * slope).sum(axis=(0, 1))), -1.0, 1.0)
    return FittedSlotDays(
        data.days, periods, response, information, hyper, correction, habits, covariance, dispersion
    )


def _parts(periods: tuple[int, int, int], part: float) -> FloatArray:
    first, last, n = periods
    knots = np.linspace(first, last, 1 + max(1, round((last - first) * _HOURS / n / part)))
    return np.stack([np.interp(np.arange(first, last + 1), knots, row) for row in np.eye(len(knots))], axis=1)


def _variance(parts: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ta,iab,tb->it", parts, covariance, parts, optimize=True))


def _log_determinant(positive: FloatArray) -> float:
    return 2.0 * float(np.log(np.diagonal(np.linalg.cholesky(positive), axis1=-2, axis2=-1)).sum())


@dataclass(frozen=True, eq=False)
class _Curves:
    """The Gaussian model of the days' log-odds without habits."""

    days: Days
    hours: FloatArray  # (t,)
    parts: FloatArray  # (t, k) basis of the weekdays' deviations
    numbers: IntArray  # different days, ascending: those of the drift

    @cached_property
    def _own_design(self) -> FloatArray:
        return self.design(self.days)

    @cached_property
    def _lag(self) -> FloatArray:
        return np.asarray(np.subtract.outer(self.hours, self.hours))

    @cached_property
    def _days_apart(self) -> FloatArray:
        return np.abs(np.subtract.outer(self.numbers, self.numbers)).astype(float)

    @cached_property
    def _profile(self) -> tuple[FloatArray, float]:
        lag = np.sqrt(3.0) * np.abs(self._lag) / _PROFILE_LENGTH
        covariance = _PROFILE_SD**2 + _PROFILE_CURVE_SD**2 * (1 + lag) * np.exp(-lag)
        covariance += _JITTER * np.eye(len(lag))
        return np.linalg.inv(covariance), _log_determinant(covariance)

    @classmethod
    def of(cls, periods: tuple[int, int, int], days: Days, forecast: Days | None = None) -> _Curves:
        first, last, n = periods
        numbers = days.number if forecast is None else np.append(days.number, forecast.number)
        hours = np.arange(last + 1 - first) * _HOURS / n
        return cls(days, hours, _parts(periods, _WEEKDAY_PART), np.unique(numbers))

    def design(self, days: Days) -> FloatArray:
        d, (t, k) = len(days.number), self.parts.shape
        weekdays = np.zeros((d, t, _WEEKDAYS, k))
        weekdays[np.arange(d), :, days.weekday] = self.parts
        drift = np.repeat((days.number[:, None] == self.numbers)[:, None].astype(float), t, axis=1)
        return np.concatenate([np.tile(np.eye(t), (d, 1, 1)), weekdays.reshape(d, t, -1), drift], axis=2)

    def day_covariance(self, hyper: FloatArray) -> FloatArray:
        constant_sd, curve_sd, _ = np.exp(hyper[:3])
        return np.asarray(constant_sd**2 + curve_sd**2 * self._day_curve(hyper))

    def _day_curve(self, hyper: FloatArray) -> FloatArray:
        curve = np.exp(-0.5 * (self._lag / np.exp(hyper[2])) ** 2)
        return np.asarray(curve + _JITTER * np.eye(len(curve)))

    def solve(
        self, hyper: FloatArray, response: FloatArray, information: FloatArray
    ) -> tuple[_Solution, FloatArray]:
        """Solve for the coefficients with the days' own levels integrated out (Henderson's equations).

        Returns also the gradient of the evidence by the hyperparameters, (6,).
        """
        t, (_, k), n = len(self.hours), self.parts.shape, len(self.numbers)
        day, root = self.day_covariance(hyper), np.sqrt(information)
        inner = np.eye(t) + root[:, :, None] * day * root[:, None]
        weight = root[:, :, None] * np.linalg.inv(inner) * root[:, None]  # (d, t, t)
        design = self._own_design
        weighted = weight @ design
        flat, size = weighted.reshape(-1, design.shape[2]), design.shape[2]
        precision = design.reshape(-1, size).T @ flat
        # Priors of the profile, of the weekdays and of the drift.
        weekday_sd, drift_sd, drift_days = np.exp(hyper[3:])
        correlation = np.exp(-self._days_apart / drift_days)
        drift = drift_sd**2 * correlation + _JITTER * np.eye(n)
        inverse = np.zeros((size, size))
        inverse[:t, :t], log_prior = self._profile
        weekdays = slice(t, size - n)
        inverse[weekdays, weekdays] = np.eye(_WEEKDAYS * k) / weekday_sd**2
        inverse[-n:, -n:] = np.linalg.inv(drift)
        log_prior += 2.0 * _WEEKDAYS * k * float(hyper[3]) + _log_determinant(drift)
        precision += inverse
        right = response.ravel() @ flat
        covariance = np.linalg.inv(precision)
        mean = covariance @ right
        fit = design @ mean
        # Of the residuals, weighted: response - fit, less what the days' own levels explain.
        score = (weight @ (response - fit)[:, :, None])[:, :, 0]
        explained = float((response * score).sum())
        evidence = -0.5 * (explained + _log_determinant(inner) + _log_determinant(precision) + log_prior)
        solution = _Solution(evidence, mean, precision, fit + score @ day)

        # With V the covariance of the responses: d evidence = (s dV s - tr(V⁻¹ dV)) / 2, where s is the score.
        surplus = (
            score.T @ score
            - weight.sum(axis=0)
            + (flat @ covariance).reshape(weighted.shape).transpose(1, 0, 2).reshape(t, -1)
            @ weighted.transpose(1, 0, 2).reshape(t, -1).T
        )
        constant_sd, curve_sd, length = np.exp(hyper[:3])
        curve = self._day_curve(hyper)
        of_length = curve_sd**2 * curve * (self._lag / length) ** 2
        pull = inverse @ mean
        prior = np.outer(pull, pull) - inverse + inverse @ covariance @ inverse
        of_drift = prior[-n:, -n:] * drift_sd**2 * correlation
        gradient = np.array(
            [
                constant_sd**2 * surplus.sum(),
                curve_sd**2 * (surplus * curve).sum(),
                0.5 * (surplus * of_length).sum(),
                weekday_sd**2 * np.trace(prior[weekdays, weekdays]),
                of_drift.sum(),
                0.5 * (of_drift * self._days_apart).sum() / drift_days,
            ]
        )
        return solution, gradient

    def tune(self, start: FloatArray, response: FloatArray, information: FloatArray) -> FloatArray:
        def loss(hyper: FloatArray) -> tuple[float, FloatArray]:
            off = (hyper - _MEDIAN) / _SPREAD
            solution, gradient = self.solve(hyper, response, information)
            return 0.5 * float(off @ off) - solution.evidence, off / _SPREAD - gradient

        bounds = list(zip(_MEDIAN - 3 * _SPREAD, _MEDIAN + 3 * _SPREAD, strict=True))
        optimum = minimize(
            loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": _TUNING_STEPS}
        )
        return np.asarray(optimum.x, float)


def _with_pseudo_days(p_taken: FloatArray, n_days: int) -> FloatArray:
    return np.asarray((n_days * p_taken + 0.5 * _PSEUDO_DAYS) / (n_days + _PSEUDO_DAYS))
