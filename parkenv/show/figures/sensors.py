"""Figures of simulated sensor data."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm

from parkenv.compiled.arrays import Image
from parkenv.perception.range_scan import disparity
from parkenv.show.colors import PALETTE, hex_color
from parkenv.show.figures.lot import draw_lot
from parkenv.show.figures.picture_files import picture
from parkenv.show.painters.opencv import write_tag
from parkenv.world.lot import ParkingLot
from sim_sensors.ground_truth import VehicleBoxes, View
from sim_sensors.rig import Capture, SensorRig

NEAREST, FARTHEST = 2.0, 30.0
"""Limits of the depth colour scale, m."""
BOX_COLORS = {view: PALETTE[view.name.lower()] for view in View}
SEEN = 0.05
"""Least visible fraction of a vehicle for its box to be drawn."""


def with_boxes(image: Image, boxes: VehicleBoxes) -> Image:
    """Return a copy of an image, (h, w, 3) RGB, with the boxes of visible vehicles, farthest first."""
    drawn = image.copy()
    for i in np.flatnonzero(boxes.visible_fraction >= SEEN)[::-1]:
        left, top, right, bottom = boxes.visible_box[i].tolist()
        view = View(boxes.view[i])
        cv2.rectangle(drawn, (left, top), (right - 1, bottom - 1), BOX_COLORS[view], 2, cv2.LINE_AA)
        label = f"{view.name.lower()} {boxes.distance[i]:.0f} m {boxes.visible_fraction[i]:.0%}"
        write_tag(drawn, label, (left, top), BOX_COLORS[view])
    return drawn


def draw_scan(ax: Axes, lot: ParkingLot, capture: Capture, rig: SensorRig) -> None:
    """Draw the lot from above with the vehicle and the end points of its beams."""
    draw_lot(lot, ax)
    x, y, yaw = capture.pose
    for name, laser, mount in rig.lasers:
        at_x, at_y, at_yaw = mount.in_world(capture.pose)
        ranges = capture.scans[name]
        hit = np.isfinite(ranges)
        angle = laser.angles[hit] + at_yaw
        ends = np.stack([at_x + ranges[hit] * np.cos(angle), at_y + ranges[hit] * np.sin(angle)], axis=1)
        ax.scatter(ends[:, 0], ends[:, 1], s=2.0, color="#d0103a", linewidths=0, zorder=4)
    ax.quiver(x, y, np.cos(yaw), np.sin(yaw), color=hex_color("car"), scale=18, width=0.012, zorder=5)
    # The rest of the lot is out of the laser's range.
    ax.set(xlim=(x - 24.0, x + 24.0), ylim=(y - 18.0, y + 18.0))


def save_sensor_preview(
    lot: ParkingLot, rig: SensorRig, capture: Capture, boxes: VehicleBoxes, title: str, path: Path
) -> None:
    """Draw the camera frame with true boxes, its depth, the stereo disparity and the scan from above.

    Args:
        lot: the lot.
        rig: a rig with at least a camera, a stereo camera and a laser.
        capture: a capture of this rig.
        boxes: boxes in the first camera's frame.
        title: title of the figure.
        path: the PNG file to write.
    """
    frame = capture.images[rig.cameras[0][0]]
    name, stereo, _ = rig.stereo_cameras[0]
    with picture(path, (10.6, 8.4), layout=None) as figure:
        figure.suptitle(title, x=0.02, ha="left", weight="bold")
        places = ((0.02, 0.5), (0.02, 0.02), (0.52, 0.02), (0.52, 0.5))
        axes = [figure.add_axes((x, y, 0.44, 0.43)) for x, y in places]
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
        draw_scan(axes[3], lot, capture, rig)
        axes[3].set_title("270° scan at knee height")
