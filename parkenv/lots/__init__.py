"""Lots: read and write lot files, import real places, generate lots by rule, check lots.

`ParkingLot` is independent of file formats; the functions here create it from files and rules.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from parkenv.files.known_names import PACKAGED_LOTS
from parkenv.lots.checks import check_lot
from parkenv.lots.formats.contents import LotProblem
from parkenv.lots.formats.geojson import write_lot
from parkenv.lots.generators import city_lot, grid_lot
from parkenv.lots.lot_files import import_lot, load_lot, packaged_lot, read_lot

if TYPE_CHECKING:
    from parkenv.lots.town.draft import import_town

__all__ = [
    "PACKAGED_LOTS",
    "LotProblem",
    "check_lot",
    "city_lot",
    "grid_lot",
    "import_lot",
    "import_town",
    "load_lot",
    "packaged_lot",
    "read_lot",
    "write_lot",
]


def __getattr__(name: str) -> Any:
    if name == "import_town":
        # It takes longer to load than all the rest.
        from parkenv.lots.town.draft import import_town

        return import_town
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
