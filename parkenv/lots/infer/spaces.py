"""Parking spaces as rectangles: size, position and axis of mapped outlines, and outlines that are refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError
from parkenv.world.lot import corner_points

LEAST_AREA, GREATEST_AREA = 4.0, 250.0
"""Areas, m², outside which an outline is a mistake of drawing."""
DRAWN_TWICE = 0.5
"""Fraction of a space's area from which an overlap means that it was drawn twice."""
STRAIGHTENED = 0.2  # tolerance, m, for further corners on the sides of an outline


@dataclass(frozen=True, eq=False)
class Spaces:
    """The rectangles of n parking spaces, m in the lot's frame.

    `axis` points along the longer side; its sign means nothing. `opens` points to the open side where that is known:
    unit vectors decide it, shorter ones are a preference, zeros say nothing.
    """

    ids: tuple[str, ...]
    xy: FloatArray  # (n, 2) centres
    axis: FloatArray  # (n, 2) unit vectors
    length: FloatArray  # (n,) along the axis
    width: FloatArray  # (n,) across it
    opens: FloatArray | None = None  # (n, 2), or None if no open side is known

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def across(self) -> FloatArray:
        """Unit vectors to the left of the axes, (n, 2)."""
        return np.stack([-self.axis[:, 1], self.axis[:, 0]], axis=1)

    def boxes(self, shrink: float = 0.0) -> NDArray[np.object_]:
        """Return the rectangles, (n,) polygons, each side shorter by `shrink` m."""
        yaw = np.arctan2(self.axis[:, 1], self.axis[:, 0])
        corners = corner_points(self.xy, yaw, self.length - shrink, self.width - shrink)
        return np.atleast_1d(np.asarray(shapely.polygons(corners)))

    def subset(self, index: IntArray) -> Spaces:
        """Return some of the spaces."""
        return Spaces(
            tuple(self.ids[i] for i in index.tolist()),
            self.xy[index],
            self.axis[index],
            self.length[index],
            self.width[index],
            None if self.opens is None else self.opens[index],
        )


def spaces_from_outlines(ids: Sequence[str], outlines: NDArray[np.object_]) -> Spaces:
    """Return the spaces of outlines, (n,) valid polygons, m.

    A parallelogram becomes the rectangle along its longer sides, any other outline the smallest rectangle around it,
    narrowed to the outline's area. Rectangles that overlap a little are narrowed until they do not.
    """
    area = shapely.area(outlines)
    validate_areas(ids, area)
    corners = np.stack([rectangle_corners(outline) for outline in outlines])
    sides = np.roll(corners, -1, axis=1) - corners
    size = np.hypot(sides[..., 0], sides[..., 1])
    turn = size[:, 0] < size[:, 1]
    long = np.where(turn[:, None], sides[:, 1], sides[:, 0])
    length = np.where(turn, size[:, 1], size[:, 0])
    spaces = Spaces(
        tuple(ids),
        corners.mean(axis=1),
        long / length[:, None],
        length,
        np.minimum(np.where(turn, size[:, 0], size[:, 1]), area / length),
    )
    _refuse_drawn_twice(ids, outlines, area)
    return without_overlaps(spaces)


def validate_areas(ids: Sequence[str], area: FloatArray) -> None:
    """Raise an error for areas, (n,) m², outside the range of parking spaces."""
    for i in np.flatnonzero((area < LEAST_AREA) | (area > GREATEST_AREA)).tolist():
        raise InputError(
            f"{ids[i]}: a parking space of {area[i]:.1f} m², want {LEAST_AREA:g} to {GREATEST_AREA:g} m²"
        )


def rectangle_corners(outline: shapely.Geometry) -> FloatArray:
    """Return the corners, (4, 2) m, of the rectangle of an outline."""
    simple = shapely.simplify(outline, STRAIGHTENED)
    if len(shapely.get_coordinates(simple)) != 5 or shapely.area(simple) < 0.9 * shapely.area(outline):
        simple = shapely.minimum_rotated_rectangle(outline)
    return shapely.get_coordinates(to_rectangle(simple))[:4]


def to_rectangle(polygon: shapely.Geometry) -> shapely.Geometry:
    """Turn a parallelogram into the rectangle along its longer sides with the same centre and area.

    Polygons without exactly four corners are returned unchanged.
    """
    corners = shapely.get_coordinates(polygon)
    if len(corners) != 5:
        return polygon
    sides = np.diff(corners, axis=0)
    length = np.hypot(sides[:, 0], sides[:, 1])
    first = int(length[1] + length[3] > length[0] + length[2])
    along = sides[first] - sides[first + 2]
    size = (length[first] + length[first + 2]) / 2
    along = along / np.hypot(*along) * size / 2
    across = np.array([-along[1], along[0]]) * float(shapely.area(polygon)) / (4 * (along @ along))
    middle = shapely.get_coordinates(shapely.centroid(polygon))[0]
    return shapely.Polygon([middle + a * along + b * across for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])


def _refuse_drawn_twice(ids: Sequence[str], outlines: NDArray[np.object_], area: FloatArray) -> None:
    one, other = shapely.STRtree(outlines).query(outlines, predicate="intersects")
    pair = one < other
    one, other = one[pair], other[pair]
    shared = shapely.area(shapely.intersection(outlines[one], outlines[other]))
    share = shared / np.minimum(area[one], area[other])
    for k in np.flatnonzero(share > DRAWN_TWICE).tolist():
        raise InputError(
            f"{ids[other[k]]}: lies on {ids[one[k]]}, {100 * share[k]:.0f} % of it; want spaces beside each other"
        )


def without_overlaps(spaces: Spaces) -> Spaces:
    """Narrow and shorten spaces that overlap others, by a few per cent at a time."""
    length, width = spaces.length.copy(), spaces.width.copy()
    for _ in range(6):
        boxes = replace(spaces, length=length, width=width).boxes(shrink=0.08)
        one, other = shapely.STRtree(boxes).query(boxes, predicate="intersects")
        hit = np.unique(one[one != other])
        if not len(hit):
            break
        width[hit] *= 0.97
        length[hit] *= 0.98
    return replace(spaces, length=length, width=width)
