"""Figures of sensors and surveys: captures, detections, one session's grid and slots, the map (T Fig. 4.4-4.7)."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LogNorm, Normalize, to_rgb
from matplotlib.patches import Patch
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.mapping.discovery import DiscoveryScore, FoundSlots
from parkenv.mapping.inference import Prediction
from parkenv.mapping.odometry import between, moved
from parkenv.mapping.survey import SessionResult
from parkenv.perception.detector import LEAST_PROBABILITY, PROBABILITY, Detections
from parkenv.perception.range_scan import disparity
from parkenv.show.figures.charts import Line, Panel, Row, draw_panels, key_line
from parkenv.show.figures.lot import BELIEF_MAP, draw_discs, draw_lot
from parkenv.show.figures.picture_files import INK, picture, save_picture
from parkenv.show.painters.axes import paint
from parkenv.show.painters.opencv import write_tag
from parkenv.show.scene import DISC, PALETTE, Color, Layer, Lines, Marks, hex_color, posed
from parkenv.show.tables import plural, slots_text
from parkenv.world.lot import ParkingLot
from sim_sensors.ground_truth import VehicleBoxes, View
from sim_sensors.rig import Capture, SensorRig

VIEW_COLORS = {view: PALETTE[view.name.lower()] for view in View}
UNRANGED_COLOR = (200, 200, 200)
NEAREST, FARTHEST = 2.0, 30.0  # limits of the depth colour scale, m
SEEN = 0.05  # least visible fraction of a vehicle for its box to be drawn
HIDDEN = 0.8  # visible fraction below which it is written beside the probability
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
    image: NDArray[np.uint8], detections: Detections, placed: NDArray[np.int64] | None = None
) -> NDArray[np.uint8]:
    """Return a copy of an image with its detections: probability, and what is visible of a hidden car.

    Of indices of ranged detections, if given, others are drawn thin and grey.
    """
    drawn = image.copy()
    for i, (box, p) in enumerate(zip(detections.boxes, detections.probability, strict=True)):
        corners = [round(float(v)) for v in box]
        if placed is not None and i not in placed:
            _draw_box(drawn, corners, UNRANGED_COLOR, 1)
            continue
        visible = detections.visible_fraction[i]
        hidden = f", {visible:.0%} visible" if visible < HIDDEN else ""
        _draw_box(drawn, corners, VIEW_COLORS[View(detections.view[i])], 2, f"{p:.2f}{hidden}")
    return drawn


def with_boxes(image: Image, boxes: VehicleBoxes) -> Image:
    drawn = image.copy()
    for i in np.flatnonzero(boxes.visible_fraction >= SEEN)[::-1]:
        corners, view = boxes.visible_box[i] - [0, 0, 1, 1], View(boxes.view[i])
        tag = f"{view.name.lower()} {boxes.distance[i]:.0f} m {boxes.visible_fraction[i]:.0%}"
        _draw_box(drawn, corners.tolist(), VIEW_COLORS[view], 2, tag)
    return drawn


def _draw_box(image: Image, corners: Sequence[int], color: Color, thickness: int, tag: str = "") -> None:
    left, top, right, bottom = corners
    cv2.rectangle(image, (left, top), (right, bottom), color, thickness, cv2.LINE_AA)
    if tag:
        write_tag(image, tag, (left, max(top, 0)), color)


def save_sensor_preview(
    lot: ParkingLot, rig: SensorRig, capture: Capture, boxes: VehicleBoxes, title: str, path: Path
) -> None:
    frame = capture.images[rig.cameras[0][0]]
    name, stereo, _ = rig.stereo_cameras[0]
    with picture(path, (10.6, 8.4), layout=None) as figure:
        figure.suptitle(title, x=0.02, ha="left", weight="bold")
        corners = ((0.02, 0.5), (0.02, 0.02), (0.52, 0.02), (0.52, 0.5))
        axes = [figure.add_axes((x, y, 0.44, 0.43)) for x, y in corners]
        axes[0].imshow(with_boxes(frame.image, boxes))
        axes[0].set_title("camera; true boxes: view, distance, visible fraction")
        shown = axes[1].imshow(frame.depth, cmap="viridis_r", norm=LogNorm(NEAREST, FARTHEST))
        axes[1].set_title("depth of the first opaque surface, m")
        metres = figure.colorbar(shown, ax=axes[1], fraction=0.034, pad=0.01)
        metres.set_ticks([2, 5, 10, 20, 30], labels=["2", "5", "10", "20", "30"], minor=False)
        metres.ax.minorticks_off()
        shown = axes[2].imshow(disparity(capture.pairs[name], stereo), cmap="magma")
        axes[2].set_title("disparity by semi-global matching, px")
        figure.colorbar(shown, ax=axes[2], fraction=0.034, pad=0.01)
        for ax in axes[:3]:
            ax.set_axis_off()
        _draw_scan(axes[3], lot, capture, rig)
        axes[3].set_title("270° scan at knee height")


def _draw_scan(ax: Axes, lot: ParkingLot, capture: Capture, rig: SensorRig) -> None:
    draw_lot(lot, ax)
    x, y, yaw = capture.pose
    for name, laser, mount in rig.lasers:
        at_x, at_y, at_yaw = mount.in_world(capture.pose)
        ranges = capture.scans[name]
        hit = np.isfinite(ranges)
        angle = laser.angles[hit] + at_yaw
        ends = at_x + ranges[hit] * np.cos(angle), at_y + ranges[hit] * np.sin(angle)
        ax.scatter(*ends, s=2.0, color="#d0103a", linewidths=0, zorder=4)
    ax.quiver(x, y, np.cos(yaw), np.sin(yaw), color=hex_color("car"), scale=18, width=0.012, zorder=5)
    # The rest of the lot is out of the laser's range.
    ax.set(xlim=(x - 24.0, x + 24.0), ylim=(y - 18.0, y + 18.0))


def save_detections(result: SessionResult, path: Path) -> None:
    n = len(result.shown)
    caption = "Camera frames of a survey drive, with the cars that were detected"
    with picture(path, (4.2 * n, 3.7), caption, layout=None) as figure:
        weather = result.session.weather.replace("_", " ")
        figure.suptitle(f"Detected cars, {weather}", x=0.01, ha="left", weight="bold")
        for i, shown in enumerate(result.shown):
            ax, view = figure.add_subplot(1, n, i + 1), shown.views[0]
            ax.imshow(draw_detections(view.image, view.detections, view.cars.detection))
            ax.set_axis_off()
        names = {View.SIDE: "a car's side", View.OBLIQUE: "oblique", View.END: "front or rear"}
        kinds = [*((name, VIEW_COLORS[view], 2.0) for view, name in names.items())]
        key: list[Any] = [
            Patch(fill=False, edgecolor="#{:02x}{:02x}{:02x}".format(*color), linewidth=width, label=name)
            for name, color, width in (*kinds, ("no distance", UNRANGED_COLOR, 1.0))
        ]
        least = f"{LEAST_PROBABILITY:g} where a distance confirms it, else {PROBABILITY:g}"
        key.append(key_line(f"number: probability, at least {least}", INK, linestyle="none"))
        figure.legend(handles=key, loc="lower left", ncols=5)
        figure.subplots_adjust(0.01, 0.08, 0.99, 0.91, wspace=0.02)


@contextmanager
def _lots(
    lot: ParkingLot, panels: int, path: Path, caption: str, *, room: float = 0.0
) -> Iterator[Sequence[Axes]]:
    x0, y0, x1, y1 = lot.bounds()
    height = 11.0 * (y1 - y0 + 8.0) / (x1 - x0 + 8.0) * 0.92 + 0.45
    with picture(path, (11.0, panels * height + room), caption) as figure:
        yield list(np.atleast_1d(figure.subplots(panels, 1)))


def _draw_lot(lot: ParkingLot, ax: Axes, layers: Sequence[Layer], title: str, *key: Any) -> None:
    draw_lot(lot, ax)
    paint(ax, layers, 3.0)
    ax.set_title(title)
    _draw_key(ax, key)


def save_session(lot: ParkingLot, result: SessionResult, path: Path) -> None:
    caption = "One survey drive: occupancy grid, detected cars, and the states of the slots"
    with _lots(lot, 3, path, caption) as axes:
        above, middle, below = axes
        for ax in axes:
            draw_lot(lot, ax)
        grid = result.grid
        rows, columns = grid.log_odds.shape
        low_x, low_y = grid.low
        extent = (low_x, low_x + columns * grid.cell, low_y, low_y + rows * grid.cell)
        seen = np.ma.masked_where(~grid.seen, grid.probability)
        how: dict[str, Any] = {"cmap": BELIEF_MAP, "vmin": 0, "vmax": 1, "alpha": 0.8, "zorder": 3}
        above.imshow(seen, origin="lower", extent=extent, **how)
        above.set_title("occupancy grid: where cars were detected")
        scale, inset = ScalarMappable(Normalize(0, 1), BELIEF_MAP), above.inset_axes((0.76, 0.1, 0.2, 0.025))
        bar: dict[str, Any] = {"orientation": "horizontal", "label": "P(a car is here)", "ticks": [0, 0.5, 1]}
        above.figure.colorbar(scale, cax=inset, **bar)
        cars, boxes = result.session.cars, plural(result.score.detections, "detection")
        heading = key_line("a car's middle and heading", CAR_COLOR, linewidth=2.0)
        title = f"cars, frame by frame: {len(cars)} of {boxes} have a distance"
        paint(middle, [headings(cars, CAR_COLOR)], 3.0)
        middle.set_title(title)
        _draw_key(middle, [heading])
        _draw_states(lot, result, below)


def headings(poses: FloatArray, color: str, length: float = 2.5) -> Lines:
    ahead = 0.5 * length * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    return Lines(list(np.stack([poses[:, :2] - ahead, poses[:, :2] + ahead], axis=1)), color, px=(1.3, 1.3))


def save_localisation(lot: ParkingLot, result: SessionResult, path: Path) -> None:
    cars = result.session.cars
    by_odometry = [
        moved(result.odometry[i], between(result.poses[i], car))
        for i, car in zip(result.car_captures, cars, strict=True)
    ]
    panels = (
        ("by odometry", result.odometry, np.array(by_odometry).reshape(-1, 3)),
        ("corrected", result.poses, cars),
    )
    key = [
        key_line("true path", INK, linestyle="--"),
        key_line("path", PATH_COLOR),
        key_line("a located car, frame by frame", CAR_COLOR, linewidth=2.0),
    ]
    with _lots(
        lot, 2, path, "A survey drive by drifting odometry, and as corrected by scan matching"
    ) as axes:
        for ax, (name, poses, placed) in zip(axes, panels, strict=True):
            error = np.hypot(*(poses - result.true_poses)[:, :2].T)
            layers = [
                Lines([result.true_poses[:, :2]], INK, px=(1.0, 1.0), dash=(3.7, 1.6)),
                Lines([poses[:, :2]], PATH_COLOR, px=(1.2, 1.2)),
                headings(placed, CAR_COLOR),
            ]
            off = f"{np.sqrt((error**2).mean()):.2f} m off the true path, at most {error.max():.2f} m"
            _draw_lot(lot, ax, layers, f"{name}: {off}", *(key if ax is axes[0] else ()))


def save_graph(lot: ParkingLot, predicted: Prediction, result: SessionResult, path: Path) -> None:
    """Draw the drive graph with the map's prediction and one session's observation of each slot (T Fig. 4.7)."""
    with _lots(lot, 1, path, "The map's P(taken) on the drive graph, and what one drive saw", room=0.5) as (
        ax,
    ):
        draw_lot(lot, ax, show_graph=True)
        seen = BELIEF_MAP(result.states.occupied.astype(np.float64))
        seen[~result.states.in_view] = (*to_rgb(UNKNOWN), 1.0)
        draw_discs(lot, ax, predicted.p_occupied, seen)
        weather = result.session.weather.replace("_", " ")
        ax.set_title(f"{lot.name}: the drive graph; ring: map, disc: one session ({weather})")
        _draw_scale(ax, BELIEF_MAP, "P(taken)")


def save_found_slots(lot: ParkingLot, found: FoundSlots, score: DiscoveryScore, path: Path) -> None:
    with _lots(lot, 1, path, "Slots discovered from detected cars, without a map of the lot") as (ax,):
        slots = posed(found.xy, found.yaw)
        layers: list[Layer] = [headings(slots, SLOT_COLOR, 4.0), Marks(slots, DISC, SLOT_COLOR, px=3.0)]
        off = f", mean error {score.error:.2f} m" if score.recall else ""
        title = (
            f"{lot.name}: {plural(len(found.xy), 'slot')} discovered without a map; precision {score.precision:.0%}, "
            f"recall {score.recall:.0%} of {lot.n_slots}{off}"
        )
        key = key_line("a discovered slot and its heading", SLOT_COLOR, marker="o", markersize=3)
        _draw_lot(lot, ax, layers, title, key)


def save_detection_reach(rows: Sequence[Row], title: str, path: Path) -> None:
    weathers, marks = list(dict.fromkeys(row["weather"] for row in rows)), list[Any]()
    for i, weather in enumerate(weathers):
        of_weather = [row for row in rows if row["weather"] == weather]
        color = WEATHER_COLORS.get(weather, UNKNOWN)
        # Offset the points, so that the intervals do not hide each other.
        x = np.array([np.mean(row["distance_m"]) for row in of_weather]) + 0.09 * (
            i - (len(weathers) - 1) / 2
        )
        low, high = np.array([row["rate_ci95"] for row in of_weather]).T
        style = {"marker": "o", "markersize": 4, "linewidth": 1.6, "label": weather.replace("_", " ")}
        marks.append(Line(x, [row["rate"] for row in of_weather], color, style))
        ends: dict[str, Any] = {"x": x, "ymin": low, "ymax": high, "color": color}
        marks.append(partial(Axes.vlines, **ends, linewidth=1.2, alpha=0.7))
    axes = {
        "xlabel": "distance from the camera to the middle of the car, m; points in the middle of ranges",
        "xticks": sorted({end for row in rows for end in row["distance_m"]}),
        "ylabel": "share of unoccluded cars that are detected",
        "ylim": (0.0, 1.03),
    }
    figure = draw_panels([Panel(marks, title, axes, "y", {"loc": "lower left", "ncols": 2})], (7.0, 3.8))
    save_picture(figure, path, "How often a car in the frame is detected, by weather and distance")


def save_map(lot: ParkingLot, predicted: Prediction, true: FloatArray | None, title: str, path: Path) -> None:
    panels: list[tuple[str, str, Colormap, FloatArray]] = [
        ("what the map says", "P(taken)", BELIEF_MAP, predicted.p_occupied)
    ]
    if true is not None:
        panels.append(("the truth", "P(taken)", BELIEF_MAP, true))
    # Neither colour map passes through the grey of the asphalt.
    unsure = mpl.colormaps["plasma"], predicted.high - predicted.low
    panels.append(("how unsure it is", "width of the 90 % interval", *unsure))
    caption = "The map: how likely each slot is taken, and how sure the map is"
    with _lots(lot, len(panels), path, caption) as axes:
        for ax, (name, label, colors, values) in zip(axes, panels, strict=True):
            draw_lot(lot, ax, slot_color=colors(values))
            ax.set_title(f"{title}: {name}")
            _draw_scale(ax, colors, label)


def _draw_states(lot: ParkingLot, result: SessionResult, ax: Axes) -> None:
    states, wrong = result.states, (result.states.occupied != result.truth) & result.states.in_view
    color = np.array([to_rgb(TAKEN if o else FREE) for o in states.occupied])
    color[~states.in_view] = to_rgb(UNKNOWN)
    draw_lot(lot, ax, slot_color=color)
    outlines = lot.slot_corners()[wrong][:, [0, 1, 2, 3, 0]]
    paint(ax, [Lines(list(outlines), WRONG, px=(2.4, 2.4), halo="white")], 4.0)
    names: dict[str, Any] = {"taken": TAKEN, "free": FREE, "never in view": UNKNOWN}
    key = [Patch(color=c, label=name) for name, c in names.items()]
    key.append(Patch(fill=False, edgecolor=WRONG, linewidth=2.0, label=f"wrong ({wrong.sum()})"))
    _draw_key(ax, key)
    right, unknown = result.slot_accuracy, 1.0 - result.states.in_view.mean()
    ax.set_title(f"slots: {slots_text(right, unknown)}")


def _draw_key(ax: Axes, handles: Sequence[Any]) -> None:
    if handles:
        ax.legend(handles=handles, loc="lower right", ncols=len(handles), fontsize=8)


def _draw_scale(ax: Axes, colors: Colormap, label: str) -> None:
    ax.figure.colorbar(ScalarMappable(Normalize(0, 1), colors), ax=ax, fraction=0.02, label=label)
