"""Forecasts of slots side by side: each recorded day is forecast from the days of its class before it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import expit, logit

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import with_extra
from parkenv.forecast.day_forecast import INTERVAL
from parkenv.forecast.scores import Scores, crps_of_equally_likely
from parkenv.forecast.slot_days import Days, SlotDays, fit_slot_days

OURS = "slot-days"
_DRAWS = 400
_EDGE = 0.001  # forecasts stay this far from 0 and 1
# logits, of a day's error of a baseline before it has made any; its weight
_LEVEL_SD, _LEVEL_DAYS = 0.77, 2.0
_SMOOTH = 1.5  # periods, of the features of gradient boosting


class ScoredDay(NamedTuple):
    """A day's forecast of m slots, and what was recorded in its t periods."""

    number: int  # of the day (`date.toordinal`)
    p_taken: FloatArray  # (m, t) forecast
    taken: FloatArray  # (m, t) fraction of the observed time in which a slot was taken
    seen: FloatArray  # (m, t) observed fraction of the period
    # (k, u) equally likely days of the mean occupancy over the observed slots, in the u periods that have some
    draws: FloatArray

    def lot_means(self, values: FloatArray) -> FloatArray:
        used = self.seen.sum(axis=0) > 0
        return np.asarray((values * self.seen)[:, used].sum(axis=0) / self.seen[:, used].sum(axis=0))


class ComparedSlots(NamedTuple):
    model: str
    days: tuple[ScoredDay, ...]
    scores: Scores


def compare_slot_days(
    classes: list[SlotDays], first: int, on_day: Callable[[], None] = lambda: None
) -> list[ComparedSlots]:
    """Score forecasts of every day from number `first` on that has a day of its class before; a row for each model.

    Baselines are the mean of the half-hour on some earlier days, shrunk to the mean of the lot by a Beta prior worth
    one day: all of them, the last four of the same weekday, or the last one; all days where none is of that weekday.
    The day error of a baseline is that of its earlier forecasts. Without a day that can be scored there are no rows.
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
                    scored[name].append(_scored(p, np.full((p.shape[1],) * 2, variance), day))
            if counts:
                forecast = fit_slot_days(past).forecast(day.days)
                p = np.clip(forecast.p_taken[0], _EDGE, 1 - _EDGE)
                scored[OURS].append(_scored(p, forecast.curve_covariance[0], day))
                on_day()
    in_order = {name: sorted(days, key=lambda day: day.number) for name, days in scored.items()}
    return [ComparedSlots(name, tuple(days), _scores(days)) for name, days in in_order.items()]


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
    with with_extra("gradient boosting", "fit"):
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


def _level_error(p: FloatArray, taken: FloatArray, seen: FloatArray) -> float:
    used = seen.sum(axis=0) > 0
    total = seen[:, used].sum(axis=0)
    means = [((values * seen)[:, used].sum(axis=0) / total).mean() for values in (taken, p)]
    return float(np.subtract(*logit(np.clip(means, _EDGE, 1 - _EDGE))))


def _scored(p: FloatArray, covariance: FloatArray, day: SlotDays) -> ScoredDay:
    taken, seen = day.taken[:, 0], day.seen[:, 0]
    return ScoredDay(int(day.days.number[0]), p, taken, seen, _drawn_occupancy(p, covariance, seen))


def _scores(days: list[ScoredDay]) -> Scores:
    p, taken, seen = (
        np.stack([getattr(day, name) for day in days], axis=1) for name in ("p_taken", "taken", "seen")
    )
    crps, covered, forecast, observed = np.full((1, *p.shape[1:]), np.nan), [], [], []
    for d, day in enumerate(days):
        mean = day.lot_means(day.taken)
        crps[0, d, day.seen.sum(axis=0) > 0] = crps_of_equally_likely(np.sort(day.draws, axis=0), mean)
        low, high = np.quantile(day.draws.mean(axis=1), INTERVAL)
        covered.append(float(low <= mean.mean() <= high))
        forecast.append(day.lot_means(day.p_taken).mean())
        observed.append(mean.mean())
    return Scores(
        log_loss=-(taken * np.log(p) + (1 - taken) * np.log1p(-p)),
        brier=taken * (1 - p) ** 2 + (1 - taken) * p**2,
        crps=crps,
        occupancy=p,
        observed=taken,
        weight=seen,
        day_covered=np.array([covered]),
        day_forecast=np.array([forecast]),
        day_observed=np.array([observed]),
        block=1,
    )


def _drawn_occupancy(p: FloatArray, covariance: FloatArray, seen: FloatArray) -> FloatArray:
    used = np.flatnonzero(seen.sum(axis=0) > 0)
    rng = np.random.default_rng(0)
    p, weight = p[:, used], seen[:, used] / seen[:, used].sum(axis=0)
    covariance = covariance[np.ix_(used, used)]
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
