"""Learning curves: scores against training decisions, with planners for comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter

from parkenv.show.figures.picture_files import INK, picture
from parkenv.show.figures.times import spread

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555")
"""Colours of trainings: as many as are easy to tell apart."""
OFF_SCALE = 2.0
"""Times above this multiple of the lowest are cut off."""
_APART = 0.045  # least distance of two labels, fraction of the axis
_MARGIN_IN = 0.12  # beside the labels, inches

Evaluations = Sequence[Mapping[str, Any]]
Curves = Sequence[Evaluations]


def save_learning_curves(
    curves: Mapping[str, Curves],
    means: Mapping[str, Evaluations],
    planners: Mapping[str, float],
    title: str,
    path: Path,
) -> None:
    """Draw each algorithm's total time, and planners as horizontal lines.

    A single algorithm is drawn as the mean over seeds with its interval. Several are drawn as medians: their intervals
    would hide each other, and medians are robust against single searches that drive in circles. Single seeds are thin
    lines.

    Args:
        curves: rows of `curve.csv` by algorithm and seed.
        means: their means over seeds: steps, `total_s`, `low_s`, `high_s` and `median_s`.
        planners: mean total time, s, of each planner in the same worlds.
        title: title of the figure.
        path: the PNG file to write.
    """
    layout = ConstrainedLayoutEngine(w_pad=_MARGIN_IN)
    with picture(
        path,
        (7.2, 4.2 if len(curves) == 1 else 4.8),
        "Learning curves, and planners in the same worlds",
        layout=layout,
    ) as figure:
        axes = figure.subplots()
        highest = 0.0
        for (name, its), color in zip(curves.items(), COLORS, strict=False):
            drawn = _draw(axes, name, its, means[name], color, alone=len(curves) == 1)
            highest = max([highest, *drawn[len(drawn) // 10 :]])
        low = min([*planners.values(), *(r["total_s"] for its in curves.values() for c in its for r in c)])
        # An untrained policy drives in circles, so cut off high values to keep the end of the curves readable.
        high = min(max([highest, *planners.values()]), OFF_SCALE * low)
        margin = 0.06 * (high - low) or 1.0
        axes.set_ylim(low - margin, high + margin)
        shown = {name: t for name, t in planners.items() if t <= high + margin}
        ascending = sorted(shown.items(), key=lambda item: item[1])
        bottom, top = axes.get_ylim()
        heights = spread([(seconds - bottom) / (top - bottom) for _, seconds in ascending], _APART)
        for (name, seconds), height in zip(ascending, heights, strict=True):
            _mark(axes, seconds, f"{name}  {seconds:.1f}", height)
        axes.set(xlabel="decisions in training", ylabel="mean total time, s", title=title)
        if len(curves) == 1:
            axes.legend(loc="upper right", frameon=True, facecolor="white", edgecolor="none", framealpha=1.0)
        else:
            figure.legend(loc="outside lower left", ncols=2, frameon=False)


def _draw(
    axes: Axes, name: str, curves: Curves, rows: Evaluations, color: str, *, alone: bool
) -> Sequence[float]:
    """Draw the mean over seeds with its interval, or the median, and single seeds as thin lines; return the line."""
    steps, line = [row["steps"] for row in rows], [row["total_s" if alone else "median_s"] for row in rows]
    words = f"{len(curves)} seeds" if alone or len(curves) == 1 else f"median of {len(curves)} seeds"
    for single in curves:
        axes.plot(
            [r["steps"] for r in single], [r["total_s"] for r in single], color=color, lw=0.5, alpha=0.35
        )
    if alone and len(curves) > 1:
        axes.fill_between(
            steps,
            [row["low_s"] for row in rows],
            [row["high_s"] for row in rows],
            color=color,
            alpha=0.2,
            lw=0,
        )
    axes.plot(steps, line, color=color, lw=2.0, label=f"{name}, {words}")
    axes.set_xlim(left=0.0)
    axes.xaxis.set_major_formatter(FuncFormatter(_count))
    axes.grid(axis="y")
    return line


def _mark(axes: Axes, value: float, words: str, height: float) -> None:
    """Draw a horizontal line, with a label beside the axes at a height given as a fraction of theirs."""
    axes.axhline(value, color=INK, lw=0.8, ls=(0, (4, 3)), zorder=1)
    axes.annotate(
        words, (1.0, height), xycoords="axes fraction", xytext=(5, 0),
        textcoords="offset points", va="center", fontsize=8, color=INK,
    )  # fmt: skip


def _count(x: float, _: Any) -> str:
    return f"{x / 1e6:g} M" if x >= 1e6 else f"{x / 1e3:g} k" if x >= 1e3 else f"{x:g}"
