"""Pictures of single searches, as in T Fig. 4.7 to 4.12."""

import textwrap
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.path import Path as MplPath
from matplotlib.patheffects import Normal, Stroke
from matplotlib.textpath import TextPath
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from parkenv.engine.search_record import SearchRecord
from parkenv.errors import require
from parkenv.show.figures.charts import key_line
from parkenv.show.figures.lot import BELIEF_MAP, draw_discs, draw_lot
from parkenv.show.figures.picture_files import INK, STYLE
from parkenv.show.painters.axes import paint, points_per_m
from parkenv.show.scene import ARROWHEAD, LANE_ARROW, Layer, Lines, Marks, hex_color, posed, poses_on
from parkenv.show.tables import plural
from parkenv.world.cost_terms import COST_TERMS
from parkenv.world.lot import PARK, ParkingLot
from parkenv.world.scenario import KMH

PATH, WALK = hex_color("car"), hex_color("goal")
POLICY_SCALE = 2.2  # least scale, points per metre, at which arrows at every vertex are legible


def draw_search(record: SearchRecord, ax: Axes) -> None:
    """Draw one search as in T Fig. 4.9 to 4.12.

    At each slot, an inner disc shows the true occupancy and an outer ring the forecast. The path (from 1 to 2) and the
    walk follow and, if there is room, the first plan's action at each vertex (T Fig. 4.8). Set the final size of the
    axes first: line widths and arrows depend on the scale.
    """
    lot = record.scenario.lot
    draw_lot(lot, ax)
    scale = points_per_m(ax)
    draw_discs(lot, ax, record.forecast, BELIEF_MAP(record.occupied.astype(np.float64)))
    if record.policy is not None and scale >= POLICY_SCALE:
        _draw_policy(lot, record.policy, record.path, ax, scale)
    _draw_path(record, ax, scale)
    title = _title(record, ax.get_window_extent().width / ax.figure.dpi)
    ax.set_title(title, loc="left", fontsize=mpl.rcParams["font.size"], linespacing=1.35)


def _title(record: SearchRecord, width: float) -> str:
    scenario, metrics = record.scenario, record.metrics
    terms = [
        f"{metrics[term.field]:.0f} {term.label}"
        for term in COST_TERMS
        if not term.optional or metrics[term.field]
    ]
    replans = metrics.get("replans", 0)
    planned = f"; {plural(replans, 'replan')}" if replans else ""
    lines = (
        f"{record.agent}: failure cost {scenario.failure_s:g} s, walk {scenario.v_walk / KMH:g}, "
        f"drive {scenario.v_drive / KMH:g} km/h",
        f"total {metrics['total_s']:.0f} s = {' + '.join(terms)}{planned}",
    )
    letters = int(width * 72 / (0.6 * mpl.rcParams["font.size"]))
    return "\n".join(line for text in lines for line in textwrap.wrap(text, max(letters, 10)))


def _draw_path(record: SearchRecord, ax: Axes, scale: float) -> None:
    lot, parked = record.scenario.lot, bool(record.metrics["parked"])
    xy = lot.vertex_xy[record.path]
    width = float(np.clip(0.5 * scale, 1.2, 3.0))
    layers: list[Layer] = []
    if parked:
        end, goal = lot.slot_xy[record.path[-1]], lot.goals[record.scenario.goal]
        xy = np.vstack([xy, end])
        layers.append(Lines([np.stack([end, goal])], WALK, px=(1.8, 1.8), dash=(5.4, 3.6), halo="white"))
    layers.append(Lines([xy], PATH, px=(width, width), halo=INK))
    length = np.hypot(*np.diff(xy, axis=0).T)
    if length.any():
        # About one mark per inch of path, but not hundreds on a long search.
        n = int(np.clip(length.sum() * scale / 60.0, 1, 18))
        marks = poses_on(xy, (np.arange(n) + 0.5) / n * length.sum())
        layers.append(Marks(marks, ARROWHEAD, PATH, px=1.7 * (3.0 + 1.4 * width), edge=INK, edge_px=0.8))
    paint(ax, layers, 3.0)
    words: dict[str, Any] = {
        "weight": "bold",
        "fontsize": 8,
        "ha": "center",
        "va": "center_baseline",
        "zorder": 6.1,
    }
    for number, point, color in (("1", xy[0], INK), ("2", xy[-1], WALK if parked else "#c03219")):
        ax.plot(*point, marker="o", markersize=11, color=color, markeredgecolor="white", zorder=6)
        ax.annotate(number, point, color="white", **words)


def _draw_policy(lot: ParkingLot, policy: NDArray[np.int64], path: list[int], ax: Axes, scale: float) -> None:
    drives = np.flatnonzero(policy < PARK)
    target = lot.neighbors[drives, policy[drives]]
    drives, target = drives[target >= 0], target[target >= 0]
    ahead = lot.vertex_xy[target] - lot.vertex_xy[drives]
    poses = posed(lot.vertex_xy[drives], np.arctan2(ahead[:, 1], ahead[:, 0]))
    driven = np.isin(drives, path)
    for there, color in ((driven, INK), (~driven, "white")):
        paint(ax, [Marks(poses[there], LANE_ARROW, color, (1.9, 0.8))], 3.5)
    size = min(2.1 * scale, 14.0)
    style: dict[str, Any] = {
        "linestyle": "none",
        "marker": _text_marker("P"),
        "markersize": size,
        "zorder": 3.6,
    }
    for color, extra in ((INK, 1.6), ("white", 0.0)):
        ax.plot(*lot.vertex_xy[np.flatnonzero(policy == PARK)].T, color=color, markeredgewidth=extra, **style)


def _text_marker(text: str) -> MplPath:
    path = TextPath((0, 0), text, prop=FontProperties(weight="bold"))
    return path.transformed(Affine2D().translate(*-path.get_extents().get_points().mean(axis=0)))


def draw_searches(records: Sequence[SearchRecord]) -> Figure:
    require(records, "no search to draw")
    bounds = np.array([record.scenario.lot.bounds() for record in records])
    across, up = (bounds[:, 2:] - bounds[:, :2]).T
    aspect = float(
        np.max((up + 6.0 + 0.1 * np.maximum(across, up)) / (across + 6.0 + 0.04 * np.maximum(across, up)))
    )
    columns = 1 if len(records) == 1 or (len(records) == 2 and aspect < 0.6) else 2
    lines = -(-len(records) // columns)
    # All sizes in inches. Line widths depend on the size of the axes, so the axes get their final place here.
    width = 9.6 if columns == 1 else 7.0
    height = min(width * aspect, 8.0)
    width = height / aspect
    zoom = 1.0 if columns == 1 else 1.2
    key, gap = 0.66 * zoom, 0.14
    with mpl.rc_context({**STYLE, "font.size": 10.0 * zoom}):
        title = 0.12 + 0.19 * zoom * max(_title(record, width).count("\n") + 1 for record in records)
        total = max(columns * (width + gap) + gap, 7.4 * zoom), lines * (height + title) + key
        figure = Figure(figsize=total)
        side = (total[0] - columns * (width + gap) + gap) / 2
        for i, record in enumerate(records):
            line, column = divmod(i, columns)
            left = side + column * (width + gap)
            bottom = total[1] - (line + 1) * (height + title)
            box = left / total[0], bottom / total[1], width / total[0], height / total[1]
            draw_search(record, figure.add_axes(box))
        scales = map(points_per_m, figure.axes)
        policy = any(t.policy is not None and s >= POLICY_SCALE for t, s in zip(records, scales, strict=True))
        _draw_key(figure, key, zoom, policy=policy)
    return figure


def _draw_key(figure: Figure, height: float, zoom: float, *, policy: bool) -> None:
    disc: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 8 * zoom}
    disc |= {"markeredgecolor": INK, "markeredgewidth": 0.5}
    cased = [Stroke(linewidth=3.8, foreground=INK), Normal()]
    handles = [
        key_line("true occupancy: free", BELIEF_MAP(0.0), **disc),
        key_line("taken", BELIEF_MAP(1.0), **disc),
        key_line("driven, 1 to 2", PATH, linewidth=2.2, path_effects=cased),
        key_line("walk to the goal", WALK, linewidth=1.8, linestyle=(0, (3, 2))),
    ]
    if policy:
        plan: dict[str, Any] = {"linestyle": "none", "marker": _text_marker("P→"), "markersize": 16 * zoom}
        handles.append(key_line("first plan", INK, **plan))
    width, total = figure.get_size_inches()
    middle = 0.4 * height
    place = (width / 2 - 3.5 * zoom) / width, middle / total, 1.3 * zoom / width, 0.11 * zoom / total
    bar = figure.add_axes(place)
    bar.imshow(np.linspace(0, 1, 256)[None], aspect="auto", cmap=BELIEF_MAP, extent=(0, 1, 0, 1))
    bar.set_yticks([])
    bar.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
    bar.tick_params(length=2, labelsize=8 * zoom, pad=1)
    bar.set_title("ring: forecast P(taken)", fontsize=8.5 * zoom, pad=3, loc="center")
    at = (width / 2 - 2.0 * zoom) / width, (middle + 0.05 * zoom) / total
    figure.legend(
        handles=handles, loc="center left", bbox_to_anchor=at, ncols=len(handles), fontsize=8.5 * zoom,
        handletextpad=0.6, handlelength=1.8, columnspacing=1.1,
    )  # fmt: skip
