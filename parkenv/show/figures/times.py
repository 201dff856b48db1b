"""Charts of searches: total times by part, setting and share of the searches; days of a commute; training."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from zlib import crc32

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import require
from parkenv.files.known_names import FIXED, NONE, UNBEATEN
from parkenv.show.figures.charts import (
    BOLD,
    COLORS,
    Line,
    Mark,
    Panel,
    Row,
    draw_panels,
    key_line,
    legend_columns,
    level,
    spread,
)
from parkenv.show.figures.picture_files import INK, STYLE, picture, save_picture
from parkenv.show.tables import LEAST_SEARCHES, SETTING_AXES, plural
from parkenv.world.cost_terms import COST_TERMS

# Each agent has one colour in all figures, distinguishable with any colour vision (Okabe-Ito and Tol).
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
    "network": "#44aa99",
    "dqn": "#999933",
    "ppo": "#332288",
    "maskable-ppo": "#aa4499",
}
_OTHERS = ("#5c4a3d", "#a6761d", "#6a3d9a", "#1b7a8c", "#b15928")
OFF_SCALE = 3.0  # totals above this multiple of the median are cut off, so that they do not compress the rest
BOUND = "clairvoyant lower bound"
_AXIS_END = 2.5  # the axis of a distribution ends at this multiple of the median
_TOTAL = "mean total time, s; 95 % interval"
Totals = Mapping[str, FloatArray]  # total times of each agent, (n_episodes,) s, by name


def agent_color(agent: str) -> str:
    return AGENT_COLORS.get(agent, _OTHERS[crc32(agent.encode()) % len(_OTHERS)])


@mpl.rc_context(STYLE)
def draw_time_split(rows: Sequence[Row]) -> Figure:
    limit = _limit(rows)
    settings: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        settings.setdefault(tuple(row[k] for k in SETTING_AXES), []).append(row)
    most = max(map(len, settings.values()))
    columns = 1 if len(settings) == 1 else 2 if len(settings) <= 4 else 3
    width = (6.5, 9.0, 12.0)[columns - 1]
    key: list[Any] = [
        Patch(color=term.color, label=term.label)
        for term in COST_TERMS
        if not term.optional or any(row[term.field] for row in rows)
    ]
    key.append(key_line(BOUND, INK, linestyle=(0, (3, 2)), linewidth=1.2))
    keys = legend_columns([handle.get_label() for handle in key], width, 5 if columns > 1 else 3)
    panels = [
        Panel(
            [partial(_draw_split, of_setting, limit)],
            "failure cost {:g} s, walk {:g}, drive {:g} km/h".format(*setting),
            {"xlim": (0, limit), "ylim": (len(of_setting) - 0.5, -0.5)},
            "x",
        )
        for setting, of_setting in settings.items()
    ]
    size = width, 0.95 + -(-len(panels) // columns) * (0.62 + 0.26 * most)
    style: dict[str, Any] = {"key": key, "key_style": {"ncols": keys}, "label": {"x": _TOTAL}, "share": "x"}
    figure = draw_panels(panels, size, columns, _name(rows), bold=True, **style)
    for ax in figure.axes:
        ax.xaxis.label.set_color(_GREY)
    return figure


def _draw_split(rows: Sequence[Row], limit: float, ax: Axes) -> None:
    y, left = np.arange(len(rows)), np.zeros(len(rows))
    total = np.array([row["total_s"] for row in rows])
    for term in COST_TERMS:
        right = left + np.array([row[term.field] for row in rows])
        start = np.minimum(left, limit)
        ax.barh(y, np.minimum(right, limit) - start, 0.66, start, color=term.color)
        left = right
    for i, row in enumerate(rows):
        low, high = _interval(row)
        if total[i] > limit:
            _draw_break(ax, i, limit)
        elif low < limit:
            ax.plot([low, min(high, limit)], [i, i], color=INK, linewidth=1.3, solid_capstyle="butt")
            ends = [end for end in (low, high) if end <= limit]
            ax.plot(ends, [i] * len(ends), linestyle="none", marker="|", color=INK, markersize=6)
        ax.annotate(
            f"{total[i]:,.0f} s", (1.0, i), (44, 0), xycoords=ax.get_yaxis_transform(), textcoords="offset points",
            va="center", ha="right", weight="bold" if total[i] == total.min() else "normal", annotation_clip=False,
        )  # fmt: skip
    if all(row.get("bound_s") is not None for row in rows):
        bound = float(np.mean([row["bound_s"] for row in rows]))
        ax.axvline(bound, color=INK, linestyle=(0, (3, 2)), linewidth=1.2, zorder=3)
    ax.set_yticks(y, [row["agent"] for row in rows])
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)


def _draw_break(ax: Axes, y: float, limit: float) -> None:
    slant = np.array([[-0.008, 0.46], [0.008, -0.46]])
    for at in (0.925, 0.95):
        xy = np.array([at, y]) + slant
        ax.plot(limit * xy[:, 0], xy[:, 1], color="white", linewidth=2.6)


def draw_time_against_occupancy(rows: Sequence[Row], about: str = "") -> Figure:
    limit = _limit(rows)
    panels = [
        _lines(
            [row for row in rows if row["failure_cost_s"] == cost],
            lambda row: 100.0 * float(row["occupancy"]),
            f"failure cost {cost:g} s{about}",
            limit,
            xlabel="occupancy at the arrival, %",
        )
        for cost in sorted({row["failure_cost_s"] for row in rows})
    ]
    columns = min(len(panels), 2)
    size = 6.0 if columns == 1 else 10.0, 0.4 + 3.7 * -(-len(panels) // columns)
    return draw_panels(panels, size, columns, _name(rows), share="y", label={"y": _TOTAL}, bold=True)


def draw_time_against_failure_cost(observed: Sequence[Row], blind: Sequence[Row]) -> Figure:
    def panel(rows: Sequence[Row], title: str) -> Panel:
        last = max(row["failure_cost_s"] for row in rows)
        ticks = [tick for tick in (0, 1, 2, 5, 10, 20, 50, 100) if tick <= last]
        axes: dict[str, Any] = {
            "xlim": (0.0, 1.08 * last),
            "xticks": ticks,
            "xticklabels": [*map(str, ticks)],
        }
        axes |= {"xlabel": "failure cost, s (in the world and in the planners' models)", "ylabel": _TOTAL}
        lines = _lines(rows, lambda row: float(row["failure_cost_s"]), title, _limit(rows), **axes)
        return lines._replace(marks=[*lines.marks, _scale_by_decades])

    panels = [
        panel(observed, "slots observed from the lane"),
        panel(blind, "no observation before an attempt (agents that can)"),
    ]
    return draw_panels(panels, (11.0, 4.2), 2, _name(observed), bold=True)


def _scale_by_decades(ax: Axes) -> None:
    # A symmetric log scale includes a cost of 0.
    ax.set_xscale("symlog", linthresh=1.0, linscale=0.4)
    ax.minorticks_off()


def draw_time_against_map(rows: Sequence[Row], own: Sequence[Row], forecast: Mapping[str, float]) -> Figure:
    title = "dashed: with the scenario's own forecast"
    labels = {"xlabel": "forecast P(taken) of every slot, %", "ylabel": _TOTAL}
    lines = _lines(rows, lambda row: 100.0 * forecast[row["scenario"]], title, _limit(rows), **labels)
    dashed = [
        level(row["total_s"], agent_color(row["agent"]), linewidth=0.9, linestyle=(0, (2, 3)), zorder=1)
        for row in own
    ]
    panel = lines._replace(marks=[*lines.marks, *dashed])
    return draw_panels([panel], (6.6, 4.2), 1, _name(own or rows), bold=True)


def _lines(
    rows: Sequence[Row], along: Callable[[Row], float], title: str, limit: float, **axes: Any
) -> Panel:
    """Return a panel with a line per agent, named at its end; `along` returns a row's x value."""
    lines, ends = [], []
    for agent in dict.fromkeys(row["agent"] for row in rows):
        own = sorted((row for row in rows if row["agent"] == agent), key=along)
        x, total = (np.array([value(row) for row in own]) for value in (along, lambda row: row["total_s"]))
        # NaN where there is no interval, and where the line is beyond the limit: no band there.
        band = np.array([row["total_s_ci95"] for row in own], dtype=np.float64).T
        band[:, total > limit] = np.nan
        dashes = (0, (4, 2)) if agent in UNBEATEN else "-"
        style = {"linestyle": dashes, "linewidth": 1.8, "marker": "o", "markersize": 3.5}
        lines.append(Line(x, total, agent_color(agent), style, (band[0], band[1]), 0.07))
        ends.append((total[-1], x[-1], agent))
    ends_x = [along(row) for row in rows]
    axes = {"xlim": (min(ends_x) - 1.0, max(ends_x) + 1.0), "ylim": (0, limit)} | axes
    return Panel([*lines, partial(_name_ends, sorted(ends), limit)], title, axes, "y")


def _name_ends(ends: Sequence[tuple[float, float, str]], limit: float, ax: Axes) -> None:
    heights = spread([min(total / limit, 1.0) for total, *_ in ends], 0.062)
    for (total, x, agent), height in zip(ends, heights, strict=True):
        color, off = agent_color(agent), total > limit
        link = {"arrowstyle": "-", "color": color, "linewidth": 0.7, "relpos": (0, 0.5), "shrinkB": 3}
        ax.annotate(
            f"{agent} ↑ {total:,.0f} s" if off else agent, (x, min(total, limit)), (1.035, height),
            textcoords="axes fraction", va="center", color=color, weight="bold", fontsize=8.5,
            arrowprops=None if off else link, annotation_clip=False,
        )  # fmt: skip


@mpl.rc_context(STYLE)
def draw_time_distribution(panels: Mapping[str, Totals]) -> Figure:
    require(panels and any(panels.values()), "no total times to draw")
    columns = len(panels) if len(panels) < 4 else 2 if len(panels) == 4 else 3
    names = list(dict.fromkeys(name for totals in panels.values() for name in totals))
    width, mean = (4.6, 7.2, 9.6)[columns - 1], "mean (▸ beyond the axis)"
    keys = legend_columns([*names, mean], width, min(len(names) + 1, 3 if columns == 1 else 5))
    key = [key_line(name, linewidth=2.0, **_curve_style(name)) for name in names]
    key.append(key_line(mean, "#777777", linestyle="none", marker="o", markersize=6, markeredgecolor="white"))
    return draw_panels(
        [
            _distribution(totals, f"{name}{_each([len(times) for times in totals.values()])}")
            for name, totals in panels.items()
        ],
        (width, 2.6 * -(-len(panels) // columns) + 0.3 + 0.2 * -(-(len(names) + 1) // keys)),
        columns, share="y", label={"y": "searches that took at most this long, %"}, key=key,
        key_style={"ncols": keys, "handlelength": 2.0, "columnspacing": 1.4},
    )  # fmt: skip


def _curve_style(name: str) -> dict[str, Any]:
    dashed = name in ("oracle", BOUND)
    return {"color": INK if dashed else agent_color(name), "linestyle": (0.0, (4.0, 2.0)) if dashed else "-"}


def _distribution(totals: Totals, title: str) -> Panel:
    everything = np.concatenate(list(totals.values()))
    low, high = float(everything.min()), float(everything.max())
    end = min(high, _AXIS_END * float(np.median(everything)))
    margin = 0.04 * (end - low) or 1.0
    limit = end + margin

    marks = []
    # The first agent lies on top of the others.
    for order, name in enumerate(reversed(list(totals))):
        style, times = _curve_style(name), np.sort(totals[name])
        color = style.pop("color")
        share = 100.0 * np.arange(1, len(times) + 1) / len(times)
        x, y = np.r_[times[0], times, max(limit, times[-1])], np.r_[0.0, share, 100.0]
        steps = {"drawstyle": "steps-post", "linewidth": 1.7, "zorder": 2 + 0.01 * order}
        # A mean beyond the axis is a triangle at its end.
        mean = min(float(times.mean()), limit)
        height = 100.0 * float(np.searchsorted(times, mean, side="right")) / len(times)
        dot = {
            "marker": "o" if mean < limit else ">", "markersize": 6, "markeredgecolor": "white",
            "markeredgewidth": 1.0, "zorder": 3 + 0.01 * order, "clip_on": False,
        }  # fmt: skip
        marks += [Line(x, y, color, steps | style), Line(mean, height, color, dot)]
    longer = 100.0 * float(np.mean(everything > end))
    note = f"; {longer:.0f} % longer, up to {high:,.0f} s" if longer >= 0.5 else ""
    axes = {"xlim": (max(low - margin, 0.0), limit), "ylim": (0.0, 102.0), "yticks": [0, 25, 50, 75, 100]}
    return Panel(marks, title, axes | {"xlabel": f"total time, s{note}"}, title_style=BOLD)


def _limit(rows: Sequence[Row]) -> float:
    require(rows, "no rows to draw")
    total = np.array([row["total_s"] for row in rows])
    return float(1.12 * total[total <= OFF_SCALE * np.median(total)].max()) or 1.0


def _interval(row: Row) -> tuple[float, float]:
    """Return the confidence interval of the total; the mean twice if there is none, or of too few searches."""
    if row.get("episodes", LEAST_SEARCHES) < LEAST_SEARCHES:
        return row["total_s"], row["total_s"]
    low, high = (row["total_s"] if end is None or end != end else end for end in row["total_s_ci95"])
    return low, high


def _name(rows: Sequence[Row]) -> str:
    names = {row.get("scenario") for row in rows} - {None}
    each = _each([int(row["episodes"]) for row in rows if "episodes" in row]).strip(" ()")
    return f"{names.pop()}{f', {each} each' if each else ''}" if len(names) == 1 else ""


def _each(searches: Sequence[int]) -> str:
    return f" ({plural(searches[0], 'search', 'searches')})" if len(set(searches)) == 1 else ""


_WORDS = {"empty": "empty map at first", "right": "right map at first", "wrong": "wrong map at first"}
_DASHES = ("-", (0, (5, 1.5)), (0, (2, 1)), (0, (5, 1, 1, 1)))  # lines of an agent with different options
_FIXED_LINE: dict[str, Any] = {"linewidth": 1.2, "linestyle": (0, (1, 1))}
_GREY = "#444444"
_NONE_LINE: dict[str, Any] = {"linewidth": 1.4, "linestyle": (0, (4, 2))}


@mpl.rc_context(STYLE)
def save_commute_curves(rows: Sequence[Row], path: Path) -> None:
    """Draw a column of panels for each scenario and map: time and forecast error of each agent against the day.

    Excess time is what a search takes beyond that of the first agent with the right map, which does not learn, in the
    same worlds (10 % trimmed mean). Shaded are 95 % intervals. All of the first agent's curve is in the panel; others
    may leave it.
    """
    columns = list(dict.fromkeys((r["scenario"], r["map"]) for r in rows if r["map"] not in (FIXED, NONE)))
    if not columns:
        return
    above, below = list[Panel](), list[Panel]()
    for scenario, start in columns:
        its = {
            m: [r for r in rows if (r["scenario"], r["map"]) == (scenario, m)] for m in (start, NONE, FIXED)
        }
        right = [row for row in its[FIXED] if row["agent"] == its[FIXED][0]["agent"]]
        last = max(row["day"] for row in rows if row["scenario"] == scenario)
        axes: dict[str, Any] = {"xlim": (0.5, last + 0.5)}
        zero = f"0 = {right[0]['agent']}, right map: {np.mean([row['total_s'] for row in right]):.0f} s"
        excess, limits = _excess(its[start], its[NONE])
        above.append(Panel(excess, f"{scenario}, {_WORDS[start]}\n{zero}", axes | {"ylim": limits}, "y"))
        error: list[Mark] = [
            Line(
                [row["day"] for row in right],
                [row["forecast_error"] for row in right],
                _GREY,
                _FIXED_LINE | {"zorder": 1},
            ),
            *_bands(its[start], "forecast_error"),
            lambda ax: ax.xaxis.set_major_locator(MaxNLocator(integer=True)),
        ]
        below.append(Panel(error, "", axes | {"xlabel": "day", "ylim": (0.0, None)}, "y"))
    learn = [row for row in rows if row["map"] not in (FIXED, NONE)]
    colors = {row["agent"]: _color(row["agent"]) for row in rows}
    key = [
        key_line(f"{a}, learning", colors[a], linewidth=2.0, linestyle=d) for a, d in _dashes(learn).items()
    ]
    without = dict.fromkeys(row["agent"] for row in rows if row["map"] == NONE)
    key += [key_line(f"{agent}, no map", colors[agent], **_NONE_LINE) for agent in without]
    key.append(key_line("right map that does not learn", _GREY, **_FIXED_LINE))
    size = 1.2 + max(2.9 * len(columns), 4.4), 5.6
    keys = {"ncols": max(2, int(size[0] // 2.2))}
    figure = draw_panels([*above, *below], size, len(columns), share="column", key=key, key_style=keys)
    figure.axes[0].set_ylabel("excess time, s (trimmed mean)")
    figure.axes[len(columns)].set_ylabel("forecast error (Brier score)")
    save_picture(figure, path, "Time and forecast error of drivers whose map learns from every trip")


def _excess(learned: Sequence[Row], others: Sequence[Row]) -> tuple[list[Mark], tuple[float, float]]:
    """Return the excess of learning agents and of those without a map, and limits of the axis.

    Lines far above are named at the top.
    """
    levels = {
        agent: float(np.mean([row["excess_s"] for row in others if row["agent"] == agent]))
        for agent in dict.fromkeys(row["agent"] for row in others)
    }
    first = [row["excess_s"] for row in learned if row["agent"] == learned[0]["agent"]]
    nearest = min(levels.values(), default=0.0)
    low, high = np.percentile([row["excess_s"] for row in learned], [10.0, 90.0])
    top, bottom = max(*first, nearest, high, 1.0), min(*first, nearest, low, 0.0)
    margin = 0.2 * (top - bottom)
    far = {agent: excess for agent, excess in levels.items() if excess > top + margin}
    words = "\n".join(f"{agent} \N{UPWARDS ARROW} {excess:+.0f} s" for agent, excess in far.items())

    def name_far(ax: Axes) -> None:
        ax.text(0.98, 0.97, words, transform=ax.transAxes, ha="right", va="top", color=_GREY)

    marks: list[Mark] = [level(0.0, _GREY, linewidth=0.9, zorder=1), *_bands(learned, "excess_s")]
    marks += [
        level(excess, _color(agent), **_NONE_LINE, zorder=1)
        for agent, excess in levels.items()
        if agent not in far
    ]
    return [*marks, name_far], (bottom - margin, top + margin)


def _bands(rows: Sequence[Row], measure: str) -> Iterator[Line]:
    for agent, dashes in _dashes(rows).items():
        its = [row for row in rows if row["agent"] == agent]
        low, high = np.array([row[f"{measure}_ci95"] for row in its], float).T
        style = {"linewidth": 1.8, "linestyle": dashes}
        mean = [row[measure] for row in its]
        yield Line([row["day"] for row in its], mean, _color(agent), style, (low, high), 0.18)


def _color(agent: str) -> str:
    return agent_color(agent.partition("(")[0])


def _dashes(rows: Sequence[Row]) -> dict[str, Any]:
    colors = {row["agent"]: _color(row["agent"]) for row in rows}
    alike = {color: [agent for agent in colors if colors[agent] == color] for color in colors.values()}
    return {agent: _DASHES[alike[color].index(agent) % len(_DASHES)] for agent, color in colors.items()}


# Colours of trainings: as many as are easy to tell apart.
TRAINING_COLORS = (*COLORS, "#555555")
OFF_CURVES = 2.0  # times above this multiple of the lowest are cut off
_NAMES_APART = 0.045  # least distance of two labels, fraction of the axis
_MARGIN_IN = 0.12  # beside the labels, inches


def save_learning_curves(
    curves: Mapping[str, Sequence[Sequence[Row]]],
    means: Mapping[str, Sequence[Row]],
    planners: Mapping[str, float],
    title: str,
    path: Path,
) -> None:
    """Draw each algorithm's total time, and planners as horizontal lines.

    A single algorithm is drawn as the mean over seeds with its interval. Several are drawn as medians: their intervals
    would hide each other, and medians are robust against single searches that drive in circles. Single seeds are thin
    lines.
    """
    alone, lines, highest = len(curves) == 1, list[Line](), 0.0
    for (name, seeds), color in zip(curves.items(), TRAINING_COLORS, strict=False):
        for single in seeds:
            steps, total = [r["steps"] for r in single], [r["total_s"] for r in single]
            lines.append(Line(steps, total, color, {"linewidth": 0.5, "alpha": 0.35}))
        rows = means[name]
        mean = [row["total_s" if alone else "median_s"] for row in rows]
        words = f"{'' if alone or len(seeds) == 1 else 'median of '}{len(seeds)} seeds"
        ends = [row["low_s"] for row in rows], [row["high_s"] for row in rows]
        style, band = (
            {"linewidth": 2.0, "label": f"{name}, {words}"},
            ends if alone and len(seeds) > 1 else None,
        )
        lines.append(Line([row["steps"] for row in rows], mean, color, style, band))
        highest = max([highest, *mean[len(mean) // 10 :]])
    low = min(
        [*planners.values(), *(row["total_s"] for its in curves.values() for seed in its for row in seed)]
    )
    # An untrained policy drives in circles, so cut off high values to keep the end of the curves readable.
    high = min(max([highest, *planners.values()]), OFF_CURVES * low)
    margin = 0.06 * (high - low) or 1.0
    bottom, top = low - margin, high + margin

    def mark_planners(ax: Axes) -> None:
        shown = sorted(((t, name) for name, t in planners.items() if t <= top), key=lambda pair: pair[0])
        for (seconds, name), height in zip(
            shown,
            spread([(seconds - bottom) / (top - bottom) for seconds, _ in shown], _NAMES_APART),
            strict=True,
        ):
            ax.axhline(seconds, color=INK, lw=0.8, ls=(0, (4, 3)), zorder=1)
            ax.annotate(
                f"{name}  {seconds:.1f}", (1.0, height), xycoords="axes fraction", xytext=(5, 0),
                textcoords="offset points", va="center", fontsize=8, color=INK,
            )  # fmt: skip

    labels = {"xlabel": "decisions in training", "ylabel": "mean total time, s"}
    key = {
        "loc": "upper right", "frameon": True, "facecolor": "white", "edgecolor": "none", "framealpha": 1.0,
    } if alone else None  # fmt: skip
    axes = {"xlim": (0.0, None), "ylim": (bottom, top)} | labels
    panel = Panel([*lines, mark_planners], title, axes, "y", key)
    size, caption = (7.2, 4.2 if alone else 4.8), "Learning curves, and planners in the same worlds"
    with picture(path, size, caption, ConstrainedLayoutEngine(w_pad=_MARGIN_IN)) as figure:
        ax = figure.subplots()
        panel.draw(ax)
        ax.xaxis.set_major_formatter(_count)
        if not alone:
            figure.legend(loc="outside lower left", ncols=2, frameon=False)


def _count(x: float, _: Any) -> str:
    return f"{x / 1e6:g} M" if x >= 1e6 else f"{x / 1e3:g} k" if x >= 1e3 else f"{x:g}"
