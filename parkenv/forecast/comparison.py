"""Models of counts side by side: ours, what the hour, last week, and recent same weekdays were; boosted trees.

Each forecasts a day from the days before it. The simple ones state a fraction per hour, with the spread of their own
earlier errors.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.special import logit

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import with_extra
from parkenv.forecast.count_table import HOURS
from parkenv.forecast.counts import Counts
from parkenv.forecast.day_curves import CurveSettings, forecast_days
from parkenv.forecast.day_forecast import DIAGONAL, DayForecast, calibrated, logits
from parkenv.forecast.scores import Scores

OURS = "day-curves"
MODELS = (OURS, "last-four-weekdays", "last-week", "hour-mean", "gradient-boosting")
_WEEK = 7
_MEMORY = 56.0  # days over which errors are averaged
_PRIOR_DAYS, _PRIOR_VARIANCE = 5.0, 0.5  # errors assumed before any is seen, log-odds squared
_REFIT_DAYS = 122
_MAX_ROWS = 250_000
_MAX_CATEGORIES = 250


def _days_ago(values: FloatArray, days: int) -> FloatArray:
    shifted = np.full_like(values, np.nan)
    shifted[:, days:] = values[:, : max(values.shape[1] - days, 0)]
    return shifted


def _mean(parts: list[FloatArray]) -> FloatArray:
    stack = np.stack(parts)
    n = np.isfinite(stack).sum(axis=0)
    return np.where(n > 0, np.nansum(stack, axis=0) / np.maximum(n, 1), np.nan)


def hour_mean(counts: Counts) -> FloatArray:
    result = np.full(counts.seen.shape, np.nan)
    for weekend in (False, True):
        days = np.flatnonzero((counts.weekday >= 5) == weekend)
        y = counts.seen[:, days]
        total, n = np.nan_to_num(y).cumsum(axis=1), np.isfinite(y).cumsum(axis=1)
        result[:, days[1:]] = np.where(n > 0, total / np.maximum(n, 1), np.nan)[:, :-1]
    return result


def last_week(counts: Counts) -> FloatArray:
    return _days_ago(counts.seen, _WEEK)


def last_four_weekdays(counts: Counts) -> FloatArray:
    return _mean([_days_ago(counts.seen, _WEEK * k) for k in (1, 2, 3, 4)])


def gradient_boosting(counts: Counts, first: int) -> FloatArray:
    """Return forecasts (c, d, 24) of boosted trees, fitted anew every four months.

    They know car park, weekday, hour, day of the year, the same hour one and two weeks before, in the last four and
    eight weeks and the day before, the means of the last day and the day a week before, and how much the day before
    differed from its last four weeks.
    """
    with with_extra("gradient boosting", "fit"):
        from sklearn.ensemble import HistGradientBoostingRegressor

    y = counts.seen
    c = len(y)
    everywhere = np.ones(y.shape)

    def level(values: FloatArray) -> FloatArray:
        return np.asarray(_mean(list(np.moveaxis(values, 2, 0)))[:, :, None] * everywhere)

    four = last_four_weekdays(counts)
    yesterday = _days_ago(y, 1)
    features = np.stack(
        [
            np.arange(c)[:, None, None] * everywhere,
            counts.weekday[None, :, None] * everywhere,
            np.arange(HOURS) * everywhere,
            np.array([day.timetuple().tm_yday for day in counts.days])[None, :, None] * everywhere,
            _days_ago(y, _WEEK),
            _days_ago(y, 2 * _WEEK),
            four,
            _mean([_days_ago(y, _WEEK * k) for k in range(1, 9)]),
            yesterday,
            level(yesterday),
            level(_days_ago(y, _WEEK)),
            level(yesterday - _days_ago(four, 1)),
        ],
        axis=-1,
    ).astype(np.float32)
    features = features if c <= _MAX_CATEGORIES else features[..., 1:]
    result = np.full(y.shape, np.nan)
    rng = np.random.default_rng(0)
    # Once before the first day, so that the trees have errors of their own.
    for start in range(max(first - _REFIT_DAYS, first % _REFIT_DAYS), len(counts.days), _REFIT_DAYS):
        rows = np.argwhere(np.isfinite(y[:, :start]))
        if len(rows) > _MAX_ROWS:
            rows = rows[rng.choice(len(rows), _MAX_ROWS, replace=False)]
        if len(rows) >= HOURS:
            park, day, hour = rows.T
            known = features[park, day, hour]
            used = np.isfinite(known).any(axis=0)  # there is no week before the first
            categories = list(range(1 + (c <= _MAX_CATEGORIES)))
            model = HistGradientBoostingRegressor(
                max_iter=250, learning_rate=0.07, categorical_features=categories, random_state=0
            )
            model.fit(known[:, used], y[park, day, hour])
            days = slice(start, start + _REFIT_DAYS)
            inputs = features[:, days][..., used]
            result[:, days] = model.predict(inputs.reshape(-1, inputs.shape[-1])).reshape(inputs.shape[:3])
    return result


def with_past_errors(points: FloatArray, counts: Counts, first: int) -> DayForecast:
    """Make a forecast of points (c, d, 24), with the spread of their errors on earlier days.

    Where there is no point, that of the last four weekdays serves, then the mean of the hour, then one half. Errors are
    those of the whole day, and of its hours besides; they are averaged over about two months, and calibrated as those
    of every model.
    """
    for other in (last_four_weekdays(counts), hour_mean(counts), np.full(points.shape, 0.5)):
        points = np.where(np.isfinite(points), points, other)
    points = np.clip(points, 0.0, 1.0)
    c, d, _ = points.shape
    edge = 0.5 / (counts.sample[:, :, None] + 1.0)
    mean = logit(np.clip(points, edge, 1.0 - edge))
    observed = np.isfinite(counts.seen)
    error = np.where(observed, logits(counts.seen, counts.sample[:, :, None]) - mean, 0.0)
    covariance = np.empty((c, d, HOURS, HOURS), np.float32)
    level = np.full(c, _PRIOR_VARIANCE)
    hours = np.full((c, HOURS), _PRIOR_VARIANCE)
    n = np.full(c, _PRIOR_DAYS)
    for day in range(d):
        covariance[:, day] = level[:, None, None]
        covariance[:, day][:, DIAGONAL, DIAGONAL] += hours
        o = observed[:, day]
        some = o.any(axis=1)
        shift = error[:, day].sum(axis=1) / np.maximum(o.sum(axis=1), 1)
        n = np.where(some, np.minimum(n + 1.0, _MEMORY), n)
        level = np.where(some, level + (shift**2 - level) / n, level)
        rest = (error[:, day] - shift[:, None]) ** 2
        hours = np.where(o, hours + (np.maximum(rest, 1e-4) - hours) / n[:, None], hours)
    return calibrated(DayForecast(0, mean, covariance, points), counts).from_day(first)


class Compared(NamedTuple):
    model: str
    forecast: DayForecast
    scores: Scores


def compare(
    counts: Counts, first: int, settings: CurveSettings, on_day: Callable[[int], None] | None = None
) -> Iterator[Compared]:
    """Forecast the days from index `first` on with every model of `MODELS`, in that order, from the days before.

    `on_day` is called with the number of days that our model, with `settings`, has done.
    """
    points = (last_four_weekdays, last_week, hour_mean, lambda counts: gradient_boosting(counts, first))
    for model, points_of in zip(MODELS, (None, *points), strict=True):
        if points_of is None:
            forecast = forecast_days(counts, first, "rolling", settings, on_day)
        else:
            forecast = with_past_errors(points_of(counts), counts, first)
        yield Compared(model, forecast, Scores.of(forecast, counts))
