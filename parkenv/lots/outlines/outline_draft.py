"""Draft a lot from the outlines of its parking spaces: spaces, rows, open sides, aisles, connections, entry, goal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.lots.generators import Slots
from parkenv.lots.outlines.access import Entry, goal_beyond, guess_entry
from parkenv.lots.outlines.aisles import Aisle, find_aisles
from parkenv.lots.outlines.connections import Connection, connect
from parkenv.lots.outlines.free_space import FreeSpace
from parkenv.lots.outlines.network import Line, directed, largest_part, lanes_of, noded, without_stubs
from parkenv.lots.outlines.openings import OpenRow, open_rows
from parkenv.lots.outlines.rows import find_rows
from parkenv.lots.outlines.spaces import Spaces
from parkenv.world.lot import Lane, Mouth, mouth_points

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LONGEST_CONNECTION = 120.0  # m


@dataclass(frozen=True, eq=False)
class InferredLot:
    """Everything inferred from outlines."""

    index: IntArray  # (n,) which spaces became slots
    slots: Slots
    lanes: tuple[Lane, ...]
    entries: FloatArray
    goals: FloatArray
    rows: tuple[OpenRow, ...]
    aisles: tuple[Aisle, ...]
    connections: tuple[Connection, ...]
    entry: Entry | None
    two_way: tuple[int, ...]  # aisles that stay two-way against the slant of their spaces
    left_out: dict[str, list[int]] = field(default_factory=dict)  # reason: spaces


def infer_lot(
    spaces: Spaces,
    obstacles: Sequence[shapely.Geometry] = (),
    entries: FloatArray | None = None,
    goals: FloatArray | None = None,
) -> InferredLot:
    """Infer the lanes, entries and goals of a car park from its spaces.

    Args:
        spaces: the parking spaces.
        obstacles: buildings and other polygons that no car drives over, m.
        entries: (k, 2) m, entries if known.
        goals: (k, 2) m, goals if known.

    Raises:
        InputError: no aisle, or no way in, was found.
    """
    blocked = [*spaces.boxes(), *obstacles]
    rows, lost = open_rows(spaces, find_rows(spaces), obstacles)
    left_out = {"spaces that only another space leads to": lost.tolist()} if len(lost) else {}
    aisles = find_aisles(spaces, rows, blocked)
    if not aisles:
        raise InputError("no aisle: no space has free ground in front")
    free = FreeSpace(blocked)
    connections = connect([aisle.points for aisle in aisles], free, LONGEST_CONNECTION)
    lines = [
        Line(aisle.points if aisle.one_way >= 0 else aisle.points[::-1], aisle.one_way != 0, a)
        for a, aisle in enumerate(aisles)
    ]
    lines += [Line(connection.points) for connection in connections]
    lines = noded(lines)
    main = largest_part(lines)[0]
    lines = [lines[k] for k in main]
    index, slots = _slots(spaces, rows)
    mouths = mouth_points(slots.xy, slots.yaw, slots.length, slots.width, slots.mouth)
    lines = without_stubs(lines, mouths)
    wanted = {
        a: int(sum(len(rows[r].row) for r in aisle.rows)) for a, aisle in enumerate(aisles) if aisle.one_way
    }
    lines, two_way = directed(lines, wanted)
    entry = None
    if entries is None or not len(entries):
        entry = guess_entry(lines, mouths, blocked)
        if entry is None:
            raise InputError("no way in: no lane can be continued to the edge of the car park; give one by --entry X,Y")
        lines = [*lines, Line(entry.points)]
        entries = entry.points[1:]
        lines = noded(lines)
    if goals is None or not len(goals):
        lane = shapely.LineString(min(lines, key=lambda l: shapely.distance(shapely.LineString(l.points), shapely.Point(entries[0]))).points)
        before = entry.points[0] if entry is not None else shapely.get_coordinates(lane.centroid)[0]
        goals = goal_beyond(entries[0], before)
    return InferredLot(
        index, slots, tuple(lanes_of(lines)), entries, goals, tuple(rows), tuple(aisles), tuple(connections),
        entry, tuple(two_way), left_out,
    )


def _slots(spaces: Spaces, rows: Sequence[OpenRow]) -> tuple[IntArray, Slots]:
    """Return the slots of all rows in the order of the spaces, with the indices of their spaces."""
    parts, members = [], []
    for part in rows:
        row, side = part.row, part.side
        outward = row.outward(side)
        index = row.members
        if row.kerbside:
            # The lane is on the left of a car that keeps to the right.
            heading = np.stack([outward[:, 1], -outward[:, 0]], axis=1)
            mouth = Mouth.LEFT
        else:
            heading, mouth = -outward, Mouth.REAR
        parts.append(
            Slots(
                xy=spaces.xy[index],
                yaw=np.arctan2(heading[:, 1], heading[:, 0]),
                length=spaces.length[index],
                width=spaces.width[index],
                mouth=np.full(len(index), int(mouth), dtype=np.int8),
            )
        )
        members.append(index)
    order = np.argsort(np.concatenate(members), kind="stable")
    return np.concatenate(members)[order], Slots.joined(parts)[order]
