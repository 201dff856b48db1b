"""Real places: which reader a file needs, and the draft of a lot that it gives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from parkenv.errors import InputError
from parkenv.lots.file_formats import LotFormat, lot_format
from parkenv.lots.lot_files import read_lot
from parkenv.lots.places.lot_draft import LotDraft, Wishes, points_in
from parkenv.lots.places.osm import osm_draft
from parkenv.lots.places.slot_list import slot_list_draft


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
    file_format = lot_format(path)
    if file_format is LotFormat.OSM:
        return osm_draft(path, wishes)
    if file_format is LotFormat.SLOT_LIST:
        return slot_list_draft(path, wishes)
    if file_format is None:
        raise InputError(
            f"{path}: unknown kind of file {path.suffix!r}, want .osm or .xml (OpenStreetMap; convert .pbf first), "
            ".json or .geojson (Overpass, overpass-turbo, a native lot), .csv (slot centres) or a Dragon Lake .yml"
        )
    if wishes.bounds is not None:
        raise InputError(f"{path}: bounds go with OpenStreetMap and lists of slots; this file is a whole lot")
    draft = LotDraft.of_lot(read_lot(path))
    if wishes.goals:
        draft = replace(draft, goals=points_in(None, wishes.goals))
    if wishes.entries:
        draft = replace(draft, entries=points_in(None, wishes.entries))
    return draft
