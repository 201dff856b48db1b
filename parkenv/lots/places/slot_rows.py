"""Rows of slots and the aisles between them, found from the slots' centres.

1. A slot's row runs toward its nearest neighbour. Neighbours at about that distance whose rows run the same
   way stand in one row, which must be straight. Slots alone or in pairs join a row in line with them.
2. With a yaw, the angle between cars and row tells how they stand. Without, rows with a slot every 3.7 m or
   less are taken for perpendicular ones, every 4.8 m or more for parallel ones.
3. Two parallel rows with 2.8 to 10 m between them face each other across an aisle; closer ones stand back to
   back. A row opens to the side on which it faces one, or, where none is faced, to the side at which no
   other stands. A yaw tells the side of cars that do not stand along the aisle; of those that do, the left
   counts where no row is faced.
4. Aisles run midway between the rows that open to them (3 m before a row that faces none), and go on
   across gaps of up to 15 m. Roads join them at their ends, and through gaps in the rows, where no slot
   stands in the way. All are two-way.

Where any step could go either way, `lay_out` refuses and says what it saw.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from parkenv.errors import InputError
from parkenv.lots.generators import BAY_SIZE, KERB_SIZE, TWO_WAY_HALF_WIDTH, Slots
from parkenv.world.lot import Lane, Mouth, corner_points, mouth_points

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SPACING = (1.8, 8.0)
"""Least and greatest distance, m, from a slot to the next in its row."""
SAME_SPACING = 1.3
"""Neighbours in a row are at most this many times as far apart as the nearest one."""
SAME_WAY = np.radians(15.0)
"""Greatest angle between a slot's row and the way to a neighbour in it."""
STRAIGHT = 0.6
"""Farthest, m, that a slot's centre lies from the line of its row."""
PARALLEL_ROWS = np.radians(10.0)
WIDEST_BAY, SHORTEST_KERB = 3.7, 4.8
"""Spacing, m, up to which a row without yaw is perpendicular, and from which it is parallel."""
AISLE = (2.8, 10.0)
"""Least and greatest width, m, of an aisle between two rows."""
OPEN_AISLE = TWO_WAY_HALF_WIDTH
"""From the mouths of a row that faces none to the middle of its aisle, and from an aisle's last slot to its end, m."""
ACROSS_GAP = 15.0
"""Widest gap, m, in the rows that an aisle goes on across."""
GATE = 4.5
"""Least width, m, of a gap in a row through which a road may lead."""
SAME_AISLE = 1.5
"""Farthest, m, that the lines of two pieces of one aisle lie apart."""
SAME_STOP = 1.5
"""Roads that meet an aisle closer to each other than this, m, meet it at one place."""
ROAD_HALF_WIDTH = 1.25
LONGEST_LINK = 60.0
"""Longest road, m, between two aisles."""
GAP_IN_ROW = 4.5
"""Slots alone or in pairs belong to a row whose next slot is at most this many spacings away."""
MOST_STRAYS = 0.1
"""Greatest share of slots that may stand in no row."""


class UnsureError(InputError):
    """Slots of which the rows or aisles could be read in several ways.

    Attributes:
        saw: what was found, a line each.
        rows: (k, 2) m each, the centres in each row found, in order.
    """

    def __init__(self, message: str, rows: Sequence[Row], xy: FloatArray) -> None:
        self.saw = tuple(_saw(rows))
        self.rows = tuple(xy[row.members] for row in rows)
        super().__init__(message)


@dataclass(frozen=True, eq=False)
class Row:
    """Slots in a straight line.

    Args:
        members: (k,) indices, in order along the row.
        middle: (2,) m.
        along: (2,) unit vector.
        low: m along the row from its middle to the outer edge of its first slot.
        high: the same of its last slot.
        spacing: m from slot to slot.
        angle: rad, between row and cars, 0 to π/2.
        length: of a slot, m.
        width: of a slot, m.
    """

    members: IntArray
    middle: FloatArray
    along: FloatArray
    low: float
    high: float
    spacing: float
    angle: float = 0.0
    length: float = 0.0
    width: float = 0.0

    @property
    def left(self) -> FloatArray:
        """Unit vector to the left of the row."""
        return np.array([-self.along[1], self.along[0]])

    @property
    def depth(self) -> float:
        """How much room the slots take across the row, m."""
        return float(self.length * np.sin(self.angle) + self.width * np.cos(self.angle))


@dataclass(frozen=True, eq=False)
class Layout:
    """A lot's ground plan: `index` are the slots' numbers in the list, `strays` those that stand in no row."""

    index: tuple[int, ...]
    slots: Slots
    lanes: tuple[Lane, ...]
    strays: tuple[int, ...]
    saw: tuple[str, ...]


def lay_out(xy: FloatArray, yaw: FloatArray | None, names: Sequence[str]) -> Layout:
    """Slots and lanes from slot centres.

    Args:
        xy: (n, 2) m.
        yaw: (n,) rad, heading of a car that stands nose-in, or None.
        names: n names for messages.

    Raises:
        UnsureError: the rows or aisles could be read in several ways.
    """
    rows, strays = _rows(xy, names)
    rows = [_with_arrangement(row, rows, xy, yaw, names) for row in rows]
    if len(strays) > MOST_STRAYS * len(xy):
        shown = ", ".join(names[i] for i in strays[:5])
        raise UnsureError(f"{len(strays)} of {len(xy)} slots stand in no row ({shown})", rows, xy)
    if 2 * sum(len(row.members) for row in rows if len(row.members) > 2) < len(xy):
        raise UnsureError("most slots stand alone or in pairs, want rows of at least 3", rows, xy)
    faced = _Facing(rows)
    sides = _open_sides(rows, faced, xy, yaw, names)
    slots = Slots.joined([_row_slots(row, side, xy, yaw) for row, side in zip(rows, sides, strict=True)])
    index = np.concatenate([row.members for row in rows])
    order = np.argsort(index)
    slots, index = slots[order], index[order]
    boxes = np.asarray(
        shapely.polygons(corner_points(slots.xy, slots.yaw, slots.length - 0.1, slots.width - 0.1))
    )
    mouth_xy = mouth_points(slots.xy, slots.yaw, slots.length, slots.width, slots.mouth)
    aisles = [_lengthened(aisle, mouth_xy) for aisle in _aisles(rows, sides, faced)]
    lanes = _lanes(aisles, rows, boxes, mouth_xy, xy)
    return Layout(
        index=tuple(index.tolist()),
        slots=slots,
        lanes=tuple(lanes),
        strays=tuple(strays),
        saw=(*_saw(rows), f"{len(lanes)} lanes, two-way"),
    )


def _saw(rows: Sequence[Row]) -> Iterable[str]:
    yield f"{len(rows)} rows of {', '.join(str(len(row.members)) for row in rows[:12])}" + (
        ", ..." if len(rows) > 12 else " slots"
    )
    if rows:
        spacing = sorted(row.spacing for row in rows)
        yield f"a slot every {spacing[0]:.2f} to {spacing[-1]:.2f} m"


# ---- rows ----


def _rows(xy: FloatArray, names: Sequence[str]) -> tuple[list[Row], list[int]]:
    if len(xy) < 4:
        raise UnsureError(f"{len(xy)} slots, want at least 4 to tell rows by", [], xy)
    tree = cKDTree(xy)
    distance, nearest = map(np.asarray, tree.query(xy, k=2))
    spacing = distance[:, 1]
    usual = float(np.median(spacing))
    if not SPACING[0] <= usual <= SPACING[1]:
        raise UnsureError(
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
            raise UnsureError(
                f"the row of slots {names[row.members[0]]!r:.40} to {names[row.members[-1]]!r:.40} bends by "
                f"{bend:.1f} m, want straight rows",
                [*rows, row],
                xy,
            )
        rows.append(row)
    return _gathered(rows, strays, xy)


def _gathered(rows: Sequence[Row], strays: Sequence[int], xy: FloatArray) -> tuple[list[Row], list[int]]:
    """Slots that stand alone or in pairs join the longer row in whose line they stand beyond a gap."""
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
    # From the slot listed first to the one listed last, so that a turned list gives a turned row.
    if (points[-1] - points[0]) @ along < 0.0:
        along = -along
    station = (points - middle) @ along
    bend = float(np.abs((points - middle) @ np.array([-along[1], along[0]])).max())
    order = np.argsort(station)
    spacing = float(np.median(np.diff(station[order])))
    low, high = float(station.min()) - spacing / 2, float(station.max()) + spacing / 2
    return Row(members[order], middle, along, low, high, spacing), bend


def _with_arrangement(
    row: Row, rows: Sequence[Row], xy: FloatArray, yaw: FloatArray | None, names: Sequence[str]
) -> Row:
    """The row with the angle and size of its slots."""
    first, last = names[row.members[0]], names[row.members[-1]]
    who = f"the row of slots {first!r:.40} to {last!r:.40}"
    if yaw is None:
        if WIDEST_BAY < row.spacing < SHORTEST_KERB:
            raise UnsureError(
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
            raise UnsureError(f"{who}: cars stand at different angles", rows, xy)
        folded = abs(np.angle(axis)) / 2
        angle = 0.0 if folded < np.radians(20.0) else float(folded)
    if angle == 0.0:
        return replace(row, angle=0.0, length=min(row.spacing, KERB_SIZE[0]), width=KERB_SIZE[1])
    return replace(row, angle=float(angle), length=BAY_SIZE[0], width=row.spacing * float(np.sin(angle)))


# ---- which way rows open ----


class _Facing:
    """For every row and side (1 left, -1 right) the nearest parallel row there, and the room between, m."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self._found: dict[tuple[int, int], tuple[int, float]] = {}
        for i, row in enumerate(rows):
            for j, other in enumerate(rows):
                if i == j or abs(row.along @ other.along) < np.cos(PARALLEL_ROWS):
                    continue
                away = other.middle - row.middle
                sign = 1 if row.along @ other.along > 0 else -1
                ends = np.sort(away @ row.along + sign * np.array([other.low, other.high]))
                overlap = min(row.high, ends[1]) - max(row.low, ends[0])
                if overlap < 0.3 * min(row.high - row.low, other.high - other.low):
                    continue
                lateral = float(away @ row.left)
                room = abs(lateral) - (row.depth + other.depth) / 2
                key = (i, 1 if lateral > 0 else -1)
                if abs(lateral) > STRAIGHT and room < self._found.get(key, (0, np.inf))[1]:
                    self._found[key] = (j, room)

    def row(self, i: int, side: int) -> int | None:
        """The row across an aisle, or None."""
        other, room = self._found.get((i, side), (None, np.inf))
        return other if AISLE[0] <= room <= AISLE[1] else None

    def is_blocked(self, i: int, side: int) -> bool:
        """Whether another row stands back to back there."""
        return self._found.get((i, side), (0, np.inf))[1] < AISLE[0]


def _opens_toward(rows: Sequence[Row], side: int | None, j: int, i: int) -> bool:
    """Whether row j, open to a side, has row i there."""
    return side is not None and float(side * rows[j].left @ (rows[i].middle - rows[j].middle)) > 0.0


def _open_sides(
    rows: Sequence[Row], faced: _Facing, xy: FloatArray, yaw: FloatArray | None, names: Sequence[str]
) -> list[int]:
    """The side to which each row opens: 1 left, -1 right."""
    sides: list[int | None] = [None] * len(rows)
    for i, row in enumerate(rows):
        who = f"the row of slots {names[row.members[0]]!r:.40} to {names[row.members[-1]]!r:.40}"
        if yaw is not None and row.angle > 0.0:
            nose = np.stack([np.cos(yaw[row.members]), np.sin(yaw[row.members])], axis=1) @ row.left
            if (nose > 0.0).any() and (nose < 0.0).any():
                raise UnsureError(f"{who}: cars stand nose-in on both sides", rows, xy)
            sides[i] = -1 if nose[0] > 0.0 else 1
            if faced.is_blocked(i, sides[i] or 1):
                raise UnsureError(f"{who}: its cars would drive in through the next row", rows, xy)
            continue
        free = [side for side in (1, -1) if not faced.is_blocked(i, side)]
        facing = [side for side in free if faced.row(i, side) is not None]
        if len(facing) == 1:
            sides[i] = facing[0]
        elif len(free) == 1:
            sides[i] = free[0]
        elif not free:
            raise UnsureError(f"{who} has another close by on either side, and no way in", rows, xy)
        elif not facing and yaw is None:
            raise UnsureError(
                f"{who} faces no other and could open to either side; give a yaw column", rows, xy
            )
        elif not facing:
            # Along the aisle cars stand as traffic runs, on the right: the aisle is on their left.
            heading = yaw[row.members[0]] if yaw is not None else 0.0
            sides[i] = 1 if np.array([np.cos(heading), np.sin(heading)]) @ row.along > 0.0 else -1
    for i, row in enumerate(rows):
        if sides[i] is not None:
            continue
        # Rows on both sides: it shares the aisle that one of them opens to, if the other turns its back.
        toward = [
            side
            for side in (1, -1)
            if (j := faced.row(i, side)) is not None and _opens_toward(rows, sides[j], j, i)
        ]
        if len(toward) != 1:
            raise UnsureError(
                f"the row of slots {names[row.members[0]]!r:.40} to {names[row.members[-1]]!r:.40} has room for an "
                "aisle on either side; give a yaw column",
                rows,
                xy,
            )
        sides[i] = toward[0]
    return [side or 1 for side in sides]


def _row_slots(row: Row, side: int, xy: FloatArray, yaw: FloatArray | None) -> Slots:
    n = len(row.members)
    opens = side * row.left
    if row.angle == 0.0:
        if yaw is None:
            # On the right of a two-way aisle, which is on the car's left.
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


# ---- aisles, and the roads that join them ----


@dataclass(frozen=True, eq=False)
class _Aisle:
    """A straight piece of aisle, from `start` to `end`, (2,) m."""

    start: FloatArray
    end: FloatArray

    @property
    def along(self) -> FloatArray:
        step = self.end - self.start
        return np.asarray(step / np.hypot(*step))


def _aisles(rows: Sequence[Row], sides: Sequence[int], faced: _Facing) -> list[_Aisle]:
    pieces: list[_Aisle] = []
    done: set[tuple[int, int]] = set()
    for i, (row, side) in enumerate(zip(rows, sides, strict=True)):
        if i in {k for pair in done for k in pair}:
            continue
        j = faced.row(i, side)
        offset = row.depth / 2 + OPEN_AISLE
        low, high = row.low, row.high
        if j is not None and _opens_toward(rows, sides[j], j, i):
            other = rows[j]
            away = other.middle - row.middle
            offset = (abs(float(away @ row.left)) + row.depth / 2 - other.depth / 2) / 2
            sign = 1 if row.along @ other.along > 0 else -1
            ends = away @ row.along + sign * np.array([other.low, other.high])
            low, high = min(low, *ends.tolist()), max(high, *ends.tolist())
            if faced.row(j, sides[j]) == i:
                done.add((i, j))
        line = row.middle + side * offset * row.left
        pieces.append(_Aisle(line + low * row.along, line + high * row.along))
    return _joined(pieces)


def _joined(pieces: Sequence[_Aisle]) -> list[_Aisle]:
    """Pieces in one line, with gaps that an aisle goes on across, made one."""
    left = list(pieces)
    while True:
        for a, one in enumerate(left):
            b = next((b for b in range(a + 1, len(left)) if _in_line(one, left[b])), None)
            if b is not None:
                break
        else:
            return left
        other = left.pop(b)
        along = one.along
        sign = 1.0 if along @ other.along > 0 else -1.0
        weight = [float(np.hypot(*(piece.end - piece.start))) for piece in (one, other)]
        along = along * weight[0] + sign * other.along * weight[1]
        along /= np.hypot(*along)
        ends = np.array([one.start, one.end, other.start, other.end])
        middle = np.average(ends, axis=0, weights=np.repeat(weight, 2))
        station = (ends - middle) @ along
        left[a] = _Aisle(middle + station.min() * along, middle + station.max() * along)


def _in_line(one: _Aisle, other: _Aisle) -> bool:
    along = one.along
    if abs(along @ other.along) < np.cos(PARALLEL_ROWS):
        return False
    left = np.array([-along[1], along[0]])
    ends = np.array([other.start, other.end]) - one.start
    if np.abs(ends @ left).min() > SAME_AISLE or abs(ends.mean(axis=0) @ left) > SAME_AISLE:
        return False
    station = np.sort(ends @ along)
    length = float(np.hypot(*(one.end - one.start)))
    return bool(max(station[0] - length, -station[1]) <= ACROSS_GAP)


def _lengthened(aisle: _Aisle, mouth_xy: FloatArray) -> _Aisle:
    """The aisle, gone on with beyond its last slots as far as it is wide, so that these open to it still."""
    line = shapely.LineString([aisle.start, aisle.end])
    beyond = max(OPEN_AISLE, float(shapely.distance(shapely.MultiPoint(mouth_xy), line))) * aisle.along
    return _Aisle(aisle.start - beyond, aisle.end + beyond)


def _lanes(
    aisles: Sequence[_Aisle],
    rows: Sequence[Row],
    boxes: NDArray[np.object_],
    mouth_xy: FloatArray,
    xy: FloatArray,
) -> list[Lane]:
    """The aisles and the roads that join them, all with common points."""
    tree = shapely.STRtree(boxes)
    for aisle in aisles:
        road = shapely.LineString([aisle.start, aisle.end]).buffer(ROAD_HALF_WIDTH, cap_style="flat")
        if len(tree.query(road, predicate="intersects")):
            (x, y), (x_1, y_1) = aisle.start.tolist(), aisle.end.tolist()
            raise UnsureError(
                f"an aisle from ({x:.1f}, {y:.1f}) to ({x_1:.1f}, {y_1:.1f}) m would run over slots", rows, xy
            )
    if len(aisles) == 1:
        return [Lane(np.stack([aisles[0].start, aisles[0].end]))]
    links = _links(aisles, rows, boxes, mouth_xy)
    part = np.arange(len(aisles))
    chosen: list[tuple[int, int, FloatArray, FloatArray]] = []
    # Roads square to the aisles all count; others only where nothing else joins two parts.
    for square in (True, False):
        for i, j, start, end, is_square in links:
            if is_square == square and (square or part[i] != part[j]):
                chosen.append((i, j, start, end))
                part[part == part[j]] = part[i]
    if len(set(part.tolist())) > 1:
        alone = int(np.bincount(part).argmax())
        count = int((part != alone).sum())
        raise UnsureError(
            f"{len(aisles)} aisles, of which {count} are joined to the others by no road", rows, xy
        )
    stops: list[list[FloatArray]] = [[aisle.start, aisle.end] for aisle in aisles]
    lanes = []
    for i, j, start, end in chosen:
        for k, xy_k in ((i, start), (j, end)):
            if all(np.hypot(*(xy_k - stop)) > SAME_STOP for stop in stops[k]):
                stops[k].append(xy_k)
        near = [
            min(stops[k], key=lambda stop, at=at: float(np.hypot(*(stop - at))))  # type: ignore[misc]
            for k, at in ((i, start), (j, end))
        ]
        lanes.append(np.stack(near))
    for aisle, points in zip(aisles, stops, strict=True):
        points.sort(key=lambda point, aisle=aisle: float((point - aisle.start) @ aisle.along))  # type: ignore[misc]
    return [Lane(np.stack(points)) for points in stops] + [Lane(line) for line in lanes]


def _links(
    aisles: Sequence[_Aisle], rows: Sequence[Row], boxes: NDArray[np.object_], mouth_xy: FloatArray
) -> list[tuple[int, int, FloatArray, FloatArray, bool]]:
    """Roads that could join two aisles: from, to, both ends, whether square to the second; shortest first."""
    lines = np.array([shapely.LineString([aisle.start, aisle.end]) for aisle in aisles])
    tree = shapely.STRtree(boxes)
    mouths = np.asarray(shapely.points(mouth_xy))
    to_aisle = np.min([shapely.distance(mouths, line) for line in lines], axis=0) - 1e-6
    candidates = []
    for i, aisle in enumerate(aisles):
        starts = [aisle.start, aisle.end, *_gates(aisle, rows)]
        for at in starts:
            for j, line in enumerate(lines):
                if i == j:
                    continue
                station = shapely.line_locate_point(line, shapely.Point(at))
                end = shapely.get_coordinates(shapely.line_interpolate_point(line, station))[0]
                length = float(np.hypot(*(end - at)))
                if 0.05 < length <= LONGEST_LINK:
                    across = abs(float((end - at) @ aisles[j].along)) / length
                    candidates.append((length, i, j, at, end, across < np.sin(2 * SAME_WAY)))
    candidates.sort(key=lambda c: c[:3])
    links: list[tuple[int, int, FloatArray, FloatArray, bool]] = []
    for _, i, j, at, end, square in candidates:
        road = shapely.LineString([at, end])
        if len(tree.query(road.buffer(ROAD_HALF_WIDTH, cap_style="flat"), predicate="intersects")):
            continue
        if any(k not in (i, j) and shapely.dwithin(road, line, GATE) for k, line in enumerate(lines)):
            continue  # by way of that aisle
        if (shapely.distance(mouths, road) < to_aisle).any():
            continue  # a slot would open to it
        same = any(
            {i, j} == {a, b}
            and min(
                float(np.hypot(*(at - p)) + np.hypot(*(end - q))),
                float(np.hypot(*(at - q)) + np.hypot(*(end - p))),
            )
            < 2 * GATE
            for a, b, p, q, _ in links
        )
        if not same:
            links.append((i, j, at, end, square))
    return links


def _gates(aisle: _Aisle, rows: Sequence[Row]) -> list[FloatArray]:
    """Points on an aisle beside gaps between two rows in one line."""
    points = []
    for a, row in enumerate(rows):
        for other in rows[a + 1 :]:
            away = other.middle - row.middle
            if abs(row.along @ other.along) < np.cos(PARALLEL_ROWS) or abs(away @ row.left) > STRAIGHT:
                continue
            if abs(row.along @ aisle.along) < np.cos(PARALLEL_ROWS):
                continue
            sign = 1 if row.along @ other.along > 0 else -1
            ends = np.sort(away @ row.along + sign * np.array([other.low, other.high]))
            gap = (row.high, ends[0]) if ends[0] > row.high else (ends[1], row.low)
            if GATE <= gap[1] - gap[0] <= ACROSS_GAP:
                middle = row.middle + (gap[0] + gap[1]) / 2 * row.along
                station = float((middle - aisle.start) @ aisle.along)
                if 0.0 < station < float(np.hypot(*(aisle.end - aisle.start))):
                    points.append(aisle.start + station * aisle.along)
    return points
