"""Import every car park of a town: a lot of each, a table of what became of them, and contact sheets."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from parkenv.lots import write_lot
from parkenv.lots.draft import ImportOptions, Provenance
from parkenv.lots.osm.draft import LEAST_SPACES, import_car_parks
from parkenv.show.figures.lots import save_contact_sheets
from parkenv.show.plurals import plural
from parkenv.studies.lots.drivability import check_drivability
from parkenv.studies.results import Row
from parkenv.studies.study import Progress, counted


class TownLots(NamedTuple):
    """A row for each car park (lot, spaces, slots, lanes, result, error_probability, reason), and contact sheets."""

    rows: list[Row]
    pictures: list[Path]


def import_town_lots(
    place: Path,
    folder: Path,
    options: ImportOptions,
    least: int = LEAST_SPACES,
    progress: Progress = lambda *_: None,
) -> TownLots:
    """Write a lot of every car park of a town, of at least `least` spaces, into a folder; see `import_car_parks`."""
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
            left = "; ".join(map(str, park.draft.left_out))
            problems = "; ".join(problem.message for problem in drivability.problems)
            error = drivability.error_probability
            row |= {
                "slots": lot.n_slots,
                "lanes": len(lot.lanes),
                "result": "warnings" if drivability.problems else "clean",
                "error_probability": round(error, 3),
                "reason": problems or (f"left out: {left}" if left else ""),
            }
            lots.append((lot, Provenance(place.name, park.draft.guesses, drivability.issues), error))
        rows.append(row)
        done()
    for lot, provenance, _ in lots:
        write_lot(lot, folder / f"{lot.name}.geojson", provenance)
    drawn = [
        (f"{lot.name}\n{plural(lot.n_slots, 'slot')}, error probability {p:.2f}", lot) for lot, _, p in lots
    ]
    return TownLots(rows, save_contact_sheets(drawn, folder))
