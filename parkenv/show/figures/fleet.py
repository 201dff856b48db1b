"""Figure of an experiment with many cars: search time, price of anarchy, members and others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from parkenv.compiled.arrays import FloatArray
from parkenv.show.figures.lot import draw_zones, zone_colors
from parkenv.show.figures.picture_files import INK, picture
from parkenv.world.lot import ParkingLot

Row = dict[str, Any]

KNOWLEDGE_COLORS = {"own": INK, "shared": "#cc79a7", "reserve": "#0072b2", "full": "#009e73"}
_STYLES: tuple[tuple[Any, str], ...] = (("-", "o"), ("--", "s"), (":", "^"), ("-.", "D"))
_GREY, _SIMULATED = "#999999", "#cc79a7"
_CLOSED_FORM = "slots looked at in random order"


def save_fleet_figure(
    rows: Sequence[Row],
    closed_form: Callable[[FloatArray], FloatArray],
    title: str,
    path: str | Path,
    hours: Sequence[Row] = (),
) -> None:
    """Draw the summary of an experiment.

    Panels: search time against occupancy, with the closed form of slots looked at in random order; price of anarchy
    against demand, if it is known; what members and others gain, if there are several shares and `own`; occupancy by
    hour, simulated and as counted, if that is known.

    Args:
        rows: of `summarize_days`.
        closed_form: search time, s, of looking at slots in random order, as a function of the occupancy.
        title: title of the figure.
        path: file to write.
        hours: of `summarize_hours`.
    """
    whole = [row for row in rows if row["share"] in (0.0, max(row["share"] for row in rows))]
    mixed = [row for row in rows if 0.0 < row["share"] < 1.0]
    priced = [row for row in whole if np.isfinite(np.float64(row["price_of_anarchy"]))]
    panels: dict[str, Callable[[Axes], None]] = {}
    if len(whole) > 1 or not hours:  # a single point says little
        panels["search time"] = lambda ax: _draw_search(ax, whole, closed_form)
    if priced:
        panels["price of anarchy"] = lambda ax: _draw_price(ax, priced)
    if mixed and any(row["knows"] == "own" for row in rows):
        panels["members and others"] = lambda ax: _draw_shares(ax, rows)
    if hours:
        panels["occupancy by hour"] = lambda ax: _draw_hours(ax, hours)
    agents = list(dict.fromkeys(row["agents"] for row in rows))
    known = list(dict.fromkeys(row["knows"] for row in rows))
    with picture(path, (0.6 + 4.0 * len(panels), 3.9), f"{title}: {', '.join(panels)}.") as figure:
        for ax, draw in zip(np.ravel(figure.subplots(1, len(panels))), panels.values(), strict=True):
            draw(ax)
            ax.grid(visible=True)
        handles = [Line2D([], [], color=KNOWLEDGE_COLORS[name], label=f"knows: {name}") for name in known]
        handles += [
            Line2D([], [], color="#666666", linestyle=line, marker=marker, markersize=4, label=agent)
            for agent, (line, marker) in zip(agents, _cycled(agents), strict=True)
        ]
        if "search time" in panels:
            handles.append(Line2D([], [], color=_GREY, linewidth=1.0, label=_CLOSED_FORM))
        if list(panels) != ["occupancy by hour"]:  # which has a legend of its own
            figure.legend(
                handles=handles, loc="outside lower center", ncols=min(len(handles), 2 * len(panels))
            )
        figure.suptitle(title, x=0.01, ha="left")


def _cycled(agents: Sequence[str]) -> list[tuple[Any, str]]:
    return [_STYLES[i % len(_STYLES)] for i in range(len(agents))]


def _curves(rows: Sequence[Row]) -> Iterator[tuple[list[Row], dict[str, Any]]]:
    """Yield the rows of each agent and knowledge in order of demand, and their style."""
    agents = list(dict.fromkeys(row["agents"] for row in rows))
    for agent, (line, marker) in zip(agents, _cycled(agents), strict=True):
        for name, color in KNOWLEDGE_COLORS.items():
            its = [row for row in rows if (row["agents"], row["knows"]) == (agent, name)]
            if its:
                its.sort(key=_cars_a_day)
                yield (
                    its,
                    {"color": color, "linestyle": line, "marker": marker, "markersize": 4, "capsize": 2},
                )


def _cars_a_day(row: Row) -> float:
    return float(row["cars"] / row["days"])


def _errors(rows: Sequence[Row], name: str) -> np.ndarray:
    """Return the distances of the ends of the 95 % intervals from the means, (2, n)."""
    mean = np.array([row[name] for row in rows])
    ends = np.array([row[f"{name}_ci95"] for row in rows], float).reshape(-1, 2).T
    return np.asarray(np.nan_to_num(np.abs(ends - mean)))


def _draw_search(ax: Axes, rows: Sequence[Row], closed_form: Callable[[FloatArray], FloatArray]) -> None:
    for its, style in _curves(rows):
        x = [100.0 * row["occupancy"] for row in its]
        ax.errorbar(x, [row["search_s"] for row in its], _errors(its, "search_s"), linewidth=1.2, **style)
    low = min(row["occupancy"] for row in rows)
    occupancy = np.linspace(low, 1.0, 200)
    ax.plot(100.0 * occupancy, closed_form(occupancy), color=_GREY, linewidth=1.0)
    most = max(row["search_s"] for row in rows)
    ax.set(xlabel="mean occupancy, %", ylabel="s", ylim=(0.0, 1.25 * most), title="Search time")


def _draw_price(ax: Axes, rows: Sequence[Row]) -> None:
    named = any(isinstance(row["arrivals_per_hour"], str) for row in rows)
    for its, style in _curves(rows):
        ax.errorbar(
            [_demand(rate) if named else rate for rate in (row["arrivals_per_hour"] for row in its)],
            [row["price_of_anarchy"] for row in its],
            _errors(its, "price_of_anarchy"),
            linewidth=1.2,
            **style,
        )
    ax.set(xlabel="arrivals per hour", title="Total time over that of reservations for all")
    if not named:
        ax.set_xticks(sorted({row["arrivals_per_hour"] for row in rows}))


def _draw_shares(ax: Axes, rows: Sequence[Row]) -> None:
    """Draw how much members (filled) and others (hollow) gain or lose, at the demand with the highest price of anarchy.

    Of the first agent; without prices, at the greatest demand.
    """
    agent = rows[0]["agents"]
    its = [row for row in rows if row["agents"] == agent and row["knows"] != "own"]
    own = [row for row in rows if row["agents"] == agent and row["knows"] == "own"]
    priced = max(own, key=lambda row: (np.nan_to_num(row["price_of_anarchy"]), _cars_a_day(row)))
    chosen = priced["arrivals_per_hour"]
    ax.axhline(0.0, color=KNOWLEDGE_COLORS["own"], linewidth=1.0, linestyle=":")
    for name, color in KNOWLEDGE_COLORS.items():
        known = sorted(
            (row for row in its if (row["knows"], row["arrivals_per_hour"]) == (name, chosen)),
            key=lambda row: row["share"],
        )
        for group, face in (("members_difference_s", color), ("others_difference_s", "white")):
            there = [row for row in known if np.isfinite(np.float64(row[group]))]
            if there:
                x, y = [100.0 * row["share"] for row in there], [row[group] for row in there]
                ax.errorbar(
                    x, y, _errors(there, group), color=color, marker="o", markersize=4, capsize=2,
                    markerfacecolor=face, linestyle="-" if group[0] == "m" else "--", linewidth=1.2,
                )  # fmt: skip
    ax.set(
        xlabel="share of members, %",
        ylabel="s",
        title=f"Change for members (filled) and others, {_demand(chosen)}",
    )


def _demand(rate: float | str) -> str:
    return rate if isinstance(rate, str) else f"{rate:g}/h"


def _draw_hours(ax: Axes, rows: Sequence[Row]) -> None:
    """Draw occupancy by hour, simulated at each demand and as counted (dashed), of one agent, with one knowledge."""
    its = [row for row in rows if all(row[name] == rows[0][name] for name in ("agents", "knows", "share"))]
    columns = ("hour", "occupancy", "counted_occupancy")
    for number, demand in enumerate(dict.fromkeys(row["arrivals_per_hour"] for row in its)):
        there = [[row[name] for name in columns] for row in its if row["arrivals_per_hour"] == demand]
        hour, simulated, counted = np.array(there).T
        if number == 0:
            ax.plot(hour + 0.5, 100.0 * counted, "--", color=INK, label="as counted")
        line, marker = _STYLES[number % len(_STYLES)]
        style = {"color": _SIMULATED, "linestyle": line, "marker": marker, "markersize": 4}
        ax.plot(hour + 0.5, 100.0 * simulated, label=f"simulated, arrivals {_demand(demand)}", **style)
    ax.set(ylabel="%", ylim=(0.0, 100.0), title="Occupancy")
    _mark_hours(ax, [row["hour"] for row in its])
    ax.legend()


def _mark_hours(ax: Axes, hours: Sequence[int]) -> None:
    """Mark full hours on the horizontal axis, from the first of the hours to the end of the last one."""
    ax.set_xlim(min(hours), max(hours) + 1)
    ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    ax.xaxis.set_major_formatter(lambda hour, _: f"{hour:02.0f}:00")


def save_zones_figure(
    lot: ParkingLot, title: str, hours: Sequence[int], courses: Mapping[str, FloatArray], path: str | Path
) -> None:
    """Draw the zones of a lot: where they are, how full they are by hour, and what is paid in them.

    Args:
        lot: the lot.
        title: title of the figure.
        hours: of the day.
        courses: `occupancy` and `paid` by zone and hour, (n_zones, n_hours) each.
        path: file to write.
    """
    at = [hour + 0.5 for hour in hours]
    with picture(path, (5.8, 6.2), f"{title}: map, slots taken and revenue by hour.") as figure:
        axes = figure.subplot_mosaic([["map", "map"], ["occupancy", "paid"]], height_ratios=(1.3, 1.0))
        zones = draw_zones(lot, axes["map"])
        axes["map"].legend(
            handles=zones, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=4, frameon=False
        )
        for number, color in enumerate(zone_colors(lot)):
            for name, scale in (("occupancy", 100.0), ("paid", 1.0)):
                axes[name].plot(at, scale * courses[name][number], color=color, marker="o", markersize=4)
        axes["occupancy"].set(ylabel="%", ylim=(0.0, 100.0), title="Slots taken")
        axes["paid"].set(title="Paid an hour, when cars park", ylim=(0.0, None))
        for name in ("occupancy", "paid"):
            _mark_hours(axes[name], hours)
            axes[name].grid(visible=True)
        figure.suptitle(title, x=0.01, ha="left")
