"""Picture of a census of lots: sizes, kinds of slots, drive times and error probabilities."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.patches import Patch

from parkenv.show.figures.picture_files import picture
from parkenv.show.plurals import plural

KIND_COLORS = {"perpendicular": "#0072b2", "oblique": "#e69f00", "kerbside": "#009e73", "mixed": "#8c8c8c"}
KINDS = ("perpendicular", "oblique", "kerbside")
"""Columns with the number of slots of a kind."""
_EDGES_AN_OCTAVE = 2


def save_census(rows: Sequence[dict[str, Any]], path: str | Path) -> None:
    """Draw how many lots there are of each size and kind, their drive times, and how sure they are.

    Args:
        rows: of a census: slots, kind, result, drive_s, error_probability and the number of slots of each kind.
        path: the PNG file to write.
    """
    slots = np.array([row["slots"] for row in rows], float)
    kinds = [row["kind"] for row in rows]
    present = [kind for kind in KIND_COLORS if kind in kinds]
    colors = [KIND_COLORS[kind] for kind in present]

    def by_kind(name: str) -> list[np.ndarray]:
        return [np.array([row[name] for row in rows if row["kind"] == kind], float) for kind in present]

    low, high = np.floor(np.log2(slots.min())), np.ceil(np.log2(slots.max() + 1))
    edges = 2.0 ** np.arange(low, high + 1e-9, 1 / _EDGES_AN_OCTAVE)
    caption = (
        f"{plural(len(rows), 'lot')}: sizes, kinds of slots, drive times at 10 km/h, error probabilities."
    )
    with picture(path, (10.5, 3.4), caption) as figure:
        size, kind, drive, error = figure.subplots(1, 4, width_ratios=(1.2, 0.9, 1.3, 0.9))
        size.hist(by_kind("slots"), edges, stacked=True, color=colors, edgecolor="white", linewidth=0.4)
        size.set_xscale("log", base=2)
        size.set(xlabel="slots", ylabel="lots", title=f"{plural(len(rows), 'lot')} by size")
        ticks = edges[:: _EDGES_AN_OCTAVE * (1 if high - low < 6 else 2)]
        size.set_xticks(ticks, [f"{tick:.0f}" for tick in ticks])
        size.minorticks_off()
        total = [sum(row[name] for row in rows) for name in KINDS]
        bars = kind.barh(KINDS, total, color=[KIND_COLORS[name] for name in KINDS])
        kind.bar_label(bars, [f"{count:,}" for count in total], padding=2)
        kind.set(xticks=[], title=f"{sum(total):,} slots by kind", xlim=(0, 1.35 * max(total)))
        kind.spines["bottom"].set_visible(False)
        kind.invert_yaxis()
        for name, x, y in zip(present, by_kind("slots"), by_kind("drive_s"), strict=True):
            drive.plot(x, y, "o", color=KIND_COLORS[name], markersize=4, alpha=0.75, label=name)
        drive.set_xscale("log", base=2)
        drive.set_xticks(ticks, [f"{tick:.0f}" for tick in ticks])
        drive.minorticks_off()
        drive.set(xlabel="slots", ylabel="s, at 10 km/h", title="Drive to the farthest slot", ylim=(0, None))
        edges = np.arange(0.0, max(row["error_probability"] for row in rows) + 0.1, 0.1)
        error.hist(
            by_kind("error_probability"),
            edges,
            stacked=True,
            color=colors,
            edgecolor="white",
            linewidth=0.4,
        )
        clean = sum(row["result"] == "clean" for row in rows)
        error.set(xlabel="error probability", ylabel="lots", title=f"{clean} without a warning")
        handles = [Patch(color=KIND_COLORS[name], label=name) for name in present]
        figure.legend(handles=handles, title="lots that are", loc="outside lower center", ncols=len(handles))
        for ax in (size, drive, error):
            ax.grid(visible=True, axis="y")
