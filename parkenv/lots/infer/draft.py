"""The draft of a lot whose lanes were inferred: what was found and guessed, what may be wrong, what is missing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.lots.draft import ImportOptions, LeftOut, LotDraft
from parkenv.lots.infer.layout import KERB_WIDTH, InferredLot
from parkenv.lots.infer.openings import least_aisle
from parkenv.lots.infer.spaces import Spaces
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.quality import QualityIssue
from parkenv.world.drive_graph import SLOT_REACH

MOST_LOST = 0.2
"""Largest fraction of the spaces that an import may leave out because no aisle reaches them."""
SHARE_UNSURE = 0.35  # certainty below which the open side of a row counts as a guess
TWO_WAY_WIDTH = 4.5  # least width, m, of a two-way aisle


def draft_inferred_lot(
    name: str,
    lot: InferredLot,
    spaces: Spaces,
    options: ImportOptions,
    *,
    source: str,
    unit: str,
    left_out: Mapping[str, Sequence[str]],
    frame: LocalFrame | None,
    goals: FloatArray,
    goal_note: str = "",
    walls: Sequence[FloatArray] = (),
    outlines: Sequence[FloatArray] = (),
) -> LotDraft:
    """Draft a lot whose lanes were inferred.

    Args:
        name: the lot's name.
        lot: what was inferred.
        spaces: the spaces that it was inferred from.
        options: goals and entries given by the user, and whether they may be guessed.
        source: where the spaces come from.
        unit: what a space is in the file, such as "outlines".
        left_out: reasons, each with the names of spaces that were not used for the inference.
        frame: the lot's geographic frame, or None.
        goals: (k, 2) m, goals given by the user or found in the file.
        goal_note: where they come from, if they were found.
        walls: (k, 2) m each.
        outlines: (k, 2) m each, parking areas for the figure.
    """
    without_aisle = {reason: [spaces.ids[i] for i in members] for reason, members in lot.left_out.items()}
    lost = sum(map(len, without_aisle.values()))
    if lost > MOST_LOST * len(spaces):
        reasons = "; ".join(str(LeftOut(reason, tuple(ids))) for reason, ids in without_aisle.items())
        raise InputError(f"{lost} of {len(spaces)} spaces have no aisle: {reasons}")
    if not len(goals) and options.guess_goal:
        goals, goal_note = lot.goal, "on the side of the entry"
    is_known = bool(options.entries) or options.guess_entry or lot.entry is None
    entries = lot.entries if is_known else lot.entries[:0]
    return LotDraft(
        name=name,
        slot_ids=tuple(spaces.ids[i] for i in lot.index),
        slots=lot.slots,
        slot_source=(source,) * len(lot.index),
        lanes=lot.lanes,
        entries=entries,
        goals=goals,
        walls=tuple(walls),
        outlines=tuple(outlines),
        found=tuple(_found(lot, len(spaces), unit, frame)),
        guesses=tuple(_guesses(lot, options, goal_note)),
        issues=tuple(_issues(lot, len(spaces), sum(map(len, left_out.values())), unit, options)),
        left_out=tuple(LeftOut(reason, tuple(ids)) for reason, ids in {**left_out, **without_aisle}.items()),
        missing=tuple(_missing(lot, entries, goals)),
        frame=frame,
    ).searchable()


def _found(lot: InferredLot, n: int, unit: str, frame: LocalFrame | None) -> Iterator[str]:
    rows = lot.rows
    kinds = {"kerbside": 0, "oblique": 0, "perpendicular": 0}
    for part in rows:
        slant = np.degrees(part.row.slant)
        kinds["kerbside" if slant < 15 else "oblique" if slant < 75 else "perpendicular"] += 1
    listed = ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count)
    yield f"slots: {len(lot.index)} of {n} {unit}, in rows ({len(rows)}): {listed}"
    wide = [aisle.width for aisle in lot.aisles if aisle.width < 2 * SLOT_REACH]
    width = f", {min(wide):.1f} to {max(wide):.1f} m wide" if wide else ""
    yield f"aisles: {len(lot.aisles)}{width}; connections: {len(lot.connections)}; lanes: {len(lot.lanes)}"
    if frame is not None:
        yield f"frame: {frame}"


def _guesses(lot: InferredLot, options: ImportOptions, goal_note: str) -> Iterator[str]:
    unsure = [part for part in lot.rows if part.certainty < SHARE_UNSURE]
    yield (
        f"open sides of rows ({len(lot.rows)}): where the ground in front is free and rows share aisles"
        + (f"; {len(unsure)} could open to either side" if unsure else "")
    )
    if lot.aisles:
        yield f"aisles along the rows' fronts: {len(lot.aisles)}"
    if lot.connections:
        far = max(shapely.LineString(c.points).length for c in lot.connections)
        yield f"connections through free ground: {len(lot.connections)}, the longest {far:.0f} m"
    narrow = sum(c.clearance < TWO_WAY_WIDTH / 2 - 0.05 for c in lot.connections)
    if narrow:
        yield f"connections narrower than {TWO_WAY_WIDTH:g} m, two-way nevertheless: {narrow}"
    one_way = sum(aisle.one_way != 0 for aisle in lot.aisles) - len(lot.two_way)
    if one_way:
        yield f"aisles one-way by the slant of their spaces: {one_way}"
    if lot.two_way:
        yield f"aisles two-way against the slant of their spaces, as no other way leads back: {len(lot.two_way)}"
    if lot.widened:
        yield f"kerbside spaces narrower than {KERB_WIDTH:g} m, widened towards the lane: {lot.widened}"
    if lot.entry is not None and not options.entries and options.guess_entry:
        x, y = lot.entries[0].tolist()
        yield f"entry at {x:.1f}, {y:.1f} m: {lot.entry.reason}"
    if not options.goals and goal_note:
        yield f"goal: {goal_note}"


def _issues(
    lot: InferredLot, n: int, unused: int, unit: str, options: ImportOptions
) -> Iterator[QualityIssue]:
    unsure = sum(
        len(part.row) * (SHARE_UNSURE - part.certainty) / SHARE_UNSURE
        for part in lot.rows
        if part.certainty < SHARE_UNSURE
    )
    if unsure:
        yield QualityIssue("rows could open to either side", min(0.6, 0.6 * float(unsure) / n + 0.02))
    lost = sum(map(len, lot.left_out.values())) + unused
    if lost:
        yield QualityIssue(f"{unit} left out", min(0.5, 1.5 * lost / (n + unused)))
    reach = [shapely.LineString(c.points).length for c in lot.connections]
    far = sum(length for length in reach if length > 40.0)
    if far:
        yield QualityIssue("long connections through unknown ground", min(0.4, 0.002 * far + 0.05))
    narrow = sum(c.clearance < TWO_WAY_WIDTH / 2 - 0.05 for c in lot.connections)
    if narrow:
        yield QualityIssue("narrow connections", min(0.3, 0.05 * narrow))
    if lot.two_way:
        yield QualityIssue("oblique rows on two-way aisles", 0.15)
    tight = sum(
        len(part.row) for part in lot.rows if np.median(part.view.clear) < least_aisle(part.row) + 0.4
    )
    if tight:
        yield QualityIssue("narrow aisles", min(0.4, 0.5 * tight / n))
    if lot.entry is not None and not options.entries:
        yield QualityIssue("the entry is a guess", 0.05 + 0.1 * (1.0 - lot.entry.certainty))


def _missing(lot: InferredLot, entries: FloatArray, goals: FloatArray) -> Iterator[str]:
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
