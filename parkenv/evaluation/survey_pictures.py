"""Pictures of a survey: what was detected, what a session made of the lot, what the map says (T Fig. 4.4-4.7)."""

from __future__ import annotations

from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from parkenv.evaluation.lot_picture import draw_lot
from parkenv.evaluation.picture_files import STYLE, save_picture
from parkenv.lot import ParkingLot
from parkenv.mapping.inference import Prediction
from parkenv.mapping.survey import SessionResult
from parkenv.perception.detector import Detections

FloatArray = NDArray[np.float64]

SIDE_COLOR, END_COLOR = (255, 208, 0), (86, 180, 233)
TAKEN, FREE, UNKNOWN = "#d1495b", "#2a9d8f", "#9aa0a6"
WRONG = "#ffd000"


def draw_detections(image: NDArray[np.uint8], found: Detections) -> NDArray[np.uint8]:
    """A copy of an image, (h, w, 3) RGB, with what was detected in it."""
    drawn = image.copy()
    for box, p, end in zip(found.boxes, found.probability, found.ends, strict=True):
        color = END_COLOR if end else SIDE_COLOR
        left, top, right, bottom = (round(float(v)) for v in box)
        cv2.rectangle(drawn, (left, top), (right, bottom), color, 2, cv2.LINE_AA)
        cv2.putText(drawn, f"{p:.2f}", (left + 4, max(top, 0) + 16), color, cv2.FontFace("sans"), 14, 700)
    return drawn


def save_detections(result: SessionResult, path: Path) -> None:
    """Some frames of a session with their detections (T Fig. 4.4); yellow sides, blue fronts and rears."""
    with mpl.rc_context(STYLE):
        n = len(result.looks)
        figure = Figure(figsize=(4.2 * n, 3.5))
        figure.suptitle(
            f"Detections, {result.session.weather.replace('_', ' ')}", x=0.01, ha="left", weight="bold"
        )
        for i, (_, look) in enumerate(result.looks):
            ax = figure.add_subplot(1, n, i + 1)
            ax.imshow(draw_detections(look.views[0].image, look.views[0].detections))
            ax.set_axis_off()
        figure.subplots_adjust(0.01, 0.01, 0.99, 0.9, wspace=0.02)
        save_picture(figure, path)


def save_session(lot: ParkingLot, result: SessionResult, path: Path) -> None:
    """One session from above (T Fig. 4.5): the grid, the cars that were found, and the slots."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11.0, _height(lot, 11.0, 3)))
        axes = figure.subplots(3, 1)
        for ax in axes:
            draw_lot(lot, ax)
        grid = result.grid
        rows, columns = grid.log_odds.shape
        low_x, low_y = grid.low
        extent = (low_x, low_x + columns * grid.cell, low_y, low_y + rows * grid.cell)
        shown = np.ma.masked_where(~grid.seen, grid.probability)
        axes[0].imshow(
            shown, origin="lower", extent=extent, cmap="cividis", vmin=0, vmax=1, alpha=0.85, zorder=3
        )
        axes[0].set_title("occupancy grid: P(a car stands here)")
        cars = result.session.cars
        axes[1].quiver(
            cars[:, 0], cars[:, 1], np.cos(cars[:, 2]), np.sin(cars[:, 2]), pivot="mid", headwidth=1, headlength=0,
            headaxislength=0, scale=60, width=0.0016, color="#ffb000", zorder=3,
        )  # fmt: skip
        axes[1].set_title(f"{len(cars)} sightings of cars, each with the direction fitted to its beams")
        _draw_states(lot, result, axes[2])
        figure.tight_layout()
        save_picture(figure, path)


def save_map(lot: ParkingLot, predicted: Prediction, true: FloatArray | None, title: str, path: Path) -> None:
    """What the map predicts of every slot (T Fig. 4.6), beside the truth where it is known."""
    with mpl.rc_context(STYLE):
        panels = [("predicted", predicted.p_occupied)] + (
            [("true probability", true)] if true is not None else []
        )
        panels.append(("how sure: width of the interval", predicted.high - predicted.low))
        figure = Figure(figsize=(11.0, _height(lot, 11.0, len(panels))))
        axes = np.atleast_1d(figure.subplots(len(panels), 1))
        for ax, (name, values) in zip(axes, panels, strict=True):
            # cividis is read alike by those who do not tell red from green.
            draw_lot(lot, ax, slot_color=mpl.colormaps["cividis"](values))
            ax.set_title(f"{title}: {name}")
            bar = figure.colorbar(
                mpl.cm.ScalarMappable(mpl.colors.Normalize(0, 1), "cividis"), ax=ax, fraction=0.02
            )
            bar.ax.set_ylim(0, 1)
        figure.tight_layout()
        save_picture(figure, path)


def _draw_states(lot: ParkingLot, result: SessionResult, ax: Axes) -> None:
    """Slots by what the filter says, with a bright edge where it is wrong."""
    states, wrong = result.states, (result.states.occupied != result.truth) & result.states.in_view
    color = np.array([to_rgb(TAKEN if o else FREE) for o in states.occupied])
    color[~states.in_view] = to_rgb(UNKNOWN)
    draw_lot(lot, ax, slot_color=color)
    for corners in lot.slot_corners()[wrong]:
        ax.fill(*corners.T, fill=False, edgecolor=WRONG, linewidth=2.0, zorder=4)
    names = {"taken": TAKEN, "free": FREE, "never in view": UNKNOWN}
    handles = [Patch(color=c, label=name) for name, c in names.items()]
    handles.append(Patch(fill=False, edgecolor=WRONG, linewidth=2.0, label=f"wrong ({wrong.sum()})"))
    ax.legend(handles=handles, loc="lower right", ncols=4, fontsize=8)
    ax.set_title(f"slots: {result.slot_accuracy:.1%} right")


def _height(lot: ParkingLot, width: float, panels: int) -> float:
    x0, y0, x1, y1 = lot.bounds()
    return panels * (width * (y1 - y0 + 8.0) / (x1 - x0 + 8.0) * 0.92 + 0.45)
