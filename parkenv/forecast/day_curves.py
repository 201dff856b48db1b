"""Forecasts of daily occupancy curves: a linear state-space model, filtered day by day (Kalman).

The log-odds of a car park's occupancy over a day are a curve of harmonics of the day. It is the sum of

- a curve common to all days, which drifts,
- on Saturdays and Sundays the difference of such days, which drifts slowly; on other days that of this weekday,
- the day's own deviation, correlated from day to day (first-order autoregression),

and is observed with noise: that of the hour, and that of a finite number of places. Days that fit badly count less.
Public holidays have the curve of a Sunday: dates on which car parks were as on a Sunday a year before, known by day and
month, or by their distance from Easter. So no calendar is needed, but the first year of a record knows of no holidays.
All car parks are filtered at once; what
they share are the variances (`CurveSettings`), fitted to the past by maximum likelihood of the occupied places.

References:
    West, Harrison: Bayesian Forecasting and Dynamic Models, 2nd ed., 1997.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import asdict, dataclass, replace
from datetime import date
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, gammaln, logit

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.forecast.count_table import HOURS
from parkenv.forecast.counts import Counts
from parkenv.forecast.day_forecast import DIAGONAL, FREEDOM, DayForecast, calibrated, logits
from parkenv.forecast.scores import log_losses

Mode = Literal["past", "rolling"]

_HARMONICS = 6
_ORDER = np.r_[1, np.repeat(np.arange(1, _HARMONICS + 1), 2)]
_SIZE = len(_ORDER)
_SMOOTH = 1.0 / _ORDER**2.0  # variances fall with the square of the frequency
_HOUR = 2 * np.pi * np.arange(HOURS) / HOURS
_BASIS = np.stack(
    [np.ones(HOURS)] + [f(k * _HOUR) for k in range(1, _HARMONICS + 1) for f in (np.cos, np.sin)], axis=1
)
# Blocks of the state: the common curve, Saturday, Sunday, Monday to Friday, the day's own.
_N_BLOCKS = 9
_STATE = _N_BLOCKS * _SIZE
_TODAY = slice(_STATE - _SIZE, _STATE)
_BLOCKS = {day: (0, 3 + day, 8) for day in range(5)} | {5: (0, 1, 8), 6: (0, 2, 8)}
_SUNDAY = 6
_MIN_HOURS = 4  # to learn from a day
_MIN_HOURS_SPECIAL = 8  # to tell whether a day was as a Sunday
_SETTLED = 28  # days from which on weekdays and Sundays are told apart
_MEMORY = 30.0  # days over which the scale of the noise is averaged
_OUTLIER = 2.0  # ratio of squared error to variance from which on a day counts less
_MOVING = (-2, 1, 39, 50, 60)  # Good Friday, Easter Monday, Ascension, Whit Monday, Corpus Christi
_RARE = 0.005  # share of holidays among days of which nothing is known
_OWN = 2.5  # most that the one observation of a car park itself counts, logits
_CLEAR = 6.0  # logits from which on a day is taken for a Sunday when models learn from it
_FIT_CAR_PARKS = 14
_FIT_DAYS = 400
_FIT_WARM_UP = 45


@dataclass(frozen=True)
class CurveSettings:
    """Variances of the model, log-odds squared; those of a block are those of its mean level."""

    level_drift: float = 0.017  # of the common level, per day
    common_drift: float = 4e-4  # of the first harmonics of the common curve, per day
    class_drift: float = 3e-4  # of Saturdays and Sundays, per day
    class_spread: float = 0.08  # of Saturdays and Sundays before any is seen
    weekday_drift: float = 1e-5  # of each other weekday, per day
    weekday_spread: float = 0.02  # of each other weekday before any is seen
    day_memory: float = 0.55  # correlation of a day's own deviation with that of the day before, in (0, 1)
    day_spread: float = 0.036  # of the shape of a day's own deviation
    day_level_spread: float = 0.28  # of its mean level
    noise: float = 0.02  # of a single hour


class _Filter:
    """State of all car parks at once: mean (c, n) and covariance (c, n, n)."""

    def __init__(self, n: int, settings: CurveSettings) -> None:
        s = settings
        own = np.r_[s.day_level_spread, s.day_spread * _SMOOTH[1:]]
        classes, weekdays = np.tile(s.class_spread * _SMOOTH, 2), np.tile(s.weekday_spread * _SMOOTH, 5)
        start = np.r_[2.0, _SMOOTH[1:], classes, weekdays, own]
        self._drift = np.r_[
            s.level_drift,
            s.common_drift * _SMOOTH[1:],
            np.tile(s.class_drift * _SMOOTH, 2),
            np.tile(s.weekday_drift * _SMOOTH, 5),
            own * (1.0 - s.day_memory**2),
        ]
        self._settings = settings
        self.mean = np.zeros((n, _STATE))
        self.covariance = np.tile(np.diag(start), (n, 1, 1))

    def next_day(self) -> None:
        memory = self._settings.day_memory
        self.mean[:, _TODAY] *= memory
        self.covariance[:, _TODAY] *= memory
        self.covariance[:, :, _TODAY] *= memory
        self.covariance[:, np.arange(_STATE), np.arange(_STATE)] += self._drift

    def curve(self, weekday: int) -> _Curve:
        parts = [slice(b * _SIZE, (b + 1) * _SIZE) for b in _BLOCKS[weekday]]
        across = np.asarray(sum(self.covariance[:, :, part] for part in parts))
        mean = np.asarray(sum(self.mean[:, part] for part in parts))
        return _Curve(mean, np.asarray(sum(across[:, part] for part in parts)), across)

    def update(self, curve: _Curve, fit: _Fit, discount: FloatArray) -> None:
        self.mean += (curve.across @ (fit.step / discount[:, None])[:, :, None])[:, :, 0]
        self.covariance -= (curve.across @ (fit.gain / discount[:, None, None])) @ np.swapaxes(
            curve.across, 1, 2
        )
        self.covariance += np.swapaxes(self.covariance, 1, 2).copy()
        self.covariance *= 0.5


_Parts = TypeVar("_Parts", "_Curve", "_Fit")


class _Curve(NamedTuple):
    """Coefficients of the curve of a day: mean (c, k), covariance (c, k, k), and with the state, (c, n, k)."""

    mean: FloatArray
    covariance: FloatArray
    across: FloatArray

    def fit(self, z: FloatArray, weight: FloatArray) -> _Fit:
        """Compare the curve with log-odds (c, 24), observed with inverse noise variances `weight`, 0 if unobserved."""
        error = np.where(weight > 0, z - self.mean @ _BASIS.T, 0.0)
        information = (_BASIS.T * weight[:, None]) @ _BASIS
        score = (weight * error) @ _BASIS
        ratio = np.eye(_SIZE) + information @ self.covariance
        solved = np.linalg.solve(ratio, np.concatenate([information, score[:, :, None]], axis=2))
        gain, step = solved[:, :, :-1], solved[:, :, -1]
        explained = (score * (self.covariance @ step[:, :, None])[:, :, 0]).sum(axis=1)
        distance = np.maximum((weight * error**2).sum(axis=1) - explained, 0.0)
        gain = (gain + np.swapaxes(gain, 1, 2)) / 2
        return _Fit(step, gain, distance, np.linalg.slogdet(ratio)[1])


class _Fit(NamedTuple):
    """How a day fits a curve: step (c, k), gain (c, k, k); squared distance and log-determinant (c,)."""

    step: FloatArray
    gain: FloatArray
    distance: FloatArray
    log_det: FloatArray

    def log_likelihood(self, n: IntArray) -> FloatArray:
        """Return the log-likelihood (c,) of n observed hours, multivariate t, up to what all curves share."""
        return np.asarray(
            gammaln((FREEDOM + n) / 2)
            - self.log_det / 2
            - (FREEDOM + n) / 2 * np.log1p(self.distance / (FREEDOM - 2))
        )


def _where(mask: BoolArray, chosen: _Parts, other: _Parts) -> _Parts:
    if not mask.any():
        return other
    pairs = zip(chosen, other, strict=True)
    return type(other)(*(np.where(mask.reshape(-1, *(1,) * (b.ndim - 1)), a, b) for a, b in pairs))


def key_of(day: date) -> Hashable:
    """Return what identifies a date in every year.

    >>> key_of(date(2024, 5, 9)) == key_of(date(2023, 5, 18)), key_of(date(2024, 10, 3))
    (True, (10, 3))
    """
    after_easter = (day - _easter(day.year)).days
    return after_easter if after_easter in _MOVING else (day.month, day.day)


def _easter(year: int) -> date:
    """Return Easter Sunday of a year (J. Meeus, Astronomical Algorithms, 1991, chapter 8).

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
    def __init__(self, n: int) -> None:
        self._n = n
        self._known: dict[Hashable, tuple[NDArray[np.float64], float]] = {}

    def expected(self, day: date) -> BoolArray:
        evidence, share = self._known.get(key_of(day), (np.zeros(self._n), _RARE))
        return np.asarray(logit(share) + np.clip(evidence, -_OWN, _OWN) > 0)

    def observe(self, day: date, evidence: NDArray[np.float64], observed: BoolArray) -> BoolArray:
        """Take in a day, and return the car parks (n,) where it clearly was as a Sunday.

        `evidence`, (n,), is the log-likelihood of the day as a Sunday minus that as its own weekday; `observed`, (n,),
        says whether enough was observed of it.
        """
        alike: Any = expit(logit(_RARE) + evidence)[observed]
        share = float((alike.sum() + 2 * _RARE) / (alike.size + 2))
        evidence = np.where(observed, evidence, 0.0)
        if observed.any() and day.weekday() < 5:  # a Saturday may look like a Sunday anyway
            self._known[key_of(day)] = (evidence, share)
        return np.asarray(logit(share) + evidence > _CLEAR)


def filter_days(
    counts: Counts,
    settings: CurveSettings,
    first: int,
    last: int,
    until: int | None = None,
    on_day: Callable[[int], None] | None = None,
) -> DayForecast:
    """Forecast every day from all days before it; the covariances are the model's own, and not calibrated.

    The filter starts with day 0, and returns the days from index `first` to `last` - 1. From `until` on nothing is
    learned any more: the days from there on are forecast several days ahead. `on_day` is called with the number of the
    days done.
    """
    c = len(counts.car_parks)
    state, special = _Filter(c, settings), SpecialDays(c)
    mean = np.empty((c, last - first, HOURS))
    covariance = np.empty((c, last - first, HOURS, HOURS), np.float32)
    scale, memory = np.ones(c), np.full(c, 15.0)
    until = last if until is None else until
    for day in range(last):
        state.next_day()
        weekday = int(counts.weekday[day])
        places = counts.sample[:, max(min(day, until) - 1, 0), None]
        own = curve = state.curve(weekday)
        sunday = state.curve(_SUNDAY) if weekday != _SUNDAY and day >= _SETTLED else None
        if sunday is not None:
            curve = _where(special.expected(counts.days[day]), sunday, own)
        if day >= first:
            middle = curve.mean @ _BASIS.T
            p = expit(middle)
            spread = (_BASIS @ curve.covariance @ _BASIS.T) * scale[:, None, None]
            spread[:, DIAGONAL, DIAGONAL] += settings.noise * scale[:, None] + 1.0 / (
                places * p * (1.0 - p) + 1.0
            )
            mean[:, day - first], covariance[:, day - first] = middle, spread
        seen = counts.seen[:, day]
        hours = np.isfinite(seen).sum(axis=1)
        learned = hours >= _MIN_HOURS
        if day < until and learned.any():
            places = counts.sample[:, day, None]
            z = logits(seen, places)
            p = expit(z)
            weight = 1.0 / (settings.noise + 1.0 / (places * p * (1.0 - p) + 1.0))
            weight = np.where(np.isfinite(seen) & learned[:, None], weight, 0.0)
            fit = own.fit(z, weight)
            if sunday is not None:
                other = sunday.fit(z, weight)
                evidence = other.log_likelihood(hours) - fit.log_likelihood(hours)
                mask = special.observe(counts.days[day], evidence, hours >= _MIN_HOURS_SPECIAL)
                curve, fit = _where(mask, sunday, own), _where(mask, other, fit)
            error = fit.distance / np.maximum(hours, 1)
            memory = np.where(learned, np.minimum(memory + 1.0, _MEMORY), memory)
            step = (np.minimum(error, _MEMORY * scale) - scale) / memory
            scale = np.where(learned, scale + step, scale)
            state.update(curve, fit, np.where(learned, np.maximum(error / (_OUTLIER * scale), 1.0), 1.0))
        if on_day is not None:
            on_day(day + 1)
    return DayForecast(first, mean, covariance)


def fit_settings(counts: Counts, before: int, on_step: Callable[[], None] | None = None) -> CurveSettings:
    """Fit the variances to the days before index `before` by maximum likelihood of the occupied places.

    The likelihood is that of day-ahead forecasts: a place is taken or not, and each hour of a car park counts as
    one. The variances have log-normal priors around the defaults, so that a short past changes little.
    """
    start = max(before - _FIT_DAYS, 0)
    enough = np.flatnonzero(np.isfinite(counts.seen[:, start:before]).any(axis=2).sum(axis=1) > _FIT_WARM_UP)
    best = CurveSettings()
    if not enough.size:
        return best
    chosen = enough[np.unique(np.linspace(0, enough.size - 1, _FIT_CAR_PARKS).round().astype(int))]
    part = counts.part(chosen, start, before)

    def loss(settings: CurveSettings) -> float:
        forecast = filter_days(part, settings, _FIT_WARM_UP, before - start)
        losses = log_losses(forecast, part.seen, part.capacity)
        prior = sum(math.log(value / default[name]) ** 2 for name, value in asdict(settings).items()) / 2
        return float(np.nansum(losses) + prior)

    default = asdict(CurveSettings())
    lowest = loss(best)
    for factor in (2.0, 2.0, 1.4):
        for name in default:
            for change in (factor, 1.0 / factor):
                value = asdict(best)[name] * change
                if name == "day_memory":
                    odds = best.day_memory / (1.0 - best.day_memory) * change
                    value = odds / (1.0 + odds)
                tried = replace(best, **{name: value})
                if (of_tried := loss(tried)) < lowest:
                    best, lowest = tried, of_tried
                    break
            if on_step is not None:
                on_step()
    return best


FIT_STEPS = 30  # number of calls of `on_step` in a fit


def forecast_days(
    counts: Counts,
    first: int,
    mode: Mode = "rolling",
    settings: CurveSettings | None = None,
    on_day: Callable[[int], None] | None = None,
) -> DayForecast:
    """Forecast the days from index `first` on, with spreads calibrated on earlier days.

    Each is forecast from all days before it (`rolling`), or all from those before `first` (`past`); settings are fitted
    to the days before `first` if none are given. `on_day` is called with the number of the days done.
    """
    settings = fit_settings(counts, first) if settings is None else settings
    n, until = len(counts.days), first if mode == "past" else None
    return calibrated(filter_days(counts, settings, 0, n, until, on_day), counts, until).from_day(first)
