"""Forecasts of slots side by side: each recorded day is forecast from the days of its class before it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import expit, logit

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.forecast.day_forecast import INTERVAL
from parkenv.forecast.scores import (
    Band,
    Estimate,
    coverage_by_band,
    crps_of_equally_likely,
    ratio_of_sums,
    reliability,
)
from parkenv.forecast.slot_days import Days, SlotDays, fit_slot_days

OURS = "slot-days"
_DRAWS = 400
_EDGE = 0.001  # forecasts stay this far from 0 and 1
_LEVEL_SD, _LEVEL_DAYS = (
    0.77,
    2.0,
)  # logits, of a day's error of a baseline before it has made any; its weight
_SMOOTH = 1.5  # periods, of the features of gradient boosting


class DayForecast(NamedTuple):
    """Forecast of the slots on one day."""

    p_taken: FloatArray  # (m, p)
    curve_covariance: FloatArray  # (p, p) of the level's error over the day, logits²


@dataclass(frozen=True, eq=False)
class ScoredDay:
    """A day's forecast of m slots, and what was recorded, in the t half-hours in which something was.

    Args:
        number: of the day (`date.toordinal`).
        p_taken: (m, t) forecast.
        taken: (m, t) fraction of the observed time in which a slot was taken.
        seen: (m, t) observed fraction of the half-hour.
        draws: (k, t) equally likely days of the lot's mean occupancy, over the observed slots.
    """

    number: int
    p_taken: FloatArray
    taken: FloatArray
    seen: FloatArray
    draws: FloatArray

    @property
    def log_loss(self) -> float:
        """Sum over the observed states."""
        return -float(
            (
                self.seen * (self.taken * np.log(self.p_taken) + (1 - self.taken) * np.log1p(-self.p_taken))
            ).sum()
        )

    @property
    def brier(self) -> float:
        """Sum over the observed states."""
        taken, p = self.taken, self.p_taken
        return float((self.seen * (taken * (1 - p) ** 2 + (1 - taken) * p**2)).sum())

    @property
    def states(self) -> float:
        """Weight of the observed states."""
        return float(self.seen.sum())

    @property
    def forecast(self) -> FloatArray:
        """Forecast of the lot's mean occupancy, (t,)."""
        return _lot_means(self.p_taken, self.seen)

    @property
    def observed(self) -> FloatArray:
        """Recorded mean occupancy of the lot, (t,)."""
        return _lot_means(self.taken, self.seen)

    @property
    def crps(self) -> FloatArray:
        """Of the lot's mean occupancy, (t,)."""
        return crps_of_equally_likely(np.sort(self.draws, axis=0), self.observed)

    @property
    def held(self) -> bool:
        """Whether the 90 % interval of the day's mean occupancy holds the recorded one."""
        low, high = np.quantile(self.draws.mean(axis=1), INTERVAL)
        return bool(low <= self.observed.mean() <= high)


@dataclass(frozen=True)
class SlotScores:
    """Scores of one model.

    Args:
        model: its name.
        days: the scored days, in order of time.
    """

    model: str
    days: tuple[ScoredDay, ...]

    @property
    def log_loss(self) -> float:
        """Of a slot that is taken or not."""
        return self._per_state([day.log_loss for day in self.days])

    @property
    def brier(self) -> float:
        """Of a slot that is taken or not."""
        return self._per_state([day.brier for day in self.days])

    @property
    def crps(self) -> float:
        """Of the lot's occupancy in a half-hour."""
        return float(np.concatenate([day.crps for day in self.days]).mean())

    @property
    def coverage_90(self) -> float:
        """Of the lot's mean occupancy over a day."""
        return float(np.mean([day.held for day in self.days]))

    def coverage_by_band(self, *, observed: bool = False) -> list[Band]:
        """Return `parkenv.forecast.scores.coverage_by_band` of the days, by forecast or by recorded fullness."""
        fullness = [(day.observed if observed else day.forecast).mean() for day in self.days]
        return coverage_by_band(np.array(fullness), np.array([float(day.held) for day in self.days]))

    def reliability(self) -> FloatArray:
        """Return `parkenv.forecast.scores.reliability` of the slots' states."""
        p, taken, seen = (
            np.concatenate([getattr(day, name).ravel() for day in self.days])
            for name in ("p_taken", "taken", "seen")
        )
        return reliability(p, taken, seen)

    def means(self) -> dict[str, float]:
        """Return each score, and the numbers of days and car parks."""
        return {
            "log_loss": self.log_loss,
            "brier": self.brier,
            "crps": self.crps,
            "coverage_90": self.coverage_90,
            "days": len(self.days),
            "car_parks": 1,
        }

    def log_loss_beyond(self, ours: SlotScores, rng: np.random.Generator) -> Estimate:
        """Return the log-loss minus that of `ours` on the same days; its interval is over days."""
        difference = [a.log_loss - b.log_loss for a, b in zip(self.days, ours.days, strict=True)]
        states = [day.states for day in self.days]
        return ratio_of_sums(np.array([difference]), np.array([states]), rng)

    def _per_state(self, sums: list[float]) -> float:
        return sum(sums) / sum(day.states for day in self.days)


def compare_slot_days(
    classes: list[SlotDays], first: int, on_day: Callable[[], None] = lambda: None
) -> list[SlotScores]:
    """Score forecasts of every day from `first` on.

    Baselines are the mean of the half-hour on some earlier days, shrunk to the mean of the lot by a Beta prior worth
    one day: all of them, the last four of the same weekday, or the last one; all days where none is of that weekday.
    The day error of a baseline is that of its earlier forecasts.

    Args:
        classes: all days of each class.
        first: number of the first day that is scored; days without one of their class before are not.
        on_day: called after each day.

    Returns:
        A row for each model, ours first; none if no day can be scored.
    """
    models: dict[str, Callable[[SlotDays, Days], FloatArray]] = {
        "last-four-weekdays": lambda past, day: _shrunk_mean(past, _same_weekday(past, day)[-4:]),
        "last-week": lambda past, day: _shrunk_mean(past, _same_weekday(past, day)[-1:]),
        "half-hour-mean": lambda past, _: _shrunk_mean(past, np.arange(len(past.days.number))),
        "gradient-boosting": lambda past, _: _boosted(past),
    }
    if not any((data.days.number[1:] >= first).any() for data in classes):
        return []
    scored: dict[str, list[ScoredDay]] = {name: [] for name in (OURS, *models)}
    for data in classes:
        errors: dict[str, list[float]] = {name: [] for name in models}
        for d in range(1, len(data.days.number)):
            past, day = _days(data, slice(d)), _days(data, slice(d, d + 1))
            taken, seen, counts = day.taken[:, 0], day.seen[:, 0], int(day.days.number[0]) >= first
            for name, model in models.items():
                if name == "gradient-boosting" and not counts:
                    continue
                p = np.clip(model(past, day.days), _EDGE, 1 - _EDGE)
                variance = (np.sum(np.square(errors[name])) + _LEVEL_DAYS * _LEVEL_SD**2) / (
                    len(errors[name]) + _LEVEL_DAYS
                )
                errors[name].append(_level_error(p, taken, seen))
                if counts:
                    scored[name].append(_score(DayForecast(p, np.full((p.shape[1],) * 2, variance)), day))
            if counts:
                found = fit_slot_days(past).forecast(day.days)
                p = np.clip(found.p_taken[0], _EDGE, 1 - _EDGE)
                scored[OURS].append(_score(DayForecast(p, found.curve_covariance[0]), day))
                on_day()
    return [
        SlotScores(name, tuple(sorted(days, key=lambda day: day.number))) for name, days in scored.items()
    ]


def _days(data: SlotDays, which: slice | IntArray) -> SlotDays:
    days = Days(data.days.number[which], data.days.weekday[which])
    return SlotDays(days, data.taken[:, which], data.seen[:, which])


def _same_weekday(past: SlotDays, day: Days) -> IntArray:
    same = np.flatnonzero(past.days.weekday == day.weekday[0])
    return same if same.size else np.arange(len(past.days.number))


def _shrunk_mean(past: SlotDays, days: IntArray) -> FloatArray:
    taken, n = (past.taken * past.seen)[:, days].sum(axis=1), past.seen[:, days].sum(axis=1)
    lot = (taken.sum(axis=0) + 0.5) / (n.sum(axis=0) + 1.0)
    return np.asarray((taken + lot) / (n + 1.0))


def _boosted(past: SlotDays) -> FloatArray:
    from sklearn.ensemble import HistGradientBoostingClassifier

    taken, n = past.taken * past.seen, past.seen
    period = np.arange(n.shape[2])
    kernel = np.exp(-0.5 * (np.subtract.outer(period, period) / _SMOOTH) ** 2)

    def features(days: IntArray) -> FloatArray:
        t, w = taken[:, days].sum(axis=1), n[:, days].sum(axis=1)
        slot = (t.sum(axis=1, keepdims=True) + 1.0) / (w.sum(axis=1, keepdims=True) + 2.0)
        lot = (t.sum(axis=0) @ kernel + 0.5) / (w.sum(axis=0) @ kernel + 1.0)
        own = (t @ kernel + lot) / (w @ kernel + 1.0)
        parts = np.broadcast_arrays(period, slot, lot, own)
        return np.stack([part.ravel() for part in parts], axis=1)

    everything = np.arange(n.shape[1])
    # A day's features come from the other days, as those of the day to forecast do.
    inputs = np.concatenate([features(np.delete(everything, d)) for d in everything])
    states, weights = (np.concatenate([a[:, d].ravel() for d in everything]) for a in (past.taken, n))
    used = weights > 0
    if len(np.unique(states[used] > 0.5)) < 2:
        return _shrunk_mean(past, everything)
    model = HistGradientBoostingClassifier(
        max_iter=60, learning_rate=0.08, max_leaf_nodes=15, min_samples_leaf=50, early_stopping=False
    )
    model.fit(inputs[used], states[used] > 0.5, sample_weight=weights[used])
    return np.asarray(model.predict_proba(features(everything))[:, 1].reshape(n.shape[0], -1))


def _lot_means(values: FloatArray, seen: FloatArray) -> FloatArray:
    """Mean over the slots in each period with observations, (t,)."""
    used = seen.sum(axis=0) > 0
    return np.asarray((values * seen)[:, used].sum(axis=0) / seen[:, used].sum(axis=0))


def _level_error(p: FloatArray, taken: FloatArray, seen: FloatArray) -> float:
    means = [np.clip(_lot_means(values, seen).mean(), _EDGE, 1 - _EDGE) for values in (taken, p)]
    return float(logit(means[0]) - logit(means[1]))


def _score(forecast: DayForecast, day: SlotDays) -> ScoredDay:
    taken, seen = day.taken[:, 0], day.seen[:, 0]
    used = np.flatnonzero(seen.sum(axis=0) > 0)
    return ScoredDay(
        int(day.days.number[0]),
        forecast.p_taken[:, used],
        taken[:, used],
        seen[:, used],
        _drawn_occupancy(forecast, seen, used),
    )


def _drawn_occupancy(forecast: DayForecast, seen: FloatArray, used: IntArray) -> FloatArray:
    """Draw days of the lot's mean occupancy, (k, t)."""
    rng = np.random.default_rng(0)
    p, weight = forecast.p_taken[:, used], seen[:, used] / seen[:, used].sum(axis=0)
    covariance = forecast.curve_covariance[np.ix_(used, used)]
    sd = np.sqrt(np.diag(covariance))
    # The centre of which the mean over days is p, nearly (MacKay's probit approximation).
    centre = logit(p) * np.sqrt(1.0 + np.pi / 8.0 * sd**2)
    level = rng.multivariate_normal(np.zeros(used.size), covariance, _DRAWS, method="eigh")
    means, noise = np.empty((2, _DRAWS, used.size))
    for k in range(_DRAWS):
        state = expit(centre + level[k])
        means[k] = (weight * state).sum(axis=0)
        noise[k] = np.sqrt((weight**2 * state * (1 - state)).sum(axis=0))
    # Slots change slowly: their chance is drawn once for a day.
    return np.clip(means + noise * rng.standard_normal((_DRAWS, 1)), 0.0, 1.0)
