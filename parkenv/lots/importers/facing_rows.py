"""Find rows of slots that face each other across an aisle, and the side to which each row opens."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.importers.slot_rows import PARALLEL_ROWS, STRAIGHT, AmbiguousLayoutError, Row

AISLE = (2.8, 10.0)  # least and greatest width, m, of an aisle between two rows


class FacingRows:
    """For each row and side (1 left, -1 right) the nearest parallel row there, and the free width between, m."""

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
        """Return the row across the aisle on a side, or None."""
        other, room = self._found.get((i, side), (None, np.inf))
        return other if AISLE[0] <= room <= AISLE[1] else None

    def is_blocked(self, i: int, side: int) -> bool:
        """Return whether another row is back to back on that side."""
        return self._found.get((i, side), (0, np.inf))[1] < AISLE[0]


def opens_toward(rows: Sequence[Row], side: int | None, j: int, i: int) -> bool:
    """Return whether row j opens to a side and row i is there."""
    return side is not None and float(side * rows[j].left @ (rows[i].middle - rows[j].middle)) > 0.0


def open_sides(
    rows: Sequence[Row], faced: FacingRows, xy: FloatArray, yaw: FloatArray | None, names: Sequence[str]
) -> list[int]:
    """Return the side to which each row opens: 1 left, -1 right.

    Raises:
        AmbiguousLayoutError: a row could open to both sides, or to neither.
    """
    sides: list[int | None] = [None] * len(rows)
    for i, row in enumerate(rows):
        who = f"the row of slots {names[row.members[0]]!r:.40} to {names[row.members[-1]]!r:.40}"
        if yaw is not None and row.angle > 0.0:
            nose = np.stack([np.cos(yaw[row.members]), np.sin(yaw[row.members])], axis=1) @ row.left
            if (nose > 0.0).any() and (nose < 0.0).any():
                raise AmbiguousLayoutError(f"{who}: cars stand nose-in on both sides", rows, xy)
            sides[i] = -1 if nose[0] > 0.0 else 1
            if faced.is_blocked(i, sides[i] or 1):
                raise AmbiguousLayoutError(f"{who}: its cars would drive in through the next row", rows, xy)
            continue
        free = [side for side in (1, -1) if not faced.is_blocked(i, side)]
        facing = [side for side in free if faced.row(i, side) is not None]
        if len(facing) == 1:
            sides[i] = facing[0]
        elif len(free) == 1:
            sides[i] = free[0]
        elif not free:
            raise AmbiguousLayoutError(f"{who} has another close by on either side, and no way in", rows, xy)
        elif not facing and yaw is None:
            raise AmbiguousLayoutError(
                f"{who} faces no other and could open to either side; give a yaw column", rows, xy
            )
        elif not facing:
            # Parallel cars face the direction of traffic and park on the right: the aisle is on their left.
            heading = yaw[row.members[0]] if yaw is not None else 0.0
            sides[i] = 1 if np.array([np.cos(heading), np.sin(heading)]) @ row.along > 0.0 else -1
    for i, row in enumerate(rows):
        if sides[i] is not None:
            continue
        # Rows on both sides: if only one of them opens to this row, they share an aisle.
        toward = [
            side
            for side in (1, -1)
            if (j := faced.row(i, side)) is not None and opens_toward(rows, sides[j], j, i)
        ]
        if len(toward) != 1:
            raise AmbiguousLayoutError(
                f"the row of slots {names[row.members[0]]!r:.40} to {names[row.members[-1]]!r:.40} has room for an "
                "aisle on either side; give a yaw column",
                rows,
                xy,
            )
        sides[i] = toward[0]
    return [side or 1 for side in sides]
