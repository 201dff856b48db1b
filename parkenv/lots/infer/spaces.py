"""Parking spaces as rectangles, from outlines, and their rows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError
from parkenv.world.drive_graph import component_labels
from parkenv.world.lot import corner_points

LEAST_AREA, GREATEST_AREA = 4.0, 250.0  # areas, m², outside which an outline is a mistake of drawing
DRAWN_TWICE = 0.5  # fraction of a space's area from which an overlap means that it was drawn twice
STRAIGHTENED = 0.2  # tolerance, m, for further corners on the sides of an outline


@dataclass(frozen=True, eq=False)
class Spaces:
    """The rectangles of n parking spaces, m in the lot's frame."""

    ids: tuple[str, ...]
    xy: FloatArray  # (n, 2) centres
    axis: FloatArray  # (n, 2) unit vectors
    length: FloatArray  # (n,) along the axis
    width: FloatArray  # (n,) across it

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def across(self) -> FloatArray:
        return np.stack([-self.axis[:, 1], self.axis[:, 0]], axis=1)

    def boxes(self, shrink: float = 0.0) -> NDArray[np.object_]:
        """Return the rectangles, (n,) polygons, each side shorter by `shrink` m."""
        yaw = np.arctan2(self.axis[:, 1], self.axis[:, 0])
        corners = corner_points(self.xy, yaw, self.length - shrink, self.width - shrink)
        return np.atleast_1d(np.asarray(shapely.polygons(corners)))


def spaces_from_outlines(ids: Sequence[str], outlines: NDArray[np.object_]) -> Spaces:
    """Return the spaces of outlines, (n,) valid polygons, m: rectangles of their area, narrowed until none overlap."""
    area = shapely.area(outlines)
    validate_areas(ids, area)
    corners = np.stack([rectangle_corners(outline) for outline in outlines])
    sides = np.roll(corners, -1, axis=1) - corners
    size = np.hypot(sides[..., 0], sides[..., 1])[:, :2]
    row, along = np.arange(len(outlines)), np.argmax(size, axis=1)
    length, across = size[row, along], size[row, 1 - along]
    axis = sides[row, along] / length[:, None]
    width = np.minimum(across, area / length)
    spaces = Spaces(tuple(ids), corners.mean(axis=1), axis, length, width)
    _refuse_drawn_twice(ids, outlines, area)
    return _without_overlaps(spaces)


def validate_areas(ids: Sequence[str], area: FloatArray) -> None:
    for i in np.flatnonzero((area < LEAST_AREA) | (area > GREATEST_AREA)).tolist():
        raise InputError(
            f"{ids[i]}: a parking space of {area[i]:.1f} m², want {LEAST_AREA:g} to {GREATEST_AREA:g} m²"
        )


def rectangle_corners(outline: shapely.Geometry) -> FloatArray:
    simple = shapely.simplify(outline, STRAIGHTENED)
    if len(shapely.get_coordinates(simple)) != 5 or shapely.area(simple) < 0.9 * shapely.area(outline):
        simple = shapely.minimum_rotated_rectangle(outline)
    return shapely.get_coordinates(to_rectangle(simple))[:4]


def to_rectangle(polygon: shapely.Geometry) -> shapely.Geometry:
    """Turn a parallelogram into the rectangle along its longer sides of the same area; others stay unchanged."""
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


def _without_overlaps(spaces: Spaces) -> Spaces:
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


TOUCHING = 0.7  # widest gap, m, between neighbours in a row
SAME_AXIS = np.cos(np.radians(25.0))  # least |cosine| of the angle between the axes of neighbours
STEP = 0.62  # largest offset of neighbours along their axes, as a fraction of their length: 45° rows have 0.5
# Least ratio of length to width of spaces end to end along a kerb; of just two of them, least length, m, and ratio.
SLIM, KERB_LENGTH, KERB_SHAPE = 1.6, 4.9, 1.9
SQUARE = np.radians(12.0)  # largest deviation from a right angle of a perpendicular row
RIGHT = np.pi / 2


@dataclass(frozen=True, eq=False)
class Row:
    """Spaces in a chain, in order; they may open to `out` (side 0) or against it (side 1)."""

    members: IntArray  # (k,) indices of spaces
    kerbside: bool  # whether cars park along the row
    along: FloatArray  # (k, 2) unit vectors, direction of the row at each space
    out: FloatArray  # (k, 2) unit vectors from the centres to the mouths of side 0
    half: FloatArray  # (k,) m, from the centres to the mouths
    pitch: FloatArray  # (k,) m, extent of each space along the row

    def __len__(self) -> int:
        return len(self.members)

    def part(self, index: IntArray) -> Self:
        columns = {name: getattr(self, name)[index] for name in ("members", "along", "out", "half", "pitch")}
        return replace(self, **columns)

    def normal(self, side: int) -> FloatArray:
        """Unit vectors, (k, 2), across the row toward a side."""
        left = np.stack([-self.along[:, 1], self.along[:, 0]], axis=1)
        return np.asarray(left * (np.sign((left * self.out).sum(axis=1)) * (1.0 - 2.0 * side))[:, None])

    def outward(self, side: int) -> FloatArray:
        """Unit vectors, (k, 2), from the centres to the mouths of a side."""
        return self.out * (1.0 - 2.0 * side)

    def mouths(self, spaces: Spaces, side: int) -> FloatArray:
        return spaces.xy[self.members] + self.half[:, None] * self.outward(side)

    @property
    def slant(self) -> float:
        """Mean angle between row and cars, rad, 0 (kerbside) to π/2."""
        if self.kerbside:
            return 0.0
        cosine = np.abs((self.along * self.out).sum(axis=1))
        return float(np.arccos(np.clip(np.median(cosine), 0.0, 1.0)))


def find_rows(spaces: Spaces) -> list[Row]:
    boxes = spaces.boxes()
    one, other = shapely.STRtree(boxes).query(boxes, predicate="dwithin", distance=TOUCHING)
    pair = one != other
    one, other = one[pair], other[pair]
    away = spaces.xy[other] - spaces.xy[one]
    axis, across = spaces.axis[one], spaces.across[one]
    u, v = (away * axis).sum(axis=1), (away * across).sum(axis=1)
    parallel = np.abs((axis * spaces.axis[other]).sum(axis=1)) > SAME_AXIS
    width = (spaces.width[one] + spaces.width[other]) / 2
    length = (spaces.length[one] + spaces.length[other]) / 2
    beside = (
        parallel
        & (np.abs(v) > 0.55 * width)
        & (np.abs(v) < width + TOUCHING + 0.3)
        & (np.abs(u) < STEP * length)
    )
    links = _mutual(one[beside], other[beside], v[beside] > 0, np.abs(u[beside]) + np.abs(v[beside]))
    has_beside = np.zeros(len(spaces), dtype=bool)
    has_beside[links.ravel()] = True

    slim = (spaces.length > SLIM * spaces.width) & ~has_beside
    behind = parallel & (np.abs(v) < 0.5 * width) & (np.abs(u) < length + TOUCHING + 0.6)
    behind &= (np.abs(u) > 0.7 * length) & slim[one] & slim[other]
    kerb = _mutual(one[behind], other[behind], u[behind] > 0, np.abs(u[behind]) + np.abs(v[behind]))
    rows = [_chain(spaces, order, kerbside=False) for order in _chains(links, len(spaces), has_beside)]
    in_line = np.zeros(len(spaces), dtype=bool)
    in_line[kerb.ravel()] = True
    at_kerb = np.zeros(len(spaces), dtype=bool)
    long = (spaces.length > KERB_LENGTH) & (spaces.length > KERB_SHAPE * spaces.width)
    for order in _chains(kerb, len(spaces), in_line):
        # Two spaces end to end may also stand back to back.
        if len(order) > 2 or long[order].all():
            rows.append(_chain(spaces, order, kerbside=True))
            at_kerb[order] = True
    single = np.flatnonzero(~has_beside & ~at_kerb)
    return rows + [_chain(spaces, np.array([i]), kerbside=False) for i in single.tolist()]


def _mutual(one: IntArray, other: IntArray, positive: BoolArray, cost: FloatArray) -> IntArray:
    """Return pairs, (m, 2), of spaces that are each other's nearest neighbour on that side."""
    if not len(one):
        return np.empty((0, 2), dtype=np.int64)
    side = 2 * one + positive
    order = np.lexsort((cost, side))
    best = order[np.r_[True, np.diff(side[order]) > 0]]
    chosen = set(zip(one[best].tolist(), other[best].tolist(), strict=True))
    pairs = sorted({(i, j) for i, j in chosen if i < j and (j, i) in chosen})
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _chains(links: IntArray, n: int, used: BoolArray) -> list[IntArray]:
    """Return the spaces of each chain of links in order; a closed chain is cut at its first space."""
    label = component_labels(links, n)
    near: dict[int, list[int]] = {}
    for i, j in links.tolist():
        near.setdefault(i, []).append(j)
        near.setdefault(j, []).append(i)
    chains = []
    for part in np.unique(label[used]).tolist():
        members = np.flatnonzero(label == part).tolist()
        ends = [i for i in members if len(near[i]) == 1]
        order: list[int] = []
        at, before = (ends or members)[0], -1
        while at >= 0 and (not order or at != order[0]):
            order.append(at)
            before, at = at, next((j for j in near[at] if j not in (before, *order[-2:])), -1)
        chains.append(np.array(order))
    return chains


def _chain(spaces: Spaces, order: IntArray, *, kerbside: bool) -> Row:
    xy = spaces.xy[order]
    axis, across = spaces.axis[order], spaces.across[order]
    to_mouth = across if kerbside else axis
    if len(order) == 1:
        along = axis if kerbside else across
    else:
        step = np.gradient(xy, axis=0)
        # Every axis points the way of its predecessor.
        turns = np.sign((axis[1:] * axis[:-1]).sum(axis=1))
        axis = axis * np.cumprod(np.r_[1.0, np.where(turns == 0.0, 1.0, turns)])[:, None]
        if kerbside:
            along = axis * np.sign((axis * step).sum(axis=1))[:, None]
        else:
            # One angle between row and cars for the whole row, so that a step in it does not turn its front.
            bearings = (np.arctan2(vectors[:, 1], vectors[:, 0]) for vectors in (step, axis))
            turn = np.angle(np.exp(1j * np.subtract(*bearings)).sum())
            turn = np.round(turn / RIGHT) * RIGHT if abs(abs(turn) - np.pi / 2) < SQUARE else turn
            cos, sin = np.cos(turn), np.sin(turn)
            along = np.asarray(axis @ np.array([[cos, sin], [-sin, cos]]))
        across = np.stack([-axis[:, 1], axis[:, 0]], axis=1)
        to_mouth = across if kerbside else axis
    # Mouths of one side lie on the same side of the row.
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    out = to_mouth * np.where((left * to_mouth).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    length, width = spaces.length[order], spaces.width[order]
    slope = np.maximum(np.abs((left * out).sum(axis=1)), 0.3)
    return Row(
        members=order,
        kerbside=kerbside,
        along=along,
        out=out,
        half=(width if kerbside else length) / 2,
        pitch=length if kerbside else width / slope,
    )
