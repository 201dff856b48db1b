"""Maps of a town with several policies: how full its blocks are, and what they cost."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from parkenv.compiled.arrays import FloatArray
from parkenv.show.figures.lot import draw_lot
from parkenv.show.figures.picture_files import STYLE, save_picture
from parkenv.world.lot import ParkingLot

BELOW, WITHIN, ABOVE, OTHER = "#56b4e9", "#009e73", "#d55e00", "#c9c9c4"
"""Colours of blocks that are emptier than wanted, as wanted, fuller, and of those that do not count."""


def save_policy_maps(
    lot: ParkingLot,
    occupancy: Sequence[tuple[str, FloatArray]],
    band: Sequence[float],
    price: tuple[str, FloatArray],
    title: str,
    path: str | Path,
) -> None:
    """Draw a map for each policy, and one of the prices of the last.

    Args:
        lot: the town.
        occupancy: name of each policy, and the mean occupancy of the block of each slot, (n_slots,); NaN: it does not
            count.
        band: how full blocks should be.
        price: title, and the price of an hour in the block of each slot, (n_slots,); NaN: it is no lever.
        title: title of the figure.
        path: file to write.

    Raises:
        InputError: the file cannot be written.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.4, 8.6), layout="constrained")
        axes = figure.subplots(2, 2).ravel()
        for ax, (name, share) in zip(axes, occupancy, strict=False):
            colors = np.select(
                [np.isnan(share), share < band[0], share > band[1]], [OTHER, BELOW, ABOVE], WITHIN
            )
            _draw(lot, ax, mpl.colors.to_rgba_array(colors.tolist()))
            ax.set_title(name)
        name, values = price
        scale = ScalarMappable(Normalize(0.0, max(float(np.nanmax(values, initial=0.0)), 1e-9)), "viridis_r")
        paint = scale.to_rgba(np.nan_to_num(values))
        paint[np.isnan(values)] = mpl.colors.to_rgba(OTHER)
        _draw(lot, axes[3], paint)
        axes[3].set_title(name)
        figure.colorbar(scale, ax=axes[3], orientation="horizontal", shrink=0.7, pad=0.01)
        low, high = band
        handles = [
            Patch(color=BELOW, label=f"below {low:.0%}"),
            Patch(color=WITHIN, label=f"{low:.0%} to {high:.0%}"),
            Patch(color=ABOVE, label=f"above {high:.0%}"),
            Patch(color=OTHER, label="no lever"),
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
        figure.suptitle(title, x=0.01, ha="left")
        save_picture(figure, path, f"{title}. Blocks by the share of their spaces that is taken.")


def _draw(lot: ParkingLot, ax: Axes, colors: FloatArray) -> None:
    draw_lot(dataclasses.replace(lot, goals=lot.goals[:1], goal_weights={}), ax)
    size = np.where(lot.is_counted, 60.0, 5.0)
    x, y = lot.slot_xy.T
    ax.scatter(x, y, s=size, c=colors, marker="s", linewidths=0.0, zorder=6.0)
