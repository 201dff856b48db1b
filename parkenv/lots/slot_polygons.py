"""Infer the shape, yaw and mouth of slots from their polygons and the lanes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.lots.generators import Slots
from parkenv.world.lot import Lane, Mouth


def slots_from_polygons(polygons: NDArray[np.object_], lanes: Sequence[Lane]) -> Slots:
    """Infer length, width, yaw and mouth of slots from their outlines, (n,) polygons with an area, m.

    A slot is the smallest rectangle around its polygon. A side faces a lane if the lane's nearest point is within 60°
    of the side's outward normal. A slot with a short side that faces a lane is perpendicular or angled, and entered by
    that side (the nearer one of two). If only a long side faces a lane, it is a kerbside slot, and the car faces the
    direction of traffic: that of a one-way lane, otherwise with the lane on its left. If no side faces a lane, the
    short side nearest to one counts.
    """
    boxes = shapely.normalize(shapely.minimum_rotated_rectangle(polygons))
    corners = shapely.get_coordinates(boxes).reshape(len(polygons), 5, 2)[:, :4]
    side_length = np.hypot(*np.moveaxis(np.roll(corners, -1, axis=1) - corners, 2, 0))
    # Make sides 0 and 2 the short ones.
    turn = (side_length[:, 0] > side_length[:, 1])[:, None, None]
    corners = np.where(turn, np.roll(corners, -1, axis=1), corners)
    middle = (corners + np.roll(corners, -1, axis=1)) / 2
    center = corners.mean(axis=1)
    outward = middle - center[:, None]
    half = np.hypot(outward[..., 0], outward[..., 1])
    outward /= half[..., None]

    nearest, tangent, oneway = nearest_on_lanes(lanes, middle.reshape(-1, 2))
    to_lane = nearest.reshape(middle.shape) - middle
    distance = np.hypot(to_lane[..., 0], to_lane[..., 1])
    faced = np.where((to_lane * outward).sum(axis=2) >= 0.5 * distance, distance, np.inf)
    # A lane that touches the side has no direction from it; the side counts as facing it.
    short_faced, long_faced = (np.isfinite(np.min(faced[:, sides], axis=1)) for sides in ([0, 2], [1, 3]))
    kerbside = np.asarray(~short_faced & long_faced)
    by = np.where(np.asarray(short_faced | long_faced)[:, None], faced, distance)
    side = np.where(kerbside, 1 + 2 * by[:, [1, 3]].argmin(axis=1), 2 * by[:, [0, 2]].argmin(axis=1))

    row = np.arange(len(polygons))
    mouthward = outward[row, side]
    # For a car with this heading the mouth is on the right, for the opposite heading on the left.
    along = np.stack([-mouthward[:, 1], mouthward[:, 0]], axis=1)
    with_lane = (along * tangent.reshape(middle.shape)[row, side]).sum(axis=1) > 0.0
    on_right = oneway.reshape(side_length.shape)[row, side] & with_lane
    heading = np.where(kerbside[:, None], np.where(on_right[:, None], along, -along), -mouthward)
    return Slots(
        xy=center,
        yaw=np.arctan2(heading[:, 1], heading[:, 0]),
        length=2 * half[:, 0],
        width=2 * half[:, 1],
        mouth=np.where(kerbside, np.where(on_right, Mouth.RIGHT, Mouth.LEFT), Mouth.REAR).astype(np.int8),
    )


def nearest_on_lanes(lanes: Sequence[Lane], xy: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the lane point nearest to each, (n, 2) m, or itself, the lane's direction, and whether it is one-way."""
    if not lanes or not len(xy):
        return xy, np.zeros_like(xy), np.zeros(len(xy), dtype=bool)
    start = np.concatenate([lane.points[:-1] for lane in lanes])
    step = np.concatenate([np.diff(lane.points, axis=0) for lane in lanes])
    oneway = np.repeat([lane.oneway for lane in lanes], [len(lane.points) - 1 for lane in lanes])
    tree = shapely.STRtree(np.asarray(shapely.linestrings(np.stack([start, start + step], axis=1))))
    leg = np.asarray(tree.nearest(np.asarray(shapely.points(xy))))
    start, step, oneway = start[leg], step[leg], oneway[leg]
    share = ((xy - start) * step).sum(axis=1) / (step**2).sum(axis=1)
    nearest = start + np.clip(share, 0.0, 1.0)[:, None] * step
    return nearest, step / np.hypot(step[:, 0], step[:, 1])[:, None], oneway
