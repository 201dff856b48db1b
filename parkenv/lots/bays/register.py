"""Read a register of bays: points, outlines, or kerb lines with counts, in a table (CSV) or in GeoJSON.

Columns are known by usual names, or named by the user. Rows of one id at one place are one bay: their rules are joined;
a kerb line without a capacity has that of the most cars counted in a row. What is no bay is left out, by reason.
"""

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
import shapely
import shapely.geometry
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, IntArray
from parkenv.errors import InputError, naming, nearest, require
from parkenv.files.file_names import is_plain
from parkenv.files.limited_reading import csv_records, read_json, unpacked_path
from parkenv.files.option import columns_in
from parkenv.lots.formats.geojson import Positions

# Usual names of the columns of each part, without signs, the surest first; of `cars` and `class` all count.
SYNONYMS = {
    "bay": "bayid bay spaceid meterid meternumber postid markerid stmarkerid kerbsideid block blockid id objectid",
    "lat": "lat latitude y",
    "lon": "lon lng long longitude x",
    "line": "line geometry thegeom geom wkt shape latlng latlong location geopoint2d geopoint",
    "street": "blockface street streetname road roadname roadsegmentdescription rdsegdsc onstreet",
    "capacity": "capacity spaces stalls parkingspaces numberofspaces paidspaces",
    "cars": "cars carspaidspaces disabledplacard service vehicles occupiedspaces",
    "limit": "limit timelimit timelimitmin maxstay duration durationminutes",
    "rate": "rate fee price rateperhour priceperhour charge raterange",
    "hours": "hours policy parkingpolicy meteredhours paidhours operatinghours enforced daystimes",
    "class": "class typedesc type use restriction restrictiondisplay baytype spacetype description",
    "days": "days restrictiondays",
    "from_day": "fromday",
    "to_day": "today",
    "start": "start starttime timerestrictionsstart",
    "end": "end endtime timerestrictionsfinish",
    "disabled_limit": "disabledlimit disabilityext",
}
OF_RULES = tuple(SYNONYMS)[7:]
MOST_BYTES = 256_000_000  # of a register
Rule = tuple[tuple[str, str], ...]  # what a row says of a rule: pairs of one of `OF_RULES` and a text
Box = tuple[tuple[float, float], tuple[float, float]]  # two corners, latitude and longitude


@dataclass(frozen=True, eq=False)
class Register:
    """n bays or kerb lines."""

    ids: NDArray[np.object_]  # (n,) unique texts, to the letter
    shapes: NDArray[np.object_]  # (n,) Point, Polygon or LineString, degrees, longitude first
    streets: NDArray[np.object_]  # (n,) names; empty: not given
    capacity: IntArray  # (n,) number of slots: 1 but at kerb lines
    rules: NDArray[np.object_]  # (n,) tuples of `Rule`
    left_out: Mapping[str, Sequence[str]]  # ids, or rows without one, by reason
    found: tuple[str, ...]  # which columns are what, and where capacities come from

    def part(self, kept: BoolArray, reason: str = "") -> Self:
        """Return the bays kept; the others are left out for a reason, if there is one."""
        columns = ("ids", "shapes", "streets", "capacity", "rules")
        lost = {reason: self.ids[~kept].tolist()} if reason else {}
        own = {name: getattr(self, name)[kept] for name in columns}
        return replace(self, left_out={**self.left_out, **lost}, **own)

    def within(self, box: Box) -> Self:
        at = shapely.get_coordinates(shapely.centroid(self.shapes))[:, ::-1]
        inside = ((at >= np.min(box, axis=0)) & (at <= np.max(box, axis=0))).all(axis=1)
        require(
            inside.any(), f"no bay of the register lies within latitudes and longitudes {box[0]} to {box[1]}"
        )
        return self.part(inside)

    def box(self, margin: float) -> Box:
        """Return a box around the bays, without those a degree from most others, with a margin, degrees of latitude."""
        at = shapely.get_coordinates(shapely.centroid(self.shapes))[:, ::-1]
        at = at[(np.abs(at - np.median(at, axis=0)) <= 1.0).all(axis=1)]
        wide = np.array([margin, margin / max(np.cos(np.radians(at[0, 0])), 0.1)])
        low, high = (at.min(axis=0) - wide).round(5), (at.max(axis=0) + wide).round(5)
        return (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))


def read_bays(path: str | Path, columns: str | None = None) -> Register:
    """Read a register of bays, `.csv`, `.json` or `.geojson`, also packed as `.gz` and `.bz2`.

    Names of `columns` are by part (`SYNONYMS`), see `columns_in`.
    """
    path = Path(path)
    with naming(path):
        records = list(_records(path))
        require(records, "has no bay, want a row or a feature for each")
        names = list(dict.fromkeys(name for _, record, _ in records for name in record))
        own = dict(_usual(tuple(names)))
        for part, chosen in columns_in(columns).items():
            own[part] = chosen
            for name, known in ((part, list(SYNONYMS)), *((name, names) for name in chosen)):
                if name not in known:
                    raise InputError(f"--columns has {name!r:.40}; {nearest(name, known)}")
        require(
            own.keys() & {"line", "lat"} or unpacked_path(path).suffix.lower() != ".csv",
            f"no position in its columns {', '.join(names)[:400]}; want --columns bay=ID,lat=LATITUDE,"
            "lon=LONGITUDE or line=POSITIONS",
        )
        return _register(records, own)


# The name of a row, its columns, and the geometry of a feature, degrees, or None.
_Record = tuple[str, dict[str, Any], Any]


def _records(path: Path) -> Iterator[_Record]:
    if unpacked_path(path).suffix.lower() == ".csv":
        yield from ((f"line {line}", dict(record), None) for line, record in csv_records(path, MOST_BYTES))
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
        if "id" in feature:
            record.setdefault("id", feature["id"])
        shape = None
        with suppress(
            AttributeError, TypeError, ValueError, LookupError, OverflowError, shapely.errors.ShapelyError
        ):
            shape = shapely.transform(shapely.geometry.shape(feature["geometry"]), to_lonlat)
        yield f"feature {index}", record, shape


@lru_cache(maxsize=256)
def _usual(names: tuple[str, ...]) -> Mapping[str, list[str]]:
    """Return the columns of each part by their usual names."""
    found = {}
    for part, known in SYNONYMS.items():
        plain = {re.sub(r"[^a-z0-9]", "", name.lower()): name for name in reversed(names)}
        if ranked := [plain[name] for name in known.split() if name in plain]:
            found[part] = ranked[: None if part in ("cars", "class") else 1]
    return found


def _text(record: Mapping[str, Any], names: Sequence[str]) -> str:
    values = (record.get(name) for name in names)
    values = (int(value) if isinstance(value, float) and value.is_integer() else value for value in values)
    return " ".join(str(value).strip() for value in values if value is not None).strip()


def _register(records: Sequence[_Record], columns: Mapping[str, list[str]]) -> Register:
    left_out: dict[str, list[str]] = defaultdict(list)
    shapes: dict[str, Any] = {}
    rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for where, record, given in records:
        name = _text(record, columns["bay"]) if "bay" in columns else where
        shape, reason = _simple(_shape_in(record, columns) if given is None else given)
        if not name or not is_plain(name):
            name, reason = where, "bays without an id"
        elif name in shapes and shape is not None and not shapely.equals_exact(shapes[name], shape, 1e-7):
            reason = "bays whose id is that of another place"
        if reason:
            left_out[reason].append(name)
        else:
            shapes.setdefault(name, shape)
            rows[name].append(record)
    is_line = [shape.geom_type == "LineString" for shape in shapes.values()]
    counted = columns.get("capacity") or columns.get("cars") or []
    found = [f"register: {', '.join(f'{part}: ' + '+'.join(own) for part, own in columns.items())}"]
    if any(is_line) and "capacity" not in columns:
        found.append("capacity of kerb lines, which is not given: the most cars in any row")
    register = Register(
        _objects(shapes),
        _objects(shapes.values()),
        _objects(_text(own[0], columns.get("street", ())) for own in rows.values()),
        np.array(
            [_capacity(own, counted) if line else 1 for own, line in zip(rows.values(), is_line, strict=True)]
        ),
        _objects(_rules(own, columns) for own in rows.values()),
        left_out,
        tuple(found),
    )
    register = register.part(register.capacity > 0, "kerb lines without a capacity, where no car was counted")
    if not len(register.ids):
        reasons = "; ".join(f"{reason}: {len(ids)}" for reason, ids in register.left_out.items() if ids)
        raise InputError(f"no bay in it ({reasons})")
    return register


def _objects(values: Iterable[Any]) -> NDArray[np.object_]:
    listed = list(values)
    array = np.empty(len(listed), object)
    array[:] = listed
    return array


def _shape_in(record: Mapping[str, Any], columns: Mapping[str, list[str]]) -> Any:
    """Return the geometry of a row, degrees, or None: well-known text, pairs of latitude and longitude, or columns."""
    text = _text(record, columns.get("line", ()))
    numbers = (_text(record, columns.get(part, ())).replace(",", ".") for part in ("lon", "lat"))
    with suppress(ValueError, shapely.errors.ShapelyError):
        if re.match(r"[A-Za-z]", text):
            return shapely.from_wkt(text)
        pairs = np.array(re.findall(r"-?\d+(?:\.\d+)?", text), np.float64).reshape(-1, 2)[:, ::-1]
        if len(pairs) > 1:
            return shapely.LineString(pairs)
        return shapely.Point(pairs[0] if len(pairs) else list(map(float, numbers)))
    return None


def _simple(shape: Any) -> tuple[Any, str]:
    """Return a shape in one part and in the plane, and why it is no place of a bay, or empty text."""
    shape = shapely.force_2d(shape)
    shape = shapely.line_merge(shape) if shapely.get_type_id(shape) == 5 else shape  # a MultiLineString
    if shape is not None and shapely.get_num_geometries(shape) == 1:
        shape = shapely.get_geometry(shape, 0)
    bounds = np.array([np.nan] if shape is None else shape.bounds)
    if shape is None or not (np.abs(bounds) <= [360.0, 90.0, 360.0, 90.0]).all() or not bounds.any():
        return None, "bays without a position"
    if shape.geom_type not in ("Point", "LineString", "Polygon"):
        return None, "bays of several parts"
    if not shape.is_valid:
        return None, "outlines that cross themselves"
    is_flat = shape.geom_type == "Polygon" and shape.area < 1e-11  # degrees², some 0.1 m²
    return shape, "outlines without an area" if is_flat else ""


def _capacity(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> int:
    counts = [[re.match(r"\d+", _text(row, [name])) for name in names] for row in rows]
    return min(max(sum(int(count[0][:4]) for count in own if count) for own in counts), 1_000)


def _rules(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, list[str]]) -> tuple[Rule, ...]:
    """Return the rules of rows, of their columns and of lists of objects in them."""
    rules: dict[Rule, None] = {}
    for row in rows:
        listed = (each for value in row.values() if isinstance(value, list) for each in value)
        given = [(row, columns), *((each, _usual(tuple(each))) for each in listed if isinstance(each, dict))]
        for record, own in given:
            texts = ((part, _text(record, own.get(part, ()))) for part in OF_RULES)
            rules[tuple((part, text) for part, text in texts if text)] = None
    return tuple(rule for rule in rules if rule)
