"""Charts of many cars: time, price of anarchy, members; zones by hour; days that were counted; curves."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from parkenv.compiled.arrays import FloatArray
from parkenv.show.figures.charts import COLORS, GREY, Line, Mark, Panel, Row, draw_panels, key_line, level
from parkenv.show.figures.lot import draw_zones, zone_colors
from parkenv.show.figures.picture_files import INK, STYLE, picture, save_picture
from parkenv.world.lot import ParkingLot

KNOWLEDGE_COLORS = {"own": INK, "shared": "#cc79a7", "reserve": "#0072b2", "full": "#009e73"}
_STYLES: tuple[tuple[Any, str], ...] = (("-", "o"), ("--", "s"), (":", "^"), ("-.", "D"))
_SIMULATED = "#cc79a7"


@mpl.rc_context(STYLE)
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

    Rows are of `summarize_days`, hours of `summarize_hours`. The closed form is a search time, s, by the occupancy.
    """
    whole = [row for row in rows if row["share"] in (0.0, max(row["share"] for row in rows))]
    mixed = any(0.0 < row["share"] < 1.0 for row in rows)
    priced = [row for row in whole if np.isfinite(np.float64(row["price_of_anarchy"]))]
    panels: dict[str, Panel] = {}
    if len(whole) > 1 or not hours:  # a single point says little
        panels["search time"] = _search(whole, closed_form)
    if priced:
        panels["price of anarchy"] = _price(priced)
    if mixed and any(row["knows"] == "own" for row in rows):
        panels["members and others"] = _shares(rows)
    if hours:
        panels["occupancy by hour"] = _by_hour(hours)
    key = [
        key_line(f"knows: {name}", KNOWLEDGE_COLORS[name])
        for name in dict.fromkeys(row["knows"] for row in rows)
    ]
    key += [key_line(agent, "#666666", **style) for agent, style in _styles(rows).items()]
    if "search time" in panels:
        key.append(key_line("slots looked at in random order", GREY, linewidth=1.0))
    if list(panels) == ["occupancy by hour"]:  # which has a legend of its own
        key = []
    keys = {"ncols": min(len(key), 2 * len(panels))}
    figure = draw_panels(
        list(panels.values()), (0.6 + 4.0 * len(panels), 3.9), 0, title, key=key, key_style=keys
    )
    save_picture(figure, path, f"{title}: {', '.join(panels)}.")


def _styles(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    return {
        agent: {"linestyle": line, "marker": marker, "markersize": 4}
        for agent, (line, marker) in zip(
            dict.fromkeys(row["agents"] for row in rows), cycle(_STYLES), strict=False
        )
    }


def _curves(rows: Sequence[Row], x: Callable[[Row], Any], y: str) -> Iterator[Line]:
    for agent, style in _styles(rows).items():
        for name, color in KNOWLEDGE_COLORS.items():
            if its := [row for row in rows if (row["agents"], row["knows"]) == (agent, name)]:
                its.sort(key=_cars_a_day)
                yield _with_errors(its, x, y, color, style)


def _with_errors(rows: Sequence[Row], x: Callable[[Row], Any], y: str, color: str, style: Any) -> Line:
    mean = np.array([row[y] for row in rows])
    ends = np.array([row[f"{y}_ci95"] for row in rows], float).reshape(-1, 2).T
    more = {"linewidth": 1.2, "capsize": 2, "markersize": 4}
    return Line(
        [x(row) for row in rows], mean, color, more | style, interval=np.nan_to_num(np.abs(ends - mean))
    )


def _cars_a_day(row: Row) -> float:
    return float(row["cars"] / row["days"])


def _search(rows: Sequence[Row], closed_form: Callable[[FloatArray], FloatArray]) -> Panel:
    occupancy = np.linspace(min(row["occupancy"] for row in rows), 1.0, 200)
    lines = [
        *_curves(rows, lambda row: 100.0 * row["occupancy"], "search_s"),
        Line(100.0 * occupancy, closed_form(occupancy), GREY, {"linewidth": 1.0}),
    ]
    top = 1.25 * max(row["search_s"] for row in rows)
    return Panel(lines, "Search time", {"xlabel": "mean occupancy, %", "ylabel": "s", "ylim": (0.0, top)})


def _price(rows: Sequence[Row]) -> Panel:
    rates = {row["arrivals_per_hour"] for row in rows}
    named = any(isinstance(rate, str) for rate in rates)
    axes: dict[str, Any] = {"xlabel": "arrivals per hour"} | ({} if named else {"xticks": sorted(rates)})
    lines = _curves(
        rows,
        lambda row: _demand(row["arrivals_per_hour"]) if named else row["arrivals_per_hour"],
        "price_of_anarchy",
    )
    return Panel(list(lines), "Total time over that of reservations for all", axes)


def _shares(rows: Sequence[Row]) -> Panel:
    """Return how much members (filled) and others (hollow) gain or lose, at the demand with the highest price.

    Of the first agent; without prices, at the greatest demand.
    """
    its = [row for row in rows if row["agents"] == rows[0]["agents"]]
    own = [row for row in its if row["knows"] == "own"]
    priced = max(own, key=lambda row: (np.nan_to_num(row["price_of_anarchy"]), _cars_a_day(row)))
    chosen = priced["arrivals_per_hour"]
    marks: list[Any] = [level(0.0, KNOWLEDGE_COLORS["own"], linewidth=1.0, linestyle=":")]
    for name, color in KNOWLEDGE_COLORS.items():
        for group, face, line in (
            ("members_difference_s", color, "-"),
            ("others_difference_s", "white", "--"),
        ):
            there = sorted(
                (
                    row
                    for row in its
                    if name != "own"
                    and (row["knows"], row["arrivals_per_hour"]) == (name, chosen)
                    and np.isfinite(np.float64(row[group]))
                ),
                key=lambda row: row["share"],
            )
            if there:
                style = {"marker": "o", "markerfacecolor": face, "linestyle": line}
                marks.append(_with_errors(there, lambda row: 100.0 * row["share"], group, color, style))
    title = f"Change for members (filled) and others, {_demand(chosen)}"
    return Panel(marks, title, {"xlabel": "share of members, %", "ylabel": "s"})


def _demand(rate: float | str) -> str:
    return rate if isinstance(rate, str) else f"{rate:g}/h"


def _by_hour(rows: Sequence[Row]) -> Panel:
    its = [row for row in rows if all(row[name] == rows[0][name] for name in ("agents", "knows", "share"))]
    lines: list[Any] = []
    for demand, (line, marker) in zip(
        dict.fromkeys(row["arrivals_per_hour"] for row in its), cycle(_STYLES), strict=False
    ):
        there = [row for row in its if row["arrivals_per_hour"] == demand]
        hour, simulated, counted = (
            np.array([row[name] for row in there]) for name in ("hour", "occupancy", "counted_occupancy")
        )
        if not lines:
            style = {"linestyle": "--", "label": "as counted"}
            lines.append(Line(hour + 0.5, 100.0 * counted, INK, style))
        label = f"simulated, arrivals {_demand(demand)}"
        points = {"linestyle": line, "marker": marker, "markersize": 4, "label": label}
        lines.append(Line(hour + 0.5, 100.0 * simulated, _SIMULATED, points))
    hours = partial(_mark_hours, [row["hour"] for row in its])
    return Panel([*lines, hours], "Occupancy", {"ylabel": "%", "ylim": (0.0, 100.0)}, legend={})


def _mark_hours(hours: Sequence[int], ax: Axes) -> None:
    ax.set_xlim(min(hours), max(hours) + 1)
    ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    ax.xaxis.set_major_formatter(lambda hour, _: f"{hour:02.0f}:00")


def save_zones_figure(
    lot: ParkingLot, title: str, hours: Sequence[int], courses: Mapping[str, FloatArray], path: str | Path
) -> None:
    at = [hour + 0.5 for hour in hours]

    def panel(values: FloatArray, title: str, **axes: Any) -> Panel:
        style = {"marker": "o", "markersize": 4}
        lines = [
            Line(at, course, color, style) for course, color in zip(values, zone_colors(lot), strict=True)
        ]
        return Panel([*lines, partial(_mark_hours, hours)], title, axes)

    with picture(path, (5.8, 6.2), f"{title}: map, slots taken and revenue by hour.") as figure:
        axes = figure.subplot_mosaic([["map", "map"], ["occupancy", "paid"]], height_ratios=(1.3, 1.0))
        zones = draw_zones(lot, axes["map"])
        axes["map"].legend(
            handles=zones, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=4, frameon=False
        )
        full = panel(100.0 * courses["occupancy"], "Slots taken", ylabel="%", ylim=(0.0, 100.0))
        full.draw(axes["occupancy"])
        panel(courses["paid"], "Paid an hour, when cars park", ylim=(0.0, None)).draw(axes["paid"])
        figure.suptitle(title, x=0.01, ha="left")


class CarParkDays(NamedTuple):
    name: str
    capacity: float
    simulated: FloatArray  # (n_hours,) cars, mean of the days of the fleet
    followed: FloatArray  # (n_hours,) cars counted, mean of the days that the demand follows
    held_out: FloatArray  # (d, n_hours) cars counted on later days; NaN: not counted


@mpl.rc_context(STYLE)
def save_counted_demand(car_parks: Sequence[CarParkDays], hours: FloatArray, path: Path) -> None:
    columns = min(len(car_parks), 4)
    size = 2.8 * columns + 0.6, 2.1 * -(-len(car_parks) // columns) + 0.6
    panels = []
    for park in car_parks:
        seen = park.held_out[np.isfinite(park.held_out).any(axis=1)]
        thin = {"linewidth": 0.5, "alpha": 0.5}
        lines = [
            *(Line(hours, day / park.capacity, GREY, thin) for day in seen),
            Line(hours, park.followed / park.capacity, "#0072b2", {"linestyle": "--"}),
            Line(hours, park.simulated / park.capacity, "#d55e00"),
        ]
        axes = {"xlim": (hours[0] - 1, hours[-1]), "ylim": (0, 1.02)}
        panels.append(Panel(lines, f"{park.name}, {park.capacity:.0f}", axes, title_style={"fontsize": 8}))
    key = [
        key_line("counted later, each day", GREY, linewidth=0.5, alpha=0.5),
        key_line("counted, days followed", "#0072b2", linestyle="--"),
        key_line("simulated", "#d55e00"),
    ]
    style = {"loc": "outside upper left", "ncols": 3, "fontsize": 8}
    figure = draw_panels(panels, size, columns, share="xy", key=key, key_style=style)
    figure.supxlabel("hour of the day", fontsize=9)
    figure.supylabel("share of the places taken", fontsize=9)
    save_picture(figure, path)


Curve = Mapping[str, Sequence[float]]
_CURVE_COLORS = (*COLORS, "#666666")
_POINTS = "#9a9a9a"


@mpl.rc_context(STYLE)
def save_curves(
    curves: Mapping[str, Curve],
    points: Sequence[Row],
    errors: Row,
    forms: Mapping[str, Callable[[FloatArray], FloatArray]],
    title: str,
    path: str | Path,
) -> None:
    """Draw the curves of a lot.

    Panels: search time against occupancy with its 95 % band, zone-hours and usual forms; held-out zone-hours, predicted
    against measured; relative errors of the curve and the usual forms; walk; and the share that finds no space, if any.

    The first of the curves (columns of `Curves`) is of all purposes. Points are rows of `held_out.csv`; `errors` are
    those of the search time of held-out zones: of `curve` and other predictors, and `chance`.
    """
    whole = next(iter(curves.values()))
    occupancy, measured, predicted, cars = (
        np.array([row[name] for row in points]) for name in ("occupancy", "measured", "predicted", "cars")
    )
    grid = np.linspace(0.0, 0.98, 99)
    search: list[Mark] = [
        Line(grid, form(grid), INK, {"linestyle": line, "linewidth": 1.0, "label": name})
        for (name, form), line in zip(forms.items(), ("--", ":", "-."), strict=False)
    ]
    search.append(_line(whole, "search_s", COLORS[0], "curve of the whole lot"))
    top = 1.15 * max(whole["search_s_high"])
    held_out: list[Panel] = []
    if points:
        dots: dict[str, Any] = {"s": 24.0 * cars / np.quantile(cars, 0.95), "linewidth": 0}
        search.insert(
            0,
            lambda ax: ax.scatter(
                occupancy, measured, color=_POINTS, alpha=0.35, label="a zone in an hour, measured", **dots
            ),
        )
        top = max(top, float(np.quantile(measured, 0.99)))
        end = float(np.quantile(np.concatenate([measured, predicted]), 0.995))
        marks: list[Mark] = [
            Line([0, end], [0, end], INK, {"linewidth": 1.0}),
            lambda ax: ax.scatter(measured, predicted, color=COLORS[0], alpha=0.3, **dots),
        ]
        axes: dict[str, Any] = {"xlabel": "measured, s", "ylabel": "by the curve of the other zones, s"}
        axes |= {"xlim": (0, end), "ylim": (0, end)}
        held_out = [Panel(marks, "Search time of zones that were held out", axes), _errors(errors)]
    panels = [_panel(search, "Search time", top, "search beyond the direct drive, s"), *held_out]
    by_purpose = {"walk_s": "walk, s", "balked_fraction": "share that finds no space"}
    if max(max(curve["balked_fraction"]) for curve in curves.values()) <= 0.001:
        del by_purpose["balked_fraction"]
    for name, label in by_purpose.items():
        lines = [
            _line(curve, name, color, purpose)
            for (purpose, curve), color in zip(curves.items(), _CURVE_COLORS, strict=False)
        ]
        top = 1.35 * max(max(curve[f"{name}_high"]) for curve in curves.values())
        percent = "xy" if name == "balked_fraction" else "x"
        panel = _panel(lines, label.partition(",")[0].capitalize(), top, label)
        panels.append(panel._replace(percent=percent))
    columns = min(len(panels), 3)
    figure = draw_panels(panels, (0.6 + 3.6 * columns, 3.3 * -(-len(panels) // columns)), columns, title)
    save_picture(figure, path, f"{title}: curves with 95 % bands, and zones that were held out.")


def _panel(marks: Sequence[Mark], title: str, top: float, label: str) -> Panel:
    axes = {"xlim": (0, 1), "ylim": (0, top), "xlabel": "spaces around that are taken", "ylabel": label}
    lines = sum(isinstance(mark, Line) for mark in marks)
    return Panel(
        marks, title, axes, "both", {"loc": "upper left", "fontsize": 7.5, "ncols": 1 + (lines > 4)}, "x"
    )


def _line(curve: Curve, name: str, color: str, label: str) -> Line:
    width = 2.2 if color == COLORS[0] else 1.2
    style: dict[str, Any] = {"marker": "o", "linewidth": width, "markersize": 3, "label": label}
    return Line(curve["occupancy"], curve[name], color, style, (curve[f"{name}_low"], curve[f"{name}_high"]))


def _errors(errors: Row) -> Panel:
    chance, off = errors["chance"], {name: value for name, value in errors.items() if name != "chance"}
    axes = {"xlim": (0, 1.15 * max(off.values())), "ylim": (len(off) - 0.2, -0.6)}
    return Panel([partial(_draw_errors, off, chance)], "Off by, zones held out", axes, "x", None, "x")


def _draw_errors(off: Mapping[str, float], chance: float, ax: Axes) -> None:
    bars = ax.barh(list(off), list(off.values()), color=[COLORS[0], *[_POINTS] * (len(off) - 1)], height=0.6)
    ax.bar_label(bars, [f"{value:.0%}" for value in off.values()], padding=3)
    ax.axvline(chance, color=INK, linewidth=1.0, linestyle="--")
    ax.text(chance, len(off) - 0.45, "  chance in the days", fontsize=7.5, va="center")
