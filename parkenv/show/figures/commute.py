"""Curves of a commute: excess time and forecast error against the day."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from parkenv.show.figures.picture_files import picture
from parkenv.show.figures.times import agent_color

Row = Mapping[str, Any]
FIXED, NONE = "fixed", "none"
"""Column `map` of the references: a right map that does not learn; an agent that uses no map."""
_WORDS = {"empty": "empty map at first", "right": "right map at first", "wrong": "wrong map at first"}
_DASHES = ("-", (0, (5, 1.5)), (0, (2, 1)), (0, (5, 1, 1, 1)))
"""Lines of an agent with different options."""
_FIXED_LINE, _NONE_LINE = (0, (1, 1)), (0, (4, 2))


def save_commute_curves(rows: Sequence[Row], path: Path) -> None:
    """Draw a column of panels for each scenario and map: time and forecast error of each agent against the day.

    Excess time is what a search takes beyond that of the first agent with the right map, which does not learn, in the
    same worlds (10 % trimmed mean). Shaded are 95 % intervals. All of the first agent's curve is in the panel; others
    may leave it.
    """
    columns = list(dict.fromkeys((r["scenario"], r["map"]) for r in rows if r["map"] not in (FIXED, NONE)))
    if not columns:
        return
    with picture(
        path,
        (1.2 + max(2.9 * len(columns), 4.4), 5.6),
        "Time and forecast error of drivers whose map learns from every trip",
    ) as figure:
        panels = figure.subplots(2, len(columns), sharex="col", squeeze=False)
        for i, ((scenario, start), (above, below)) in enumerate(zip(columns, panels.T, strict=True)):
            its = [row for row in rows if row["scenario"] == scenario]
            shown = [row for row in its if row["map"] in (start, NONE, FIXED)]
            right = [row for row in its if row["map"] == FIXED]
            zero = [row["total_s"] for row in right if row["agent"] == right[0]["agent"]]
            _draw_excess(above, shown, start)
            _draw_error(below, shown, start)
            for axes in (above, below):
                axes.grid(axis="y")
                axes.set_xlim(0.5, max(row["day"] for row in its) + 0.5)
            above.set_title(
                f"{scenario}, {_WORDS[start]}\n0 = {right[0]['agent']}, right map: {np.mean(zero):.0f} s"
            )
            below.set_xlabel("day")
            below.xaxis.set_major_locator(MaxNLocator(integer=True))
            if i == 0:
                above.set_ylabel("excess time, s (trimmed mean)")
                below.set_ylabel("forecast error (Brier score)")
        figure.legend(
            handles=_legend(rows), loc="outside lower center", ncols=max(2, int(figure.get_figwidth() // 2.2))
        )


def _draw_excess(axes: Axes, rows: Sequence[Row], start: str) -> None:
    """Draw the excess of learning agents, and that of agents without a map; lines far above are named at the top."""
    learned = [row for row in rows if row["map"] == start]
    others = [row for row in rows if row["map"] == NONE]
    levels = {agent: _level(others, agent) for agent in dict.fromkeys(row["agent"] for row in others)}
    first = [row["excess_s"] for row in learned if row["agent"] == learned[0]["agent"]]
    nearest = min(levels.values(), default=0.0)
    low, high = np.percentile([row["excess_s"] for row in learned], [10.0, 90.0])
    top, bottom = max(*first, nearest, high, 1.0), min(*first, nearest, low, 0.0)
    margin = 0.2 * (top - bottom)
    axes.axhline(0.0, color="#444444", lw=0.9, zorder=1)
    for agent in dict.fromkeys(row["agent"] for row in learned):
        its = [row for row in learned if row["agent"] == agent]
        _draw_band(axes, its, "excess_s", _color(agent), _dashes(agent, rows))
    off_scale = []
    for agent, level in levels.items():
        if level > top + margin:
            off_scale.append(f"{agent} \N{UPWARDS ARROW} {level:+.0f} s")
        else:
            axes.axhline(level, color=_color(agent), lw=1.4, ls=_NONE_LINE, zorder=1)
    axes.text(
        0.98, 0.97, "\n".join(off_scale), transform=axes.transAxes, ha="right", va="top", color="#444444"
    )
    axes.set_ylim(bottom - margin, top + margin)


def _draw_error(axes: Axes, rows: Sequence[Row], start: str) -> None:
    """Draw the forecast error of learning agents, and that of the right map."""
    right = [row for row in rows if row["map"] == FIXED]
    axes.plot(
        *zip(*[(row["day"], row["forecast_error"]) for row in right if row["agent"] == right[0]["agent"]], strict=True),
        color="#444444", lw=1.2, ls=_FIXED_LINE, zorder=1,
    )  # fmt: skip
    for agent in dict.fromkeys(row["agent"] for row in rows if row["map"] == start):
        its = [row for row in rows if row["map"] == start and row["agent"] == agent]
        _draw_band(axes, its, "forecast_error", _color(agent), _dashes(agent, rows))
    axes.set_ylim(bottom=0.0)


def _draw_band(axes: Axes, rows: Sequence[Row], measure: str, color: str, dashes: Any) -> None:
    days = [row["day"] for row in rows]
    low, high = (np.array([row[f"{measure}_ci95"][end] for row in rows], float) for end in (0, 1))
    axes.plot(days, [row[measure] for row in rows], color=color, lw=1.8, ls=dashes)
    axes.fill_between(days, low, high, color=color, alpha=0.18, lw=0)


def _legend(rows: Sequence[Row]) -> list[Line2D]:
    learn = dict.fromkeys(row["agent"] for row in rows if row["map"] not in (FIXED, NONE))
    without = dict.fromkeys(row["agent"] for row in rows if row["map"] == NONE)
    return [
        *(
            Line2D([], [], color=_color(a), lw=2.0, ls=_dashes(a, rows), label=f"{a}, learning")
            for a in learn
        ),
        *(Line2D([], [], color=_color(a), lw=1.4, ls=_NONE_LINE, label=f"{a}, no map") for a in without),
        Line2D([], [], color="#444444", lw=1.2, ls=_FIXED_LINE, label="right map that does not learn"),
    ]


def _level(rows: Sequence[Row], agent: str) -> float:
    return float(np.mean([row["excess_s"] for row in rows if row["agent"] == agent]))


def _color(agent: str) -> str:
    return agent_color(agent.partition("(")[0])


def _dashes(agent: str, rows: Sequence[Row]) -> Any:
    """Return the line of an agent: agents of one colour have different ones."""
    alike = list(dict.fromkeys(row["agent"] for row in rows if _color(row["agent"]) == _color(agent)))
    return _DASHES[alike.index(agent) % len(_DASHES)]
