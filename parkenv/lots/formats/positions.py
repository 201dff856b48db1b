"""Recognise what the positions of a GeoJSON file are: longitude and latitude, a map grid, or metres."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, with_extra
from parkenv.lots.local_frame import LocalFrame

if TYPE_CHECKING:
    from pyproj import Transformer

LARGEST_DEGREES = 0.05
"""Extent, degrees, that no outline of parking exceeds (5 km); in metres all are larger than that."""
USUAL_WIDTH = (1.2, 5.5)  # m, widths of parking spaces
_CRS = re.compile(
    r"(?:urn:ogc:def:crs:|https?://www\.opengis\.net/def/crs/)?(EPSG|OGC|ESRI)[:/].*?([A-Za-z0-9]+)"
)
_ADVICE = (
    'give the file "frame": "local" for metres, or "crs": '
    '{"type": "name", "properties": {"name": "EPSG:25832"}} with its own code for a map grid'
)


@dataclass(frozen=True)
class Positions:
    """What a file's pairs of numbers are.

    Attributes:
        in_metres: metres east and north in a frame of the file's own; else `to_lonlat` converts them to degrees.
        found: which map grid they are in, one line; else empty.
        frame: of a file in metres its own frame, with the middle at longitude and latitude 0.
    """

    in_metres: bool = False
    found: str = ""
    frame: LocalFrame | None = None
    _grid: Transformer | None = None

    @property
    def converts(self) -> bool:
        return self.frame is not None or self._grid is not None

    def to_lonlat(self, points: FloatArray) -> FloatArray:
        """Convert the file's positions, (n, 2), to longitude and latitude, degrees; of metres around (0, 0)."""
        if self.frame is not None:
            return self.frame.to_lonlat(points)
        if self._grid is None or not len(points):
            return points
        return np.column_stack(self._grid.transform(points[:, 0], points[:, 1]))

    @classmethod
    def of(cls, document: dict[str, Any], path: Path) -> Positions:
        """Recognise the positions of a FeatureCollection: by `frame`, by `crs`, else by their size, with a warning."""
        rings, spaces = _outlines(document)
        low, high = (
            f(np.concatenate([*rings, np.zeros((0 if rings else 1, 2))]), axis=0) for f in (np.min, np.max)
        )
        in_metres = cls(True, frame=LocalFrame(0.0, 0.0, tuple((0.5 * (low + high)).tolist())))
        if "frame" in document:
            return in_metres
        name = _crs_name(document.get("crs"))
        grid = None if name is None else _grid(name)
        if grid is not None:
            xy = np.concatenate([*rings, np.empty((0, 2))])
            there_and_back = grid[0].transform(*grid[0].transform(xy[:, 0], xy[:, 1]), direction="INVERSE")
            # Far beyond a grid's own area a projection repeats itself.
            if not np.allclose(there_and_back, xy.T, rtol=0.0, atol=1.0):
                raise InputError(
                    f"crs is {name!r:.80}, in which the positions lie nowhere on the globe; {_ADVICE}"
                )
            return cls(found=f"positions are in {grid[1]}, as the file's crs says", _grid=grid[0])
        # The smaller side: a ring across the date line is 360° long.
        if not rings or float(np.median([np.ptp(ring, axis=0).min() for ring in rings])) <= LARGEST_DEGREES:
            return cls()
        width, length = _usual_size(spaces) if spaces else (2.5, 5.0)
        if not USUAL_WIDTH[0] <= width <= USUAL_WIDTH[1]:
            raise InputError(
                f"parking spaces are {width:.3g} × {length:.3g} in the file's units, neither degrees nor metres"
                f"{' (feet?)' if USUAL_WIDTH[1] < width < 15.0 else ''}; {_ADVICE}"
            )
        said = "" if name is None else f", though crs is {name!r:.40}"
        taken = (
            f"positions are taken for metres{said}: as degrees, {high[0] - low[0]:.0f} × {high[1] - low[1]:.0f} of "
            f"them, no parking space would have the size of a car (as metres: {width:.1f} × {length:.1f} m)"
        )
        warnings.warn(f'{path}: {taken}; "frame": "local" in the file says so', stacklevel=4)
        return in_metres


def _outlines(document: dict[str, Any]) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return the outer rings of polygons, (k, 2), else all other positions, and those rings that are parking spaces."""
    rings: list[FloatArray] = []
    spaces: list[FloatArray] = []
    others: list[FloatArray] = []
    for feature in document["features"] if isinstance(document.get("features"), list) else ():
        geometry = feature.get("geometry") if isinstance(feature, dict) else None
        if not isinstance(geometry, dict):
            continue
        properties = feature["properties"] if isinstance(feature.get("properties"), dict) else {}
        coordinates, shape = geometry.get("coordinates"), geometry.get("type")
        try:
            ring = np.array([p[:2] for p in _line_of(shape, coordinates)], dtype=np.float64).reshape(-1, 2)
        except (TypeError, ValueError, LookupError, OverflowError):
            continue
        if not np.isfinite(ring).all() or not len(ring):
            continue
        (rings if shape in ("Polygon", "MultiPolygon") else others).append(ring)
        tags = properties["tags"] if isinstance(properties.get("tags"), dict) else properties
        if shape == "Polygon" and len(ring) > 3:
            kind = properties.get("kind", tags.get("amenity"))
            if kind in ("slot", "parking_space") or (kind is None and "building" not in tags):
                spaces.append(ring)
    return rings or ([np.concatenate(others)] if others else []), spaces


def _line_of(shape: object, coordinates: Any) -> Any:
    match shape:
        case "Polygon":
            return coordinates[0]
        case "MultiPolygon":
            return coordinates[0][0]
        case "Point":
            return [coordinates]
    return coordinates


def _usual_size(rings: Iterable[FloatArray]) -> tuple[float, float]:
    polygons = np.array([shapely.Polygon(ring) for ring in rings], dtype=object)
    corners = [shapely.get_coordinates(box) for box in shapely.minimum_rotated_rectangle(polygons)]
    sides = [np.sort(np.hypot(*np.diff(c[:3], axis=0).T)) for c in corners if len(c) == 5]
    width, length = np.median(sides, axis=0).tolist() if sides else (0.0, 0.0)
    return width, length


def _crs_name(crs: object) -> str | None:
    if crs is None:
        return None
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(name, str):
        raise InputError(
            f'crs is {crs!r:.80}, want {{"type": "name", "properties": {{"name": "EPSG:25832"}}}} or none'
        )
    return name


def _grid(name: str) -> tuple[Transformer, str] | None:
    """Return the transformation of a named system to WGS 84, and its title; None for longitude and latitude itself."""
    with with_extra(f"crs {name:.80}", "osm"):
        from pyproj import CRS, Transformer
        from pyproj.exceptions import CRSError

    match = _CRS.fullmatch(name)
    try:
        # Only codes: other texts may name files and pipelines.
        if match is None:
            raise CRSError("no code")
        code = ":".join(match.groups())
        if code in ("OGC:CRS84", "EPSG:4326"):
            return None
        system = CRS.from_user_input(code)
        return Transformer.from_crs(system, "OGC:CRS84", always_xy=True), f"{code} ({system.name})"
    except CRSError as error:
        raise InputError(
            f"crs is {name!r:.80}, want the code of a known system, such as EPSG:25832, or longitude and latitude "
            "and no crs (any GIS converts: save as EPSG:4326)"
        ) from error
