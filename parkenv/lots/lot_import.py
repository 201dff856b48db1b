"""Import a lot from any supported file: choose the reader, return a draft of the lot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from parkenv.errors import InputError
from parkenv.lots.draft import ImportOptions, LotDraft, points_in_frame
from parkenv.lots.formats.recognition import LotFormat, lot_format
from parkenv.lots.formats.slot_list import slot_list_draft
from parkenv.lots.lot_files import read_lot
from parkenv.lots.osm.draft import osm_draft


def import_lot(path: str | Path, options: ImportOptions | None = None) -> LotDraft:
    """Draft a lot from a file of a real place.

    Supported formats are OpenStreetMap (`.osm`, `.xml`, `.osm.pbf`, Overpass JSON, overpass-turbo GeoJSON; see
    `parkenv.lots.osm.draft`), lists of slot centres (`.csv`; see
    `parkenv.lots.formats.slot_list`), the Dragon Lake map and native lots.
    Latitudes and longitudes are projected to metres east and north of the file's centre.

    Args:
        path: the file.
        options: goals, entries and bounds given by the user.

    Returns:
        A draft; `LotDraft.lot()` converts it to a lot, or states what is missing.

    Raises:
        InputError: the file cannot be read, contains no parking, or has an unknown format.
    """
    path = Path(path)
    options = options or ImportOptions()
    file_format = lot_format(path)
    if file_format is LotFormat.OSM:
        return osm_draft(path, options)
    if file_format is LotFormat.SLOT_LIST:
        return slot_list_draft(path, options)
    if file_format is None:
        raise InputError(
            f"{path}: unknown kind of file {path.suffix!r}, want .osm, .xml or .pbf (OpenStreetMap), "
            ".json or .geojson (Overpass, overpass-turbo, a native lot), .csv (slot centres) or a Dragon Lake .yml"
        )
    if options.bounds is not None:
        raise InputError(
            f"{path}: bounds apply to OpenStreetMap and lists of slots; this file is a whole lot"
        )
    draft = LotDraft.of_lot(read_lot(path))
    if options.goals:
        draft = replace(draft, goals=points_in_frame(None, options.goals))
    if options.entries:
        draft = replace(draft, entries=points_in_frame(None, options.entries))
    return draft
