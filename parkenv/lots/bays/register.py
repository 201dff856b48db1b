"""Read a register of bays: points, outlines, or kerb lines with counts, in a table (CSV) or in GeoJSON.

A column is known by a usual name (`SYNONYMS`) or is named by the user. Rows of one id at one place are one bay: their
rules are joined, and of counts of cars at a kerb line without a capacity the largest one is its capacity. What is no
bay is left out, by reason.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
import shapely
import shapely.geometry
from numpy.typing import NDArray

from parkenv.compiled.arrays import IntArray
from parkenv.errors import InputError, naming, nearest
from parkenv.files.file_names import is_plain
from parkenv.files.limited_reading import csv_records, read_json, unpacked_path
from parkenv.lots.formats.geojson import Positions
from parkenv.lots.local_frame import LocalFrame

SYNONYMS = {
    "bay": "bay_id bay space_id meter_id meter_number post_id marker_id st_marker_id kerbside_id blockface block_id block "
    "block_face_id element_key sensor_id id objectid fid",
    "lat": "lat latitude y y_coord", "lon": "lon lng long longitude x x_coord",
    "line": "line geometry the_geom geom wkt shape geo_shape latlng lat_lng location geo_point_2d geo_point geopoint",
    "street": "block_face street street_name road road_name road_segment_description rd_seg_dsc on_street name",
    "capacity": "capacity spaces stalls parking_spaces number_of_spaces paid_spaces",
    "cars": "cars cars_paid_spaces disabled_placard service vehicles occupied_spaces",
    "limit": "limit time_limit time_limit_min max_stay maxstay duration duration_minutes",
    "rate": "rate fee price rate_per_hour price_per_hour charge rate_range",
    "hours": "hours policy parking_policy metered_hours hours_charged paid_hours operating_hours enforced days_times",
    "class": "class type_desc type category use restriction restriction_display bay_type space_type description",
    "days": "days restriction_days", "from_day": "from_day fromday", "to_day": "to_day today",
    "start": "start start_time time_restrictions_start", "end": "end end_time time_restrictions_finish",
    "disabled_limit": "disability_ext disabled_limit",
}  # fmt: skip
"""Usual names of the columns of each part of a register, the surest first; case and signs do not matter."""
OF_RULES = ("limit", "rate", "hours", "class", "days", "from_day", "to_day", "start", "end", "disabled_limit")
MOST_BYTES = 256_000_000  # of a register
NO_POSITION, NO_ID, TWICE = "bays without a position", "bays without an id", "bays whose id is that of another place"
CROSSED, NO_AREA, PARTS = "outlines that cross themselves", "outlines without an area", "bays of several parts"
NO_CAPACITY = "kerb lines without a capacity, where no car was counted"
SMALLEST = 1e-11  # degrees², some 0.1 m², an outline that is none

Rule = tuple[tuple[str, str], ...]
"""What a row says of a rule: pairs of a key of `OF_RULES` and a text."""


@dataclass(frozen=True, eq=False)
class Register:
    """n bays or kerb lines, each id once."""

    ids: tuple[str, ...]  # to the letter
    shapes: NDArray[np.object_]  # (n,) Point, Polygon or LineString, degrees, longitude first
    streets: tuple[str, ...]  # names; empty: not given
    capacity: IntArray  # (n,) number of slots: 1 but at kerb lines
    rules: tuple[tuple[Rule, ...], ...]  # those of each bay
    left_out: Mapping[str, Sequence[str]]  # ids, or rows without one, by reason
    found: tuple[str, ...]  # which columns are what, and where capacities come from


    def within(self, south: float, west: float, north: float, east: float) -> Self:
        """Return the bays of a box, degrees; others are no bays of the place."""
        lon, lat = shapely.get_coordinates(shapely.centroid(self.shapes)).T
        index = np.flatnonzero((lat >= south) & (lat <= north) & (lon >= west) & (lon <= east))
        names = ("ids", "streets", "rules")
        own = {name: tuple(getattr(self, name)[i] for i in index.tolist()) for name in names}
        return replace(self, shapes=self.shapes[index], capacity=self.capacity[index], **own)

    def box(self, margin: float) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the corners, latitude and longitude, of a box around the bays with a margin, m.

        Bays more than a degree from most others are taken for errors.
        """
        at = shapely.get_coordinates(shapely.centroid(self.shapes))
        at = at[(np.abs(at - np.median(at, axis=0)) <= 1.0).all(axis=1)]
        corners = LocalFrame.around(at)
        low, high = corners.to_xy(at).min(axis=0) - margin, corners.to_xy(at).max(axis=0) + margin
        (west, south), (east, north) = corners.to_lonlat([low, high]).round(6).tolist()
        return (south, west), (north, east)


def read_bays(path: str | Path, columns: Mapping[str, str] | None = None) -> Register:
    """Read a register of bays.

    Args:
        path: `.csv`, `.json` or `.geojson`, also packed as `.gz` and `.bz2`.
        columns: names of columns by part (`SYNONYMS`); several that are added up are joined by `+`.

    Raises:
        InputError: the file cannot be read, or has no column of positions.
    """
    path = Path(path)
    with naming(path):
        named, records = dict(columns or {}), list(_records(path))
        if not records:
            raise InputError("has no bay, want a row or a feature for each")
        names = list(dict.fromkeys(name for _, record, _ in records for name in record))
        columns_of = _columns(names, named, any(shape is not None for _, _, shape in records))
        return _register(records, columns_of)


_Record = tuple[str, dict[str, Any], Any]
"""The name of a row, its columns, and its geometry, degrees; None in a table, and of a feature without a valid one."""


def _records(path: Path) -> Iterator[_Record]:
    if unpacked_path(path).suffix.lower() == ".csv":
        for line, record in csv_records(path, MOST_BYTES):
            yield f"line {line}", dict(record), None
        return
    document = read_json(path, MOST_BYTES)
    features = document.get("features") if isinstance(document, dict) else None
    if not isinstance(features, list):
        raise InputError("no features, want a GeoJSON FeatureCollection, or a table (.csv)")
    to_lonlat = Positions.of(document).to_lonlat
    for index, feature in enumerate(features):
        feature = feature if isinstance(feature, dict) else {}
        properties = feature.get("properties")
        record = dict(properties) if isinstance(properties, dict) else {}
        if isinstance(feature.get("id"), str | int):
            record.setdefault("id", feature["id"])
        yield f"feature {index}", record, _geometry(feature.get("geometry"), to_lonlat)


def _geometry(given: Any, to_lonlat: Any) -> Any:
    try:
        shape = shapely.transform(shapely.force_2d(shapely.geometry.shape(given)), to_lonlat)
        return shapely.get_geometry(shape, 0) if shapely.get_num_geometries(shape) == 1 else shape
    except (AttributeError, TypeError, ValueError, LookupError, OverflowError, shapely.errors.ShapelyError):
        return None


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


_KNOWN = {part: [_plain(name) for name in names.split()] for part, names in SYNONYMS.items()}


@lru_cache(maxsize=256)
def _ranked(names: tuple[str, ...]) -> Mapping[str, list[str]]:
    """Return the columns of each part by usual names: the surest one, but all that count cars or name a class."""
    found = {}
    for part, known in _KNOWN.items():
        ranked = sorted((known.index(_plain(name)), name) for name in names if _plain(name) in known)
        if ranked:
            found[part] = [name for _, name in ranked[: None if part in ("cars", "class") else 1]]
    return found


def _columns(names: Sequence[str], named: dict[str, str], has_shapes: bool) -> dict[str, list[str]]:
    found = dict(_ranked(tuple(names)))
    for part, text in named.items():
        if part not in SYNONYMS:
            raise InputError(f"--columns: no part {part!r:.40} of a register; {nearest(part, SYNONYMS)}")
        found[part] = text.split("+")
        for name in found[part]:
            if name not in names:
                raise InputError(f"--columns: no column {name!r:.40}; {nearest(name, names)}")
    if not has_shapes and not ("line" in found or {"lat", "lon"} <= found.keys()):
        raise InputError(
            f"no position in its columns {', '.join(names)[:400]}; name them by --columns lat=COLUMN,lon=COLUMN or "
            "line=COLUMN (and bay=COLUMN, the id)"
        )
    return found


def _register(records: Sequence[_Record], columns: dict[str, list[str]]) -> Register:
    left_out: dict[str, list[str]] = {}
    rows: dict[str, list[dict[str, Any]]] = {}
    shapes: dict[str, Any] = {}
    for where, record, shape in records:
        name = _text(record, columns.get("bay", ())) if "bay" in columns else where
        if not name or not is_plain(name):
            left_out.setdefault(NO_ID, []).append(where)
            continue
        shape = _shape_in(record, columns) if shape is None else shape
        reason = _fault(shape) if shape is not None else NO_POSITION
        if reason is None and name in shapes and not shapely.equals_exact(shapes[name], shape, 1e-7):
            reason = TWICE
        if reason is not None:
            left_out.setdefault(reason, []).append(name)
            continue
        shapes.setdefault(name, shapely.line_merge(shape) if "Line" in shape.geom_type else shape)
        rows.setdefault(name, []).append(record)
    names = list(rows)
    is_line = np.array([shape.geom_type == "LineString" for shape in shapes.values()], bool)
    capacity = np.array(
        [_capacity(rows[name], columns) if line else 1 for name, line in zip(names, is_line, strict=True)], np.int64
    )
    left_out.setdefault(NO_CAPACITY, []).extend(names[k] for k in np.flatnonzero(capacity == 0).tolist())
    kept = np.flatnonzero(capacity > 0).tolist()
    found = [f"register: {', '.join(f'{part}: ' + '+'.join(own) for part, own in columns.items())}"]
    if is_line.any() and "capacity" not in columns:
        found.append("capacity of kerb lines, which is not given: the most cars in any row")
    return Register(
        tuple(names[k] for k in kept),
        np.array(list(shapes.values()), dtype=np.object_)[kept],
        tuple(_text(rows[names[k]][0], columns.get("street", ())) for k in kept),
        capacity[kept],
        tuple(_rules(rows[names[k]], columns) for k in kept),
        left_out,
        tuple(found),
    )


def _text(record: Mapping[str, Any], names: Sequence[str]) -> str:
    texts = (record.get(name) for name in names)
    texts = (str(int(text)) if isinstance(text, float) and text.is_integer() else text for text in texts)
    return " ".join(str(text).strip() for text in texts if text is not None).strip()


def _shape_in(record: Mapping[str, Any], columns: dict[str, list[str]]) -> Any:
    """Return the geometry of a row of a table, degrees, or None: well-known text, GeoJSON, pairs of lat and lon."""
    numbers = [_text(record, columns.get(part, ())).replace(",", ".") for part in ("lon", "lat")]
    text = _text(record, columns.get("line", ()))
    try:
        if text[:1] == "{":
            return shapely.from_geojson(text)
        if re.match(r"[A-Za-z]", text):
            return shapely.force_2d(shapely.from_wkt(text))
        if text:
            pairs = np.array(re.findall(r"-?\d+(?:\.\d+)?", text), np.float64).reshape(-1, 2)[:, ::-1]
            return shapely.Point(pairs[0]) if len(pairs) == 1 else shapely.LineString(pairs)
        return shapely.Point(*map(float, numbers))
    except (ValueError, IndexError, shapely.errors.ShapelyError):
        return None


def _fault(shape: Any) -> str | None:
    low_x, low_y, high_x, high_y = shape.bounds if not shape.is_empty else (np.nan,) * 4
    if not (low_x >= -360.0 and high_x <= 360.0 and low_y >= -90.0 and high_y <= 90.0) or (
        low_x == high_x == low_y == high_y == 0.0
    ):
        return NO_POSITION
    if shape.geom_type in ("Point", "LineString"):
        return None
    if shape.geom_type == "MultiLineString":
        return None if shapely.line_merge(shape).geom_type == "LineString" else PARTS
    if shape.geom_type != "Polygon":
        return PARTS
    if not shape.is_valid:
        return CROSSED
    return NO_AREA if shape.area < SMALLEST else None


def _capacity(rows: Sequence[dict[str, Any]], columns: dict[str, list[str]]) -> int:
    names = columns.get("capacity") or columns.get("cars") or ()
    numbers = [re.findall(r"\d+(?:\.\d+)?", _text(row, [name])) for row in rows for name in names]
    counts = [float(found[0]) if found else 0.0 for found in numbers]
    totals = np.array(counts).reshape(len(rows), -1).sum(axis=1)
    return int(min(totals.max(initial=0.0), 1_000.0))


def _rules(rows: Sequence[dict[str, Any]], columns: dict[str, list[str]]) -> tuple[Rule, ...]:
    """Return the rules of rows: of their columns, of numbered ones (`duration1`, ...), and of lists of objects."""
    own = {part: columns[part] for part in OF_RULES if part in columns}
    rules: dict[Rule, None] = {}
    for row in rows:
        listed = [each for value in row.values() if isinstance(value, list) for each in value]
        given = [(row, own), *((row, parts) for parts in _numbered(tuple(row)))]
        given += [(each, _ranked(tuple(each))) for each in listed if isinstance(each, dict)]
        for record, parts in given:
            texts = ((part, _text(record, parts.get(part, ()))) for part in OF_RULES)
            if rule := tuple((part, text) for part, text in texts if text):
                rules[rule] = None
    return tuple(rules)


@lru_cache(maxsize=256)
def _numbered(names: tuple[str, ...]) -> list[dict[str, list[str]]]:
    """Return the columns of rules whose names end in the same digit, by part, for each digit."""
    of_digit = [{name[:-1]: name for name in names if name.endswith(digit)} for digit in "123456789"]
    parts = [{part: [own[name] for name in its] for part, its in _ranked(tuple(own)).items()} for own in of_digit]
    return [own for own in parts if not own.keys().isdisjoint(OF_RULES)]
