"""Rows of slots along roads that bend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.generators import BAY_SIZE, KERB_SIZE, Slots
from parkenv.world.lot import Mouth

Side = Literal["left", "right"]


@dataclass(frozen=True)
class Arrangement:
    """Arrangement of parked cars along a road."""

    angle: float  # angle between the road and the cars, rad, from 0 (along it) to π/2 (across)
    length: float  # length of a slot, m
    width: float  # width of a slot, m

    @property
    def pitch(self) -> float:
        """Distance from one slot to the next along the road, m."""
        return self.length if self.angle == 0.0 else self.width / float(np.sin(self.angle))


ARRANGEMENTS = {
    "parallel": Arrangement(0.0, *KERB_SIZE),
    "diagonal": Arrangement(np.pi / 3, *BAY_SIZE),
    "perpendicular": Arrangement(np.pi / 2, *BAY_SIZE),
}
"""Arrangement for each value of OpenStreetMap's `orientation`; diagonal cars park at 60°."""
DRAWN = 0.05  # tolerance, m, of the length of a row: OpenStreetMap's seven digits round to a centimetre


@dataclass(frozen=True, eq=False)
class RowAnchors:
    """Anchors of a row's slots: n points on the road's centre line."""

    xy: FloatArray  # (n, 2) m
    along: FloatArray  # (n, 2) unit vectors in the order of the road's points
    outward: FloatArray  # (n, 2) unit vectors toward the slots


def row_anchors(points: FloatArray, stations: FloatArray, pitch: float, side: Side) -> RowAnchors:
    """Return anchors on a road, (k, 2) m, at stations, (n,) m from its start; a slot takes `pitch` m of the road."""
    run = np.r_[0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T))]
    ends = [
        np.stack([np.interp(stations + half, run, points[:, i]) for i in (0, 1)], axis=1)
        for half in (-pitch / 2, pitch / 2)
    ]
    chord = ends[1] - ends[0]
    along = chord / np.hypot(chord[:, 0], chord[:, 1])[:, None]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return RowAnchors((ends[0] + ends[1]) / 2, along, left if side == "left" else -left)


def row_at(anchors: RowAnchors, offset: FloatArray | float, how: Arrangement, *, with_points: bool) -> Slots:
    """Create the slots of a row.

    Args:
        anchors: anchors of the row on its road.
        offset: distance from the centre line to the near edge of the slots, m, (n,) or scalar.
        how: arrangement of the parked cars.
        with_points: whether cars pass the row in the order of the road's points.
    """
    heading = anchors.along if with_points else -anchors.along
    outward = anchors.outward
    reach = np.broadcast_to(np.asarray(offset, dtype=np.float64), len(outward))[:, None]
    nose = np.cos(how.angle) * heading + np.sin(how.angle) * outward
    if how.angle == 0.0:
        center = anchors.xy + (reach + how.width / 2) * outward
        on_right = heading[:, 1] * outward[:, 0] - heading[:, 0] * outward[:, 1] > 0.0
        mouth = np.where(on_right, Mouth.LEFT, Mouth.RIGHT)
    else:
        # The near corner of an angled slot touches the edge, so the middle of its mouth is behind it.
        center = anchors.xy + (reach + how.width / 2 * np.cos(how.angle)) * outward + how.length / 2 * nose
        mouth = np.full(len(outward), int(Mouth.REAR))
    return Slots(
        xy=center,
        yaw=np.arctan2(nose[:, 1], nose[:, 0]),
        length=np.full(len(outward), how.length),
        width=np.full(len(outward), how.width),
        mouth=mouth.astype(np.int8),
    )


def bend_factor(points: FloatArray, start: float, end: float, side: Side, reach: float) -> float:
    """Return the length ratio of a part of a road to its parallel `reach` m to a side; at least 1.

    On the inside of a bend, slots need more room along the road by this factor.
    """
    n = max(int((end - start) / 2.0), 2)
    step = (end - start) / n
    stations = np.asarray(start + (np.arange(n) + 0.5) * step, dtype=np.float64)
    anchors = row_anchors(points, stations, step, side)
    beside = np.diff(anchors.xy + reach * anchors.outward, axis=0)
    length = float(np.hypot(beside[:, 0], beside[:, 1]).sum())
    return max(1.0, (end - start) * (n - 1) / n / max(length, 0.1))


def without_overlaps(boxes: NDArray[np.object_]) -> NDArray[np.bool_]:
    """Return the mask, (n,), of rectangles to keep so that none overlap; earlier ones take precedence."""
    kept = np.ones(len(boxes), dtype=bool)
    if len(boxes) < 2:
        return kept
    later, earlier = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    order = np.lexsort((earlier, later))
    for i, j in zip(later[order].tolist(), earlier[order].tolist(), strict=True):
        if j < i and kept[j]:
            kept[i] = False
    return kept
