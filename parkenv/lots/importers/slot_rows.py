"""Find rows of slots from the slots' centres and, if known, their yaw."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError
from parkenv.lots.generators import BAY_SIZE, KERB_SIZE, Slots
from parkenv.world.lot import Mouth

SPACING = (1.8, 8.0)  # least and greatest distance, m, from a slot to the next in its row
SAME_SPACING = 1.3
"""Largest distance of neighbours in a row, as a multiple of the nearest neighbour's distance."""
SAME_WAY = np.radians(15.0)  # largest angle between a slot's row and the direction to a neighbour in it
STRAIGHT = 0.6  # largest distance, m, of a slot's centre from the line of its row
PARALLEL_ROWS = np.radians(10.0)
WIDEST_BAY, SHORTEST_KERB = 3.7, 4.8
"""Spacing, m, up to which a row without yaw is perpendicular, and from which it is parallel."""
GAP_IN_ROW = 4.5  # largest distance, in spacings, at which single slots and pairs join a row


class AmbiguousLayoutError(InputError):
    """Slot centres that allow several layouts of rows or aisles.

    Attributes:
        found: one line per finding.
        rows: (k, 2) m each, the slot centres of each row found, in order.
    """

    def __init__(self, message: str, rows: Sequence[Row], xy: FloatArray) -> None:
        self.found = tuple(describe_rows(rows))
        self.rows = tuple(xy[row.members] for row in rows)
        super().__init__(message)


@dataclass(frozen=True, eq=False)
class Row:
    """Slots in a straight line."""

    members: IntArray  # (k,) indices, in order along the row
    middle: FloatArray  # (2,) m
    along: FloatArray  # (2,) unit vector
    low: float  # position along the row of the outer edge of its first slot, m from its middle
    high: float  # the same for its last slot
    spacing: float  # distance from slot to slot, m
    angle: float = 0.0  # angle between row and cars, rad, 0 to π/2
    length: float = 0.0  # length of a slot, m
    width: float = 0.0  # width of a slot, m

    @property
    def left(self) -> FloatArray:
        """Unit vector to the left of the row."""
        return np.array([-self.along[1], self.along[0]])

    @property
    def depth(self) -> float:
        """Extent of the slots across the row, m."""
        return float(self.length * np.sin(self.angle) + self.width * np.cos(self.angle))


def describe_rows(rows: Sequence[Row]) -> Iterator[str]:
    """Describe the rows, one line per kind: number and length of the rows, spacing of the slots."""
    yield f"{len(rows)} rows of {', '.join(str(len(row.members)) for row in rows[:12])}" + (
        ", ..." if len(rows) > 12 else " slots"
    )
    if rows:
        spacing = sorted(row.spacing for row in rows)
        yield f"a slot every {spacing[0]:.2f} to {spacing[-1]:.2f} m"


def find_rows(xy: FloatArray, names: Sequence[str]) -> tuple[list[Row], list[int]]:
    """Return the rows, and the indices of the slots in no row.

    Args:
        xy: (n, 2) m, slot centres.
        names: n names for messages.

    Raises:
        AmbiguousLayoutError: too few slots, an implausible spacing, or a row that bends.
    """
    if len(xy) < 4:
        raise AmbiguousLayoutError(f"{len(xy)} slots, want at least 4 to find rows", [], xy)
    tree = cKDTree(xy)
    distance, nearest = map(np.asarray, tree.query(xy, k=2))
    spacing = distance[:, 1]
    usual = float(np.median(spacing))
    if not SPACING[0] <= usual <= SPACING[1]:
        raise AmbiguousLayoutError(
            f"neighbours are {usual:.2f} m apart, want {SPACING[0]:g} to {SPACING[1]:g} m: are these metres?",
            [],
            xy,
        )
    way = xy[nearest[:, 1]] - xy
    way /= np.hypot(way[:, 0], way[:, 1])[:, None]
    pairs = tree.query_pairs(SAME_SPACING * SPACING[1], output_type="ndarray").reshape(-1, 2)
    step = xy[pairs[:, 1]] - xy[pairs[:, 0]]
    reach = np.hypot(step[:, 0], step[:, 1])
    near = reach <= SAME_SPACING * spacing[pairs].max(axis=1)
    near &= reach <= SAME_SPACING * SPACING[1]
    for end in (0, 1):
        across = way[pairs[:, end]]
        near &= np.abs((across * step).sum(axis=1)) >= np.cos(SAME_WAY) * reach
    links = pairs[near]
    graph = coo_array((np.ones(len(links), dtype=bool), tuple(links.T)), shape=(len(xy), len(xy)))
    _, part = connected_components(graph, directed=False)
    rows: list[Row] = []
    strays: list[int] = []
    for k in range(part.max() + 1):
        members = np.flatnonzero(part == k)
        if len(members) == 1:
            strays.append(int(members[0]))
            continue
        row, bend = _fitted_row(members, xy)
        if bend > STRAIGHT:
            raise AmbiguousLayoutError(
                f"the row of slots {names[row.members[0]]!r:.40} to {names[row.members[-1]]!r:.40} bends by "
                f"{bend:.1f} m, want straight rows",
                [*rows, row],
                xy,
            )
        rows.append(row)
    return _attach_strays(rows, strays, xy)


def _attach_strays(rows: Sequence[Row], strays: Sequence[int], xy: FloatArray) -> tuple[list[Row], list[int]]:
    """Attach single slots and pairs to a longer row in line with them, across a gap."""
    long = [row for row in rows if len(row.members) > 2]
    joined: dict[int, list[int]] = {}
    left: list[int] = []
    pairs: list[Row] = []
    for group in [row.members.tolist() for row in rows if len(row.members) <= 2] + [[i] for i in strays]:
        homes = [_row_in_line(xy[i], long, xy) for i in group]
        if None not in homes:
            for i, k in zip(group, homes, strict=True):
                joined.setdefault(k or 0, []).append(i)
        elif len(group) == 1:
            left += group
        else:
            pairs += [row for row in rows if row.members[0] == group[0]]
    for k, more in joined.items():
        row = long[k]
        fitted, _ = _fitted_row(np.sort(np.r_[row.members, more]), xy)
        sign = 1.0 if row.along @ fitted.along > 0.0 else -1.0
        half = row.spacing / 2
        station = sign * (xy[fitted.members] - fitted.middle) @ fitted.along
        long[k] = replace(
            fitted,
            spacing=row.spacing,
            low=float(station.min()) - half,
            high=float(station.max()) + half,
            along=fitted.along * sign,
            members=fitted.members if sign > 0.0 else fitted.members[::-1],
        )
    return long + pairs, left


def _row_in_line(point: FloatArray, rows: Sequence[Row], xy: FloatArray) -> int | None:
    for k, row in enumerate(rows):
        away = point - row.middle
        station = float(away @ row.along)
        gap = float(np.abs((xy[row.members] - row.middle) @ row.along - station).min())
        if abs(float(away @ row.left)) <= STRAIGHT and 0.7 * row.spacing < gap <= GAP_IN_ROW * row.spacing:
            return k
    return None


def _fitted_row(members: IntArray, xy: FloatArray) -> tuple[Row, float]:
    points = xy[members]
    middle = points.mean(axis=0)
    along = np.linalg.svd(points - middle)[2][0]
    # From the slot listed first to the one listed last, so that a rotated list gives a rotated row.
    if (points[-1] - points[0]) @ along < 0.0:
        along = -along
    station = (points - middle) @ along
    bend = float(np.abs((points - middle) @ np.array([-along[1], along[0]])).max())
    order = np.argsort(station)
    spacing = float(np.median(np.diff(station[order])))
    low, high = float(station.min()) - spacing / 2, float(station.max()) + spacing / 2
    return Row(members[order], middle, along, low, high, spacing), bend


def with_arrangement(
    row: Row, rows: Sequence[Row], xy: FloatArray, yaw: FloatArray | None, names: Sequence[str]
) -> Row:
    """Complete a row with the angle and size of its slots.

    Raises:
        AmbiguousLayoutError: the spacing fits no arrangement, or cars are parked at different angles.
    """
    first, last = names[row.members[0]], names[row.members[-1]]
    who = f"the row of slots {first!r:.40} to {last!r:.40}"
    if yaw is None:
        if WIDEST_BAY < row.spacing < SHORTEST_KERB:
            raise AmbiguousLayoutError(
                f"{who} has a slot every {row.spacing:.2f} m, too wide for perpendicular and too short for "
                "parallel parking; give a yaw column",
                rows,
                xy,
            )
        angle = np.pi / 2 if row.spacing <= WIDEST_BAY else 0.0
    else:
        turn = yaw[row.members] - np.arctan2(row.along[1], row.along[0])
        axis = np.exp(2j * turn).mean()
        if abs(axis) < 0.95:
            raise AmbiguousLayoutError(f"{who}: cars stand at different angles", rows, xy)
        folded = abs(np.angle(axis)) / 2
        angle = 0.0 if folded < np.radians(20.0) else float(folded)
    if angle == 0.0:
        return replace(row, angle=0.0, length=min(row.spacing, KERB_SIZE[0]), width=KERB_SIZE[1])
    return replace(row, angle=float(angle), length=BAY_SIZE[0], width=row.spacing * float(np.sin(angle)))


def row_slots(row: Row, side: int, xy: FloatArray, yaw: FloatArray | None) -> Slots:
    """Create the slots of a row.

    Args:
        row: a row with angle and size.
        side: side to which the row opens, 1 left, -1 right.
        xy: (n, 2) m, centres of all slots.
        yaw: (n,) rad, heading of a car parked nose-in, or None.
    """
    n = len(row.members)
    opens = side * row.left
    if row.angle == 0.0:
        if yaw is None:
            # Cars park on the right of a two-way aisle, so the aisle is on their left.
            heading = np.tile([opens[1], -opens[0]], (n, 1))
        else:
            heading = np.stack([np.cos(yaw[row.members]), np.sin(yaw[row.members])], axis=1)
        on_left = heading[:, 0] * opens[1] - heading[:, 1] * opens[0] > 0.0
        mouth = np.where(on_left, Mouth.LEFT, Mouth.RIGHT)
    else:
        heading = np.tile(-opens, (n, 1))
        if yaw is not None:
            heading = np.stack([np.cos(yaw[row.members]), np.sin(yaw[row.members])], axis=1)
        mouth = np.full(n, int(Mouth.REAR))
    return Slots(
        xy=xy[row.members],
        yaw=np.arctan2(heading[:, 1], heading[:, 0]),
        length=np.full(n, row.length),
        width=np.full(n, row.width),
        mouth=mouth.astype(np.int8),
    )
