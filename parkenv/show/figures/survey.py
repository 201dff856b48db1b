"""Figures of a survey: detections, one session's grid and slots, and the map (T Fig. 4.4-4.7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.mapping.discovery import DiscoveryScore, FoundSlots
from parkenv.mapping.inference import Prediction
from parkenv.mapping.odometry import between, moved
from parkenv.mapping.survey import SessionResult
from parkenv.perception.detector import LEAST_PROBABILITY, PROBABILITY, Detections
from parkenv.show.colors import PALETTE, hex_color
from parkenv.show.figures.lot import BELIEF_MAP, draw_discs, draw_lot
from parkenv.show.figures.picture_files import INK, picture
from parkenv.show.painters.axes import paint
from parkenv.show.painters.opencv import write_tag
from parkenv.show.plurals import plural, slots_text
from parkenv.show.scene import DISC, Lines, Marks, posed
from parkenv.world.lot import ParkingLot
from sim_sensors.ground_truth import View

SIDE_COLOR, OBLIQUE_COLOR, END_COLOR = (PALETTE[name] for name in ("side", "oblique", "end"))
UNRANGED_COLOR = (200, 200, 200)
HIDDEN = 0.8
"""Visible fraction below which it is written beside the probability."""
TAKEN, FREE, UNKNOWN = BELIEF_MAP(1.0), BELIEF_MAP(0.0), "#b9bec4"
WRONG = hex_color("wrong")
PATH_COLOR, CAR_COLOR, SLOT_COLOR = "#0072b2", "#d55e00", "#7030aa"
WEATHER_COLORS = {
    "sunny": "#e69f00",
    "overcast": "#7f7f7f",
    "low_sun": "#d55e00",
    "dusk": "#332288",
    "rain": "#0072b2",
}


def draw_detections(
    image: NDArray[np.uint8], found: Detections, placed: NDArray[np.int64] | None = None
) -> NDArray[np.uint8]:
    """Return a copy of an image, (h, w, 3) RGB, with its detections: probability, and what is visible of a hidden car.

    Args:
        image: the image.
        found: detections in the image.
        placed: indices of the ranged detections, others are drawn thin and grey; all if None.
    """
    drawn = image.copy()
    colors = {View.SIDE: SIDE_COLOR, View.OBLIQUE: OBLIQUE_COLOR, View.END: END_COLOR}
    for i, (box, p) in enumerate(zip(found.boxes, found.probability, strict=True)):
        left, top, right, bottom = (round(float(v)) for v in box)
        if placed is not None and i not in placed:
            cv2.rectangle(drawn, (left, top), (right, bottom), UNRANGED_COLOR, 1, cv2.LINE_AA)
            continue
        color, visible = colors[View(found.view[i])], found.visible_fraction[i]
        hidden = f", {visible:.0%} visible" if visible < HIDDEN else ""
        cv2.rectangle(drawn, (left, top), (right, bottom), color, 2, cv2.LINE_AA)
        write_tag(drawn, f"{p:.2f}{hidden}", (left, max(top, 0)), color)
    return drawn


def headings(poses: FloatArray, color: str, length: float = 2.5) -> Lines:
    """Return a line through each of some cars, (n, 3), along its heading, `length` m."""
    ahead = 0.5 * length * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    return Lines(list(np.stack([poses[:, :2] - ahead, poses[:, :2] + ahead], axis=1)), color, px=(1.3, 1.3))


def save_detections(result: SessionResult, path: Path) -> None:
    """Draw some frames of a session with their detections (T Fig. 4.4)."""
    n = len(result.shown)
    with picture(
        path, (4.2 * n, 3.7), "Camera frames of a survey drive, with the cars that were detected", layout=None
    ) as figure:
        weather = result.session.weather.replace("_", " ")
        figure.suptitle(f"Detected cars, {weather}", x=0.01, ha="left", weight="bold")
        for i, shown in enumerate(result.shown):
            ax = figure.add_subplot(1, n, i + 1)
            view = shown.views[0]
            ax.imshow(draw_detections(view.image, view.detections, view.cars.detection))
            ax.set_axis_off()
        kinds = (
            ("a car's side", SIDE_COLOR, 2.0), ("oblique", OBLIQUE_COLOR, 2.0), ("front or rear", END_COLOR, 2.0),
            ("no distance", UNRANGED_COLOR, 1.0),
        )  # fmt: skip
        handles = [
            Patch(fill=False, edgecolor="#{:02x}{:02x}{:02x}".format(*color), linewidth=width, label=name)
            for name, color, width in kinds
        ]
        least = f"{LEAST_PROBABILITY:g} where a distance confirms it, else {PROBABILITY:g}"
        note = Line2D([], [], linestyle="none", label=f"number: probability, at least {least}")
        figure.legend(handles=[*handles, note], loc="lower left", ncols=5)
        figure.subplots_adjust(0.01, 0.08, 0.99, 0.91, wspace=0.02)


def save_session(lot: ParkingLot, result: SessionResult, path: Path) -> None:
    """Draw a session from above (T Fig. 4.5): grid, detected cars and slots."""
    with picture(
        path,
        (11.0, _height(lot, 11.0, 3)),
        "One survey drive: occupancy grid, detected cars, and the states of the slots",
    ) as figure:
        axes = figure.subplots(3, 1)
        for ax in axes:
            draw_lot(lot, ax)
        grid = result.grid
        rows, columns = grid.log_odds.shape
        low_x, low_y = grid.low
        extent = (low_x, low_x + columns * grid.cell, low_y, low_y + rows * grid.cell)
        shown = np.ma.masked_where(~grid.seen, grid.probability)
        axes[0].imshow(
            shown, origin="lower", extent=extent, cmap=BELIEF_MAP, vmin=0, vmax=1, alpha=0.8, zorder=3
        )
        axes[0].set_title("occupancy grid: where cars were detected")
        scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(0, 1), BELIEF_MAP)
        inset = axes[0].inset_axes((0.76, 0.1, 0.2, 0.025))
        figure.colorbar(
            scale, cax=inset, orientation="horizontal", label="P(a car is here)", ticks=[0, 0.5, 1]
        )
        cars = result.session.cars
        paint(axes[1], [headings(cars, CAR_COLOR)], 3.0)
        boxes = plural(result.score.detections, "detection")
        axes[1].set_title(f"cars, frame by frame: {len(cars)} of {boxes} have a distance")
        heading = Line2D([], [], color=CAR_COLOR, linewidth=2.0, label="a car's middle and heading")
        _draw_key(axes[1], [heading])
        _draw_states(lot, result, axes[2])


def save_localisation(lot: ParkingLot, result: SessionResult, path: Path) -> None:
    """Draw the path and the located cars of a session by its odometry, and as corrected."""
    cars, at = result.session.cars, result.car_captures
    by_odometry = [
        moved(result.odometry[i], between(result.poses[i], car)) for i, car in zip(at, cars, strict=True)
    ]
    with picture(
        path,
        (11.0, _height(lot, 11.0, 2)),
        "A survey drive by drifting odometry, and as corrected by scan matching",
    ) as figure:
        panels = (
            ("by odometry", result.odometry, np.array(by_odometry).reshape(-1, 3)),
            ("corrected", result.poses, cars),
        )
        for ax, (name, poses, placed) in zip(figure.subplots(2, 1), panels, strict=True):
            draw_lot(lot, ax)
            error = np.hypot(*(poses - result.true_poses)[:, :2].T)
            layers = [
                Lines([result.true_poses[:, :2]], INK, px=(1.0, 1.0), dash=(3.7, 1.6)),
                Lines([poses[:, :2]], PATH_COLOR, px=(1.2, 1.2)),
                headings(placed, CAR_COLOR),
            ]
            paint(ax, layers, 3.0)
            rms = float(np.sqrt((error**2).mean()))
            ax.set_title(f"{name}: {rms:.2f} m off the true path, at most {error.max():.2f} m")
        keys = [
            Line2D([], [], color=INK, linestyle="--", label="true path"),
            Line2D([], [], color=PATH_COLOR, label="path"),
            Line2D([], [], color=CAR_COLOR, linewidth=2.0, label="a located car, frame by frame"),
        ]
        _draw_key(figure.axes[0], keys)


def save_graph(lot: ParkingLot, predicted: Prediction, result: SessionResult, path: Path) -> None:
    """Draw the drive graph with the map's prediction and one session's observation of each slot (T Fig. 4.7)."""
    with picture(
        path,
        (11.0, _height(lot, 11.0, 1) + 0.5),
        "The map's P(taken) on the drive graph, and what one drive saw",
    ) as figure:
        ax = figure.subplots()
        draw_lot(lot, ax, show_graph=True)
        states = result.states
        seen = BELIEF_MAP(states.occupied.astype(np.float64))
        seen[~states.in_view] = (*to_rgb(UNKNOWN), 1.0)
        draw_discs(lot, ax, predicted.p_occupied, seen)
        ax.set_title(
            f"{lot.name}: the drive graph; ring: map, disc: one session "
            f"({result.session.weather.replace('_', ' ')})"
        )
        _draw_scale(figure, ax, BELIEF_MAP, "P(taken)")


def save_found_slots(lot: ParkingLot, found: FoundSlots, score: DiscoveryScore, path: Path) -> None:
    """Draw the slots discovered from the cars of all sessions over the true slots."""
    with picture(
        path, (11.0, _height(lot, 11.0, 1)), "Slots discovered from detected cars, without a map of the lot"
    ) as figure:
        ax = figure.subplots()
        draw_lot(lot, ax)
        slots = posed(found.xy, found.yaw)
        paint(ax, [headings(slots, SLOT_COLOR, 4.0), Marks(slots, DISC, SLOT_COLOR, px=3.0)], 3.0)
        off = f", mean error {score.error:.2f} m" if score.recall else ""
        ax.set_title(
            f"{lot.name}: {plural(len(found.xy), 'slot')} discovered without a map; precision {score.precision:.0%}, "
            f"recall {score.recall:.0%} of {lot.n_slots}{off}"
        )
        found_slot = Line2D(
            [], [], color=SLOT_COLOR, marker="o", markersize=3, label="a discovered slot and its heading"
        )
        _draw_key(ax, [found_slot])


def save_detection_reach(rows: Sequence[Mapping[str, Any]], title: str, path: Path) -> None:
    """Draw detection rates by weather and distance, rows of `surveys.detection_by_distance`."""
    with picture(
        path, (7.0, 3.8), "How often a car in the frame is detected, by weather and distance"
    ) as figure:
        ax = figure.subplots()
        weathers = list(dict.fromkeys(row["weather"] for row in rows))
        for i, weather in enumerate(weathers):
            its = [row for row in rows if row["weather"] == weather]
            color = WEATHER_COLORS.get(weather, UNKNOWN)
            # Offset the points, so that the intervals do not hide each other.
            x = np.array([np.mean(row["distance_m"]) for row in its]) + 0.09 * (i - (len(weathers) - 1) / 2)
            rate = np.array([row["rate"] for row in its])
            low, high = np.array([row["rate_ci95"] for row in its]).T
            ax.plot(
                x, rate, color=color, marker="o", markersize=4, linewidth=1.6, label=weather.replace("_", " ")
            )
            ax.vlines(x, low, high, color=color, linewidth=1.2, alpha=0.7)
        ax.set(
            xlabel="distance from the camera to the middle of the car, m; points in the middle of ranges",
            xticks=sorted({end for row in rows for end in row["distance_m"]}),
            ylabel="share of unoccluded cars that are detected",
            ylim=(0.0, 1.03),
        )
        ax.grid(axis="y")
        ax.legend(loc="lower left", ncols=2)
        ax.set_title(title)


def save_map(lot: ParkingLot, predicted: Prediction, true: FloatArray | None, title: str, path: Path) -> None:
    """Draw the map's prediction for every slot (T Fig. 4.6), and the true probabilities if known."""
    panels: list[tuple[str, str, Colormap, FloatArray]] = [
        ("what the map says", "P(taken)", BELIEF_MAP, predicted.p_occupied)
    ]
    if true is not None:
        panels.append(("the truth", "P(taken)", BELIEF_MAP, true))
    width = predicted.high - predicted.low
    # Neither colour map passes through the grey of the asphalt.
    panels.append(("how unsure it is", "width of the 95 % interval", mpl.colormaps["plasma"], width))
    size = 11.0, _height(lot, 11.0, len(panels))
    with picture(path, size, "The map: how likely each slot is taken, and how sure the map is") as figure:
        axes = np.atleast_1d(figure.subplots(len(panels), 1))
        for ax, (name, label, colors, values) in zip(axes, panels, strict=True):
            draw_lot(lot, ax, slot_color=colors(values))
            ax.set_title(f"{title}: {name}")
            _draw_scale(figure, ax, colors, label)


def _draw_states(lot: ParkingLot, result: SessionResult, ax: Axes) -> None:
    """Draw the slot filter's states, with a bright outline around wrong ones."""
    states, wrong = result.states, (result.states.occupied != result.truth) & result.states.in_view
    color = np.array([to_rgb(TAKEN if o else FREE) for o in states.occupied])
    color[~states.in_view] = to_rgb(UNKNOWN)
    draw_lot(lot, ax, slot_color=color)
    outlines = lot.slot_corners()[wrong][:, [0, 1, 2, 3, 0]]
    paint(ax, [Lines(list(outlines), WRONG, px=(2.4, 2.4), halo="white")], 4.0)
    names: dict[str, Any] = {"taken": TAKEN, "free": FREE, "never in view": UNKNOWN}
    handles = [Patch(color=c, label=name) for name, c in names.items()]
    handles.append(Patch(fill=False, edgecolor=WRONG, linewidth=2.0, label=f"wrong ({wrong.sum()})"))
    _draw_key(ax, handles)
    right, unknown = result.slot_accuracy, 1.0 - result.states.in_view.mean()
    ax.set_title(f"slots: {slots_text(right, unknown)}")


def _draw_key(ax: Axes, handles: Sequence[Patch | Line2D]) -> None:
    ax.legend(handles=handles, loc="lower right", ncols=len(handles), fontsize=8)


def _draw_scale(figure: Figure, ax: Axes, colors: Colormap, label: str) -> None:
    figure.colorbar(
        mpl.cm.ScalarMappable(mpl.colors.Normalize(0, 1), colors), ax=ax, fraction=0.02, label=label
    )


def _height(lot: ParkingLot, width: float, panels: int) -> float:
    x0, y0, x1, y1 = lot.bounds()
    return panels * (width * (y1 - y0 + 8.0) / (x1 - x0 + 8.0) * 0.92 + 0.45)
