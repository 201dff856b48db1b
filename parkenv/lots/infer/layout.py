"""Infer a lot from its parking spaces: rows, the sides that they open to, aisles, connections, entry and goal.

1. Spaces side by side, or end to end along a kerb, are rows (`rows`).
2. A row opens to free ground; of two free sides to the one where it shares an aisle with a facing row (`openings`).
3. Aisles are lines before the open sides of rows, in the middle between facing ones (`aisles`).
4. The shortest ways through free ground connect the aisles (`connections`).
5. Aisles along oblique rows are one-way by the slant, if all lanes stay connected (`network`).
6. Cars enter where a lane can be continued to the edge with short drives to the spaces (`access`).

Roads of the map are lanes as they are: rows that they reach need no aisle.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError
from parkenv.lots.draft import ImportOptions, LeftOut, QualityIssue
from parkenv.lots.generators import Slots, nearest_on_lanes
from parkenv.lots.infer import network
from parkenv.lots.infer.aisles import Aisle, OpenRow, View, find_aisles, least_aisle, open_rows
from parkenv.lots.infer.spaces import Spaces, find_rows
from parkenv.lots.local_frame import LocalFrame
from parkenv.world.drive_graph import SLOT_REACH
from parkenv.world.lot import Lane, Mouth

LONGEST_CONNECTION = 120.0  # m
# Least width, m, of a slot across which cars park, and least length of one along which they park.
NARROWEST, KERB_LENGTH = 1.95, 4.8
FACING = 0.5  # least cosine of the angle between a slot's open side and the way to its lane
CAR_ROOM = 1.0  # half the width, m, that a car needs on a lane
# Least width, m, of a kerbside slot; narrower outlines are widened towards the lane, since cars stand out of them.
KERB_WIDTH = 2.0


@dataclass(frozen=True, eq=False)
class InferredLot:
    index: IntArray  # (n,) which spaces became slots
    slots: Slots
    lanes: tuple[Lane, ...]
    entries: FloatArray  # (k, 2) m
    goal: FloatArray  # (1, 2) m, on the side of the entry
    rows: tuple[OpenRow, ...]
    aisles: tuple[Aisle, ...]
    connections: tuple[network.Connection, ...]
    entry: network.Entry | None
    two_way: tuple[int, ...]  # aisles that stay two-way against the slant of their spaces
    widened: int  # number of kerbside slots wider than their outlines
    left_out: dict[str, list[int]] = field(default_factory=dict)  # reason: spaces


def infer_lot(
    spaces: Spaces,
    obstacles: Sequence[shapely.Geometry] = (),
    roads: Sequence[network.Line] = (),
    entries: FloatArray | None = None,
) -> InferredLot:
    """Infer a car park's lanes and entry from its spaces, beside `roads` of the map and known entries, (k, 2) m."""
    blocked = [*spaces.boxes(), *obstacles]
    rows, lost = open_rows(spaces, find_rows(spaces), obstacles, [road.points for road in roads])
    left_out = {"spaces that only another space leads to": lost.tolist()}
    rows, small = _large_enough(spaces, rows)
    left_out.update(small)
    aisles = find_aisles(spaces, rows, blocked, [road.points for road in roads])
    if not aisles and not roads:
        reasons = "; ".join(f"{len(members)} {reason}" for reason, members in left_out.items() if members)
        raise InputError(f"no aisle serves any of {len(spaces)} spaces: {reasons}")
    lines = [
        network.Line(aisle.points if aisle.one_way >= 0 else aisle.points[::-1], aisle.one_way != 0, a)
        for a, aisle in enumerate(aisles)
    ]
    connections = network.connect(
        [line.points for line in (*lines, *roads)], network.FreeSpace(blocked), LONGEST_CONNECTION
    )
    lines = network.noded(
        network.noded([*lines, *roads, *(network.Line(connection.points) for connection in connections)])
    )
    index, slots, widened = _slots(spaces, rows)
    mouths = slots.mouths()
    main = [lines[k] for k in network.largest_part(lines)[0]]
    lines = network.without_stubs(main, lambda some: int(_is_served(slots, some).sum()))
    wanted = {
        a: int(sum(len(rows[r].row) for r in aisle.rows)) for a, aisle in enumerate(aisles) if aisle.one_way
    }
    lines, two_way = network.directed(lines, wanted)

    entry = None
    if entries is None or not len(entries):
        on_street = network.entries_from_streets(lines, mouths)
        if on_street is not None:
            lines, entries, entry = on_street
        else:
            entry = network.guess_entry(lines, mouths, blocked)
            lines = network.noded([*lines, network.Line(entry.points)])
            entries = entry.points[1:]
    served, clear = _is_served(slots, lines), np.ones(len(slots), dtype=bool)
    ways = shapely.STRtree([shapely.LineString(line.points) for line in lines])
    clear[ways.query(slots.boxes(shrink=0.2), predicate="dwithin", distance=CAR_ROOM)[0]] = False
    left_out["spaces that no aisle passes in front"] = index[~served].tolist()
    left_out["spaces beside which the only way is too narrow"] = index[served & ~clear].tolist()
    served &= clear
    way = entries[0] - (network.corner_near(entries[0], lines) if entry is None else entry.points[0])
    return InferredLot(
        index=index[served],
        slots=slots[served],
        lanes=tuple(network.limit_junctions([Lane(line.points, line.one_way) for line in lines])),
        entries=entries,
        goal=(entries[0] + network.BEYOND_ENTRY * (way / np.hypot(*way)))[None],
        rows=tuple(rows),
        aisles=tuple(aisles),
        connections=tuple(connections),
        entry=entry,
        two_way=tuple(two_way),
        widened=widened,
        left_out={reason: members for reason, members in left_out.items() if members},
    )


def _large_enough(spaces: Spaces, rows: Sequence[OpenRow]) -> tuple[list[OpenRow], dict[str, list[int]]]:
    kept: list[OpenRow] = []
    small: dict[str, list[int]] = {}
    for part in rows:
        members, kerbside = part.row.members, part.row.kerbside
        fits = spaces.length[members] >= KERB_LENGTH if kerbside else spaces.width[members] >= NARROWEST
        reason = f"spaces narrower than {NARROWEST:g} m"
        if kerbside:
            reason = f"kerbside spaces shorter than {KERB_LENGTH:g} m"
        small.setdefault(reason, []).extend(members[~fits].tolist())
        if fits.any():
            index = np.flatnonzero(fits)
            view = View(part.view.clear[index], part.view.hit[index])
            kept.append(OpenRow(part.row.part(index), part.side, view, part.certainty))
    return kept, small


def _is_served(slots: Slots, lines: Sequence[network.Line]) -> BoolArray:
    """Whether the lane nearest to each slot's mouth, (n,), is before it and within reach."""
    mouth = slots.mouths()
    to_lane = nearest_on_lanes([Lane(line.points) for line in lines], mouth)[0] - mouth
    ahead = (to_lane * slots.outward()).sum(axis=1)
    distance = np.hypot(to_lane[:, 0], to_lane[:, 1])
    return np.asarray((ahead >= FACING * distance) & (distance <= SLOT_REACH - 0.05))


def _slots(spaces: Spaces, rows: Sequence[OpenRow]) -> tuple[IntArray, Slots, int]:
    index = np.concatenate([part.row.members for part in rows])
    kerbside = np.repeat([part.row.kerbside for part in rows], [len(part.row) for part in rows])
    outward = np.concatenate([part.row.outward(part.side) for part in rows])
    wider = np.maximum(KERB_WIDTH - spaces.width[index], 0.0) * kerbside
    # The lane is on the left of a car that keeps to the right.
    heading = np.where(kerbside[:, None], np.stack([outward[:, 1], -outward[:, 0]], axis=1), -outward)
    slots = Slots(
        xy=spaces.xy[index] + wider[:, None] / 2 * outward,
        yaw=np.arctan2(heading[:, 1], heading[:, 0]),
        length=spaces.length[index],
        width=spaces.width[index] + wider,
        mouth=np.where(kerbside, Mouth.LEFT, Mouth.REAR).astype(np.int8),
    )
    order = np.argsort(index, kind="stable")
    return index[order], slots[order], int((wider > 0.0).sum())


MOST_LOST = 0.2  # largest fraction of the spaces that an import may leave out because no aisle reaches them
SHARE_UNSURE = 0.35  # certainty below which the open side of a row counts as a guess
TWO_WAY_WIDTH = 4.5  # least width, m, of a two-way aisle


def spaces_without_aisle(lot: InferredLot, spaces: Spaces) -> dict[str, list[str]]:
    """Return the ids of spaces without an aisle, by reason; too many are an error."""
    named = {reason: [spaces.ids[i] for i in members] for reason, members in lot.left_out.items()}
    lost = sum(map(len, named.values()))
    if lost > MOST_LOST * len(spaces):
        reasons = "; ".join(map(str, LeftOut.by_reason(named)))
        raise InputError(f"{lost} of {len(spaces)} spaces have no aisle: {reasons}")
    return named


def findings(lot: InferredLot, n: int, frame: LocalFrame) -> Iterator[str]:
    rows = lot.rows
    slants = np.digitize(np.degrees([part.row.slant for part in rows]), (15.0, 75.0)).tolist()
    kinds = enumerate(("kerbside", "oblique", "perpendicular"))
    listed = ", ".join(f"{slants.count(k)} {kind}" for k, kind in kinds if k in slants)
    yield f"slots: {len(lot.index)} of {n} outlines, in rows ({len(rows)}): {listed}"
    wide = [aisle.width for aisle in lot.aisles if aisle.width < 2 * SLOT_REACH]
    width = f", {min(wide):.1f} to {max(wide):.1f} m wide" if wide else ""
    yield f"aisles: {len(lot.aisles)}{width}; connections: {len(lot.connections)}; lanes: {len(lot.lanes)}"
    yield f"frame: {frame}"


def guesses_and_issues(
    lot: InferredLot, n: int, unused: int, options: ImportOptions, goal_note: str
) -> tuple[list[str], list[QualityIssue]]:
    """Return a sentence for each guess, and what may be wrong; `unused` spaces beside the n were not inferred from."""
    unsure = [part for part in lot.rows if part.certainty < SHARE_UNSURE]
    either = f"; {len(unsure)} could open to either side" if unsure else ""
    doubt = float(sum(len(p.row) * (SHARE_UNSURE - p.certainty) / SHARE_UNSURE for p in unsure))
    lost = sum(map(len, lot.left_out.values())) + unused
    reach = [shapely.LineString(c.points).length for c in lot.connections]
    longest, far = max(reach, default=0.0), sum(length for length in reach if length > 40.0)
    narrow = sum(c.clearance < TWO_WAY_WIDTH / 2 - 0.05 for c in lot.connections)
    two_way = len(lot.two_way)
    one_way = sum(aisle.one_way != 0 for aisle in lot.aisles) - two_way
    tight = sum(len(p.row) for p in lot.rows if np.median(p.view.clear) < least_aisle(p.row) + 0.4)
    is_guess = lot.entry is not None and not options.entries
    why, certainty = ("", 1.0) if lot.entry is None else (lot.entry.reason, lot.entry.certainty)
    x, y = lot.entries[0].tolist()
    guesses: tuple[tuple[float, str], ...] = (
        (
            1,
            f"open sides of rows ({len(lot.rows)}): where the ground in front is free and rows share aisles{either}",
        ),
        (len(lot.aisles), f"aisles along the rows' fronts: {len(lot.aisles)}"),
        (len(reach), f"connections through free ground: {len(reach)}, the longest {longest:.0f} m"),
        (narrow, f"connections narrower than {TWO_WAY_WIDTH:g} m, two-way nevertheless: {narrow}"),
        (one_way, f"aisles one-way by the slant of their spaces: {one_way}"),
        (
            two_way,
            f"aisles two-way against the slant of their spaces, as no other way leads back: {two_way}",
        ),
        (
            lot.widened,
            f"kerbside spaces narrower than {KERB_WIDTH:g} m, widened towards the lane: {lot.widened}",
        ),
        (is_guess and options.guess_entry, f"entry at {x:.1f}, {y:.1f} m: {why}"),
        (bool(goal_note) and not options.goals, f"goal: {goal_note}"),
    )
    issues: tuple[tuple[float, str, float], ...] = (
        (doubt, "rows could open to either side", min(0.6, 0.6 * doubt / n + 0.02)),
        (lost, "outlines left out", min(0.5, 1.5 * lost / (n + unused))),
        (far, "long connections through unknown ground", min(0.4, 0.002 * far + 0.05)),
        (narrow, "narrow connections", min(0.3, 0.05 * narrow)),
        (two_way, "oblique rows on two-way aisles", 0.15),
        (tight, "narrow aisles", min(0.4, 0.5 * tight / n)),
        (is_guess, "the entry is a guess", 0.05 + 0.1 * (1.0 - certainty)),
    )
    return (
        [guess for count, guess in guesses if count],
        [QualityIssue(reason, error) for count, reason, error in issues if count],
    )


def missing_parts(lot: InferredLot, entries: FloatArray, goals: FloatArray) -> Iterator[str]:
    if not len(entries):
        x, y = lot.entries[0].tolist()
        yield (
            f"no entry: the file has no road; give one by --entry X,Y, or --entry auto for {x:.1f},{y:.1f}; if it has "
            "several car parks, --split makes a lot of each"
        )
    if not len(goals):
        x, y = lot.goal[0].tolist()
        yield (
            f"no goal: the file has no building; give the place that people walk to by --goal X,Y, or --goal auto for "
            f"{x:.1f},{y:.1f}"
        )
