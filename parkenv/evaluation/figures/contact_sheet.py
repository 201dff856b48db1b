"""Contact sheets: many lots in one picture, to look through an import."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from parkenv.evaluation.figures.lot_picture import ENTRY, GOAL, GROUND, INK
from parkenv.evaluation.figures.picture_files import save_picture
from parkenv.lots.slot_polygons import nearest_on_lanes
from parkenv.world.lot import ParkingLot, corner_points

COLUMNS = 6
LARGEST = 60
"""Number of lots in one sheet."""
SLOT, ONE_WAY, TWO_WAY, TIE = "#9db8d2", "#aa3377", "#333a42", "#8fa58f"


def save_contact_sheet(lots: Sequence[tuple[str, ParkingLot]], path: str | Path) -> None:
    """Draw up to 60 lots side by side: slots tied to their lanes, one-way lanes with arrows, entries and goals.

    Raises:
        InputError: the file cannot be written.
    """
    shown = lots[:LARGEST]
    columns = min(COLUMNS, max(len(shown), 1))
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(3.0 * columns, 3.2 * rows))
    for k, (title, lot) in enumerate(shown):
        ax = figure.add_subplot(rows, columns, k + 1)
        ax.set_aspect("equal")
        ax.set(xticks=[], yticks=[], facecolor=GROUND)
        ax.spines[:].set_visible(False)
        ax.set_title(title, fontsize=7, color=INK)
        corners = corner_points(lot.slot_xy, lot.slot_yaw, lot.slot_length, lot.slot_width)
        ax.add_collection(PolyCollection(list(corners), facecolors=SLOT, edgecolors="white", linewidths=0.3))
        mouth = lot.mouth_xy()
        ties = np.stack([mouth, nearest_on_lanes(lot.lanes, mouth)[0]], axis=1)
        ax.add_collection(LineCollection(list(ties), colors=TIE, linewidths=0.3))
        ax.add_collection(
            LineCollection(
                [lane.points for lane in lot.lanes],
                colors=[ONE_WAY if lane.oneway else TWO_WAY for lane in lot.lanes],
                linewidths=0.9,
            )
        )
        for lane in lot.lanes:
            if lane.oneway:
                ax.annotate(
                    "", lane.points[-1], lane.points[-2], arrowprops={"arrowstyle": "->", "color": ONE_WAY}
                )
        ax.plot(*lot.entries.T, "^", color=ENTRY, markersize=5)
        ax.plot(*lot.goals.T, "*", color=GOAL, markeredgecolor=INK, markeredgewidth=0.4, markersize=7)
        ax.autoscale_view()
    figure.tight_layout(pad=0.4)
    save_picture(figure, path)
