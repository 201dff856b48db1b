"""Figures of a comparison of detectors: detection rates by distance, and contact sheets of missed cars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from parkenv.compiled.arrays import Image
from parkenv.show.colors import hex_color
from parkenv.show.figures.picture_files import INK, STYLE, save_picture

Row = Mapping[str, Any]

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
LINES = ("-", "--", ":")
BOX = hex_color("wrong")
_CROP = (4, 3)  # width and height of a crop, in proportion
_LEAST_CROP = 176  # px, its width


def save_reach(rows: Sequence[Row], ylabel: str, path: Path) -> None:
    """Draw how often cars are found in a picture, by distance: a panel for each weather, a line for each survey.

    Args:
        rows: rows of `reach_table`.
        ylabel: what is found where.
        path: the PNG to write.
    """
    panels = list(dict.fromkeys(row["weather"] for row in rows))
    rigs, detectors = (list(dict.fromkeys(row[c] for row in rows)) for c in ("rig", "detector"))
    with mpl.rc_context(STYLE):
        columns = 2 if len(panels) == 4 else min(3, len(panels))
        lines = -(-len(panels) // columns)
        figure = Figure(figsize=(3.4 * columns + 0.6, 2.5 * lines + 0.9), layout="constrained")
        axes = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).ravel()
        for ax, weather in zip(axes, panels, strict=False):
            surveys = [(r, d) for r in rigs for d in detectors]
            for i, (rig, detector) in enumerate(surveys):
                its = [r for r in rows if (r["weather"], r["rig"], r["detector"]) == (weather, rig, detector)]
                if not its:
                    continue
                color = COLORS[detectors.index(detector) % len(COLORS)]
                line = LINES[rigs.index(rig) % len(LINES)]
                # Offset the points, so that the intervals do not hide each other.
                x = np.array([np.mean(r["distance_m"]) for r in its]) + 0.18 * (i - (len(surveys) - 1) / 2)
                rate, low, high = (np.array([r[c] for r in its]) for c in ("rate", "low", "high"))
                ax.plot(
                    x, rate, color=color, linestyle=line, marker="o", markersize=3, linewidth=1.5,
                    label=f"{detector}, {rig}",
                )  # fmt: skip
                ax.vlines(x, low, high, color=color, linewidth=1.0, alpha=0.6)
            ax.set_title(weather.replace("_", " "))
            ax.grid(axis="y")
            ax.set(ylim=(0.0, 1.03))
            ax.yaxis.set_major_formatter(mpl.ticker.PercentFormatter(1.0))
        for ax in axes[len(panels) :]:
            ax.remove()
        for ax in axes[max(len(panels) - columns, 0) : len(panels)]:
            ax.tick_params(labelbottom=True)
        figure.supxlabel("distance from the camera to the middle of the car, m", size=9.0)
        figure.supylabel(ylabel, size=9.0)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=len(labels), handlelength=2.6)
        save_picture(figure, path, "How often a car in a picture is found, by weather, distance and detector")


class MissedCar(NamedTuple):
    """A car that a detector missed, in its picture."""

    picture: Image
    box: Sequence[float]  # left, top, right, bottom, px
    distance: float  # from the camera to the middle of the car, m
    visible: float  # visible fraction
    weather: str


def save_misses(missed: Mapping[str, Sequence[MissedCar]], title: str, path: Path) -> None:
    """Draw a contact sheet of missed cars, a row for each cause.

    Args:
        missed: the cars of each row, by its heading; rows without cars are left out.
        title: title of the sheet.
        path: the PNG to write.
    """
    shown = {heading: cars for heading, cars in missed.items() if cars}
    columns = max((len(cars) for cars in shown.values()), default=1)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(1.75 * columns + 0.1, 1.78 * max(len(shown), 1) + 0.35))
        figure.suptitle(
            title, x=0.008, y=1.0 - 0.06 / figure.get_figheight(), ha="left", va="top", weight="bold"
        )
        grid = figure.add_gridspec(
            max(len(shown), 1), columns, left=0.006, right=0.994, bottom=0.2 / figure.get_figheight(),
            top=1.0 - 0.62 / figure.get_figheight(), hspace=0.36, wspace=0.04,
        )  # fmt: skip
        for i, (heading, cars) in enumerate(shown.items()):
            for k, car in enumerate(cars):
                ax = figure.add_subplot(grid[i, k])
                _draw_miss(ax, car)
                if k == 0:
                    ax.set_title(heading, weight="bold", color=INK, pad=4.0)
        save_picture(figure, path, "Cars that a detector missed in pictures of survey drives, by cause")


def _draw_miss(ax: Axes, car: MissedCar) -> None:
    """Draw the part of the picture around a car, with its box, distance, visible fraction and weather."""
    height, width = car.picture.shape[:2]
    left, top, right, bottom = (int(side) for side in car.box)
    wide = max(1.7 * (right - left), 1.7 * (bottom - top) * _CROP[0] / _CROP[1], _LEAST_CROP)
    wide = round(min(wide, width, height * _CROP[0] / _CROP[1]))
    high = round(wide * _CROP[1] / _CROP[0])
    x = int(np.clip((left + right - wide) // 2, 0, width - wide))
    y = int(np.clip((top + bottom - high) // 2, 0, height - high))
    ax.imshow(
        car.picture[y : y + high, x : x + wide], extent=(x, x + wide, y + high, y), interpolation="lanczos"
    )
    ax.add_patch(Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=BOX, linewidth=1.1))
    ax.set(xlim=(x, x + wide), ylim=(y + high, y))
    ax.set_axis_off()
    label = f"{car.distance:.1f} m, {car.visible:.0%} visible, {car.weather.replace('_', ' ')}"
    ax.text(0.0, -0.03, label, transform=ax.transAxes, va="top", fontsize=6.8, color="#444444")
