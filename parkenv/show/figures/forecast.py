"""Figures of occupancy: forecasts and what was counted, and fitted rates."""

from collections.abc import Sequence
from datetime import date
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from parkenv.compiled.arrays import FloatArray
from parkenv.forecast.comparison import Compared
from parkenv.forecast.count_table import HOURS
from parkenv.forecast.counts import Counts
from parkenv.forecast.day_forecast import draw_days
from parkenv.forecast.scores import Band, mean_where
from parkenv.forecast.slot_comparison import ComparedSlots
from parkenv.show.figures.charts import GREY, Line, Mark, Panel, draw_panels, level
from parkenv.show.figures.picture_files import INK, STYLE, picture, save_picture
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.week import DAY_S, HOUR_S

_BLUE, _ORANGE = "#0072b2", "#d55e00"
_WEEK = 7
_LEVELS = ((0.05, 0.95, 0.16), (0.25, 0.75, 0.3))


class ShownForecast(NamedTuple):
    model: str
    log_loss: float
    crps: float
    coverage_90: float
    place: str  # whose days are shown
    days: Sequence[tuple[date, int]]  # shown one after the other, and the number of their values
    draws: FloatArray  # (k, n) equally likely values of the n hours or half-hours
    forecast: FloatArray  # (n,)
    observed: FloatArray  # (n,)
    reliability: FloatArray  # (3, b), see `Scores.reliability`
    weight: str  # what reliability is weighted by
    by_forecast: list[Band]  # coverage by forecast fullness
    by_observed: list[Band]


def shown_counts(compared: Compared, counts: Counts, week: tuple[int, int]) -> ShownForecast:
    forecast, scores, (park, monday) = compared.forecast, compared.scores, week
    dates = counts.days[monday : monday + _WEEK]
    days = slice(monday - forecast.first, monday - forecast.first + _WEEK)
    draws = np.moveaxis(draw_days(forecast.mean[park, days], forecast.covariance[park, days]), 1, 0)
    return ShownForecast(
        compared.model, mean_where(scores.log_loss), mean_where(scores.crps), mean_where(scores.day_covered),
        counts.car_parks[park], [(day, HOURS) for day in dates], draws.reshape(len(draws), -1),
        forecast.occupancy[park, days].ravel(), counts.occupied[park, monday : monday + _WEEK].ravel(),
        scores.reliability(), "hours", scores.coverage_by_band(), scores.coverage_by_band(observed=True),
    )  # fmt: skip


def shown_slots(compared: ComparedSlots, log: str) -> ShownForecast:
    days, scores = compared.days[-_WEEK:], compared.scores
    means = scores.means()
    draws, forecast, observed = (
        np.concatenate(parts, axis=-1)
        for parts in zip(
            *((day.draws, day.lot_means(day.p_taken), day.lot_means(day.taken)) for day in days), strict=True
        )
    )
    return ShownForecast(
        compared.model, means["log_loss"], means["crps"], means["coverage_90"],
        f"{log}: mean over the slots", [(date.fromordinal(day.number), day.draws.shape[1]) for day in days],
        draws, forecast, observed,
        scores.reliability(), "slots' half-hours", scores.coverage_by_band(), scores.coverage_by_band(observed=True),
    )  # fmt: skip


def shown_week(counts: Counts, first: int) -> tuple[int, int]:
    """Return car park and first day, by index, of the week to show: from a Monday on, with many varied readings."""
    mondays = [d for d in range(first, len(counts.days) - _WEEK + 1) if counts.weekday[d] == 0]
    best, chosen = -1.0, (0, first)
    for monday in mondays:
        week = counts.occupied[:, monday : monday + _WEEK].reshape(len(counts.car_parks), -1)
        known = np.isfinite(week)
        middle = np.where(known, week, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        spread = np.sqrt(np.where(known, (week - middle[:, None]) ** 2, 0.0).mean(axis=1))
        worth = spread * known.mean(axis=1) ** 4
        if worth.max() > best:
            best, chosen = float(worth.max()), (int(worth.argmax()), monday)
    return chosen


def save_forecast(shown: ShownForecast, path: Path) -> None:
    with picture(path, (10.5, 5.6), f"Day-ahead forecasts of {shown.model} and what was counted") as figure:
        grid = figure.add_gridspec(2, 2, height_ratios=(1.0, 1.15), width_ratios=(1.0, 1.6))
        panels = {grid[0, :]: _days(shown), grid[1, 0]: _reliability(shown), grid[1, 1]: _coverage(shown)}
        for cell, panel in panels.items():
            panel.draw(figure.add_subplot(cell))
        figure.suptitle(
            f"{shown.model}: day-ahead forecasts, log-loss {shown.log_loss:.4f}, "
            f"CRPS {shown.crps:.4f}, {shown.coverage_90:.1%} of days in their 90 % interval",
            x=0.01,
            ha="left",
        )


def _days(shown: ShownForecast) -> Panel:
    starts = np.cumsum([0, *(n for _, n in shown.days)])
    x = np.arange(shown.forecast.size)

    def draw(ax: Axes) -> None:
        for start, stop in pairwise(starts):
            # Days need not follow each other: no line between them.
            day, hidden = slice(start, stop), "_" if start else ""
            for low, high, alpha in _LEVELS:
                bounds = np.quantile(shown.draws[:, day], (low, high), axis=0)
                label = f"{hidden}{high - low:.0%} interval"
                ax.fill_between(x[day], *bounds, color=_BLUE, alpha=alpha, linewidth=0, label=label)
            ax.plot(x[day], shown.forecast[day], color=_BLUE, linewidth=1.3, label=f"{hidden}forecast")
        ax.plot(x, shown.observed, ".", color=INK, markersize=3.0, label="counted")
        ax.set_xticks(starts[:-1], [f"{day:%a %d %b %Y}" for day, _ in shown.days], ha="left")

    axes = {"xlim": (0, max(x.size - 1, 1)), "ylim": (0, 1.02), "ylabel": "occupied"}
    key = {"ncols": 4, "loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.0}
    return Panel([draw], shown.place, axes, "x", key, "y")


def _reliability(shown: ShownForecast) -> Panel:
    forecast, observed, n = shown.reliability
    share: dict[str, Any] = {"color": "#bbbbbb", "linewidth": 5.0, "label": f"share of {shown.weight}"}
    marks: list[Mark] = [
        Line([0, 1], [0, 1], GREY, {"linewidth": 0.8}),
        lambda ax: ax.vlines(forecast, 0, 0.25 * n / n.max(), **share),
        Line(
            forecast,
            observed,
            _BLUE,
            {"marker": "o", "markersize": 3.5, "linewidth": 1.2, "label": "counted"},
        ),
    ]
    axes = {"xlim": (0, 1), "ylim": (0, 1), "xlabel": "forecast to be occupied", "ylabel": "occupied"}
    return Panel(marks, "Reliability", axes | {"aspect": "equal"}, "", {"loc": "upper left"}, "xy")


def _coverage(shown: ShownForecast) -> Panel:
    def draw(ax: Axes) -> None:
        for bands, color, shift, height, fullness in (
            (shown.by_forecast, _BLUE, -0.1, 0.545, "forecast"),
            (shown.by_observed, _ORANGE, 0.1, 0.515, "counted"),
        ):
            label = f"days by {fullness} fullness"
            for i, band in enumerate(bands):
                if (held := band["coverage_90"]) is None:
                    continue
                days = int(band["days"] or 0)
                error = 1.96 * np.sqrt(max(held * (1.0 - held), 0.25 / days) / days)
                style: dict[str, Any] = {
                    "fmt": "o",
                    "color": color,
                    "markersize": 4.5,
                    "linewidth": 1.2,
                    "label": label,
                }
                ax.errorbar(i + shift, held, error, **style)
                label = "_nolegend_"
                at: dict[str, Any] = {
                    "ha": "center",
                    "fontsize": 7.5,
                    "color": color,
                    "annotation_clip": True,
                }
                ax.annotate(f"{days:,}", (i, height), **at)
        ax.axhspan(0.8, 0.97, color="#eeeeee", zorder=0)

    names = [f"{band['from']:.0%}–{band['to']:.0%}" for band in shown.by_forecast]
    axes = {
        "xticks": range(len(names)), "xticklabels": names, "xlim": (-0.5, len(names) - 0.5), "ylim": (0.5, 1.0),
        "xlabel": "mean occupancy of the day (below: number of days)", "ylabel": "days in their 90 % interval",
    }  # fmt: skip
    key = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": 2, "borderaxespad": 0.0}
    return Panel([draw, level(0.9, GREY, linewidth=0.8)], "Coverage", axes, "", key, "y")


@mpl.rc_context(STYLE)
def save_rates(process: OccupancyProcess, path: Path, *, title: str = "") -> None:
    hours = np.arange(0.0, 24.01, 0.25)
    full, rates = list[Any](), list[Any]()
    for name, day, color in (("weekday", 0, _BLUE), ("weekend", 5, "#e69f00")):
        moments = np.stack([process.marginal(day * DAY_S + h * HOUR_S) for h in hours])
        low, middle, high = np.quantile(moments, [0.1, 0.5, 0.9], axis=1)
        full.append(Line(hours, moments.mean(axis=1), color, {"label": f"{name}, mean"}, (low, high), 0.18))
        full.append(Line(hours, middle, color, {"linewidth": 0.8, "linestyle": ":"}))
        for event, profile, line in (
            ("arrivals", process.arrival_profile, "-"),
            ("departures", process.departure_profile, "--"),
        ):
            values = profile[24 * day : 24 * day + 24] * HOUR_S
            style: dict[str, Any] = {
                "color": color,
                "linestyle": line,
                "linewidth": 1.5,
                "label": f"{event}, {name}",
            }
            rates.append(partial(Axes.stairs, values=values, baseline=None, **style))
    axes = {"xlim": (0, 24), "xticks": range(0, 25, 4), "xlabel": "hour of the day"}
    shares = {"ylabel": "fraction occupied", "ylim": (0, 1.02)}
    by_hour = {"ylabel": "per hour and slot", "yscale": "log"}
    panels = [
        Panel(full, "Occupancy (band: 80 % of slots)", axes | shares, legend={"fontsize": 8}),
        Panel(rates, "Arrival and departure rates", axes | by_hour, legend={"fontsize": 8}),
    ]
    figure = draw_panels(panels, (9.0, 3.6))
    figure.axes[1].yaxis.set_major_formatter("{x:g}")
    if title:
        figure.suptitle(title)
    save_picture(figure, path)
