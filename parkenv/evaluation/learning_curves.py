"""Total time against decisions made in training, with the planners for comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from parkenv.evaluation.picture_files import INK, STYLE, save_picture
from parkenv.evaluation.statistics import mean_interval
from parkenv.evaluation.time_figures import spread

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
OFF_SCALE = 2.0
"""Times above this many times the least one are off the figure."""
_APART = 0.045  # of the axis, the least distance of two words beside the lines


def across_seeds(curves: Sequence[Sequence[Mapping[str, Any]]]) -> list[dict[str, float]]:
    """Mean over seeds, with its 95 % interval, at the examinations that all seeds have.

    Args:
        curves: of each seed, the rows of its `curve.csv`.
    """
    rows = []
    for examinations in zip(*curves, strict=False):
        mean, low, high = mean_interval([row["total_s"] for row in examinations])
        rows.append(
            {
                "steps": float(np.mean([r["steps"] for r in examinations])),
                "total_s": mean,
                "low_s": low,
                "high_s": high,
            }
        )
    return rows


def save_learning_curves(
    curves: Mapping[str, Sequence[Sequence[Mapping[str, Any]]]],
    planners: Mapping[str, float],
    title: str,
    path: Path,
) -> None:
    """Draw each algorithm's mean over seeds in its interval, single seeds thinly, and planners as horizontal lines.

    Args:
        curves: of each algorithm and seed, examinations.
        planners: mean total time, s, of each planner in the same worlds.
        title: of the figure.
        path: of the PNG.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 4.2), layout="constrained")
        axes = figure.subplots()
        highest = 0.0
        for (name, its), color in zip(curves.items(), COLORS, strict=False):
            rows = across_seeds(its)
            steps = [row["steps"] for row in rows]
            for single in its:
                axes.plot(
                    [r["steps"] for r in single],
                    [r["total_s"] for r in single],
                    color=color,
                    lw=0.5,
                    alpha=0.35,
                )
            if len(its) > 1:
                axes.fill_between(
                    steps,
                    [r["low_s"] for r in rows],
                    [r["high_s"] for r in rows],
                    color=color,
                    alpha=0.2,
                    lw=0,
                )
            axes.plot(
                steps, [r["total_s"] for r in rows], color=color, lw=2.0, label=f"{name}, {len(its)} seeds"
            )
            highest = max(highest, *(r["total_s"] for r in rows[len(rows) // 10 :]))
        low = min(*planners.values(), *(r["total_s"] for its in curves.values() for c in its for r in c))
        # An untrained policy drives in circles; where it ends is what is to be seen.
        high = min(max([highest, *planners.values()]), OFF_SCALE * low)
        margin = 0.06 * (high - low)
        axes.set_ylim(low - margin, high + margin)
        shown = {name: t for name, t in planners.items() if t <= high + margin}
        ascending = sorted(shown.items(), key=lambda item: item[1])
        bottom, top = axes.get_ylim()
        heights = spread([(seconds - bottom) / (top - bottom) for _, seconds in ascending], _APART)
        for (name, seconds), height in zip(ascending, heights, strict=True):
            axes.axhline(seconds, color=INK, lw=0.8, ls=(0, (4, 3)), zorder=1)
            axes.annotate(
                f"{name}  {seconds:.1f}", (1.0, height), xycoords="axes fraction", xytext=(5, 0),
                textcoords="offset points", va="center", fontsize=8, color=INK,
            )  # fmt: skip
        axes.set_xlim(left=0.0)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x / 1e6:g} M" if x else "0"))
        axes.set(xlabel="decisions in training", ylabel="mean total time, s", title=title)
        axes.grid(axis="y")
        axes.legend(loc="upper right", frameon=True, facecolor="white", edgecolor="none", framealpha=1.0)
        save_picture(figure, path)
