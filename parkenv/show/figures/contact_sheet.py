"""Contact sheets: many lots in one picture, to look through an import."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from parkenv.show.figures.lot import ENTRY, GOAL, GROUND, INK
from parkenv.show.figures.picture_files import picture
from parkenv.show.figures.schematic import ONE_WAY, TWO_WAY, schematic
from parkenv.show.painters.axes import paint
from parkenv.world.lot import ParkingLot

COLUMNS = 6
WIDTH, HEIGHT, KEY = 2.8, 3.2, 0.4
"""Width and height of a lot with its caption, and the height of the key, inches."""
SCALES = (5, 10, 20, 50, 100, 200, 500)
"""Lengths of the scale bar, m."""
LONGEST_NAME = 28
LARGEST = 60
"""Number of lots in one sheet."""
SLOT = "#9db8d2"


def save_contact_sheets(lots: Sequence[tuple[str, ParkingLot]], folder: Path) -> list[Path]:
    """Draw lots, 60 in a sheet, into `contact-sheet-1.png` and so on in a folder, and return the files."""
    files = []
    for k in range(0, len(lots), LARGEST):
        files.append(folder / f"contact-sheet-{k // LARGEST + 1}.png")
        save_contact_sheet(lots[k : k + LARGEST], files[-1])
    return files


def save_contact_sheet(lots: Sequence[tuple[str, ParkingLot]], path: str | Path) -> None:
    """Draw up to 60 lots side by side: slots tied to their lanes, one-way lanes with arrows, entries and goals.

    Args:
        lots: captions, whose first line is bold, and lots; each is drawn at a scale of its own, with a bar.
        path: the file.
    """
    shown = lots[:LARGEST]
    columns = min(COLUMNS, max(len(shown), 1))
    rows = -(-len(shown) // columns)
    with picture(path, (WIDTH * columns, HEIGHT * rows + KEY), layout=None) as figure:
        grid = figure.subplots(rows, columns, squeeze=False)
        for ax in grid.flat[len(shown) :]:
            ax.remove()
        for ax, (caption, _) in zip(grid.flat, shown, strict=False):
            ax.set(xticks=[], yticks=[])
            name, _, details = caption.partition("\n")
            ax.set_title(_shortened(name), fontsize=10, weight="bold", color=INK, pad=16)
            ax.text(0.0, 1.02, details, transform=ax.transAxes, fontsize=9, color=INK, va="bottom")
        bottom = KEY / (HEIGHT * rows + KEY)
        figure.tight_layout(pad=0.6, w_pad=1.0, h_pad=1.0, rect=(0.0, bottom, 1.0, 1.0))
        # Widths depend on the final size of the axes.
        for ax, (_, lot) in zip(grid.flat, shown, strict=False):
            _draw_lot(ax, lot)
        handles = [
            Line2D([], [], linestyle="", marker="^", color=ENTRY, label="entry"),
            Line2D([], [], linestyle="", marker="*", color=GOAL, markeredgecolor=INK, label="goal"),
            Line2D([], [], color=TWO_WAY, label="lane"),
            Line2D([], [], color=ONE_WAY, label="one-way lane"),
        ]
        figure.legend(handles=handles, loc="lower center", ncols=4 if columns > 2 else 2, fontsize=9)


def _draw_lot(ax: Axes, lot: ParkingLot) -> None:
    ax.set(xticks=[], yticks=[], facecolor=GROUND)
    ax.spines[:].set_visible(False)
    corners = lot.slot_corners()
    lanes = [lane.points for lane in lot.lanes]
    points = np.concatenate([corners.reshape(-1, 2), *lanes, lot.entries, lot.goals])
    low, high = points.min(axis=0), points.max(axis=0)
    box = ax.get_window_extent()
    # As large as the axes allow, with room for the bar below the lot.
    extent = 1.1 * max(high[0] - low[0], 1.1 * (high[1] - low[1]) * box.width / box.height)
    (x, y), half = (low + high) / 2 - [0.0, 0.04 * extent], extent / 2
    up = half * box.height / box.width
    ax.set(xlim=(x - half, x + half), ylim=(y - up, y + up))
    ax.set_aspect("equal")
    paint(
        ax,
        schematic(corners, SLOT, lot.mouth_xy(), lot.lanes, lot.entries, lot.goals, small=True),
        1.0,
    )
    length = max((step for step in SCALES if step < 0.4 * extent), default=SCALES[0])
    bar_y = low[1] - 0.08 * extent
    ax.plot([low[0], low[0] + length], [bar_y, bar_y], color=INK, linewidth=1.5, solid_capstyle="butt")
    ax.text(low[0] + length, bar_y, f" {length} m", fontsize=8, color=INK, va="center")


def _shortened(name: str) -> str:
    return (
        name if len(name) <= LONGEST_NAME else f"{name[: LONGEST_NAME // 2]}…{name[-LONGEST_NAME // 2 + 1 :]}"
    )
