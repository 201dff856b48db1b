"""Lots in files: which reader a file needs, and the lots that come with the package."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import TypeVar

from parkenv.errors import InputError
from parkenv.lots.dragon_lake import dragon_lake_lot, is_dragon_lake
from parkenv.lots.geojson import graph_errors, read_contents
from parkenv.lots.places.lot_import import is_place
from parkenv.world.drive_graph import GraphError
from parkenv.world.lot import ParkingLot

LotT = TypeVar("LotT", bound=ParkingLot)

PACKAGED_LOTS = ("campus", "jam", "street", "mini")


def read_lot(cls: type[LotT], path: Path) -> LotT:
    """See `ParkingLot.from_file`.

    Slots without exact properties are taken from their polygons, see `slots_from_polygons`. The Dragon Lake
    map is read as `dragon_lake_lot` says.

    Raises:
        InputError: the first fault of the file, and how many more there are.
    """
    if is_dragon_lake(path):
        return dragon_lake_lot(cls, path)
    contents = read_contents(path)
    if not contents.errors:
        try:
            return cls(**contents.columns())
        except GraphError:
            pass
    errors = [*contents.errors, *graph_errors(contents)]
    first = str(errors[0]).removeprefix("error: ")
    if is_place(path):
        raise InputError(f"{path}: {first}; `parkenv lot import {path}` makes a lot of it")
    more = f" (and {len(errors) - 1} more; `parkenv lot check {path}` lists all)" if len(errors) > 1 else ""
    raise InputError(f"{path}: {first}{more}")


def packaged_lot(cls: type[LotT], name: str) -> LotT:
    """See `ParkingLot.packaged`.

    Raises:
        InputError: no lot of that name comes with the package.
    """
    if name not in PACKAGED_LOTS:
        raise InputError(f"no packaged lot {name!r}, want one of {', '.join(PACKAGED_LOTS)}")
    with resources.as_file(resources.files("parkenv.lots") / "packaged" / f"{name}.geojson") as path:
        return read_lot(cls, path)
