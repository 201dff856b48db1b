"""Rows of slots and the aisles between them, inferred from the slots' centres.

1. A slot's row runs toward its nearest neighbour. Neighbours at about that distance whose rows have the same
   direction form one row, which must be straight. Single slots and pairs join a row in line with them.
2. With a yaw, the angle between cars and row determines the arrangement. Without, rows with a slot every 3.7 m or less
   are perpendicular parking, with one every 4.8 m or more parallel parking.
3. Two parallel rows with 2.8 to 10 m between them face each other across an aisle; closer ones are back to back. A row
   opens to the side of its facing row or, without one, to the side without a neighbour. A yaw decides the side for
   cars that are not parallel to the aisle; for parallel cars without a facing row the aisle is on their left.
4. Aisles run midway between the rows that open to them (3 m from a row without a facing row), and continue across
   gaps of up to 15 m. Roads connect them at their ends and through gaps in the rows, if no slot is in the way.
   All are two-way.

If a step is ambiguous, `infer_layout` raises an error that states what it found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.generators import Slots
from parkenv.lots.importers.facing_rows import FacingRows, open_sides
from parkenv.lots.importers.slot_aisles import extended_aisle, find_aisles, lanes_through
from parkenv.lots.importers.slot_rows import (
    AmbiguousLayoutError,
    describe_rows,
    find_rows,
    row_slots,
    with_arrangement,
)
from parkenv.world.lot import Lane, corner_points, mouth_points

MOST_STRAYS = 0.1  # largest allowed fraction of slots in no row


@dataclass(frozen=True, eq=False)
class SlotLayout:
    """Slots and lanes inferred from slot centres."""

    index: tuple[int, ...]  # indices, in the list, of the slots that are part of a row
    slots: Slots  # these slots
    lanes: tuple[Lane, ...]  # aisles and the roads that connect them, all two-way
    strays: tuple[int, ...]  # indices of the slots in no row
    found: tuple[str, ...]  # one line per finding


def infer_layout(xy: FloatArray, yaw: FloatArray | None, names: Sequence[str]) -> SlotLayout:
    """Infer slots and lanes from slot centres.

    Args:
        xy: (n, 2) m.
        yaw: (n,) rad, heading of a car parked nose-in, or None.
        names: n names for messages.

    Raises:
        AmbiguousLayoutError: several layouts of rows or aisles are possible.
    """
    rows, strays = find_rows(xy, names)
    rows = [with_arrangement(row, rows, xy, yaw, names) for row in rows]
    if len(strays) > MOST_STRAYS * len(xy):
        shown = ", ".join(names[i] for i in strays[:5])
        raise AmbiguousLayoutError(f"{len(strays)} of {len(xy)} slots are in no row ({shown})", rows, xy)
    if 2 * sum(len(row.members) for row in rows if len(row.members) > 2) < len(xy):
        raise AmbiguousLayoutError("most slots are single or in pairs, want rows of at least 3", rows, xy)
    faced = FacingRows(rows)
    sides = open_sides(rows, faced, xy, yaw, names)
    slots = Slots.joined([row_slots(row, side, xy, yaw) for row, side in zip(rows, sides, strict=True)])
    index = np.concatenate([row.members for row in rows])
    order = np.argsort(index)
    slots, index = slots[order], index[order]
    boxes = np.asarray(
        shapely.polygons(corner_points(slots.xy, slots.yaw, slots.length - 0.1, slots.width - 0.1))
    )
    mouth_xy = mouth_points(slots.xy, slots.yaw, slots.length, slots.width, slots.mouth)
    aisles = [extended_aisle(aisle, mouth_xy) for aisle in find_aisles(rows, sides, faced)]
    lanes = lanes_through(aisles, rows, boxes, mouth_xy, xy)
    return SlotLayout(
        index=tuple(index.tolist()),
        slots=slots,
        lanes=tuple(lanes),
        strays=tuple(strays),
        found=(*describe_rows(rows), f"{len(lanes)} lanes, two-way"),
    )
