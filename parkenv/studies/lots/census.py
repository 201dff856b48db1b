"""A census of lots: how large each is, of what kinds its slots are, how far it is to drive, and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import dijkstra

from parkenv.errors import InputError
from parkenv.files.atomic_write import make_folder
from parkenv.files.csv_tables import write_csv
from parkenv.lots import read_lot
from parkenv.lots.draft import QualityIssue, read_provenance
from parkenv.show.plurals import plural
from parkenv.studies.lots.drivability import check_drivability, manoeuvre_kinds
from parkenv.studies.results import Row
from parkenv.studies.study import Progress, counted
from parkenv.world.lot import ParkingLot
from parkenv.world.scenario import KMH

KINDS = ("perpendicular", "oblique", "kerbside")
MIXED = "mixed"
LEAST_SHARE = 0.9
"""Share of the slots that are of one kind from which the lot is of that kind; else it is mixed."""
KERBSIDE_BELOW, OBLIQUE_BELOW = 15, 75
"""Degrees between lane and parked car below which a slot is kerbside, and below which it is oblique."""
SIZES = (("small", 80), ("medium", 200), ("large", np.inf))
"""Names of sizes, each with the number of slots that it stays below."""
V_DRIVE = 10.0 * KMH  # m/s, of the drive time
COLUMNS = (
    "lot", "file", "slots", "size", "kind", *KINDS, "extent_x_m", "extent_y_m", "lanes", "one_way_lanes", "entries",
    "goals", "drive_s", "error_probability", "result", "reason",
)  # fmt: skip
"""Columns of a census."""


def lot_files(places: Sequence[Path]) -> list[Path]:
    """Return the lot files that paths stand for: files, and the .geojson files in folders, in order of their names."""
    files: list[Path] = []
    for place in places:
        if not place.is_dir():
            if not place.exists():
                raise InputError(
                    f"{place}: no such file or folder, want a lot (.geojson, .yml) or a folder of lots"
                )
            files.append(place)
            continue
        found = sorted(path for path in place.iterdir() if path.suffix == ".geojson")
        if not found:
            raise InputError(f"{place}: holds no lot (.geojson)")
        files += found
    return files


def take_census(
    places: Sequence[Path], folder: Path, *, drive: bool = True, progress: Progress = lambda *_: None
) -> list[Row]:
    """Count lots; write census.csv, census.png and contact sheets into a folder.

    Returns a row for each lot, the largest first; those of files that hold no lot say why. With `drive`, manoeuvres are
    planned as `parkenv lot check` does.
    """
    from parkenv.show.figures.lots import save_census, save_contact_sheets

    files = lot_files(places)
    make_folder(folder)
    done = counted(progress, "Checking", len(files))
    found = []
    for file in files:
        found.append(count_lot(file, drive=drive))
        done()
    found.sort(key=lambda one: -one[0].get("slots", 0))
    rows = [row for row, _ in found]
    write_csv(folder / "census.csv", COLUMNS, rows)
    if lots := [(row, lot) for row, lot in found if lot is not None]:
        save_census([row for row, _ in lots], folder / "census.png")
        drawn = [
            (
                f"{row['lot']}\n{plural(row['slots'], 'slot')}, error probability {row['error_probability']:.2f}",
                lot,
            )
            for row, lot in lots
        ]
        save_contact_sheets(drawn, folder)
    return rows


def count_lot(path: Path, *, drive: bool = True) -> tuple[Row, ParkingLot | None]:
    """Return the row of a lot file in a census, and the lot; for a file that is no lot, its row says why, and None."""
    try:
        lot = read_lot(path)
        origin = read_provenance(path) if path.suffix == ".geojson" else None
    except InputError as error:
        reason = str(error).removeprefix(f"{path}: ")
        return {"lot": path.stem, "file": str(path), "result": "invalid", "reason": reason}, None
    row = {"lot": lot.name, "file": str(path)}
    return row | lot_columns(lot, origin.issues if origin is not None else (), drive=drive), lot


def lot_columns(lot: ParkingLot, issues: tuple[QualityIssue, ...] = (), *, drive: bool = True) -> Row:
    """Return the columns of a lot in a census; `issues` are what may be wrong with it, as its import knows."""
    counts = slots_by_kind(lot)
    drivability = check_drivability(lot, issues, drive=drive)
    low_x, low_y, high_x, high_y = lot.bounds()
    return {
        "slots": lot.n_slots,
        "size": next(name for name, below in SIZES if lot.n_slots < below),
        "kind": next((kind for kind in KINDS if counts[kind] >= LEAST_SHARE * lot.n_slots), MIXED),
        **counts,
        "extent_x_m": round(high_x - low_x, 1),
        "extent_y_m": round(high_y - low_y, 1),
        "lanes": len(lot.lanes),
        "one_way_lanes": sum(lane.oneway for lane in lot.lanes),
        "entries": len(lot.entries),
        "goals": len(lot.goals),
        "drive_s": round(longest_drive_m(lot) / V_DRIVE, 1),
        "error_probability": round(drivability.error_probability, 3),
        "result": "warnings" if drivability.problems else "clean",
        "reason": "; ".join(problem.message for problem in drivability.problems),
    }


def slots_by_kind(lot: ParkingLot) -> dict[str, int]:
    """Return the number of slots of each of `KINDS`, by the angle between the lane and the parked car."""
    kinds, member = manoeuvre_kinds(lot)
    slant = np.array([kind.slant for kind in kinds])[member]
    kerbside, oblique = slant < KERBSIDE_BELOW, slant < OBLIQUE_BELOW
    return {
        "perpendicular": int((~oblique).sum()),
        "oblique": int((oblique & ~kerbside).sum()),
        "kerbside": int(kerbside.sum()),
    }


def longest_drive_m(lot: ParkingLot) -> float:
    """Return the distance, m, from an entry to the slot that is farthest from it by the shortest way."""
    reach = dijkstra(lot.drive_matrix(), indices=lot.entry_vertices)[:, : lot.n_slots]
    return float(reach[np.isfinite(reach)].max(initial=0.0))
