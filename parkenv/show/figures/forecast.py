"""Figures of occupancy: forecasts and what was counted, fitted rates, and demand that follows counts."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from parkenv.compiled.arrays import FloatArray
from parkenv.forecast.comparison import Compared
from parkenv.forecast.counts import HOURS, Counts
from parkenv.forecast.day_forecast import draw_days
from parkenv.forecast.scores import Band, mean_where
from parkenv.forecast.slot_comparison import ComparedSlots
from parkenv.show.figures.picture_files import INK, STYLE, picture, save_picture
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.week import DAY_S, HOUR_S

_BLUE, _ORANGE = "#0072b2", "#d55e00"
_WEEK = 7
_LEVELS = ((0.05, 0.95, 0.16), (0.25, 0.75, 0.3))


class ShownForecast(NamedTuple):
    """What the figure of a model shows."""

    model: str
    log_loss: float
    crps: float
    coverage_90: float
    place: str  # whose days are shown
    days: Sequence[tuple[date, int]]  # shown one after the other, and the number of their values
    draws: FloatArray  # (k, n) equally likely values of the n hours or half-hours
    forecast: FloatArray  # (n,)
    observed: FloatArray  # (n,)
    reliability: FloatArray  # (3, b), see `parkenv.forecast.scores.reliability`
    weight: str  # what reliability is weighted by
    by_forecast: list[Band]  # coverage by forecast fullness
    by_observed: list[Band]


def shown_counts(compared: Compared, counts: Counts, week: tuple[int, int]) -> ShownForecast:
    """Return what to show of a model of counts."""
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
    """Return what to show of a model of slots: the last days that were scored, a week at most."""
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
    """Draw the figure of one model."""
    with picture(path, (10.5, 5.6), f"Day-ahead forecasts of {shown.model} and what was counted") as figure:
        grid = figure.add_gridspec(2, 2, height_ratios=(1.0, 1.15), width_ratios=(1.0, 1.6))
        _draw_days(figure.add_subplot(grid[0, :]), shown)
        reliability, coverage = (figure.add_subplot(grid[1, column]) for column in (0, 1))
        _draw_reliability(reliability, shown)
        _draw_coverage(coverage, shown)
        figure.suptitle(
            f"{shown.model}: day-ahead forecasts, log-loss {shown.log_loss:.4f}, "
            f"CRPS {shown.crps:.4f}, {shown.coverage_90:.1%} of days in their 90 % interval",
            x=0.01,
            ha="left",
        )


def _draw_days(ax: Axes, shown: ShownForecast) -> None:
    starts = np.cumsum([0, *(n for _, n in shown.days)])
    x = np.arange(shown.forecast.size)
    for start, stop in pairwise(starts):
        # Days need not follow each other: no line between them.
        day = slice(start, stop)
        for low, high, alpha in _LEVELS:
            bounds = np.quantile(shown.draws[:, day], (low, high), axis=0)
            label = f"{high - low:.0%} interval" if start == 0 else "_nolegend_"
            ax.fill_between(x[day], *bounds, color=_BLUE, alpha=alpha, linewidth=0, label=label)
        label = "forecast" if start == 0 else "_nolegend_"
        ax.plot(x[day], shown.forecast[day], color=_BLUE, linewidth=1.3, label=label)
    ax.plot(x, shown.observed, ".", color=INK, markersize=3.0, label="counted")
    ax.set_xticks(starts[:-1], [f"{day:%a %d %b %Y}" for day, _ in shown.days], ha="left")
    ax.set(xlim=(0, max(x.size - 1, 1)), ylim=(0, 1.02), ylabel="occupied", title=shown.place)
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    ax.grid(axis="x")
    ax.legend(ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)


def _draw_reliability(ax: Axes, shown: ShownForecast) -> None:
    forecast, observed, n = shown.reliability
    ax.plot([0, 1], [0, 1], color="#999999", linewidth=0.8)
    ax.vlines(
        forecast, 0, 0.25 * n / n.max(), color="#bbbbbb", linewidth=5.0, label=f"share of {shown.weight}"
    )
    ax.plot(forecast, observed, "o-", color=_BLUE, markersize=3.5, linewidth=1.2, label="counted")
    ax.set(xlim=(0, 1), ylim=(0, 1), xlabel="forecast to be occupied", ylabel="occupied", title="Reliability")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(PercentFormatter(1.0))
    ax.set_aspect("equal")
    ax.legend(loc="upper left")


def _draw_coverage(ax: Axes, shown: ShownForecast) -> None:
    for bands, color, shift, height, label in (
        (shown.by_forecast, _BLUE, -0.1, 0.545, "days by forecast fullness"),
        (shown.by_observed, _ORANGE, 0.1, 0.515, "days by counted fullness"),
    ):
        for i, band in enumerate(bands):
            if (held := band["coverage_90"]) is None:
                continue
            days = int(band["days"] or 0)
            error = 1.96 * np.sqrt(max(held * (1.0 - held), 0.25 / days) / days)
            ax.errorbar(
                i + shift, held, error, fmt="o", color=color, markersize=4.5, linewidth=1.2,
                label=label,
            )  # fmt: skip
            label = "_nolegend_"
            ax.annotate(
                f"{days:,}", (i, height), ha="center", fontsize=7.5, color=color,
                rotation=0, annotation_clip=True,
            )  # fmt: skip
    ax.axhspan(0.8, 0.97, color="#eeeeee", zorder=0)
    ax.axhline(0.9, color="#999999", linewidth=0.8)
    names = [f"{band['from']:.0%}–{band['to']:.0%}" for band in shown.by_forecast]
    ax.set_xticks(range(len(names)), names)
    ax.set(
        xlim=(-0.5, len(names) - 0.5), ylim=(0.5, 1.0), xlabel="mean occupancy of the day (below: number of days)",
        ylabel="days in their 90 % interval", title="Coverage",
    )  # fmt: skip
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.0)


_DAYS = (("weekday", 0, "#0072b2"), ("weekend", 5, "#e69f00"))


@mpl.rc_context(STYLE)
def save_rates(process: OccupancyProcess, path: Path, *, title: str = "") -> None:
    """Draw the mean occupancy with its spread over slots, and the profiles of both rates, for each day class."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    full, rates = figure.subplots(1, 2)
    hours = np.arange(0.0, 24.01, 0.25)
    for name, day, color in _DAYS:
        moments = np.stack([process.marginal(day * DAY_S + h * HOUR_S) for h in hours])
        low, middle, high = np.quantile(moments, [0.1, 0.5, 0.9], axis=1)
        full.fill_between(hours, low, high, color=color, alpha=0.18, linewidth=0)
        full.plot(hours, moments.mean(axis=1), color=color, label=f"{name}, mean")
        full.plot(hours, middle, color=color, linewidth=0.8, linestyle=":")
        for profile, style in ((process.arrival_profile, "-"), (process.departure_profile, "--")):
            event = "arrivals" if style == "-" else "departures"
            rates.stairs(
                profile[24 * day : 24 * day + 24] * HOUR_S, baseline=None, color=color, linestyle=style, linewidth=1.5,
                label=f"{event}, {name}",
            )  # fmt: skip
    full.set(
        xlabel="hour of the day",
        ylabel="fraction occupied",
        ylim=(0, 1.02),
        title="Occupancy (band: 80 % of slots)",
    )
    rates.set(
        xlabel="hour of the day",
        ylabel="per hour and slot",
        yscale="log",
        title="Arrival and departure rates",
    )
    rates.yaxis.set_major_formatter("{x:g}")
    for ax in (full, rates):
        ax.set(xlim=(0, 24), xticks=range(0, 25, 4))
        ax.grid(visible=True)
        ax.legend(fontsize=8)
    if title:
        figure.suptitle(title)
    save_picture(figure, path)


class CarParkDays(NamedTuple):
    """A car park over the hours of a day."""

    name: str
    capacity: float
    simulated: FloatArray  # (n_hours,) cars, mean of the days of the fleet
    followed: FloatArray  # (n_hours,) cars counted, mean of the days that the demand follows
    held_out: FloatArray  # (d, n_hours) cars counted on later days; NaN: not counted


@mpl.rc_context(STYLE)
def save_counted_demand(car_parks: Sequence[CarParkDays], hours: FloatArray, path: Path) -> None:
    """Draw the share of the places that is taken: simulated, as counted on the days followed, and on later ones."""
    columns = min(len(car_parks), 4)
    rows = ceil(len(car_parks) / columns)
    figure = Figure(figsize=(2.8 * columns + 0.6, 2.1 * rows + 0.6), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for ax, its in zip(axes, car_parks, strict=False):
        seen = its.held_out[np.isfinite(its.held_out).any(axis=1)]
        for k, day in enumerate(seen):
            ax.plot(hours, day / its.capacity, color="#999999", linewidth=0.5, alpha=0.5,
                    label="counted later, each day" if k == 0 else None)  # fmt: skip
        ax.plot(hours, its.followed / its.capacity, "--", color="#0072b2", label="counted, days followed")
        ax.plot(hours, its.simulated / its.capacity, color="#d55e00", label="simulated")
        ax.set_title(f"{its.name}, {its.capacity:.0f}", fontsize=8)
        ax.set(xlim=(hours[0] - 1, hours[-1]), ylim=(0, 1.02))
        ax.grid(visible=True)
    for ax in axes[len(car_parks) :]:
        ax.set_axis_off()
    figure.supxlabel("hour of the day", fontsize=9)
    figure.supylabel("share of the places taken", fontsize=9)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=3, fontsize=8)
    save_picture(figure, path)
