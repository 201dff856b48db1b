"""Lots under examination: clear lanes and closed one-way loops, and imports of all car parks of a town."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from scipy.sparse.csgraph import connected_components, dijkstra

from parkenv.compiled.arrays import FloatArray
from parkenv.lots import write_lot
from parkenv.lots.draft import (
    ImportOptions,
    Provenance,
    QualityIssue,
    combined_error_probability,
)
from parkenv.lots.formats.contents import LotProblem
from parkenv.lots.generators import Slots, nearest_on_lanes
from parkenv.lots.lot_files import dead_ends
from parkenv.lots.osm.draft import import_car_parks
from parkenv.show.figures.lots import save_contact_sheets
from parkenv.show.tables import plural
from parkenv.studies.results import Row
from parkenv.studies.study import Progress, counted
from parkenv.world.drive_graph import linestrings
from parkenv.world.lot import Mouth, ParkingLot, is_building
from parkenv.world.scenario import KMH

CAR_ROOM = 1.0  # half the width, m, that a car needs on a lane: 1.8 m and the mirrors
NAMED = 3  # number of slots named in a message


@dataclass(frozen=True)
class Drivability:
    problems: tuple[LotProblem, ...]  # warnings; none for a lot that can be driven throughout
    issues: tuple[QualityIssue, ...]  # what may be wrong with it, also of the import

    @property
    def error_probability(self) -> float:
        return combined_error_probability(self.issues)


def check_drivability(lot: ParkingLot, issues: tuple[QualityIssue, ...] = ()) -> Drivability:
    problems = tuple(
        LotProblem("warning", None, text)
        for text in (*_open_loops(lot), *dead_ends(lot), *_blocked_lanes(lot))
    )
    if problems:
        issues = (*issues, QualityIssue("lanes that are blocked or lead nowhere", 0.5))
    return Drivability(problems, issues)


def _open_loops(lot: ParkingLot) -> list[str]:
    part = connected_components(lot.drive_matrix(), connection="strong")[1][: lot.n_slots]
    apart = np.flatnonzero(part != np.argmax(np.bincount(part)))
    names = ", ".join(repr(lot.slot_ids[slot])[:42] for slot in apart[:NAMED].tolist())
    slots = f"{len(apart)} slots ({names}{', ...' if len(apart) > NAMED else ''})"
    text = f"one-way lanes form no loop: a car that passed {slots} does not get back to the others"
    return [text] if len(apart) else []


def _blocked_lanes(lot: ParkingLot) -> list[str]:
    walls = [
        shapely.make_valid(shapely.Polygon(wall)) if is_building(wall) else shapely.LineString(wall)
        for wall in lot.walls
    ]
    things = np.concatenate([Slots.of_lot(lot).boxes(shrink=0.2), np.array(walls, dtype=object)])
    lanes = linestrings([lane.points for lane in lot.lanes])
    lane, thing = shapely.STRtree(things).query(lanes, predicate="dwithin", distance=CAR_ROOM)
    texts = []
    for k in np.unique(lane).tolist():
        slots = thing[(lane == k) & (thing < lot.n_slots)]
        x, y = lot.lanes[k].points.mean(axis=0)
        what = f"the slot {lot.slot_ids[int(slots[0])]!r:.40}" if len(slots) else "a wall"
        texts.append(f"the lane at ({x:.1f}, {y:.1f}) m leaves less than {CAR_ROOM:g} m to {what}")
    return texts


def _slants(lot: ParkingLot) -> FloatArray:
    """Return the angle between the lane and the parked car in each slot, (n_slots,) degrees, in steps of five."""
    slots = Slots.of_lot(lot)
    mouth, outward = slots.mouths(), slots.outward()
    nearest, tangent, _ = nearest_on_lanes(lot.lanes, mouth)
    left = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    across = left * np.where((left * outward).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    # A lane may end before a slot, or bend around it.
    to_lane = nearest - mouth
    distance = np.hypot(to_lane[:, 0], to_lane[:, 1])[:, None]
    across = np.where(distance > 0.3, to_lane / np.maximum(distance, 0.3), across)
    sine = np.clip(np.abs((across * outward).sum(axis=1)), 0.0, 1.0)
    slant = np.where(lot.slot_mouth == Mouth.REAR, np.degrees(np.arcsin(sine)), 0.0)
    return np.asarray(np.round(slant / 5.0) * 5.0)


KINDS = ("perpendicular", "oblique", "kerbside")
# Share of the slots that are of one kind from which the lot is of that kind; else it is mixed.
LEAST_SHARE = 0.9
# Degrees between lane and parked car below which a slot is kerbside, and below which it is oblique.
KERBSIDE_BELOW, OBLIQUE_BELOW = 15, 75
# Names of sizes, each with the number of slots that it stays below.
SIZES = (("small", 80), ("medium", 200), ("large", np.inf))
V_DRIVE = 10.0 * KMH  # m/s, of the drive time


def import_town_lots(
    place: Path, folder: Path, options: ImportOptions, least: int, progress: Progress = lambda *_: None
) -> list[Row]:
    """Write a lot of every car park of a town, of at least `least` spaces, and contact sheets into a folder.

    Returns a row of each car park: lot, spaces, result, reason, and `lot_columns`.
    """
    rows: list[Row] = []
    lots = []
    done = counted(progress, "car parks")
    for park in import_car_parks(place, options, least):
        row: Row = {"lot": park.name, "spaces": park.spaces, "slots": 0, "lanes": 0}
        if park.draft is None:
            row |= {"result": "refused", "error_probability": None, "reason": park.reason}
        else:
            lot = park.draft.lot()
            drivability = check_drivability(lot, park.draft.issues)
            row |= lot_columns(lot, drivability)
            if park.draft.left_out and not row["reason"]:
                row["reason"] = f"left out: {'; '.join(map(str, park.draft.left_out))}"
            write_lot(
                lot,
                folder / f"{lot.name}.geojson",
                Provenance(place.name, park.draft.guesses, drivability.issues),
            )
            lots.append((row, lot))
        rows.append(row)
        done()
    _draw(lots, folder)
    return rows


def _draw(lots: Sequence[tuple[Row, ParkingLot]], folder: Path) -> None:
    counts = [
        f"{plural(lot.n_slots, 'slot')}, error probability {row['error_probability']:.2f}"
        for row, lot in lots
    ]
    drawn = [(f"{lot.name}\n{count}", lot) for count, (_, lot) in zip(counts, lots, strict=True)]
    save_contact_sheets(drawn, folder)


def lot_columns(lot: ParkingLot, drivability: Drivability) -> Row:
    slant = _slants(lot)
    kerbside, oblique = slant < KERBSIDE_BELOW, slant < OBLIQUE_BELOW
    numbers = (~oblique).sum(), (oblique & ~kerbside).sum(), kerbside.sum()
    counts = {kind: int(number) for kind, number in zip(KINDS, numbers, strict=True)}
    low_x, low_y, high_x, high_y = lot.bounds()
    reach = dijkstra(lot.drive_matrix(), indices=lot.entry_vertices)[:, : lot.n_slots]
    return {
        "slots": lot.n_slots,
        "size": next(name for name, below in SIZES if lot.n_slots < below),
        "kind": next((kind for kind in KINDS if counts[kind] >= LEAST_SHARE * lot.n_slots), "mixed"),
        **counts,
        "extent_x_m": round(high_x - low_x, 1),
        "extent_y_m": round(high_y - low_y, 1),
        "lanes": len(lot.lanes),
        "one_way_lanes": sum(lane.oneway for lane in lot.lanes),
        "entries": len(lot.entries),
        "goals": len(lot.goals),
        "drive_s": round(float(reach[np.isfinite(reach)].max(initial=0.0)) / V_DRIVE, 1),
        "error_probability": round(drivability.error_probability, 3),
        "result": "warnings" if drivability.problems else "clean",
        "reason": "; ".join(problem.message for problem in drivability.problems),
    }
