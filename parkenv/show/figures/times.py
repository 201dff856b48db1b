"""Figures of total times: means by part, against occupancy, failure cost and forecast, and distributions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any
from zlib import crc32

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullFormatter

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.files.known_names import UNBEATEN
from parkenv.show.columns import SETTING_AXES
from parkenv.show.figures.picture_files import INK, STYLE, legend_columns
from parkenv.show.plurals import LEAST_SEARCHES, plural
from parkenv.world.cost_terms import COST_TERMS

Row = Mapping[str, Any]

AGENT_COLORS = {
    "mdp": "#0072b2",
    "mdp-static": "#56b4e9",
    "mdp-tuned": "#117733",
    "greedy-goal": "#e69f00",
    "greedy-drive": "#d55e00",
    "greedy-total": "#ddcc77",
    "first-free": "#009e73",
    "usual": "#88ccee",
    "random": "#8c8c8c",
    "oracle": "#000000",
    "bound": "#8c564b",
    "belief": "#cc79a7",
    "belief-rivals": "#661100",
    "exact": "#882255",
    "network": "#44aa99",
    "rollout": "#4b5d16",
    "dqn": "#999933",
    "ppo": "#332288",
    "maskable-ppo": "#aa4499",
}
"""Each agent has one colour in all figures, distinguishable with any colour vision (Okabe-Ito and Tol)."""
_OTHERS = ("#5c4a3d", "#a6761d", "#6a3d9a", "#1b7a8c", "#b15928")
OFF_SCALE = 3.0
"""Totals above this multiple of the median are cut off, so that they do not compress the rest."""


def agent_color(agent: str) -> str:
    """Return the colour of an agent; agents of your own have one of five, by their name."""
    return AGENT_COLORS.get(agent, _OTHERS[crc32(agent.encode()) % len(_OTHERS)])


def draw_time_split(rows: Sequence[Row]) -> Figure:
    """Draw mean total times: a panel per setting, a bar per agent, split into drive, failed attempts and walk.

    Args:
        rows: rows of one scenario, as `parkenv compare` writes them to `summary.json`.
    """
    _require_rows(rows)
    panels: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        panels.setdefault(tuple(row[k] for k in SETTING_AXES), []).append(row)
    most = max(len(panel) for panel in panels.values())
    columns = 1 if len(panels) == 1 else 2 if len(panels) <= 4 else 3
    lines = -(-len(panels) // columns)
    limit = _limit(rows)
    with mpl.rc_context(STYLE):
        figure = Figure(
            figsize=((6.5, 9.0, 12.0)[columns - 1], 0.95 + lines * (0.62 + 0.26 * most)), layout="constrained"
        )
        axes = figure.subplots(lines, columns, squeeze=False, sharex=True)
        for ax, (setting, panel) in zip(axes.flat, panels.items(), strict=False):
            _draw_split(ax, panel, limit)
            ax.set_title("failure cost {:g} s, walk {:g}, drive {:g} km/h".format(*setting))
        for ax in axes.flat[len(panels) :]:
            ax.remove()
        for column in range(columns):
            lowest = (len(panels) - 1 - column) // columns
            axes[lowest, column].tick_params(labelbottom=True)
            axes[lowest, column].set_xlabel("mean total time, s; 95 % interval", color="#444444")
        handles: list[Any] = [
            Patch(color=term.color, label=term.label)
            for term in COST_TERMS
            if not term.optional or any(row[term.field] for row in rows)
        ]
        handles.append(
            Line2D([], [], color=INK, linestyle=(0, (3, 2)), linewidth=1.2, label="clairvoyant lower bound")
        )
        labels, most = [handle.get_label() for handle in handles], 5 if columns > 1 else 3
        keys = legend_columns(labels, figure.get_figwidth(), most)
        figure.legend(handles=handles, loc="outside lower center", ncols=keys)
        _name(figure, rows)
    return figure


def _draw_split(ax: Axes, rows: Sequence[Row], limit: float) -> None:
    y = np.arange(len(rows))
    total = np.array([row["total_s"] for row in rows])
    left = np.zeros(len(rows))
    for term in COST_TERMS:
        part = np.array([row[term.field] for row in rows])
        ax.barh(
            y,
            np.minimum(left + part, limit) - np.minimum(left, limit),
            0.66,
            np.minimum(left, limit),
            color=term.color,
        )
        left += part
    for i, row in enumerate(rows):
        low, high = _interval(row)
        cut = total[i] > limit
        if low < limit and not cut:
            ax.plot([low, min(high, limit)], [i, i], color=INK, linewidth=1.3, solid_capstyle="butt")
            ends = [end for end in (low, high) if end <= limit]
            ax.plot(ends, [i] * len(ends), linestyle="none", marker="|", color=INK, markersize=6)
        if cut:
            _draw_break(ax, i, limit)
        weight = "bold" if total[i] == total.min() else "normal"
        ax.annotate(
            f"{total[i]:,.0f} s",
            (1.0, i),
            (44, 0),
            xycoords=ax.get_yaxis_transform(),
            textcoords="offset points",
            va="center",
            ha="right",
            weight=weight,
            annotation_clip=False,
        )
    if all(row.get("bound_s") is not None for row in rows):
        bound = float(np.mean([row["bound_s"] for row in rows]))
        ax.axvline(bound, color=INK, linestyle=(0, (3, 2)), linewidth=1.2, zorder=3)
    ax.set(xlim=(0, limit), ylim=(len(rows) - 0.5, -0.5))
    ax.set_yticks(y, [row["agent"] for row in rows])
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)
    ax.grid(axis="x")


def _draw_break(ax: Axes, y: float, limit: float) -> None:
    """Mark a truncated bar with two slanted lines near its end."""
    slant = np.array([[-0.008, 0.46], [0.008, -0.46]])
    for at in (0.925, 0.95):
        xy = np.array([at, y]) + slant
        ax.plot(limit * xy[:, 0], xy[:, 1], color="white", linewidth=2.6)


def draw_time_against_occupancy(rows: Sequence[Row], about: str = "") -> Figure:
    """Draw the total time against occupancy: a panel per failure cost, a line per agent.

    Args:
        rows: rows with occupancy (0..1), agent, failure_cost_s, total_s, total_s_ci95.
        about: what else the rows have in common; follows the failure cost in the titles.
    """
    _require_rows(rows)
    costs = sorted({row["failure_cost_s"] for row in rows})
    columns = min(len(costs), 2)
    lines = -(-len(costs) // columns)
    limit = _limit(rows)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.0 if columns == 1 else 10.0, 0.4 + 3.7 * lines), layout="constrained")
        axes = figure.subplots(lines, columns, squeeze=False, sharey=True)
        for ax, cost in zip(axes.flat, costs, strict=False):
            its = [row for row in rows if row["failure_cost_s"] == cost]
            _draw_lines(ax, its, limit, lambda row: 100.0 * float(row["occupancy"]))
            ax.set_title(f"failure cost {cost:g} s{about}")
            ax.set_xlabel("occupancy at the arrival, %")
        for ax in axes.flat[len(costs) :]:
            ax.remove()
        for ax in axes[:, 0]:
            ax.set_ylabel("mean total time, s; 95 % interval")
        _name(figure, rows)
    return figure


def draw_time_against_decision_time(panels: Mapping[str, Sequence[Row]]) -> Figure:
    """Draw the total time against that of a decision: a panel per scenario, a line per planner; oracles are left out.

    Args:
        panels: rows of each scenario with planner, total_s, total_s_ci95 and decision_ms, the median.
    """
    panels = {name: [row for row in rows if row["agent"] not in UNBEATEN] for name, rows in panels.items()}
    _require_rows([row for rows in panels.values() for row in rows])
    columns = min(len(panels), 4)
    lines = -(-len(panels) // columns)
    planners = list(dict.fromkeys(row["planner"] for rows in panels.values() for row in rows))
    width = max(3.0 * columns, 4.6)
    keys = legend_columns(planners, width, min(len(planners), 2 + columns))
    with mpl.rc_context(STYLE):
        size = width, 2.7 * lines + 0.2 * -(-len(planners) // keys)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(lines, columns, squeeze=False, sharex=True)
        for ax, (name, rows) in zip(axes.flat, panels.items(), strict=False):
            # The first planner lies on top of the others.
            for order, planner in enumerate(reversed(planners)):
                own = sorted(
                    (r for r in rows if r["planner"] == planner), key=lambda r: float(r["decision_ms"])
                )
                _draw_in_time(ax, own, agent_color(planner.partition("(")[0]), 2.0 + 0.01 * order)
            episodes = {row["episodes"] for row in rows}
            each = f" ({plural(episodes.pop(), 'search', 'searches')})" if len(episodes) == 1 else ""
            ax.set_title(f"{name}{each}", weight="bold")
            ax.set(xscale="log")
            ax.xaxis.set_major_formatter("{x:g}")
            ax.xaxis.set_minor_formatter(NullFormatter())
            ax.grid(axis="y")
        for ax in axes.flat[len(panels) :]:
            ax.remove()
        for i, ax in enumerate(axes.flat[: len(panels)]):
            if i % columns == 0:
                ax.set_ylabel("mean total time, s; 95 % interval")
            if i + columns >= len(panels):
                ax.tick_params(labelbottom=True)
                ax.set_xlabel("time of a decision, ms")
        handles = [
            Line2D([], [], color=agent_color(p.partition("(")[0]), linewidth=2.0, marker="o", label=p)
            for p in planners
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=keys, columnspacing=1.4)
    return figure


def _draw_in_time(ax: Axes, rows: Sequence[Row], color: str, order: float) -> None:
    """Draw a planner's totals with their intervals; one that takes no longer for more is also a level line."""
    x = np.array([row["decision_ms"] for row in rows])
    total = np.array([row["total_s"] for row in rows])
    low, high = np.array([_interval(row) for row in rows], dtype=np.float64).reshape(-1, 2).T
    ax.errorbar(
        x, total, [total - low, high - total], color=color, linewidth=1.8, marker="o", markersize=4.0,
        elinewidth=1.0, capsize=2.0, zorder=order,
    )  # fmt: skip
    if len(rows) == 1:
        ax.axhline(total[0], color=color, linestyle=(0, (1, 2)), linewidth=1.0, zorder=order - 1.0)


def draw_time_against_failure_cost(observed: Sequence[Row], blind: Sequence[Row]) -> Figure:
    """Draw the total time against the failure cost, with and without observations of slots before an attempt.

    Args:
        observed: rows of one scenario with failure_cost_s, agent, total_s, total_s_ci95.
        blind: the same without observations from the lane.
    """
    _require_rows(observed)
    _require_rows(blind)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11.0, 4.2), layout="constrained")
        panels = (
            ("slots observed from the lane", observed),
            ("no observation before an attempt (agents that can)", blind),
        )
        for ax, (title, rows) in zip(figure.subplots(1, 2), panels, strict=True):
            _draw_lines(ax, rows, _limit(rows), lambda row: float(row["failure_cost_s"]))
            last = max(row["failure_cost_s"] for row in rows)
            # A symmetric log scale includes a cost of 0.
            ax.set_xscale("symlog", linthresh=1.0, linscale=0.4)
            ticks = [tick for tick in (0, 1, 2, 5, 10, 20, 50, 100) if tick <= last]
            ax.set(xlim=(0.0, 1.08 * last), xticks=ticks, xticklabels=[str(tick) for tick in ticks])
            ax.minorticks_off()
            ax.set_title(title)
            ax.set_xlabel("failure cost, s (in the world and in the planners' models)")
            ax.set_ylabel("mean total time, s; 95 % interval")
        _name(figure, observed)
    return figure


def draw_time_against_map(rows: Sequence[Row], own: Sequence[Row], forecast: Mapping[str, float]) -> Figure:
    """Draw the total time against a forecast that is the same for every slot.

    Args:
        rows: rows with scenario, agent, total_s, total_s_ci95, of one world with several flat forecasts.
        own: rows of the same world with its own forecast, drawn dashed.
        forecast: P(taken) of each flat forecast, by scenario.
    """
    _require_rows(rows)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.6, 4.2), layout="constrained")
        ax = figure.subplots()
        limit = _limit(rows)
        _draw_lines(ax, rows, limit, lambda row: 100.0 * forecast[row["scenario"]])
        for row in own:
            color = agent_color(row["agent"])
            ax.axhline(row["total_s"], color=color, linewidth=0.9, linestyle=(0, (2, 3)), zorder=1)
        ax.set_title("dashed: with the scenario's own forecast")
        ax.set_xlabel("forecast P(taken) of every slot, %")
        ax.set_ylabel("mean total time, s; 95 % interval")
        _name(figure, own or rows)
    return figure


def _draw_lines(ax: Axes, rows: Sequence[Row], limit: float, along: Callable[[Row], float]) -> None:
    """Draw a line per agent; `along` returns a row's x value."""
    ends = []
    places = [along(row) for row in rows]
    for agent in dict.fromkeys(row["agent"] for row in rows):
        own = sorted((row for row in rows if row["agent"] == agent), key=along)
        color = agent_color(agent)
        x = np.array([along(row) for row in own])
        total = np.array([row["total_s"] for row in own])
        # NaN where there is no interval, e.g. of a single search: no band there.
        low, high = np.array([row["total_s_ci95"] for row in own], dtype=np.float64).T
        dashes = (0, (4, 2)) if agent in UNBEATEN else "-"
        # The interval of a line beyond the limit would only cover the others.
        ax.fill_between(x, low, high, where=total <= limit, color=color, alpha=0.07, linewidth=0)
        ax.plot(x, total, color=color, linestyle=dashes, linewidth=1.8, marker="o", markersize=3.5)
        ends.append((total[-1], x[-1], agent, color))
    ax.set(xlim=(min(places) - 1.0, max(places) + 1.0), ylim=(0, limit))
    ends.sort()
    heights = spread([min(total / limit, 1.0) for total, *_ in ends], 0.062)
    for (total, x, agent, color), height in zip(ends, heights, strict=True):
        off = total > limit
        link = {"arrowstyle": "-", "color": color, "linewidth": 0.7, "relpos": (0, 0.5), "shrinkB": 3}
        ax.annotate(
            f"{agent} ↑ {total:,.0f} s" if off else agent,
            (x, min(total, limit)),
            (1.035, height),
            textcoords="axes fraction",
            va="center",
            color=color,
            weight="bold",
            fontsize=8.5,
            arrowprops=None if off else link,
            annotation_clip=False,
        )
    ax.grid(axis="y")


def spread(places: Sequence[float], gap: float) -> FloatArray:
    """Move ascending positions at least `gap` apart, as little as possible, and not above 1 if they fit."""
    spread = np.array(places, dtype=np.float64)
    for i in range(1, len(spread)):
        spread[i] = max(spread[i], spread[i - 1] + gap)
    spread[-1:] = np.minimum(spread[-1:], max(1.0, gap * (len(spread) - 1)))
    for i in range(len(spread) - 2, -1, -1):
        spread[i] = min(spread[i], spread[i + 1] - gap)
    return spread


def _limit(rows: Sequence[Row]) -> float:
    """Return the upper limit of the total-time axis: above all totals within `OFF_SCALE` medians."""
    total = np.array([row["total_s"] for row in rows])
    near = total[total <= OFF_SCALE * np.median(total)]
    return float(1.12 * near.max()) or 1.0


def _interval(row: Row) -> tuple[float, float]:
    """Return the confidence interval of the total; the mean twice if there is none, or of too few searches."""
    if row.get("episodes", LEAST_SEARCHES) < LEAST_SEARCHES:
        return row["total_s"], row["total_s"]
    low, high = (row["total_s"] if end is None or end != end else end for end in row["total_s_ci95"])
    return low, high


def _require_rows(rows: Sequence[Row]) -> None:
    if not rows:
        raise InputError("no rows to draw")


def _name(figure: Figure, rows: Sequence[Row]) -> None:
    """Title a figure with the scenario if all rows share it."""
    names = {row.get("scenario") for row in rows} - {None}
    episodes = {int(row["episodes"]) for row in rows if "episodes" in row}
    if len(names) == 1:
        each = f", {plural(episodes.pop(), 'search', 'searches')} each" if len(episodes) == 1 else ""
        figure.suptitle(f"{names.pop()}{each}", x=0.01, ha="left", weight="bold")


Totals = Mapping[str, FloatArray]
"""Total times of each agent, (n_episodes,) s, by name."""

BOUND = "clairvoyant lower bound"
_AXIS_END = 2.5
"""The time axis ends at this multiple of the median, so that rare long searches do not compress the rest."""
_DASHED = ("oracle", BOUND)


def draw_time_distribution(panels: Mapping[str, Totals]) -> Figure:
    """Draw the empirical distribution functions of total times, with each agent's mean as a dot on its curve."""
    if not panels or not any(panels.values()):
        raise InputError("no total times to draw")
    columns = len(panels) if len(panels) < 4 else 2 if len(panels) == 4 else 3
    lines = -(-len(panels) // columns)
    names = list(dict.fromkeys(name for totals in panels.values() for name in totals))
    width, mean = (4.6, 7.2, 9.6)[columns - 1], "mean (▸ beyond the axis)"
    keys = legend_columns([*names, mean], width, min(len(names) + 1, 3 if columns == 1 else 5))
    with mpl.rc_context(STYLE):
        size = width, 2.6 * lines + 0.3 + 0.2 * -(-(len(names) + 1) // keys)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(lines, columns, squeeze=False, sharey=True)
        for ax, (name, totals) in zip(axes.flat, panels.items(), strict=False):
            _draw_panel(ax, totals)
            episodes = {len(its) for its in totals.values()}
            each = f" ({plural(episodes.pop(), 'search', 'searches')})" if len(episodes) == 1 else ""
            ax.set_title(f"{name}{each}", weight="bold")
        for ax in axes.flat[len(panels) :]:
            ax.remove()
        for i, ax in enumerate(axes.flat[: len(panels)]):
            if i % columns == 0:
                ax.set_ylabel("searches that took at most this long, %")
        handles = [
            Line2D([], [], color=_color(name), linestyle=_dashes(name) or "-", linewidth=2.0, label=name)
            for name in names
        ]
        handles.append(
            Line2D(
                [], [], linestyle="none", marker="o", markersize=6, color="#777777", markeredgecolor="white",
                label=mean,
            )
        )  # fmt: skip
        figure.legend(
            handles=handles, loc="outside lower center", ncols=keys, handlelength=2.0, columnspacing=1.4
        )
    return figure


def _draw_panel(ax: Axes, totals: Totals) -> None:
    everything = np.concatenate(list(totals.values()))
    low, high = float(everything.min()), float(everything.max())
    end = min(high, _AXIS_END * float(np.median(everything)))
    margin = 0.04 * (end - low) or 1.0
    limit = end + margin
    # Draw the first agent on top of the others.
    for order, name in enumerate(reversed(list(totals))):
        times = np.sort(totals[name])
        share = 100.0 * np.arange(1, len(times) + 1) / len(times)
        x, y = np.r_[times[0], times, max(limit, times[-1])], np.r_[0.0, share, 100.0]
        ax.step(
            x, y, where="post", color=_color(name), linestyle=_dashes(name) or "-", linewidth=1.7,
            zorder=2 + 0.01 * order,
        )  # fmt: skip
        # Show a mean beyond the axis as a triangle at its end.
        mean = float(times.mean())
        at = min(mean, limit)
        height = 100.0 * float(np.searchsorted(times, at, side="right")) / len(times)
        ax.plot(
            at, height, marker="o" if mean < limit else ">", markersize=6, color=_color(name),
            markeredgecolor="white", markeredgewidth=1.0, zorder=3 + 0.01 * order, clip_on=False,
        )  # fmt: skip
    ax.set(xlim=(max(low - margin, 0.0), limit), ylim=(0.0, 102.0), yticks=[0, 25, 50, 75, 100])
    longer = 100.0 * float(np.mean(everything > end))
    note = f"; {longer:.0f} % longer, up to {high:,.0f} s" if longer >= 0.5 else ""
    ax.set_xlabel(f"total time, s{note}")
    ax.grid(axis="both")


def _color(name: str) -> str:
    return INK if name in _DASHED else agent_color(name)


def _dashes(name: str) -> tuple[float, Sequence[float]] | None:
    return (0.0, (4.0, 2.0)) if name in _DASHED else None
