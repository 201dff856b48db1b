"""Choose the places of suite v2: `python -m parkenv.studies.benchmark.choose_places DIR OUT`.

DIR holds the outlines of parking spaces of car parks, a file of each. A place is sure: it is imported without a
warning of `parkenv lot check`, with an error probability of at most 0.3. Of the sure ones, each stratum gives those
with the smallest `lot_share`, a hash of their slots, so that nobody picks them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from parkenv.errors import InputError
from parkenv.lots import import_lot, write_lot
from parkenv.lots.draft import ImportOptions
from parkenv.lots.quality import Provenance
from parkenv.scenarios.selection import lot_share
from parkenv.studies.lots.census import lot_columns

LEAST_SURE = 0.3
"""Largest error probability of a place."""
STRATA = (
    ("perpendicular", "small", 4), ("perpendicular", "medium", 4), ("perpendicular", "large", 4),
    ("oblique", None, 2), ("kerbside", None, 4), ("mixed", None, 6),
)  # fmt: skip
"""Kind, size, any if None, and number of places."""


def choose_places(outlines: Iterable[Path], out: Path) -> list[dict[str, Any]]:
    """Import car parks, write those chosen into a folder, and return a row for each."""
    sure = []
    for path in outlines:
        try:
            draft = import_lot(path, ImportOptions(guess_entry=True, guess_goal=True))
            lot = draft.lot()
        except InputError:
            continue
        row = lot_columns(lot, draft.issues)
        if row["result"] == "clean" and row["error_probability"] <= LEAST_SURE:
            sure.append((lot_share(lot), row, lot, Provenance(path.name, draft.guesses, draft.issues)))
    sure.sort(key=lambda one: one[0])
    rows: list[dict[str, Any]] = []
    for kind, size, count in STRATA:
        chosen = [one for one in sure if one[1]["kind"] == kind and size in (None, one[1]["size"])][:count]
        for share, row, lot, provenance in sorted(chosen, key=lambda one: one[1]["slots"]):
            name = f"place-{len(rows) + 1:02d}"
            write_lot(lot, out / f"{name}.geojson", provenance)
            rows.append(
                {"name": name, "kind": kind, "size": row["size"], "slots": row["slots"], "share": share}
            )
    return rows


if __name__ == "__main__":
    source, target = map(Path, sys.argv[1:3])
    target.mkdir(parents=True, exist_ok=True)
    rows = choose_places(sorted(source.glob("*.geojson")), target)
    sys.stdout.write(json.dumps(rows, indent=1) + "\n")
