"""Recognise lot files; read those that describe a whole lot, and the packaged lots; import the others."""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
from importlib import resources
from pathlib import Path

from parkenv.errors import InputError
from parkenv.files.known_names import PACKAGED_LOTS
from parkenv.files.limited_reading import is_there, read_json, unpacked_path
from parkenv.lots.draft import ImportOptions, LotDraft, points_in_frame
from parkenv.lots.formats.contents import graph_errors
from parkenv.lots.formats.dragon_lake import dragon_lake_lot
from parkenv.lots.formats.geojson import read_contents
from parkenv.lots.osm.elements import holds_osm
from parkenv.world.drive_graph import GraphError
from parkenv.world.lot import ParkingLot


class LotFormat(Enum):
    """Format of a file that a lot is read or imported from."""

    GEOJSON = "native GeoJSON"
    DRAGON_LAKE = "Dragon Lake map"
    OSM = "OpenStreetMap"
    SLOT_LIST = "list of slot centres"

    @property
    def is_complete(self) -> bool:
        """Whether a file of this format defines a whole lot; for other formats, `import_lot` derives one by rules."""
        return self in (LotFormat.GEOJSON, LotFormat.DRAGON_LAKE)


def lot_format(path: Path) -> LotFormat | None:
    """Return a file's format by its suffix and, for JSON, its content; None for an unknown suffix. Does not raise.

    A JSON file that cannot be read counts as native: its reader then reports the error.
    """
    suffix = unpacked_path(path).suffix.lower()
    if suffix in (".json", ".geojson"):
        try:
            is_osm = holds_osm(read_json(path))
        except InputError:
            is_osm = False
        return LotFormat.OSM if is_osm else LotFormat.GEOJSON
    by_suffix = {
        ".yml": LotFormat.DRAGON_LAKE,
        ".yaml": LotFormat.DRAGON_LAKE,
        ".osm": LotFormat.OSM,
        ".xml": LotFormat.OSM,
        ".pbf": LotFormat.OSM,
        ".csv": LotFormat.SLOT_LIST,
    }
    return by_suffix.get(suffix)


def load_lot(name_or_path: str | Path) -> ParkingLot:
    """Load a packaged lot by its name, or a lot file by its path.

    Raises:
        InputError: neither a packaged lot nor a file, or the file contains no valid lot (see `read_lot`).

    Examples:
        >>> load_lot("campus").n_slots
        189
    """
    if not isinstance(name_or_path, str | Path):
        raise InputError(f"lot is a {type(name_or_path).__name__}, want a packaged lot's name or a lot file")
    if str(name_or_path) in PACKAGED_LOTS:
        return packaged_lot(str(name_or_path))
    path = Path(name_or_path)
    if not is_there(path):
        raise InputError(f"{path}: no such file, nor a packaged lot ({', '.join(PACKAGED_LOTS)})")
    return read_lot(path)


PLACES = Path(__file__).parent / "places"
"""Folder with 24 real car parks, © OpenStreetMap contributors, ODbL (see its README)."""


def packaged_lot(name: str) -> ParkingLot:
    """Load a packaged lot: campus, jam, street, mini."""
    if name not in PACKAGED_LOTS:
        raise InputError(f"no packaged lot {name!r}, want one of {', '.join(PACKAGED_LOTS)}")
    with resources.as_file(resources.files("parkenv.lots") / "packaged" / f"{name}.geojson") as path:
        return read_lot(path)


def read_lot(path: str | Path) -> ParkingLot:
    """Read a lot from native GeoJSON (`.geojson`, `.json`) or a Dragon Lake map (`.yml`).

    Slots without exact properties take their shape from their polygons (`slots_from_polygons`).
    """
    return _read_whole(Path(path))[0]


def _read_whole(path: Path) -> tuple[ParkingLot, str]:
    """Return the lot of a file, and what was recognised of its positions."""
    file_format = lot_format(path)
    if file_format is LotFormat.DRAGON_LAKE:
        return dragon_lake_lot(path), ""
    contents = read_contents(path)
    if not contents.errors:
        try:
            return ParkingLot(**contents.columns()), contents.found
        except GraphError:
            pass
    errors = [*contents.errors, *graph_errors(contents)]
    first = str(errors[0]).removeprefix("error: ")
    if file_format is not None and not file_format.is_complete:
        raise InputError(f"{path}: {first}; `parkenv lot import {path}` makes a lot of it")
    more = f" (and {len(errors) - 1} more; `parkenv lot check {path}` lists all)" if len(errors) > 1 else ""
    raise InputError(f"{path}: {first}{more}")


def import_lot(path: str | Path, options: ImportOptions | None = None) -> LotDraft:
    """Draft a lot from a file of a real place.

    Supported formats are OpenStreetMap (`.osm`, `.xml`, also packed as `.gz` and `.bz2`, `.osm.pbf`,
    overpass-turbo GeoJSON; see `parkenv.lots.osm.draft`), lists of slot centres (`.csv`; see
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
    # What infers a lot takes longer to load than a search in a finished one.
    if file_format is LotFormat.OSM:
        from parkenv.lots.osm.draft import osm_draft

        return osm_draft(path, options)
    if file_format is LotFormat.SLOT_LIST:
        from parkenv.lots.formats.slot_list import slot_list_draft

        return slot_list_draft(path, options)
    if file_format is None:
        raise InputError(
            f"{path}: unknown kind of file {path.suffix!r}, want .osm, .xml or .pbf (OpenStreetMap), "
            ".json or .geojson (overpass-turbo, a native lot), .csv (slot centres) or a Dragon Lake .yml"
        )
    if options.bounds is not None:
        raise InputError(
            f"{path}: bounds apply to OpenStreetMap and lists of slots; this file is a whole lot"
        )
    lot, recognised = _read_whole(path)
    draft = LotDraft.of_lot(lot)
    if recognised:
        draft = replace(draft, found=(recognised, *draft.found))
    if options.goals:
        draft = replace(draft, goals=points_in_frame(None, options.goals), goal_weights={})
    if options.entries:
        draft = replace(draft, entries=points_in_frame(None, options.entries), entry_weights={})
    return draft
