"""Figure for checking a lot import: what was read from the file, and what is missing."""

from __future__ import annotations

from pathlib import Path
from textwrap import wrap

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.draft import LotDraft
from parkenv.show.figures.lot import ENTRY, GOAL, GROUND, INK
from parkenv.show.figures.picture_files import STYLE, save_picture
from parkenv.show.figures.schematic import schematic
from parkenv.show.painters.axes import paint
from parkenv.show.plurals import plural
from parkenv.show.scene import DISC, Areas, Marks, building_layers, posed
from parkenv.world.lot import corner_points, is_building, mouth_points

SOURCE_COLORS = ("#4477aa", "#66ccee", "#228833", "#aa3377", "#ccbb44", "#ee6677")
AREA, AREA_EDGE = "#d9d3e3", "#8d7ca8"


@mpl.rc_context(STYLE)
def save_import_picture(draft: LotDraft, path: str | Path) -> None:
    """Draw a draft, complete or not, to a PNG file.

    Slots are coloured by their source, each with a line from its open side to its lane. One-way lanes have arrows.
    Missing parts are listed below the drawing.
    """
    notes = [line for text in draft.missing for line in wrap(f"missing: {text}", 110)]
    points = _extent(draft)
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(high - low, 20.0)
    scale = 9.0 / size.max()
    room = 0.7 + 0.18 * len(notes)
    width, height = max(size[0] * scale, 5.0), max(size[1] * scale, 2.0)
    figure = Figure(figsize=(width, height + room))
    ax = figure.add_axes((0.07, (room + 0.1) / (height + room), 0.92, (height - 0.4) / (height + room)))
    margin = 0.04 * size.max()
    ax.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    ax.set_aspect("equal")
    ax.set_facecolor(GROUND)
    ax.tick_params(labelsize=7)
    ax.set_xlabel("m", fontsize=7)
    _draw(draft, ax)
    counts = f"{plural(len(draft.slots), 'slot')}, {plural(len(draft.lanes), 'lane')}"
    ax.set_title(f"{draft.name}: {counts}", loc="left", fontsize=9)
    handles: list[Patch | Line2D] = [
        Patch(facecolor=SOURCE_COLORS[k % len(SOURCE_COLORS)], label=source)
        for k, source in enumerate(_sources(draft))
    ]
    for label, marker, color, many in (
        ("entry", "^", ENTRY, draft.entries),
        ("goal", "*", GOAL, draft.goals),
    ):
        if len(many):
            name = f"guessed {label}" if any(g.startswith(label) for g in draft.guesses) else label
            handles.append(
                Line2D([], [], marker=marker, color=color, markeredgecolor=INK, linestyle="", label=name)
            )
    if handles:
        figure.legend(handles=handles, loc="lower left", ncols=4, fontsize=7)
    for k, text in enumerate(reversed(notes)):
        figure.text(0.01, (0.3 + 0.18 * k) / (height + room), text, fontsize=7, color="#bb2222")
    save_picture(figure, path)


def _sources(draft: LotDraft) -> list[str]:
    return list(dict.fromkeys(draft.slot_source))


def _extent(draft: LotDraft) -> FloatArray:
    slots = draft.slots
    parts = [corner_points(slots.xy, slots.yaw, slots.length, slots.width).reshape(-1, 2)]
    parts += [lane.points for lane in draft.lanes]
    parts += [draft.entries.reshape(-1, 2), draft.goals.reshape(-1, 2), *draft.outlines, draft.loose]
    points = np.concatenate(parts)
    return points if len(points) else np.zeros((1, 2))


def _draw(draft: LotDraft, ax: Axes) -> None:
    slots, sources = draft.slots, _sources(draft)
    colors = [SOURCE_COLORS[sources.index(source) % len(SOURCE_COLORS)] for source in draft.slot_source]
    mouths = mouth_points(slots.xy, slots.yaw, slots.length, slots.width, slots.mouth)
    layers = [
        Areas([[outline] for outline in draft.outlines], AREA, AREA_EDGE),
        *building_layers([w for w in draft.walls if is_building(w)], draft.walls),
        Marks(posed(draft.loose), DISC, SOURCE_COLORS[0], px=5.0),
        *schematic(
            corner_points(slots.xy, slots.yaw, slots.length, slots.width), colors, mouths, draft.lanes,
            draft.entries.reshape(-1, 2), draft.goals.reshape(-1, 2),
        ),
    ]  # fmt: skip
    paint(ax, layers, 0.5)
