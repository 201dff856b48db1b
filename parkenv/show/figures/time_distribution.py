"""Cumulative distribution of the total time of each agent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.show.figures.picture_files import INK, STYLE, legend_columns
from parkenv.show.figures.times import agent_color
from parkenv.show.plurals import plural

Totals = Mapping[str, FloatArray]
"""Total times of each agent, (n_episodes,) s, by name."""

BOUND = "clairvoyant lower bound"
OFF_SCALE = 2.5
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
    end = min(high, OFF_SCALE * float(np.median(everything)))
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
