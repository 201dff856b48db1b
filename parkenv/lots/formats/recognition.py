"""The formats of files that lots are read from or imported from."""

from __future__ import annotations

from enum import Enum
from pathlib import Path

from parkenv.errors import InputError
from parkenv.files.limited_reading import read_json
from parkenv.lots.osm.elements import holds_osm


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
    suffix = path.suffix.lower()
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
