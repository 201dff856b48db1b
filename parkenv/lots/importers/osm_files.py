"""Read OpenStreetMap files of any format."""

from __future__ import annotations

from pathlib import Path

from parkenv.lots.importers.osm_elements import OsmElement, read_elements
from parkenv.lots.importers.osm_pbf import read_pbf


def read_map(path: Path) -> list[OsmElement]:
    """Read all tagged nodes, ways and multipolygons of a file in PBF, XML or JSON.

    Raises:
        InputError: see `read_elements` and `read_pbf`.
    """
    return read_pbf(path) if path.suffix.lower() == ".pbf" else read_elements(path)
