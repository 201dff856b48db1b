"""Read OpenStreetMap files of any format; PBF with the package osmium."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from parkenv.errors import InputError
from parkenv.files.limited_reading import is_there
from parkenv.lots.osm.elements import (
    OsmElement,
    RawElements,
    RawRelation,
    RawWay,
    is_area_relation,
    read_elements,
)

KEYS = ("amenity", "highway", "building", "entrance", "noexit")
"""Keys of the elements that an import reads."""


def read_map(path: Path) -> list[OsmElement]:
    """Read all tagged nodes, ways and multipolygons of a file in PBF, XML or JSON.

    Raises:
        InputError: see `read_elements` and `read_pbf`.
    """
    return read_pbf(path) if path.suffix.lower() == ".pbf" else read_elements(path)


def read_pbf(path: Path) -> list[OsmElement]:
    """Read the parking, roads, buildings and entrances of an extract.

    Raises:
        InputError: osmium is not installed, or the file cannot be read.
    """
    try:
        import osmium
    except ImportError as error:
        raise InputError(
            f"{path}: .osm.pbf is read with osmium; install it by: pip install 'parkenv[osm]'"
        ) from error
    if not is_there(path):
        raise InputError(f"{path}: No such file or directory")
    raw = RawElements()
    needed: set[int] = set()
    try:
        for relation in osmium.FileProcessor(str(path), osmium.osm.RELATION):
            tags = dict(relation.tags)
            if is_area_relation(tags):
                members = [(m.ref, m.role) for m in relation.members if m.type == "w"]
                raw.relations[relation.id] = RawRelation(tags, [(ref, role, None) for ref, role in members])
                needed.update(ref for ref, _ in members)
        for element in osmium.FileProcessor(str(path), osmium.osm.NODE | osmium.osm.WAY).with_locations():
            _add(raw, element, needed)
    except RuntimeError as error:
        raise InputError(f"{path}: not an OpenStreetMap extract: {error}") from error
    try:
        return raw.elements()
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _add(raw: RawElements, element: Any, needed: set[int]) -> None:
    wanted = any(key in element.tags for key in KEYS)
    if element.is_node():
        if wanted:
            location = element.location
            raw.add_node(element.id, (location.lon, location.lat), dict(element.tags))
    elif wanted or element.id in needed:
        # Nodes beyond the edge of an extract have no position.
        line = [(n.location.lon, n.location.lat) for n in element.nodes if n.location.valid()]
        raw.add_way(element.id, RawWay(dict(element.tags), [], np.array(line).reshape(-1, 2)))
