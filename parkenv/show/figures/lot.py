"""Pictures of lots, on which paths, beliefs and policies are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, PathPatch, Polygon, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.typing import ColorType
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.lot_outline import LotOutline, Rings
from parkenv.errors import InputError
from parkenv.files.atomic_write import atomic_write
from parkenv.show.rendering import BELIEF_ANCHORS
from parkenv.world.lot import ParkingLot

GROUND = "#e7eae0"
ASPHALT = "#5f646a"
PAINT = "#ffffff"
BUILDING = "#cdc5b8"
WALL = "#877d70"
ENTRY = "#1d8a4e"
GOAL = "#ffc53a"
GRAPH = "#ffd98a"
INK = "#333333"
BELIEF_MAP = LinearSegmentedColormap.from_list("belief", [[c / 255 for c in rgb] for rgb in BELIEF_ANCHORS])
"""Colours of beliefs, from free to taken."""
COST_MAP = "viridis"
"""Colour map of parking costs."""
SMALLEST_DISC = 6.0
"""Smallest diameter of a disc, points."""


def draw_lot(
    lot: ParkingLot, ax: Axes, *, slot_color: ColorType | FloatArray | None = None, show_graph: bool = False
) -> None:
    """Draw a lot from above, to scale, with a scale bar.

    Everything has a z-order below 2 except entries and goals (5), so that later plots lie in between.

    Args:
        lot: the lot.
        ax: axes to draw in; sets their limits and aspect, and removes ticks and frame.
        slot_color: fill of the slots: one colour, or (n_slots, 3 or 4) RGB(A) in 0..1; no fill if None.
        show_graph: also draw the drive graph, an arrow for every move.
    """
    x0, y0, x1, y1 = lot.bounds()
    margin = 3.0 + 0.02 * max(x1 - x0, y1 - y0)
    bar_room = 0.04 * max(x1 - x0, y1 - y0)
    ax.set(xlim=(x0 - margin, x1 + margin), ylim=(y0 - margin - bar_room, y1 + margin), xticks=[], yticks=[])
    ax.set_aspect("equal")
    ax.set_facecolor(GROUND)
    ax.spines[:].set_visible(False)
    # Road markings are drawn to scale, but not too thin to see.
    scale = points_per_m(ax)
    paint_width = float(np.clip(0.12 * scale, 0.2, 1.2))

    outline = LotOutline.of(lot)
    ax.add_patch(_patch(outline.paved(), facecolor=ASPHALT, edgecolor="none", zorder=0.5))
    _draw_lane_marks(outline, ax, paint_width)
    if slot_color is not None:
        ax.add_collection(
            PolyCollection(list(outline.slots), facecolors=slot_color, edgecolors="none", zorder=1.0)
        )
    lines = LineCollection(list(outline.slot_lines), colors=PAINT, linewidths=paint_width, zorder=1.1)
    ax.add_collection(lines)
    draw_walls(ax, outline.buildings, outline.walls)
    if show_graph:
        _draw_graph(lot, ax, scale)
    _draw_entries_and_goals(outline, ax, scale)
    _draw_scale_bar(ax, x0, y0 - 0.5 * margin - bar_room, x1 - x0)


def draw_discs(lot: ParkingLot, ax: Axes, outer: FloatArray, inner: FloatArray) -> None:
    """Draw two discs at each slot, as in T Fig. 4.7: an outer one for the prediction, an inner one for the truth.

    Args:
        lot: a lot that is already drawn in `ax`.
        ax: axes to draw in.
        outer: (n_slots,) probabilities that the slot is taken, coloured by `BELIEF_MAP`.
        inner: (n_slots, 3 or 4) RGB(A) in 0..1.
    """
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


def points_per_m(ax: Axes) -> float:
    """Return the size of a metre, points, in axes with an equal aspect ratio."""
    box = ax.get_window_extent()
    across, down = np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim())
    return float(min(box.width / across, box.height / down)) / ax.figure.dpi * 72


def save_lot_picture(
    lot: ParkingLot, path: str | Path, *, show_graph: bool = False, guesses: Sequence[str] = ()
) -> None:
    """Draw a lot to a file in the format of its suffix (`.png`, `.pdf`, `.svg`).

    Slots with a parking cost are filled with its colour, and a colour bar gives the scale. Guesses of an import are
    marked and listed below the lot.

    Raises:
        InputError: the format is unknown, or the file cannot be written.
    """
    path = Path(path)
    x0, y0, x1, y1 = lot.bounds()
    longer, shorter = max(x1 - x0, y1 - y0), min(x1 - x0, y1 - y0)
    short = 10.0 * min(1.0, (shorter + 0.15 * longer) / longer)
    figure = Figure(figsize=(10.0, short) if x1 - x0 >= y1 - y0 else (short, 10.0))
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    cost = lot.slot_parking_cost_s
    if cost.any():
        scale = ScalarMappable(Normalize(0.0, float(cost.max())), COST_MAP)
        colors = scale.to_rgba(cost)
        colors[cost == 0.0, 3] = 0.0
        draw_lot(lot, ax, slot_color=colors, show_graph=show_graph)
        figure.colorbar(scale, ax=ax, shrink=0.6, pad=0.01, label="parking cost, s")
    else:
        draw_lot(lot, ax, show_graph=show_graph)
    _draw_guesses(lot, ax, guesses)
    formats = figure.canvas.get_supported_filetypes()
    if path.suffix.removeprefix(".") not in formats:
        raise InputError(
            f"{path}: no picture format {path.suffix!r}, want one of {', '.join(sorted(formats))}"
        )
    with atomic_write(path) as beside:
        figure.savefig(
            beside, format=path.suffix.removeprefix("."), dpi=160, bbox_inches="tight", pad_inches=0.0
        )


def _draw_guesses(lot: ParkingLot, ax: Axes, guesses: Sequence[str]) -> None:
    """Mark entries and goals that an import guessed, and list all of its guesses below the lot."""
    for start, points in (("entry", lot.entries), ("goal", lot.goals)):
        if any(guess.startswith(start) for guess in guesses):
            for xy in points:
                ax.annotate(
                    f"guessed {start}",
                    xy,
                    (16, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=9,
                    color=INK,
                )
    if guesses:
        lines = [line for guess in guesses for line in wrap(f"guessed: {guess}", 100)]
        ax.text(0.0, -0.01, "\n".join(lines), transform=ax.transAxes, va="top", fontsize=9, color=INK)


def draw_walls(ax: Axes, buildings: Sequence[FloatArray], walls: Sequence[FloatArray]) -> None:
    """Draw buildings and walls, (k, 2) m each."""
    for building in buildings:
        ax.add_patch(Polygon(building, facecolor=BUILDING, edgecolor=WALL, linewidth=0.8, zorder=0.8))
    ax.add_collection(LineCollection(list(walls), colors=WALL, linewidths=1.6, capstyle="butt", zorder=0.8))


def _patch(polygons: Sequence[Rings], **style: object) -> PathPatch:
    rings = [ring for polygon in polygons for ring in polygon]
    return PathPatch(Outline.make_compound_path(*(Outline(ring, closed=True) for ring in rings)), **style)


def _draw_lane_marks(outline: LotOutline, ax: Axes, paint_width: float) -> None:
    """Draw a dashed line in the middle of two-way lanes and arrows on one-way lanes."""
    ax.add_collection(
        LineCollection(
            list(outline.centre_lines), colors=PAINT, alpha=0.45, linewidths=paint_width, linestyles=(0, (5, 6)),
            zorder=0.9,
        )
    )  # fmt: skip
    arrow = np.array(
        [[1.6, 0.0], [-0.2, 0.75], [-0.2, 0.2], [-1.6, 0.2], [-1.6, -0.2], [-0.2, -0.2], [-0.2, -0.75]]
    )
    cos, sin = np.cos(outline.arrows[:, 2]), np.sin(outline.arrows[:, 2])
    turn = np.stack([np.stack([cos, sin], axis=1), np.stack([-sin, cos], axis=1)], axis=1)
    arrows = outline.arrows[:, None, :2] + arrow @ turn
    ax.add_collection(
        PolyCollection(list(arrows), facecolors=PAINT, edgecolors="none", alpha=0.85, zorder=0.9)
    )


def _draw_graph(lot: ParkingLot, ax: Axes, points_per_m: float) -> None:
    source, column = np.nonzero(lot.neighbors >= 0)
    tail, head = lot.vertex_xy[source], lot.vertex_xy[lot.neighbors[source, column]]
    ax.quiver(
        *tail.T,
        *(head - tail).T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        units="xy",
        width=0.18,
        headwidth=4.5,
        headlength=5.0,
        headaxislength=4.5,
        color=GRAPH,
        zorder=1.5,
    )
    ax.scatter(
        lot.vertex_xy[:, 0],
        lot.vertex_xy[:, 1],
        s=(0.55 * points_per_m) ** 2,
        color=GRAPH,
        edgecolors=INK,
        linewidths=0.3,
        zorder=1.6,
    )


def _draw_entries_and_goals(outline: LotOutline, ax: Axes, points_per_m: float) -> None:
    """Draw an arrow into the lot at each entry and a star at each goal."""
    for x, y, yaw in outline.entries:
        reach = 32.0 / points_per_m
        ax.add_patch(
            FancyArrowPatch(
                (x, y),
                (x + reach * np.cos(yaw), y + reach * np.sin(yaw)),
                arrowstyle="simple,head_length=0.9,head_width=1.1,tail_width=0.45",
                mutation_scale=14.0,
                shrinkA=0.0,
                shrinkB=0.0,
                facecolor=ENTRY,
                edgecolor=PAINT,
                linewidth=0.7,
                zorder=5,
            )
        )
    ax.scatter(
        outline.goals[:, 0],
        outline.goals[:, 1],
        marker="*",
        s=340.0,
        color=GOAL,
        edgecolors=INK,
        linewidths=0.9,
        zorder=5,
    )


def _draw_scale_bar(ax: Axes, x: float, y: float, width: float) -> None:
    """Draw a scale bar of a round length, about a sixth of the lot's width, with its lower left corner at (x, y)."""
    power = 10.0 ** np.floor(np.log10(width / 6))
    length = power * max(step for step in (1, 2, 5) if step * power <= width / 6)
    thickness = 0.005 * width
    for i in (0, 1):
        ax.add_patch(
            Rectangle(
                (x + i * length / 2, y),
                length / 2,
                thickness,
                facecolor=(INK, "white")[i],
                edgecolor=INK,
                linewidth=0.7,
            )
        )
    ax.annotate(
        f"{length:g} m",
        (x + length, y + thickness / 2),
        (5, 0),
        textcoords="offset points",
        va="center",
        color=INK,
    )
