"""Curves of a commute: mean total time and forecast error against the day."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from parkenv.evaluation.experiments.commute import FIXED, NONE
from parkenv.evaluation.figures.picture_files import STYLE, save_picture
from parkenv.evaluation.figures.time_figures import AGENT_COLORS, OTHER_AGENT

Row = Mapping[str, Any]
_WORDS = {"empty": "empty map at first", "right": "right map at first", "wrong": "wrong map at first"}
_MEASURES = (("total_s", "mean total time, s"), ("forecast_error", "forecast error (Brier score)"))


def save_commute_curves(rows: Sequence[Row], path: Path) -> None:
    """Draw a column of panels for each scenario and map: time and forecast error of each agent against the day.

    Shaded are 95 % intervals. Dashed lines are the levels, over all days, of an agent with the right map, which does
    not learn; dotted ones those of agents without a map.

    Args:
        rows: rows of `commute.day_rows`.
        path: the PNG file to write.
    """
    columns = list(dict.fromkeys((r["scenario"], r["map"]) for r in rows if r["map"] not in (FIXED, NONE)))
    if not columns:
        return
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(1.2 + 2.9 * len(columns), 5.4), layout="constrained")
        panels = figure.subplots(2, len(columns), sharex=True, squeeze=False)
        for (scenario, start), (above, below) in zip(columns, panels.T, strict=True):
            its = [row for row in rows if row["scenario"] == scenario]
            for axes, (measure, words) in zip((above, below), _MEASURES, strict=True):
                _draw(axes, its, start, measure)
                axes.set_ylabel(words if start == columns[0][1] and scenario == columns[0][0] else "")
                axes.grid(axis="y")
            above.set_title(f"{scenario}, {_WORDS[start]}")
            below.set_xlabel("day")
            below.set_ylim(bottom=0.0)
            below.xaxis.set_major_locator(MaxNLocator(integer=True))
        agents = list(dict.fromkeys(row["agent"] for row in rows))
        lines = [Line2D([], [], color=_color(agent), lw=2.0, label=agent) for agent in agents]
        lines += [
            Line2D([], [], color="#444444", lw=1.2, ls="--", label="right map that does not learn"),
            Line2D([], [], color="#444444", lw=1.2, ls=":", label="without a map"),
        ]
        figure.legend(handles=lines, loc="outside lower center", ncols=min(len(lines), 2 + len(columns)))
        save_picture(figure, path, "Time and forecast error of drivers whose map learns from every trip")


def _draw(axes: Axes, rows: Sequence[Row], start: str, measure: str) -> None:
    for agent in dict.fromkeys(row["agent"] for row in rows):
        its = [row for row in rows if row["agent"] == agent]
        for name, style in ((FIXED, "--"), (NONE, ":")):
            levels = [row[measure] for row in its if row["map"] == name]
            if levels and np.isfinite(levels).all():
                axes.axhline(float(np.mean(levels)), color=_color(agent), lw=1.2, ls=style, zorder=1)
        learned = [row for row in its if row["map"] == start]
        days = [row["day"] for row in learned]
        low, high = (np.array([row[f"{measure}_ci95"][end] for row in learned], float) for end in (0, 1))
        axes.plot(days, [row[measure] for row in learned], color=_color(agent), lw=1.8)
        if len(learned):
            axes.fill_between(days, low, high, color=_color(agent), alpha=0.15, lw=0)


def _color(agent: str) -> str:
    return AGENT_COLORS.get(agent.partition("(")[0], OTHER_AGENT)
