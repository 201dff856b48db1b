"""Figure of a forecasting model: reliability, a week with its intervals, and how often the intervals hold."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from parkenv.evaluation.figures.picture_files import INK, STYLE, save_picture
from parkenv.forecast.comparison import Compared
from parkenv.forecast.counts import HOURS, Counts
from parkenv.forecast.day_forecast import draw_days
from parkenv.forecast.scores import mean_where

_BLUE, _ORANGE = "#0072b2", "#d55e00"
_WEEK = 7
_LEVELS = ((0.05, 0.95, 0.16), (0.25, 0.75, 0.3))


def shown_week(counts: Counts, first: int) -> tuple[int, int]:
    """Return car park and first day, by index, of the week to show: from Monday on, with many readings that vary most.

    Args:
        counts: what was observed.
        first: index of the first day that may be shown.
    """
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


def save_forecast(compared: Compared, counts: Counts, week: tuple[int, int], path: Path) -> None:
    """Draw the figure of one model.

    Args:
        compared: its forecasts and scores.
        counts: what was observed.
        week: car park and first day to show, by index.
        path: the PNG to write.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10.5, 5.6), layout="constrained")
        grid = figure.add_gridspec(2, 2, height_ratios=(1.0, 1.15), width_ratios=(1.0, 1.6))
        _draw_week(figure.add_subplot(grid[0, :]), compared, counts, *week)
        reliability, coverage = (figure.add_subplot(grid[1, column]) for column in (0, 1))
        _draw_reliability(reliability, compared)
        _draw_coverage(coverage, compared)
        scores = compared.scores
        figure.suptitle(
            f"{compared.model}: day-ahead forecasts, log-loss {mean_where(scores.log_loss):.4f}, "
            f"CRPS {mean_where(scores.crps):.4f}, {mean_where(scores.day_held):.1%} of days in their 90 % interval",
            x=0.01,
            ha="left",
        )
        save_picture(figure, path, f"Day-ahead forecasts of {compared.model} and what was counted")


def _draw_week(ax: Axes, compared: Compared, counts: Counts, park: int, monday: int) -> None:
    forecast = compared.forecast
    days = slice(monday - forecast.first, monday - forecast.first + _WEEK)
    draws = np.moveaxis(draw_days(forecast.mean[park, days], forecast.covariance[park, days]), 1, 0)
    draws = draws.reshape(len(draws), -1)
    hours = np.arange(draws.shape[1])
    for low, high, alpha in _LEVELS:
        bounds = np.quantile(draws, (low, high), axis=0)
        label = f"{high - low:.0%} interval"
        ax.fill_between(hours, *bounds, color=_BLUE, alpha=alpha, linewidth=0, label=label)
    ax.plot(hours, forecast.occupancy[park, days].ravel(), color=_BLUE, linewidth=1.3, label="forecast")
    counted = counts.occupied[park, monday : monday + _WEEK].ravel()[: hours.size]
    ax.plot(hours, counted, ".", color=INK, markersize=3.0, label="counted")
    dates = [f"{day:%a %d %b %Y}" for day in counts.days[monday : monday + _WEEK]]
    ax.set_xticks(np.arange(len(dates)) * HOURS, dates, ha="left")
    ax.set(xlim=(0, hours.size - 1), ylim=(0, 1.02), ylabel="occupied", title=counts.car_parks[park])
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    ax.grid(axis="x")
    ax.legend(ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)


def _draw_reliability(ax: Axes, compared: Compared) -> None:
    told, was, n = compared.scores.reliability()
    ax.plot([0, 1], [0, 1], color="#999999", linewidth=0.8)
    ax.vlines(told, 0, 0.25 * n / n.max(), color="#bbbbbb", linewidth=5.0, label="share of hours")
    ax.plot(told, was, "o-", color=_BLUE, markersize=3.5, linewidth=1.2, label="counted")
    ax.set(xlim=(0, 1), ylim=(0, 1), xlabel="forecast to be occupied", ylabel="occupied", title="Reliability")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(PercentFormatter(1.0))
    ax.set_aspect("equal")
    ax.legend(loc="upper left")


def _draw_coverage(ax: Axes, compared: Compared) -> None:
    scores = compared.scores
    for observed, color, shift, label in (
        (False, _BLUE, -0.1, "days by forecast fullness"),
        (True, _ORANGE, 0.1, "days by counted fullness"),
    ):
        bands = scores.coverage_by_band(observed=observed)
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
                f"{days:,}", (i, 0.515 if observed else 0.545), ha="center", fontsize=7.5, color=color,
                rotation=0, annotation_clip=True,
            )  # fmt: skip
    ax.axhspan(0.8, 0.97, color="#eeeeee", zorder=0)
    ax.axhline(0.9, color="#999999", linewidth=0.8)
    names = [f"{band['from']:.0%}–{band['to']:.0%}" for band in scores.coverage_by_band()]
    ax.set_xticks(range(len(names)), names)
    ax.set(
        xlim=(-0.5, len(names) - 0.5), ylim=(0.5, 1.0), xlabel="mean occupancy of the day (below: number of days)",
        ylabel="days in their 90 % interval", title="Coverage",
    )  # fmt: skip
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.0)
