"""The rectangles of parking spaces that are known by their centres alone.

1. A space's row runs toward its nearest neighbour. Neighbours at about that distance whose rows have the same direction
   form one row; single spaces and pairs join a row in line with them.
2. With a yaw, the angle between cars and row determines the arrangement. Without, rows with a space every 3.7 m or less
   are perpendicular parking, with one every 4.8 m or more parallel parking.
3. A space is as wide, along a kerb as long, as the row's spacing allows; its other side has the default size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError
from parkenv.lots.generators import BAY_SIZE, KERB_SIZE
from parkenv.lots.infer.spaces import Spaces, without_overlaps
from parkenv.world.drive_graph import component_labels

SPACING = (1.8, 8.0)  # least and greatest distance, m, from a space to the next in its row
SAME_SPACING = 1.3
"""Largest distance of neighbours in a row, as a multiple of the nearest neighbour's distance."""
SAME_WAY = np.radians(15.0)  # largest angle between a space's row and the direction to a neighbour in it
STRAIGHT = 0.6  # largest distance, m, of a space's centre from the line of a straight row
SHARPEST = np.radians(30.0)  # largest change of direction from space to space in a curved row
WIDEST_BAY, SHORTEST_KERB = 3.7, 4.8
"""Spacing, m, up to which a row without yaw is perpendicular, and from which it is parallel."""
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
        """Typical distance from space to space, m."""
        return float(np.median(self.gaps))

    def extent(self, most: float) -> FloatArray:
        """Extent of each space along the row, (k,) m: the row's spacing or, of wider spaces up to `most`, their own."""
        near = np.minimum(np.r_[np.inf, self.gaps], np.r_[self.gaps, np.inf])
        return np.where((near > WIDER * self.spacing) & (near <= most), near, self.spacing)


def spaces_from_centers(
    ids: Sequence[str], xy: FloatArray, yaw: FloatArray | None
) -> tuple[Spaces, IntArray, list[CenterRow]]:
    """Return the rectangles of spaces, the index of each in the list, and the rows of centres.

    Centres in no row have no rectangle.

    Args:
        ids: n names.
        xy: (n, 2) m, centres.
        yaw: (n,) rad, heading of a car parked nose-in, or None.
    """
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
    spaces = Spaces(tuple(ids), xy, axis, length, width, opens).subset(kept)
    return without_overlaps(spaces), kept, rows


def describe_rows(rows: Sequence[CenterRow]) -> str:
    """Describe rows in a line: their number, lengths and spacing."""
    listed = ", ".join(str(len(row.members)) for row in rows[:12]) + (", ..." if len(rows) > 12 else "")
    spacing = [row.spacing for row in rows]
    return f"{len(rows)} rows of {listed} slots, a slot every {min(spacing):.2f} to {max(spacing):.2f} m"


def _find_rows(xy: FloatArray) -> tuple[list[CenterRow], IntArray]:
    """Return the rows of centres, (n, 2) m, and the indices of the centres in none."""
    if len(xy) < 4:
        raise InputError(f"{len(xy)} slots, want at least 4 to find rows")
    tree = cKDTree(xy)
    distance, nearest = map(np.asarray, tree.query(xy, k=2))
    spacing = distance[:, 1]
    usual = float(np.median(spacing))
    if not SPACING[0] <= usual <= SPACING[1]:
        raise InputError(
            f"neighbours are {usual:.2f} m apart, want {SPACING[0]:g} to {SPACING[1]:g} m: are these metres?"
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
    """Return the row that a point continues across a gap; -1 for none."""
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
        if WIDEST_BAY < row.spacing < SHORTEST_KERB:
            raise InputError(
                f"{name} has a slot every {row.spacing:.2f} m, too wide for perpendicular and too short for "
                "parallel parking; give a yaw column"
            )
        return np.pi / 2 if row.spacing <= WIDEST_BAY else 0.0
    mean = np.exp(2j * (yaw - np.arctan2(row.along[:, 1], row.along[:, 0]))).mean()
    if abs(mean) < SAME_ANGLE:
        raise InputError(f"{name}: cars stand at different angles")
    angle = float(abs(np.angle(mean))) / 2
    return 0.0 if angle < ALONG else angle
