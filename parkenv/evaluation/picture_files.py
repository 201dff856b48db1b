"""The style that all pictures share, and how they get into files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from parkenv.whole_files import written_whole

DPI = 150
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#666666",
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "figure.titlesize": 11.0,
}

INK = "#181b1f"
TIME_COLORS = {
    "drive_s": ("drive", "#0072b2"),
    "failed_s": ("failed tries", "#d55e00"),
    "walk_s": ("walk", "#a6cfe8"),
    "gave_up_s": ("gave up", "#8c8c8c"),
}
"""What the parts of a search's time are called, and their colours."""


def save_picture(figure: Figure, path: str | Path) -> None:
    """Write a PNG, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    with written_whole(path) as beside:
        figure.savefig(beside, format="png", dpi=DPI)
