"""Read lot files that describe a whole lot, and the packaged lots."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from parkenv.errors import InputError
from parkenv.files.known_names import PACKAGED_LOTS
from parkenv.files.limited_reading import is_there
from parkenv.lots.formats.contents import graph_errors
from parkenv.lots.formats.dragon_lake import dragon_lake_lot
from parkenv.lots.formats.geojson import read_contents
from parkenv.lots.formats.recognition import LotFormat, lot_format
from parkenv.world.drive_graph import GraphError
from parkenv.world.lot import ParkingLot


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
"""Folder with the places of benchmark suites: real car parks, © OpenStreetMap contributors, ODbL (see its README)."""


def packaged_lot(name: str) -> ParkingLot:
    """Load a packaged lot: campus, jam, street, mini.

    Raises:
        InputError: an unknown name.
    """
    if name not in PACKAGED_LOTS:
        raise InputError(f"no packaged lot {name!r}, want one of {', '.join(PACKAGED_LOTS)}")
    with resources.as_file(resources.files("parkenv.lots") / "packaged" / f"{name}.geojson") as path:
        return read_lot(path)


def read_lot(path: str | Path) -> ParkingLot:
    """Read a lot from native GeoJSON (`.geojson`, `.json`) or a Dragon Lake map (`.yml`).

    Slots without exact properties take their shape from their polygons (`slots_from_polygons`).

    Raises:
        InputError: the file cannot be read or contains no valid lot; the message states the first fault and the
            number of further ones, and `parkenv.lots.check_lot` lists all.
    """
    path = Path(path)
    file_format = lot_format(path)
    if file_format is LotFormat.DRAGON_LAKE:
        return dragon_lake_lot(path)
    contents = read_contents(path)
    if not contents.errors:
        try:
            return ParkingLot(**contents.columns())
        except GraphError:
            pass
    errors = [*contents.errors, *graph_errors(contents)]
    first = str(errors[0]).removeprefix("error: ")
    if file_format is not None and not file_format.is_complete:
        raise InputError(f"{path}: {first}; `parkenv lot import {path}` makes a lot of it")
    more = f" (and {len(errors) - 1} more; `parkenv lot check {path}` lists all)" if len(errors) > 1 else ""
    raise InputError(f"{path}: {first}{more}")
