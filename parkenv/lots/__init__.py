"""Lots: read and write lot files, import real places, generate lots by rule, check lots.

`ParkingLot` is independent of file formats; the functions here create it from files and rules.
"""

from parkenv.files.known_names import PACKAGED_LOTS
from parkenv.lots.formats.contents import LotProblem
from parkenv.lots.formats.geojson import write_lot
from parkenv.lots.generators import city_lot, grid_lot
from parkenv.lots.lot_files import check_lot, import_lot, load_lot, packaged_lot, read_lot

__all__ = [
    "PACKAGED_LOTS",
    "LotProblem",
    "check_lot",
    "city_lot",
    "grid_lot",
    "import_lot",
    "load_lot",
    "packaged_lot",
    "read_lot",
    "write_lot",
]
