"""Ground truth of the vehicles in a frame: bounding boxes, visible fractions, and viewing sides."""

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, Int32Array
from parkenv.compiled.jit import compiled
from sim_sensors.camera.models import Drawable, Frame, PinholeCamera, checked_pose
from sim_sensors.camera.projection import project
from sim_sensors.camera.rasterizer import edge_slope, sorted_by_row

END_LIMIT = math.radians(30.0)
SIDE_LIMIT = math.radians(60.0)


class View(IntEnum):
    """Viewing side of a vehicle, by the angle in the ground plane between its axis and the line of sight."""

    END = 0  # front or rear: below 30°
    OBLIQUE = 1
    SIDE = 2  # 60° or more


@dataclass(frozen=True, eq=False)
class VehicleBoxes:
    """The vehicles that would be visible without occlusion, nearest first."""

    ids: Int32Array  # (n,) int32, as in the instances
    # (n, 4) int32, px: left, top, right, bottom (right and bottom exclusive) of the whole vehicle within the image,
    # hidden parts included
    box: Int32Array
    visible_box: Int32Array  # (n, 4) int32, the box of its visible pixels; zeros if there are none
    # (n,) float64, visible pixels divided by the pixels that it would have alone, both within the image
    visible_fraction: FloatArray
    view: NDArray[np.int8]  # (n,) int8, a `View` each
    distance: FloatArray  # (n,) float64, m, from the camera to the vehicle's origin, in the ground plane


def vehicle_boxes(camera: PinholeCamera, scene: Drawable, pose: FloatArray, frame: Frame) -> VehicleBoxes:
    """Return the boxes of the vehicles (instances with an id above 0) in a frame of the camera.

    Each vehicle is rasterized again without depth test, into one image that stores the last vehicle at each pixel.

    Args:
        camera: the camera of the frame.
        scene: the scene of the frame.
        pose: (4, 4) camera to world.
        frame: the frame with the instance ids.
    """
    pose = checked_pose(scene, pose)
    size = (camera.width, camera.height)
    triangles = project(scene.pool, scene.instances, pose, camera.intrinsics, size, camera.coarse_from)
    alone, box = _extents_alone(triangles.corners, triangles.instance, len(scene.instances.ids), *size)
    greatest = int(scene.instances.ids.max(initial=0))
    seen, visible_box = _extents_seen(frame.ids, greatest + 1)
    offset = scene.instances.pose[:, :2] - pose[:2, 3]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    shown = np.flatnonzero((alone > 0) & (scene.instances.ids > 0))
    shown = shown[np.argsort(distance[shown], kind="stable")]
    ids = scene.instances.ids[shown]
    return VehicleBoxes(
        ids,
        box[shown],
        visible_box[ids],
        np.minimum(seen[ids] / alone[shown], 1.0),
        _views(offset[shown], scene.instances.pose[shown, 3]),
        distance[shown],
    )


def _views(offset: FloatArray, yaw: FloatArray) -> NDArray[np.int8]:
    angle = np.abs(np.arctan2(offset[:, 1], offset[:, 0]) - yaw) % np.pi
    angle = np.minimum(angle, np.pi - angle)
    view = np.full(len(angle), View.OBLIQUE, dtype=np.int8)
    view[angle < END_LIMIT] = View.END
    view[angle >= SIDE_LIMIT] = View.SIDE
    return view


@compiled
def _extents_alone(
    corners: NDArray[np.float32], instance: Int32Array, n: int, width: int, height: int
) -> tuple[NDArray[np.int64], Int32Array]:
    """Return the pixel count and box of each instance without the others; triangles of an instance are consecutive."""
    last = np.full((height, width), -1, dtype=np.int32)
    count = np.zeros(n, dtype=np.int64)
    box = _empty_boxes(n, width, height)
    for t in range(corners.shape[0]):
        q = instance[t]
        ax, ay, bx, by, cx, cy = sorted_by_row(corners[t])
        slope_ac = edge_slope(ax, ay, cx, cy)
        slope_ab = edge_slope(ax, ay, bx, by)
        slope_bc = edge_slope(bx, by, cx, cy)
        for y in range(max(0, math.ceil(ay - 0.5)), min(height, math.ceil(cy - 0.5))):
            py = y + 0.5
            long = ax + (py - ay) * slope_ac
            short = ax + (py - ay) * slope_ab if py < by else bx + (py - by) * slope_bc
            first = math.ceil(max(min(long, short), 0.0) - 0.5)
            end = math.ceil(min(max(long, short), float(width)) - 0.5)
            if first >= end:
                continue
            box[q, 0] = min(box[q, 0], first)
            box[q, 1] = min(box[q, 1], y)
            box[q, 2] = max(box[q, 2], end)
            box[q, 3] = max(box[q, 3], y + 1)
            for x in range(first, end):
                if last[y, x] != q:
                    last[y, x] = q
                    count[q] += 1
    return count, box


@compiled
def _extents_seen(ids: Int32Array, n: int) -> tuple[NDArray[np.int64], Int32Array]:
    height, width = ids.shape
    count = np.zeros(n, dtype=np.int64)
    box = _empty_boxes(n, width, height)
    for y in range(height):
        for x in range(width):
            q = ids[y, x]
            if q > 0:
                count[q] += 1
                box[q, 0] = min(box[q, 0], x)
                box[q, 1] = min(box[q, 1], y)
                box[q, 2] = max(box[q, 2], x + 1)
                box[q, 3] = max(box[q, 3], y + 1)
    for q in range(n):
        if count[q] == 0:
            box[q] = 0
    return count, box


@compiled
def _empty_boxes(n: int, width: int, height: int) -> Int32Array:
    box = np.zeros((n, 4), dtype=np.int32)
    box[:, 0] = width
    box[:, 1] = height
    return box
