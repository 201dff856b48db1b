"""Models of counts side by side: each day is forecast from the days before it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from parkenv.compiled.arrays import FloatArray
from parkenv.forecast import baselines
from parkenv.forecast.counts import Counts
from parkenv.forecast.day_curves import CurveSettings, forecast_days
from parkenv.forecast.day_forecast import DayForecast
from parkenv.forecast.scores import Scores

OURS = "day-curves"
MODELS = (OURS, "last-four-weekdays", "last-week", "hour-mean", "gradient-boosting")


class Compared(NamedTuple):
    """A model's forecasts and scores."""

    model: str
    forecast: DayForecast
    scores: Scores


def compare(
    counts: Counts, first: int, settings: CurveSettings, on_day: Callable[[int], None] | None = None
) -> Iterator[Compared]:
    """Forecast the days from index `first` on with every model of `MODELS`, in that order.

    Args:
        counts: what was observed.
        first: index of the first day that is scored.
        settings: of our model, fitted to the days before.
        on_day: called with the number of days that our model has done.
    """
    points: dict[str, Callable[[Counts], FloatArray]] = {
        "last-four-weekdays": baselines.last_four_weekdays,
        "last-week": baselines.last_week,
        "hour-mean": baselines.hour_mean,
        "gradient-boosting": lambda counts: baselines.gradient_boosting(counts, first),
    }
    for model in MODELS:
        if model == OURS:
            forecast = forecast_days(counts, first, "rolling", settings, on_day)
        else:
            forecast = baselines.with_past_errors(points[model](counts), counts, first)
        yield Compared(model, forecast, Scores.of(forecast, counts))
