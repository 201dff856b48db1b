"""Pictures to check lots by: imports, discovered streets and contact sheets."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import wrap
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.draft import LotDraft
from parkenv.lots.generators import nearest_on_lanes
from parkenv.lots.town.draft import TownDraft
from parkenv.mapping.inference import SessionLog
from parkenv.mapping.street_slots import CAR, StreetSlots
from parkenv.show.figures.charts import key_line
from parkenv.show.figures.lot import BELIEF_MAP, ENTRY, GOAL, GROUND, INK, draw_lot
from parkenv.show.figures.picture_files import INK as DARK
from parkenv.show.figures.picture_files import STYLE, picture, save_picture
from parkenv.show.painters.axes import paint
from parkenv.show.scene import (
    ARROWHEAD,
    STAR,
    Areas,
    Layer,
    Lines,
    Marks,
    Paint,
    arrows_along,
    building_layers,
    posed,
)
from parkenv.show.tables import plural
from parkenv.world.facility import FACILITY_KINDS
from parkenv.world.lot import Lane, ParkingLot, corner_points, is_building, mouth_points

TWO_WAY, ONE_WAY, TIE = "#333a42", "#aa3377", "#9aa0a6"
ARROW_EVERY = 15.0  # distance between arrows on a one-way lane, m
_TRIANGLE = np.array([[0.5, 0.0], [-0.5, 0.5], [-0.5, -0.5]])
SOURCE_COLORS = ("#4477aa", "#66ccee", "#228833", "#aa3377", "#ccbb44", "#ee6677")
AREA, AREA_EDGE = "#d9d3e3", "#8d7ca8"
SLOT = "#9db8d2"
# Colour of a slot by what its capacity is known from.
KERB_COLORS = {"tag": "#225588", "register": "#225588", "drawn": "#4477aa", "rule": "#8fb8d8"}
STREET = "#8a8a84"
SPACE_M2 = 60.0  # m² of a counted facility's disc for each place: twice the room of a parked car
COLUMNS = 6
# Width and height of a lot with its caption in a contact sheet, and the height of the key, inches.
WIDTH, HEIGHT, KEY = 2.8, 3.2, 0.4
SCALES = (5, 10, 20, 50, 100, 200, 500)  # lengths of the scale bar, m
LONGEST_NAME = 28
LARGEST = 60  # number of lots in one sheet


def _schematic(
    corners: FloatArray,
    colors: Paint,
    mouths: FloatArray,
    lanes: Sequence[Lane],
    entries: FloatArray,
    goals: FloatArray,
    *,
    small: bool = False,
) -> list[Layer]:
    """Return layers that show how a lot is put together; the middles of open sides are tied to the nearest lane."""
    thin = 0.75 if small else 1.0
    layers: list[Layer] = [Areas([[slot] for slot in corners], colors, "white", 0.4 * thin)]
    if lanes and len(corners):
        ties = np.stack([mouths, nearest_on_lanes(lanes, mouths)[0]], axis=1)
        layers.append(Lines(list(ties), TIE, px=(0.5 * thin, 0.5 * thin)))
    one_way = [lane.points for lane in lanes if lane.oneway]
    for lines, color in ((one_way, ONE_WAY), ([lane.points for lane in lanes if not lane.oneway], TWO_WAY)):
        layers.append(Lines(lines, color, px=(1.2 * thin, 1.2 * thin)))
    return [
        *layers,
        Marks(arrows_along(one_way, ARROW_EVERY), ARROWHEAD, ONE_WAY, px=7.0 * thin),
        Marks(posed(entries, np.pi / 2), _TRIANGLE, "entry", px=9.0 * thin, edge="ink", edge_px=0.6),
        Marks(posed(goals), STAR, "goal", px=15.0 * thin, edge="paint", edge_px=0.6),
    ]


@mpl.rc_context(STYLE)
def save_import_picture(draft: LotDraft, path: str | Path) -> None:
    """Draw a draft, complete or not, to a PNG file.

    Slots are coloured by their source, each with a line from its open side to its lane. One-way lanes have arrows.
    Missing parts are listed below the drawing.
    """
    slots, sources = draft.slots, list(dict.fromkeys(draft.slot_source))
    corners = corner_points(slots.xy, slots.yaw, slots.length, slots.width)
    colors = [SOURCE_COLORS[sources.index(source) % len(SOURCE_COLORS)] for source in draft.slot_source]
    entries, goals = draft.entries.reshape(-1, 2), draft.goals.reshape(-1, 2)
    parts = [corners.reshape(-1, 2), *(lane.points for lane in draft.lanes), entries, goals]
    points = np.concatenate([*parts, *draft.outlines])
    if not len(points):
        points = np.zeros((1, 2))
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(high - low, 20.0)
    scale, margin = 9.0 / size.max(), 0.04 * size.max()
    notes = [line for text in draft.missing for line in wrap(f"missing: {text}", 110)]
    room = 0.7 + 0.18 * len(notes)
    width, height = max(size[0] * scale, 5.0), max(size[1] * scale, 2.0)
    figure = Figure(figsize=(width, height + room))
    box = (0.07, (room + 0.1) / (height + room), 0.92, (height - 0.4) / (height + room))
    ax = _ground(figure, box, low - margin, high + margin, 7)
    ax.set_aspect("equal")
    layers = [
        Areas([[outline] for outline in draft.outlines], AREA, AREA_EDGE),
        *building_layers([wall for wall in draft.walls if is_building(wall)], draft.walls),
        *_schematic(
            corners, colors, mouth_points(slots.xy, slots.yaw, slots.length, slots.width, slots.mouth), draft.lanes,
            entries, goals,
        ),
    ]  # fmt: skip
    paint(ax, layers, 0.5)
    counts = f"{plural(len(draft.slots), 'slot')}, {plural(len(draft.lanes), 'lane')}"
    ax.set_title(f"{draft.name}: {counts}", loc="left", fontsize=9)
    key: list[Any] = [
        Patch(facecolor=SOURCE_COLORS[k % len(SOURCE_COLORS)], label=source)
        for k, source in enumerate(sources)
    ]
    for label, marker, color, many in (("entry", "^", ENTRY, entries), ("goal", "*", GOAL, goals)):
        if len(many):
            name = f"guessed {label}" if any(g.startswith(label) for g in draft.guesses) else label
            key.append(key_line(name, color, marker=marker, markeredgecolor=INK, linestyle=""))
    if key:
        figure.legend(handles=key, loc="lower left", ncols=4, fontsize=7)
    for k, text in enumerate(reversed(notes)):
        figure.text(0.01, (0.3 + 0.18 * k) / (height + room), text, fontsize=7, color="#bb2222")
    save_picture(figure, path)


def _ground(figure: Figure, box: Any, low: FloatArray, high: FloatArray, fontsize: int) -> Axes:
    ax = figure.add_axes(box)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), facecolor=GROUND)
    ax.tick_params(labelsize=fontsize)
    ax.set_xlabel("m", fontsize=fontsize)
    return ax


@mpl.rc_context(STYLE)
def save_town_picture(town: TownDraft, path: str | Path) -> None:
    draft = town.draft
    points = np.concatenate([draft.slots.xy, *(lane.points for lane in draft.lanes)])
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(high - low, 50.0) * 1.06
    inch = 14.0 / max(size[0], 1.4 * size[1])
    width, height = size * inch
    whole = width + 0.8, height + 1.2
    figure = Figure(figsize=whole)
    middle = (low + high) / 2
    box = (0.6 / whole[0], 0.85 / whole[1], width / whole[0], height / whole[1])
    ax = _ground(figure, box, middle - 0.5 * size, middle + 0.5 * size, 8)
    _draw_town(town, ax, 72.0 * inch)
    places = sum(row["capacity"] for row in town.facilities)
    by_rule = sum(row["capacity"] for row in town.facilities if row["capacity_from"] == "rule")
    ax.set_title(
        f"{draft.name}: {places:,} places, {by_rule:,} of them by rule, in {len(town.facilities):,} facilities",
        loc="left",
        fontsize=10,
    )
    handles, labels = ax.get_legend_handles_labels()
    columns = max(min(len(labels), int(width / 1.3)), 1)
    legend = figure.legend(handles, labels, loc="lower left", ncols=columns, fontsize=8)
    for handle in legend.legend_handles:
        if isinstance(handle, PathCollection):
            handle.set_sizes([40.0])
    save_picture(figure, path)


def _draw_town(town: TownDraft, ax: Axes, points_per_m: float) -> None:
    draft = town.draft
    source = {row["name"]: row["capacity_from"] for row in town.facilities}
    ax.add_collection(LineCollection([lane.points for lane in draft.lanes], colors=STREET, linewidths=0.5))
    sources = np.array([source.get(name, "rule") for name in draft.slots.facility.tolist()])
    dot = np.clip((5.0 * points_per_m) ** 2, 1.2, 30.0)
    for name, color in KERB_COLORS.items():
        if (sources == name).any():
            _dots(
                ax, draft.slots.xy[sources == name], s=dot, color=color, linewidths=0, label=f"slots, {name}"
            )
    for kind, (color, *_) in FACILITY_KINDS.items():
        for known in (True, False):
            facilities = [
                facility
                for facility in draft.facilities
                if facility.is_counted
                and facility.kind == kind
                and (source.get(facility.name.partition(",")[0], "rule") != "rule") is known
            ]
            if facilities:
                area = np.array([facility.capacity for facility in facilities]) * SPACE_M2 * points_per_m**2
                _dots(ax, np.array([facility.xy for facility in facilities]), s=np.maximum(area, 4.0),
                    facecolors=color if known else "none", edgecolors=color, linewidths=0.9, alpha=0.85,
                    label=f"{kind}s, {'tag' if known else 'rule'}", zorder=4,
                )  # fmt: skip
    total = sum(draft.goal_weights.values(), np.zeros(len(draft.goals)))
    share = total / max(float(total.max(initial=0.0)), 1e-9)
    traffic = next(iter(draft.entry_weights.values()), np.ones(len(draft.entries)))
    edge: dict[str, Any] = {"linewidths": 0.5, "zorder": 5}
    goals: dict[str, Any] = {"marker": "*", "color": GOAL, "edgecolors": "none", "label": "goals"}
    _dots(ax, draft.goals, s=12.0 + 90.0 * share, **goals, **edge)
    entries: dict[str, Any] = {"marker": "^", "color": ENTRY, "edgecolors": INK, "label": "entries"}
    _dots(ax, draft.entries, s=20.0 + 6.0 * traffic, **entries, **edge)


def _dots(ax: Axes, xy: FloatArray, **style: Any) -> None:
    ax.scatter(xy[:, 0], xy[:, 1], **style)


def save_contact_sheets(lots: Sequence[tuple[str, ParkingLot]], folder: Path) -> list[Path]:
    """Draw lots, 60 in a sheet, into `contact-sheet-1.png` and so on in a folder, and return the files.

    Each has its slots tied to their lanes, one-way lanes with arrows, entries and goals, at a scale of its own, and a
    caption, whose first line is bold.
    """
    files = []
    for k in range(0, len(lots), LARGEST):
        files.append(folder / f"contact-sheet-{k // LARGEST + 1}.png")
        _save_contact_sheet(lots[k : k + LARGEST], files[-1])
    return files


def _save_contact_sheet(lots: Sequence[tuple[str, ParkingLot]], path: Path) -> None:
    columns = min(COLUMNS, len(lots))
    rows = -(-len(lots) // columns)
    with picture(path, (WIDTH * columns, HEIGHT * rows + KEY), layout=None) as figure:
        grid = figure.subplots(rows, columns, squeeze=False)
        for ax in grid.flat[len(lots) :]:
            ax.remove()
        for ax, (caption, _) in zip(grid.flat, lots, strict=False):
            ax.set(xticks=[], yticks=[])
            name, _, details = caption.partition("\n")
            if len(name) > LONGEST_NAME:
                name = f"{name[: LONGEST_NAME // 2]}…{name[-LONGEST_NAME // 2 + 1 :]}"
            ax.set_title(name, fontsize=10, weight="bold", color=INK, pad=16)
            ax.text(0.0, 1.02, details, transform=ax.transAxes, fontsize=9, color=INK, va="bottom")
        bottom = KEY / (HEIGHT * rows + KEY)
        figure.tight_layout(pad=0.6, w_pad=1.0, h_pad=1.0, rect=(0.0, bottom, 1.0, 1.0))
        # Widths depend on the final size of the axes.
        for ax, (_, lot) in zip(grid.flat, lots, strict=False):
            _draw_small(ax, lot)
        key = [
            key_line("entry", ENTRY, linestyle="", marker="^"),
            key_line("goal", GOAL, linestyle="", marker="*", markeredgecolor=INK),
            key_line("lane", TWO_WAY),
            key_line("one-way lane", ONE_WAY),
        ]
        figure.legend(handles=key, loc="lower center", ncols=4 if columns > 2 else 2, fontsize=9)


def _draw_small(ax: Axes, lot: ParkingLot) -> None:
    ax.set_facecolor(GROUND)
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
    ax.set(xlim=(x - half, x + half), ylim=(y - up, y + up), aspect="equal")
    paint(ax, _schematic(corners, SLOT, lot.mouth_xy(), lot.lanes, lot.entries, lot.goals, small=True), 1.0)
    length = max((step for step in SCALES if step < 0.4 * extent), default=SCALES[0])
    bar_y = low[1] - 0.08 * extent
    ax.plot([low[0], low[0] + length], [bar_y, bar_y], color=INK, linewidth=1.5, solid_capstyle="butt")
    ax.text(low[0] + length, bar_y, f" {length} m", fontsize=8, color=INK, va="center")


KERB, TRACK, UNSEEN = "#7030aa", "#0072b2", "#b9bec4"
_WIDTH, _HEIGHTS = 12.0, (2.2, 9.0)  # inches


def save_street(
    lot: ParkingLot, found: StreetSlots, tracks: Sequence[FloatArray], log: SessionLog, path: Path
) -> None:
    """Draw a street from above, turned so that its longer side is level; an arrow shows where north is."""
    points = np.concatenate([*tracks, lot.slot_xy])
    axis = np.linalg.eigh(np.cov(points.T))[1][:, 1]
    angle = -math.atan(axis[1] / axis[0]) if abs(axis[0]) > 1e-9 else math.pi / 2
    lot, turn = _turned(lot, angle), _turn(angle)
    x0, y0, x1, y1 = lot.bounds()
    height = float(np.clip(_WIDTH * (y1 - y0 + 16.0) / (x1 - x0 + 8.0), *_HEIGHTS))
    seen, last = log.known.any(axis=0), len(log.time) - 1 - log.known[::-1].argmax(axis=0)
    color = np.where(log.occupied[last, np.arange(lot.n_slots)][:, None], BELIEF_MAP(0.9), BELIEF_MAP(0.1))
    color[~seen] = to_rgba(UNSEEN)
    guessed = found.source != CAR
    with picture(
        path, (_WIDTH, height + 0.6), "Slots of a street, discovered from the cars parked along it"
    ) as figure:
        ax = figure.add_subplot()
        draw_lot(lot, ax, slot_color=color)
        corners = lot.slot_corners()
        outlines = PolyCollection(list(corners[guessed]), facecolors="none", edgecolors=DARK, linestyles=(0, (2, 1.5)),
                                  linewidths=0.9, zorder=3.0)  # fmt: skip
        ax.add_collection(outlines)
        layers = [
            Lines([track @ turn.T for track in tracks], TRACK, px=(1.2, 1.2)),
            Lines([kerb @ turn.T for kerb in found.kerbs], KERB, px=(1.6, 1.6)),
        ]
        paint(ax, layers, 2.5)
        sure = plural(int((~guessed).sum()), "slot")
        ax.set_title(f"{lot.name}: {sure} where parked cars were seen in a row, {int(guessed.sum())} guessed")
        states = {"taken when last seen": 0.9, "free when last seen": 0.1}
        key: list[Any] = [Patch(color=BELIEF_MAP(p), label=name) for name, p in states.items()]
        key += [Patch(color=UNSEEN, label="never in view")]
        key += [
            Patch(
                fill=False,
                edgecolor=DARK,
                linestyle=(0, (2, 1.5)),
                label="guessed: a gap, a car alone or seen once",
            )
        ]
        key += [key_line("kerb", KERB), key_line("driven", TRACK)]
        figure.legend(handles=key, loc="outside lower left", ncols=len(key), fontsize=8)
        north = turn @ np.array([0.0, 1.0])
        arrow = {"arrowstyle": "<|-", "color": DARK}
        how: dict[str, Any] = {"ha": "center", "va": "center", "color": DARK, "arrowprops": arrow}
        tip = (22.0 * float(north[0]), 22.0 * float(north[1]))
        ax.annotate("N", (0.965, 0.86), tip, "axes fraction", "offset points", **how)


def _turn(angle: float) -> FloatArray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def _turned(lot: ParkingLot, angle: float) -> ParkingLot:
    turn = _turn(angle).T
    return replace(
        lot,
        slot_xy=lot.slot_xy @ turn,
        slot_yaw=lot.slot_yaw + angle,
        lanes=tuple(Lane(lane.points @ turn, lane.oneway, lane.speed) for lane in lot.lanes),
        entries=lot.entries @ turn,
        goals=lot.goals @ turn,
    )
