"""Picture of a verification: how far what was found is from theory, with intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from parkenv.show.figures.picture_files import INK, STYLE, save_picture

AGREES, DISAGREES = "#0072b2", "#d55e00"
_ROW_HEIGHT = 0.19  # inches
_LEAST_HALF_WIDTH, _MOST_HALF_WIDTH = 1.0, 40.0  # limits of the axis, %


def save_verification(rows: Sequence[Mapping[str, Any]], confidence: float, path: str | Path) -> None:
    """Draw every row: the difference between what was found and theory, in percent of theory.

    Args:
        rows: case, expected, found, found_ci95, interval, agrees.
        confidence: of `interval`, which decides.
        path: the PNG file to write.

    Raises:
        InputError: the file cannot be written.
    """
    scale = np.array([100.0 / abs(row["expected"]) if row["expected"] else 100.0 for row in rows])
    expected = np.array([row["expected"] for row in rows])

    def percent(values: Sequence[float]) -> np.ndarray:
        return np.asarray((np.array(values) - expected) * scale)

    found = percent([row["found"] for row in rows])
    (low, high), (low95, high95) = (
        (percent([ends[0] for ends in intervals]), percent([ends[1] for ends in intervals]))
        for intervals in ([row["interval"] for row in rows], [row["found_ci95"] for row in rows])
    )
    y = np.arange(len(rows))
    colors = [AGREES if row["agrees"] else DISAGREES for row in rows]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 1.0 + _ROW_HEIGHT * len(rows)), layout="constrained")
        ax = figure.subplots()
        ax.axvline(0.0, color=INK, linewidth=0.8)
        ax.hlines(y, low, high, colors, linewidth=1.0, alpha=0.55)
        ax.hlines(y, low95, high95, colors, linewidth=3.0, alpha=0.8)
        ax.scatter(found, y, s=14, c=colors, zorder=3)
        width = np.nanmax(np.abs(np.concatenate([low, high, found])), initial=_LEAST_HALF_WIDTH)
        width = 1.05 * min(width, _MOST_HALF_WIDTH)
        ax.set_xlim(-width, width)
        ax.set_ylim(len(rows) - 0.4, -0.6)
        ax.set_yticks(y, [row["case"] for row in rows], fontsize=7.5)
        ax.set_xlabel("found, difference from theory, %")
        ax.tick_params(axis="y", length=0)
        ax.grid(visible=True, axis="x")
        ax.spines["left"].set_visible(False)
        n_agree = sum(row["agrees"] for row in rows)
        figure.suptitle(f"{n_agree} of {len(rows)} statements of theory hold", x=0.01, ha="left")
        handles = [
            Line2D([], [], color=AGREES, marker="o", markersize=3.5, linestyle="", label="found"),
            Line2D([], [], color=AGREES, linewidth=3.0, alpha=0.8, label="95 % interval"),
            Line2D(
                [], [], color=AGREES, linewidth=1.0, alpha=0.55, label=f"{confidence:.2%} interval, decides"
            ),
        ]
        figure.legend(handles=handles, loc="outside lower right", ncols=3)
        save_picture(figure, path, f"What was found against theory: {n_agree} of {len(rows)} rows agree.")
