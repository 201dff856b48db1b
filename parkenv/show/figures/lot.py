"""Pictures of lots, on which paths, beliefs and policies are drawn."""

import math
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.typing import ColorType
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.drivable_area import JOINED_WHOLE
from parkenv.errors import require
from parkenv.files.atomic_write import atomic_write
from parkenv.show.figures.picture_files import STYLE
from parkenv.show.painters.axes import draw_scale_bar, paint, points_per_m
from parkenv.show.scene import (
    ARROWHEAD,
    BELIEF_ANCHORS,
    DISC,
    STAR,
    Layer,
    Lines,
    LotScene,
    Marks,
    hex_color,
    posed,
)
from parkenv.world.lot import ParkingLot
from parkenv.world.tariff import NO_ZONE

INK = "#333333"
GROUND, ENTRY, GOAL = (hex_color(name) for name in ("ground", "entry", "goal"))
ARROWHEAD_LENGTH = 0.9  # m, of a move in the drive graph
# An arrow from the entry into the lot.
ENTRY_ARROW = np.array(
    [[1.0, 0.0], [0.6, 0.28], [0.6, 0.1], [0.0, 0.1], [0.0, -0.1], [0.6, -0.1], [0.6, -0.28]]
)
# Colours of beliefs, from free to taken.
BELIEF_MAP = LinearSegmentedColormap.from_list("belief", [[c / 255 for c in rgb] for rgb in BELIEF_ANCHORS])
# Colours of zones; the first seven are distinguishable with any colour vision.
ZONE_COLORS = (
    *("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442"),
    *("#882255", "#117733", "#332288", "#aa4499", "#999933", "#44aa99", "#661100"),
)
# Ground of a parking sign, which marks counted facilities with their capacity.
PARKING_SIGN = "#1565c0"
MOST_SIGNS = 40  # counted facilities with signs; more are discs
INK_PALE = "#b4b8bd"
COST_MAP = "viridis"  # colour map of parking costs
MANY_MARKS = 25  # entries and goals from which on their marks are smaller
SMALLEST_DISC = 6.0  # smallest diameter of a disc, points


def draw_lot(
    lot: ParkingLot, ax: Axes, *, slot_color: ColorType | FloatArray | None = None, show_graph: bool = False
) -> None:
    """Draw a lot from above, to scale, with a scale bar.

    The axes get limits and an aspect, and lose ticks and frame. Everything has a z-order below 2 except entries and
    goals (5), so that later plots lie in between. Slots have one colour, (n_slots, 3 or 4) RGB(A) in 0..1, or none.
    """
    x0, y0, x1, y1 = lot.bounds()
    margin = 3.0 + 0.02 * max(x1 - x0, y1 - y0)
    bar_room = 0.04 * max(x1 - x0, y1 - y0)
    ax.set(xlim=(x0 - margin, x1 + margin), ylim=(y0 - margin - bar_room, y1 + margin), xticks=[], yticks=[])
    ax.set_aspect("equal")
    ax.set_facecolor(GROUND)
    ax.spines[:].set_visible(False)
    scene = LotScene.of(lot)
    paint(ax, scene.ground(joined=lot.n_slots <= JOINED_WHOLE), 0.5)
    if slot_color is not None:
        ax.add_collection(
            PolyCollection(list(scene.slots), facecolors=slot_color, edgecolors="none", zorder=1.0)
        )
    paint(ax, [Lines(list(scene.slot_lines), "paint", 0.12, (0.2, 1.2))], 1.1)
    if show_graph:
        paint(ax, drive_graph(lot), 1.5)
    if lot.is_counted.any():
        _draw_counted(lot, ax, INK_PALE if slot_color is None else slot_color)
    size = float(np.clip(math.sqrt(MANY_MARKS / (len(lot.goals) + len(lot.entries))), 0.4, 1.0))
    marks = [
        Marks(scene.entries, ENTRY_ARROW, "entry", px=32.0 * size, edge="paint", edge_px=0.7),
        Marks(posed(scene.lot.goals), STAR, "goal", px=21.0 * size, edge="paint", edge_px=0.9),
    ]
    paint(ax, marks, 5.0)
    draw_scale_bar(ax, x0, y0 - 0.5 * margin - bar_room, x1 - x0, INK)


def _draw_counted(lot: ParkingLot, ax: Axes, color: ColorType | FloatArray) -> None:
    which = np.flatnonzero(lot.is_counted)
    x, y = lot.slot_xy[which].T
    if len(which) <= MOST_SIGNS:
        sign = {"boxstyle": "round,pad=0.3", "fc": PARKING_SIGN, "ec": "white", "lw": 0.6}
        how: dict[str, Any] = {"fontsize": 7, "color": "white", "ha": "center", "va": "center", "zorder": 5.5}
        for k, slot in enumerate(which.tolist()):
            ax.text(float(x[k]), float(y[k]), f"P {lot.capacity[slot]}", bbox=sign, **how)
        return
    colors = np.broadcast_to(to_rgba_array(color), (lot.n_slots, 4))
    sizes = np.clip(lot.capacity[which] * 0.5, 14.0, 400.0)
    ax.scatter(x, y, s=sizes, c=colors[which], edgecolors="white", linewidths=0.6, zorder=4.0)


def drive_graph(lot: ParkingLot) -> list[Layer]:
    source, column = np.nonzero(lot.neighbors >= 0)
    tail, head = lot.vertex_xy[source], lot.vertex_xy[lot.neighbors[source, column]]
    step = head - tail
    tip = ARROWHEAD_LENGTH / 2 / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
    heads = posed(head - tip * step, np.arctan2(step[:, 1], step[:, 0]))
    return [
        Lines(list(np.stack([tail, head], axis=1)), "graph", 0.18, (0.2, math.inf)),
        Marks(heads, ARROWHEAD, "graph", (ARROWHEAD_LENGTH, 0.8)),
        Marks(posed(lot.vertex_xy), DISC, "graph", (0.55, 0.55), edge="ink", edge_px=0.3),
    ]


def draw_discs(lot: ParkingLot, ax: Axes, outer: FloatArray, inner: FloatArray) -> None:
    """Draw two discs at each slot, as in T Fig. 4.7: an outer one for the prediction, an inner one for the truth."""
    scale = points_per_m(ax)
    # As wide as the slot, or larger if that is too small to see and the distance to neighbours allows it.
    nearest = np.asarray(cKDTree(lot.slot_xy).query(lot.slot_xy, k=2)[0])[:, 1]
    size = np.minimum(lot.slot_width, lot.slot_length)
    size = np.maximum(size, np.minimum(nearest, SMALLEST_DISC / scale))
    for share, colors, edge in ((0.92, BELIEF_MAP(outer), "none"), (0.52, inner, "#181b1f")):
        discs = EllipseCollection(
            share * size,
            share * size,
            np.zeros(lot.n_slots),
            units="xy",
            offsets=lot.slot_xy,
            offset_transform=ax.transData,
            facecolors=colors,
            edgecolors=edge,
            linewidths=float(np.clip(0.12 * scale, 0.2, 0.7)),
            zorder=1.5,
        )
        ax.add_collection(discs)


@mpl.rc_context(STYLE)
def save_lot_picture(
    lot: ParkingLot, path: str | Path, *, show_graph: bool = False, guesses: Sequence[str] = ()
) -> None:
    """Draw a lot to a file in the format of its suffix (`.png`, `.pdf`, `.svg`).

    Slots are filled with the colour of their zone, which a legend names; in lots without zones with that of their
    parking cost, of which a colour bar gives the scale. Guesses of an import are marked and listed below the lot.
    """
    path = Path(path)
    x0, y0, x1, y1 = lot.bounds()
    longer, shorter = max(x1 - x0, y1 - y0), min(x1 - x0, y1 - y0)
    short = 10.0 * min(1.0, (shorter + 0.15 * longer) / longer)
    figure = Figure(figsize=(10.0, short) if x1 - x0 >= y1 - y0 else (short, 10.0))
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    cost = lot.slot_parking_cost_s
    if lot.zones != (NO_ZONE,):
        zones = draw_zones(lot, ax, show_graph=show_graph)
        ax.legend(handles=zones, title="zone", loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    elif cost.any():
        scale = ScalarMappable(Normalize(0.0, float(cost.max())), COST_MAP)
        colors = scale.to_rgba(cost)
        colors[cost == 0.0, 3] = 0.0
        draw_lot(lot, ax, slot_color=colors, show_graph=show_graph)
        figure.colorbar(scale, ax=ax, shrink=0.6, pad=0.01, label="parking cost, s")
    else:
        draw_lot(lot, ax, show_graph=show_graph)
    _draw_guesses(lot, ax, guesses)
    formats = figure.canvas.get_supported_filetypes()
    require(
        path.suffix.removeprefix(".") in formats,
        f"{path}: no picture format {path.suffix!r}, want one of {', '.join(sorted(formats))}",
    )
    with atomic_write(path) as beside:
        figure.savefig(
            beside, format=path.suffix.removeprefix("."), dpi=160, bbox_inches="tight", pad_inches=0.0
        )


def draw_zones(lot: ParkingLot, ax: Axes, *, show_graph: bool = False) -> list[Patch]:
    colors = zone_colors(lot)
    draw_lot(lot, ax, slot_color=to_rgba_array(colors)[lot.zone_of_slot], show_graph=show_graph)
    return [Patch(color=color, label=zone) for zone, color in zip(lot.zones, colors, strict=True)]


def zone_colors(lot: ParkingLot) -> list[str]:
    return [
        INK_PALE if zone == NO_ZONE else ZONE_COLORS[i % len(ZONE_COLORS)] for i, zone in enumerate(lot.zones)
    ]


def _draw_guesses(lot: ParkingLot, ax: Axes, guesses: Sequence[str]) -> None:
    middle = 0.5 * (lot.bounds()[0] + lot.bounds()[2])
    for start, points in (("entry", lot.entries), ("goal", lot.goals)):
        if any(guess.startswith(start) for guess in guesses):
            for xy in points:
                is_east = bool(xy[0] > middle)
                ax.annotate(
                    f"guessed {start}",
                    xy,
                    (-22 if is_east else 22, 0),
                    textcoords="offset points",
                    ha="right" if is_east else "left",
                    va="center",
                    weight="bold",
                    color=INK,
                    bbox={"boxstyle": "round", "facecolor": "white", "edgecolor": hex_color(start)},
                    zorder=7,
                )
    if guesses:
        lines = [line for guess in guesses for line in wrap(f"guessed: {guess}", 100)]
        ax.text(0.0, -0.01, "\n".join(lines), transform=ax.transAxes, va="top", fontsize=9, color=INK)
