"""Parking spaces as rectangles, from outlines or from centres, and their rows.

A row is a chain of spaces side by side, or end to end along a kerb. From centres alone:

1. A space's row runs toward its nearest neighbour. Neighbours at about that distance whose rows have the same direction
   form one row; single spaces and pairs join a row in line with them.
2. With a yaw, the angle between cars and row determines the arrangement. Without, rows with a space every 3.7 m or less
   are perpendicular parking, with one every 4.8 m or more parallel parking.
3. A space is as wide, along a kerb as long, as the row's spacing allows; its other side has the default size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError, require
from parkenv.lots.generators import BAY_SIZE, KERB_SIZE
from parkenv.world.drive_graph import component_labels
from parkenv.world.lot import corner_points

LEAST_AREA, GREATEST_AREA = 4.0, 250.0  # areas, m², outside which an outline is a mistake of drawing
DRAWN_TWICE = 0.5  # fraction of a space's area from which an overlap means that it was drawn twice
STRAIGHTENED = 0.2  # tolerance, m, for further corners on the sides of an outline


@dataclass(frozen=True, eq=False)
class Spaces:
    """The rectangles of n parking spaces, m in the lot's frame.

    `opens` are unit vectors to known open sides, shorter ones preferences, zeros nothing.
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
    return without_overlaps(spaces)


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


def without_overlaps(spaces: Spaces) -> Spaces:
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


SPACING = (1.8, 8.0)  # least and greatest distance, m, from a space to the next in its row
# Largest distance of neighbours in a row, as a multiple of the nearest neighbour's distance.
SAME_SPACING = 1.3
SAME_WAY = np.radians(15.0)  # largest angle between a space's row and the direction to a neighbour in it
STRAIGHT = 0.6  # largest distance, m, of a space's centre from the line of a straight row
SHARPEST = np.radians(30.0)  # largest change of direction from space to space in a curved row
# Spacing, m, up to which a row without yaw is perpendicular, and from which it is parallel.
WIDEST_BAY, SHORTEST_KERB = 3.7, 4.8
WIDER = 1.25  # from this multiple of the row's spacing on, a space is wider than the others of its row
ALONG = np.radians(20.0)  # largest angle between a row and cars that park along it
SAME_ANGLE = 0.95  # least length of the mean direction, as an axis, of the cars in a row
GAP_IN_ROW = 4.5  # largest distance, in spacings, at which single spaces and pairs join a row
MOST_STRAYS = 0.1  # largest allowed fraction of spaces in no row


@dataclass(frozen=True, eq=False)
class CenterRow:
    """Centres in a straight or gently curved line."""

    members: IntArray  # (k,) indices, in order along the row
    along: FloatArray  # (k, 2) unit vectors, direction of the row at each centre
    gaps: FloatArray  # (k - 1,) m, distances from space to space

    @property
    def spacing(self) -> float:
        return float(np.median(self.gaps))

    def extent(self, most: float) -> FloatArray:
        """Extent of each space along the row, (k,) m: the row's spacing or, of wider spaces up to `most`, their own."""
        near = np.minimum(np.r_[np.inf, self.gaps], np.r_[self.gaps, np.inf])
        return np.where((near > WIDER * self.spacing) & (near <= most), near, self.spacing)


def spaces_from_centers(
    ids: Sequence[str], xy: FloatArray, yaw: FloatArray | None
) -> tuple[Spaces, IntArray]:
    """Return rectangles of the centres, (n, 2) m, in rows, and their indices; `yaw`, (n,) rad, is of cars nose-in."""
    rows, strays = _find_rows(xy)
    if len(strays) > MOST_STRAYS * len(xy):
        shown = ", ".join(ids[i] for i in strays[:5])
        raise InputError(f"{len(strays)} of {len(xy)} slots are in no row ({shown})")
    if 2 * sum(len(row.members) for row in rows if len(row.members) > 2) < len(xy):
        raise InputError("most slots are single or in pairs, want rows of at least 3")
    n = len(xy)
    axis, opens, length, width = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n), np.zeros(n)
    for row in rows:
        index = row.members
        left = np.stack([-row.along[:, 1], row.along[:, 0]], axis=1)
        angle = _angle(row, None if yaw is None else yaw[index], ids)
        nose = None if yaw is None else np.stack([np.cos(yaw[index]), np.sin(yaw[index])], axis=1)
        if angle == 0.0:
            axis[index], length[index], width[index] = row.along, row.extent(SPACING[1]), KERB_SIZE[1]
            if nose is not None:
                # Cars keep to the right, so the lane is on the left of a car that parks along it.
                axis[index], opens[index] = nose, 0.5 * np.stack([-nose[:, 1], nose[:, 0]], axis=1)
        else:
            axis[index] = left if nose is None else nose
            opens[index] = 0.0 if nose is None else -nose
            length[index], width[index] = BAY_SIZE[0], row.extent(WIDEST_BAY) * np.sin(angle)
    kept = np.setdiff1d(np.arange(n), strays)
    columns = (values[kept] for values in (xy, axis, length, width, opens))
    return without_overlaps(Spaces(tuple(ids[i] for i in kept.tolist()), *columns)), kept


def _find_rows(xy: FloatArray) -> tuple[list[CenterRow], IntArray]:
    require(len(xy) >= 4, f"{len(xy)} slots, want at least 4 to find rows")
    tree = cKDTree(xy)
    distance, nearest = map(np.asarray, tree.query(xy, k=2))
    spacing = distance[:, 1]
    usual = float(np.median(spacing))
    require(
        SPACING[0] <= usual <= SPACING[1],
        f"neighbours are {usual:.2f} m apart, want {SPACING[0]:g} to {SPACING[1]:g} m: are these metres?",
    )
    way = xy[nearest[:, 1]] - xy
    way /= np.hypot(way[:, 0], way[:, 1])[:, None]
    pairs = tree.query_pairs(SAME_SPACING * SPACING[1], output_type="ndarray").reshape(-1, 2)
    step = xy[pairs[:, 1]] - xy[pairs[:, 0]]
    reach = np.hypot(step[:, 0], step[:, 1])
    near = reach <= SAME_SPACING * np.minimum(spacing[pairs].max(axis=1), SPACING[1])
    for end in (0, 1):
        near &= np.abs((way[pairs[:, end]] * step).sum(axis=1)) >= np.cos(SAME_WAY) * reach
    part = component_labels(pairs[near], len(xy))
    groups = [np.flatnonzero(part == k) for k in range(part.max() + 1)]
    long = [_row(group, xy) for group in groups if len(group) > 2]
    joined: dict[int, list[int]] = {}
    pairs_alone, strays = [], []
    for group in (group for group in groups if len(group) <= 2):
        homes = [_row_in_line(xy[i], long, xy) for i in group.tolist()]
        if -1 not in homes:
            for i, k in zip(group.tolist(), homes, strict=True):
                joined.setdefault(k, []).append(i)
        elif len(group) == 1:
            strays += group.tolist()
        else:
            pairs_alone.append(_row(group, xy))
    for k, more in joined.items():
        long[k] = _row(np.sort(np.r_[long[k].members, more]), xy)
    return long + pairs_alone, np.array(strays, dtype=np.int64)


def _row(members: IntArray, xy: FloatArray) -> CenterRow:
    points = xy[members]
    middle = points.mean(axis=0)
    line = np.linalg.svd(points - middle)[2][0]
    # From the space listed first to the one listed last, so that a rotated list gives a rotated row.
    line = line if (points[-1] - points[0]) @ line >= 0.0 else -line
    order = np.argsort((points - middle) @ line)
    points, members = points[order], members[order]
    off = np.abs((points - middle) @ np.array([-line[1], line[0]])).max()
    steps = np.diff(points, axis=0)
    gaps = np.hypot(steps[:, 0], steps[:, 1])
    if off <= STRAIGHT:
        return CenterRow(members, np.tile(line, (len(points), 1)), gaps)
    if ((steps[1:] * steps[:-1]).sum(axis=1) < np.cos(SHARPEST) * gaps[1:] * gaps[:-1]).any():
        x, y = points[0].tolist()
        raise InputError(
            f"a row of {len(points)} slots from ({x:.1f}, {y:.1f}) m on bends by more than 30° at a slot"
        )
    along = np.gradient(points, axis=0)
    return CenterRow(members, along / np.hypot(along[:, 0], along[:, 1])[:, None], gaps)


def _row_in_line(point: FloatArray, rows: Sequence[CenterRow], xy: FloatArray) -> int:
    for k, row in enumerate(rows):
        away = point - xy[row.members]
        i = int(np.argmin(np.hypot(away[:, 0], away[:, 1])))
        (x, y), (u, v) = away[i].tolist(), row.along[i].tolist()
        if (
            abs(u * y - v * x) <= STRAIGHT
            and 0.7 * row.spacing < abs(u * x + v * y) <= GAP_IN_ROW * row.spacing
        ):
            return k
    return -1


def _angle(row: CenterRow, yaw: FloatArray | None, ids: Sequence[str]) -> float:
    """Return the angle between a row and its cars, rad: 0 along it, to π/2."""
    name = f"the row of slots {ids[row.members[0]]!r:.40} to {ids[row.members[-1]]!r:.40}"
    if yaw is None:
        require(
            not WIDEST_BAY < row.spacing < SHORTEST_KERB,
            f"{name} has a slot every {row.spacing:.2f} m, too wide for perpendicular and too short for "
            "parallel parking; give a yaw column",
        )
        return np.pi / 2 if row.spacing <= WIDEST_BAY else 0.0
    mean = np.exp(2j * (yaw - np.arctan2(row.along[:, 1], row.along[:, 0]))).mean()
    require(abs(mean) >= SAME_ANGLE, f"{name}: cars stand at different angles")
    angle = float(abs(np.angle(mean))) / 2
    return 0.0 if angle < ALONG else angle
