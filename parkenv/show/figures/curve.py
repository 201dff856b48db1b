"""Figure of curves: search time and walk against occupancy, held-out zones, and the usual forms beside."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter

from parkenv.compiled.arrays import FloatArray
from parkenv.show.figures.picture_files import INK, picture

Row = Mapping[str, Any]
_GREY, _COLORS = "#9a9a9a", ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#666666")


def save_curves(
    curves: Mapping[str, Mapping[str, Sequence[float]]],
    points: Sequence[Row],
    errors: Row,
    forms: Mapping[str, Callable[[FloatArray], FloatArray]],
    title: str,
    path: str | Path,
) -> None:
    """Draw the curves of a lot.

    Panels: search time against occupancy with its 95 % band, zone-hours and usual forms; held-out zone-hours, predicted
    against measured; relative errors of the curve and the usual forms; walk; and the share that finds no space, if any.

    Args:
        curves: columns of the curve of each purpose, all of them first; see `Curves`.
        points: of `held_out.csv`.
        errors: of the search time of held-out zones: of `curve` and other predictors, and `chance`.
        forms: usual forms, fitted to the points.
        title: title of the figure.
        path: the PNG to write.
    """
    by_purpose = {"walk_s": "walk, s"}
    if any(max(its["balked_fraction"]) > 0.001 for its in curves.values()):
        by_purpose["balked_fraction"] = "share that finds no space"
    n_panels = 1 + 2 * bool(points) + len(by_purpose)
    columns = min(n_panels, 3)
    with picture(
        path,
        (0.6 + 3.6 * columns, 3.3 * -(-n_panels // columns)),
        f"{title}: curves with 95 % bands, and zones that were held out.",
    ) as figure:
        axes = figure.subplots(-(-n_panels // columns), columns, squeeze=False).ravel()
        _draw_search(axes[0], curves, points, forms)
        if points:
            _draw_held_out(axes[1], points)
            _draw_errors(axes[2], errors)
        for ax, (name, label) in zip(axes[n_panels - len(by_purpose) :], by_purpose.items(), strict=False):
            for (purpose, its), color in zip(curves.items(), _COLORS, strict=False):
                _draw_curve(ax, its, name, color, purpose)
            top = 1.35 * max(max(its[f"{name}_high"]) for its in curves.values())
            _finish(ax, label.partition(",")[0].capitalize(), top, label)
            if name == "balked_fraction":
                ax.yaxis.set_major_formatter(PercentFormatter(1.0))
        for ax in axes[n_panels:]:
            ax.set_axis_off()
        figure.suptitle(title, x=0.01, ha="left")


def _areas(points: Sequence[Row]) -> FloatArray:
    cars = np.array([row["cars"] for row in points])
    return np.asarray(24.0 * cars / np.quantile(cars, 0.95))


def _finish(ax: Axes, title: str, top: float, label: str) -> None:
    ax.set(xlim=(0, 1), ylim=(0, top), xlabel="spaces around that are taken", ylabel=label, title=title)
    ax.xaxis.set_major_formatter(PercentFormatter(1.0))
    ax.legend(loc="upper left", fontsize=7.5, ncols=1 + (len(ax.get_lines()) > 4))
    ax.grid(visible=True)


def _draw_curve(ax: Axes, its: Mapping[str, Sequence[float]], name: str, color: str, label: str) -> None:
    width = 2.2 if color == _COLORS[0] else 1.2
    ax.plot(its["occupancy"], its[name], "o-", color=color, linewidth=width, markersize=3, label=label)
    ax.fill_between(
        its["occupancy"], its[f"{name}_low"], its[f"{name}_high"], color=color, alpha=0.2, linewidth=0
    )


def _draw_search(
    ax: Axes,
    curves: Mapping[str, Mapping[str, Sequence[float]]],
    points: Sequence[Row],
    forms: Mapping[str, Callable[[FloatArray], FloatArray]],
) -> None:
    whole = next(iter(curves.values()))
    top = 1.15 * max(whole["search_s_high"])
    if points:
        x, y = (np.array([row[name] for row in points]) for name in ("occupancy", "measured"))
        ax.scatter(
            x, y, _areas(points), color=_GREY, alpha=0.35, linewidth=0, label="a zone in an hour, measured"
        )
        top = max(top, float(np.quantile(y, 0.99)))
    grid = np.linspace(0.0, 0.98, 99)
    for (name, form), line in zip(forms.items(), ("--", ":", "-."), strict=False):
        ax.plot(grid, form(grid), line, color=INK, linewidth=1.0, label=name)
    _draw_curve(ax, whole, "search_s", _COLORS[0], "curve of the whole lot")
    _finish(ax, "Search time", top, "search beyond the direct drive, s")


def _draw_held_out(ax: Axes, points: Sequence[Row]) -> None:
    measured, predicted = (np.array([row[name] for row in points]) for name in ("measured", "predicted"))
    top = float(np.quantile(np.concatenate([measured, predicted]), 0.995))
    ax.plot([0, top], [0, top], color=INK, linewidth=1.0)
    ax.scatter(measured, predicted, _areas(points), color=_COLORS[0], alpha=0.3, linewidth=0)
    ax.set(xlim=(0, top), ylim=(0, top), xlabel="measured, s", ylabel="by the curve of the other zones, s")
    ax.set_title("Search time of zones that were held out")
    ax.grid(visible=True)


def _draw_errors(ax: Axes, errors: Row) -> None:
    off = dict(errors)
    chance, names = off.pop("chance"), list(off)
    bars = ax.barh(names, list(off.values()), color=[_COLORS[0], *[_GREY] * (len(names) - 1)], height=0.6)
    ax.bar_label(bars, [f"{value:.0%}" for value in off.values()], padding=3)
    ax.axvline(chance, color=INK, linewidth=1.0, linestyle="--")
    ax.text(chance, len(names) - 0.45, "  chance in the days", fontsize=7.5, va="center")
    ax.set(xlim=(0, 1.15 * max(off.values())), ylim=(len(names) - 0.2, -0.6), title="Off by, zones held out")
    ax.xaxis.set_major_formatter(PercentFormatter(1.0))
    ax.grid(visible=True, axis="x")
