"""Real places: which reader a file needs, and the draft of a lot that it gives."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from parkenv.errors import InputError
from parkenv.lots.dragon_lake import is_dragon_lake
from parkenv.lots.places.lot_draft import LotDraft, Wishes, points_in
from parkenv.lots.places.osm import osm_draft
from parkenv.lots.places.osm_elements import holds_osm
from parkenv.lots.places.slot_list import slot_list_draft
from parkenv.world.lot import ParkingLot


def is_place(path: Path) -> bool:
    """Whether a file is a map or a list that a lot is made from by rules, not a lot itself."""
    suffix = path.suffix.lower()
    if suffix in (".json", ".geojson"):
        try:
            return holds_osm(json.loads(path.read_text(encoding="utf-8-sig")))
        except (OSError, ValueError, RecursionError):
            return False  # the reader of lots says what is wrong
    return suffix in (".osm", ".xml", ".csv")


def import_lot(path: str | Path, wishes: Wishes | None = None) -> LotDraft:
    """The lot that a file describes, as far as it does.

    Read are OpenStreetMap (`.osm`, `.xml`, Overpass JSON, GeoJSON of overpass-turbo; see
    `parkenv.lots.places.osm`), lists of slot centres (`.csv`; see
    `parkenv.lots.places.slot_list`), Dragon Lake's map and native lots.
    Lots by latitude and longitude get metres east and north of their middle.

    Args:
        path: the file.
        wishes: goals, entries and bounds that the user gives.

    Returns:
        A draft; `LotDraft.lot()` makes it a lot, or says what is missing.

    Raises:
        InputError: the file cannot be read, holds no parking, or is of an unknown kind.
    """
    path = Path(path)
    wishes = wishes or Wishes()
    if is_place(path):
        draft_of = slot_list_draft if path.suffix.lower() == ".csv" else osm_draft
        return draft_of(path, wishes)
    if not is_dragon_lake(path) and path.suffix.lower() not in (".json", ".geojson"):
        raise InputError(
            f"{path}: unknown kind of file {path.suffix!r}, want .osm or .xml (OpenStreetMap; convert .pbf first), "
            ".json or .geojson (Overpass, overpass-turbo, a native lot), .csv (slot centres) or a Dragon Lake .yml"
        )
    if wishes.bounds is not None:
        raise InputError(f"{path}: bounds go with OpenStreetMap and lists of slots; this file is a whole lot")
    draft = LotDraft.of_lot(ParkingLot.from_file(path))
    if wishes.goals:
        draft = replace(draft, goals=points_in(None, wishes.goals))
    if wishes.entries:
        draft = replace(draft, entries=points_in(None, wishes.entries))
    return draft
