"""Scores of forecasts of occupancy: log-loss, Brier score, CRPS, reliability, coverage of intervals.

References:
    Gneiting, Raftery: Strictly Proper Scoring Rules, Prediction, and Estimation. JASA, 2007.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from parkenv.compiled.arrays import FloatArray
from parkenv.forecast.counts import Counts
from parkenv.forecast.day_forecast import MIN_HOURS, DayForecast, day_means, held, quantiles_of_t

BANDS = (0.0, 0.2, 0.5, 0.8, 0.95, 1.0)  # bands of fullness

Band = dict[str, float | int | None]  # A band of fullness: from, to, days, coverage_90

_WEEK, _BINS, _REPETITIONS = 7, 20, 1_000  # days; of the forecast, for its reliability; of a bootstrap


def log_losses(forecast: DayForecast, occupied: FloatArray, capacity: FloatArray) -> FloatArray:
    """Return the log-loss (c, d, 24) of a place that is taken or not, in the mean over the places; NaN if unobserved.

    Probabilities stay a quarter of a place away from 0 and 1.
    """
    days = slice(forecast.first, forecast.first + forecast.mean.shape[1])
    edge = 0.25 / capacity[:, days, None]
    y, p = occupied[:, days], np.clip(forecast.occupancy, edge, 1.0 - edge)
    return np.asarray(-(y * np.log(p) + (1.0 - y) * np.log1p(-p)))


def crps_of_equally_likely(values: FloatArray, observed: FloatArray) -> FloatArray:
    """Return the continuous ranked probability score of equally likely values, (k, ...) ascending.

    >>> float(crps_of_equally_likely(np.array([0.0, 1.0]), np.array(0.0)))
    0.25
    """
    k = len(values)
    weight = (2.0 * np.arange(1, k + 1) - k - 1.0).reshape((k,) + (1,) * observed.ndim)
    return np.asarray(np.abs(values - observed).mean(axis=0) - (weight * values).sum(axis=0) / k**2)


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of one model's forecasts of d days with t hours or other periods; NaN where nothing was observed.

    Either of r whole car parks, each of them in a row of its own, or of the r slots of one car park.
    """

    log_loss: FloatArray  # (r, d, t) of a place that is taken or not
    brier: FloatArray
    crps: FloatArray  # (c, d, t) of the occupied fraction of each of c car parks
    occupancy: FloatArray  # (r, d, t) forecast
    observed: FloatArray  # (r, d, t) occupied fraction
    weight: FloatArray  # (r, d, t) of each of these, 0 where nothing was observed
    # (c, d) float64, 1 where the 90 % interval of the day's mean covers the observed one
    day_covered: FloatArray
    day_forecast: FloatArray  # (c, d) mean over the day's observed periods
    day_observed: FloatArray
    block: int  # number of days whose errors the interval of a difference takes for dependent
    # (c, d, t) float64, 1 where the 90 % interval of a period covers the observed fraction
    hour_covered: FloatArray | None = None

    @classmethod
    def of(cls, forecast: DayForecast, counts: Counts) -> Scores:
        c, d = forecast.mean.shape[:2]
        days = slice(forecast.first, forecast.first + d)
        y, places = counts.occupied[:, days], counts.capacity[:, days]
        observed = np.isfinite(y)
        p, mean, sd = forecast.occupancy, forecast.mean, forecast.sd
        crps = np.empty(y.shape)
        day_covered, day_forecast = np.full((2, c, d), np.nan)
        hour_covered = np.full(y.shape, np.nan)
        enough = observed.sum(axis=2) >= MIN_HOURS
        values = quantiles_of_t()[:, None, None]
        for day in range(d):
            crps[:, day] = crps_of_equally_likely(expit(mean[:, day] + sd[:, day] * values), y[:, day])
            o, rows = observed[:, day], enough[:, day]
            inside, hour_covered[:, day] = held(
                mean[:, day], forecast.covariance[:, day], y[:, day], o, places[:, day]
            )
            day_covered[rows, day] = inside[rows]
            day_forecast[rows, day] = day_means(p[:, day], o)[rows]
        flat = (c * d, y.shape[2])
        return cls(
            log_loss=log_losses(forecast, counts.occupied, counts.capacity),
            brier=(p - y) ** 2,
            crps=crps,
            occupancy=p,
            observed=y,
            weight=observed.astype(float),
            day_covered=day_covered,
            day_forecast=day_forecast,
            day_observed=np.where(
                enough, day_means(y.reshape(flat), observed.reshape(flat)).reshape(c, d), np.nan
            ),
            block=_WEEK,
            hour_covered=np.where(observed, hour_covered, np.nan),
        )

    def coverage_by_band(self, *, observed: bool = False) -> list[Band]:
        """Return how many days each band of fullness has, and how many of them the 90 % intervals hold.

        The fullness is the forecast one or, with `observed`, that of the day itself: days of unexpected fullness are
        missed then by construction.
        """
        fullness, covered = self.day_observed if observed else self.day_forecast, self.day_covered
        rows: list[Band] = []
        for low, high in pairwise(BANDS):
            inside = (fullness >= low) & ((fullness < high) | (high == BANDS[-1])) & np.isfinite(covered)
            share = float(covered[inside].mean()) if inside.any() else None
            rows.append({"from": low, "to": high, "days": int(inside.sum()), "coverage_90": share})
        return rows

    def reliability(self) -> FloatArray:
        """Return mean forecast, mean of what was observed, and weight (3, k) of equally wide bins of the forecast.

        Empty bins are left out.
        """
        seen = self.weight > 0
        p, weight = self.occupancy[seen], self.weight[seen]
        cell = np.minimum((p * _BINS).astype(int), _BINS - 1)
        n = np.bincount(cell, weight, _BINS)
        used = n > 0
        sums = (np.bincount(cell, weight * values, _BINS) for values in (p, self.observed[seen]))
        return np.stack([*(total[used] / n[used] for total in sums), n[used]])

    def means(self) -> dict[str, float]:
        observed = np.isfinite(self.crps)
        seen = self.weight > 0
        log_loss, brier = (
            float(np.average(values[seen], weights=self.weight[seen]))
            for values in (self.log_loss, self.brier)
        )
        hours = {} if self.hour_covered is None else {"coverage_90_hours": mean_where(self.hour_covered)}
        return {
            "log_loss": log_loss,
            "brier": brier,
            "crps": mean_where(self.crps),
            "coverage_90": mean_where(self.day_covered),
            **hours,
            "days": int(observed.any(axis=(0, 2)).sum()),
            "car_parks": int(observed.any(axis=(1, 2)).sum()),
        }

    def log_loss_beyond(self, ours: Scores, rng: np.random.Generator) -> Estimate:
        """Return the mean log-loss minus that of `ours`; its interval is over car parks and blocks of days."""
        difference = self.weight * np.where(self.weight > 0, self.log_loss - ours.log_loss, 0.0)
        c, d = self.day_covered.shape
        total, n = (
            np.add.reduceat(
                values.sum(axis=2).reshape(c, -1, d).sum(axis=1), np.arange(0, d, self.block), axis=1
            )
            for values in (difference, self.weight)
        )
        return ratio_of_sums(total, n, rng)


class Estimate(NamedTuple):
    value: float
    low: float
    high: float


def ratio_of_sums(total: FloatArray, n: FloatArray, rng: np.random.Generator) -> Estimate:
    """Return sum(total) / sum(n), with its interval by a bootstrap over rows, such as car parks, and columns, as weeks.

    >>> ratio_of_sums(np.array([[1.0, 2.0]]), np.array([[2.0, 4.0]]), np.random.default_rng(0))
    Estimate(value=0.5, low=0.5, high=0.5)
    """
    rows, columns = (
        rng.multinomial(size, np.full(size, 1.0 / size), _REPETITIONS).astype(float) for size in total.shape
    )
    drawn_total, drawn_n = (
        np.einsum("kr,rc,kc->k", rows, values, columns, optimize=True) for values in (total, n)
    )
    drawn = drawn_n > 0
    if not drawn.any():
        return Estimate(float("nan"), float("nan"), float("nan"))
    low, high = np.quantile(drawn_total[drawn] / drawn_n[drawn], (0.025, 0.975))
    return Estimate(float(total.sum() / n.sum()), float(low), float(high))


def mean_where(values: FloatArray) -> float:
    chosen = values[np.isfinite(values)]
    return float(chosen.mean()) if chosen.size else float("nan")
