"""Read and write native lot files (GeoJSON), and collect all errors of a file.

The native file is a GeoJSON FeatureCollection with the additional members
`"parkenv": {"format": "lot", "version": 1}`, `"name"` and `"frame": "local"` (metres). Without
`frame`, positions are longitude and latitude (RFC 7946) or those of the map grid that `crs` names, and are projected
to metres east and north of the centre of the features. `properties.kind` is the kind of a feature:

| kind | geometry | properties |
|---|---|---|
| `slot` | Polygon | `id`; `parking_cost_s`, 0 if absent; `zone` and `facility`, none if absent; all or none of \
`center`, `yaw`, `length`, `width`, `mouth` (rear, left, right) |
| `lane` | LineString | `oneway`, false if absent; `speed`, multiple of the driving speed, 1 if absent |
| `entry`, `goal` | Point | `weights`, numbers by purpose, none if absent |
| `wall` | LineString or Polygon | |
| `turn` | LineString: on the lane before, the junction, on the lane after | `only`: false if absent, cars may not \
make it; true: they may make no other |
| `facility` | Point | `name`, `type` (kerb, lot, garage), `zone`; a counted one `capacity`, `gate_s`, `inside_s`, \
`known` (nothing, sign, live), `delay_s` |

The member `traffic` is `left` where cars keep to the left; `zones` has the rules of zones by name
(`parkenv.lots.formats.contents`).

A file made by an import may have the member `import`: its source, what was guessed, and what may be wrong with it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, require, with_extra
from parkenv.files.atomic_write import check_writable, write_text
from parkenv.files.file_names import is_plain
from parkenv.files.limited_reading import read_json
from parkenv.lots.draft import Provenance
from parkenv.lots.formats.contents import (
    KINDS,
    SLOT_SHAPE,
    LotContents,
    RawFeature,
    facility_properties,
    read_facilities,
    read_slots,
    read_weights,
    read_zones,
    zone_document,
)
from parkenv.lots.local_frame import LocalFrame
from parkenv.world.lot import FARTHEST, Lane, Mouth, ParkingLot, Turn, is_building

LOT_VERSION = 1


def write_lot(
    lot: ParkingLot,
    path: str | Path,
    provenance: Provenance | None = None,
    *,
    members: Mapping[str, Any] | None = None,
    of_slots: Sequence[Mapping[str, Any]] = (),
) -> None:
    """Write a lot as native GeoJSON, atomically; `read_lot` restores it exactly.

    Args:
        lot: the lot.
        path: the file.
        provenance: what an import guessed, kept in the member `import`.
        members: further members of the file, which readers of lots pass over.
        of_slots: further properties of each slot.
    """
    path = Path(path)
    _check_suffix(path)
    head: dict[str, Any] = {
        "type": "FeatureCollection",
        "name": lot.name,
        "parkenv": {"format": "lot", "version": LOT_VERSION},
        "frame": "local",
    }
    if lot.left_hand:
        head["traffic"] = "left"
    if provenance is not None:
        head["import"] = provenance.document()
    if lot.zone_rules:
        head["zones"] = {name: zone_document(zone) for name, zone in lot.zone_rules.items()}
    head |= members or {}
    features = [*_features(lot)]
    for feature, properties in zip(features, of_slots, strict=False):  # slots come first
        feature["properties"] |= properties
    write_features(path, head, features)


def write_features(path: Path, head: Mapping[str, Any], features: Iterable[Mapping[str, Any]]) -> None:
    """Write a FeatureCollection with other members, atomically, a line for each feature."""
    lines = ",\n".join(map(json.dumps, features))
    write_text(path, f'{json.dumps(head)[:-1]},\n"features": [\n{lines}\n]}}\n')


def check_lot_output(path: Path) -> None:
    _check_suffix(path)
    check_writable(path)


def _check_suffix(path: Path) -> None:
    require(path.suffix.lower() in (".geojson", ".json"), f"{path}: a lot is written as .geojson or .json")


def _features(lot: ParkingLot) -> Iterator[dict[str, Any]]:
    def feature(geometry: str, coordinates: object, **properties: object) -> dict[str, Any]:
        shape = {"type": geometry, "coordinates": coordinates}
        return {"type": "Feature", "properties": properties, "geometry": shape}

    rings = np.round(lot.slot_corners()[:, [0, 1, 2, 3, 0]], 3).tolist()
    shapes = (lot.slot_xy, lot.slot_yaw, lot.slot_length, lot.slot_width)
    exact = zip(
        *(column.tolist() for column in shapes), (Mouth(m).name.lower() for m in lot.slot_mouth), strict=True
    )
    more = zip(
        lot.slot_parking_cost_s.tolist(), lot.slot_zone.tolist(), lot.slot_facility.tolist(), strict=True
    )
    slots = zip(lot.slot_ids, rings, exact, more, lot.is_counted.tolist(), strict=True)
    for slot_id, ring, shape, own, is_counted in slots:
        if not is_counted:  # else its facility says all of it
            named = zip(("parking_cost_s", "zone", "facility"), own, strict=True)
            given = {name: value for name, value in named if value} | dict(
                zip(SLOT_SHAPE, shape, strict=True)
            )
            yield feature("Polygon", [ring], kind="slot", id=slot_id, **given)
    for lane in lot.lanes:
        given = {} if lane.speed == 1.0 else {"speed": lane.speed}
        yield feature("LineString", lane.points.tolist(), kind="lane", oneway=lane.oneway, **given)
    for kind, points, weights in (
        ("entry", lot.entries, lot.entry_weights),
        ("goal", lot.goals, lot.goal_weights),
    ):
        for i, xy in enumerate(points.tolist()):
            given = (
                {"weights": {name: float(weight[i]) for name, weight in weights.items()}} if weights else {}
            )
            yield feature("Point", xy, kind=kind, **given)
    order = np.argsort(lot.facility_of_slot, kind="stable")
    ends = np.searchsorted(lot.facility_of_slot[order], range(len(lot.facilities) + 1)).tolist()
    for place, (start, end) in zip(lot.facilities, pairwise(ends), strict=True):
        xy = place.xy or lot.slot_xy[order[start:end]].mean(axis=0).tolist()
        yield feature("Point", list(xy), kind="facility", **facility_properties(place))
    for wall in lot.walls:
        if is_building(wall):
            yield feature("Polygon", [wall.tolist()], kind="wall")
        else:
            yield feature("LineString", wall.tolist(), kind="wall")
    for turn in lot.turns:
        yield feature("LineString", turn.points.tolist(), kind="turn", only=turn.only)


# ---- reading: all errors are collected, so nothing below raises out of `read_contents` ----


def read_contents(path: Path) -> LotContents:
    """Read all valid features of a file, and record all errors. Does not raise."""
    contents = LotContents(path.stem)
    try:
        require(
            path.suffix.lower() in (".geojson", ".json"),
            f"unknown kind of file {path.suffix!r}, want .geojson, .json or a Dragon Lake .yml",
        )
        document = read_json(path)
        contents.name = _check_head(document, path.stem)
        system = Positions(True) if "frame" in document else Positions.of(document)
        contents.found = system.found
        traffic = document.get("traffic", "right")
        require(traffic in ("left", "right"), f"traffic is {traffic!r:.40}, want 'left' or 'right'")
        contents.left_hand = traffic == "left"
        contents.zone_rules = read_zones(document.get("zones", {}))
    except InputError as error:
        contents.error(None, str(error).removeprefix(f"{path}: "))
        return contents

    raw: list[RawFeature] = []
    positions: list[tuple[float, float]] = []
    kinds_seen: set[object] = set()
    for number, feature in enumerate(document["features"]):
        mark = len(positions)
        try:
            raw.append(_check_feature(number, feature, positions, kinds_seen))
        except InputError as error:
            del positions[mark:]
            contents.error(number, str(error))
    for kind in ("slot", "lane", "entry", "goal"):
        if kind not in kinds_seen | ({"slot"} if "facility" in kinds_seen else set()):
            contents.error(None, f"no {kind}: an empty lot, want at least one feature of kind {kind!r}")

    xy = np.array(positions, dtype=np.float64).reshape(-1, 2)
    if not system.in_metres:
        xy = system.to_lonlat(xy)
        off_globe = np.flatnonzero((np.abs(xy) > (180.0, 90.0)).any(axis=1))
        if len(off_globe):
            number = next(f.number for f in raw if any(p.stop > off_globe[0] for p in f.parts))
            lon, lat = xy[off_globe[0]].tolist()
            contents.error(
                number,
                f"position [{lon:g}, {lat:g}] is no longitude and latitude; "
                'for metres, the file needs the member "frame": "local", for a map grid "crs"',
            )
            return contents
        if len(xy):
            contents.frame = LocalFrame.around(xy)
            xy = contents.frame.to_xy(xy)

    for feature in raw:
        if feature.kind not in ("slot", "facility"):
            _add_feature(contents, feature, [xy[part] for part in feature.parts])
    read_facilities(contents, [feature for feature in raw if feature.kind == "facility"], xy)
    read_slots(contents, [feature for feature in raw if feature.kind == "slot"], xy, exact=system.in_metres)
    contents.errors.sort(key=lambda problem: -1 if problem.feature is None else problem.feature)
    return contents


_OPTIONS = {"lane": (Lane, ("oneway", "speed")), "turn": (Turn, ("only",))}
"""Classes of features that are lines, and their properties, which all may be absent."""


def _add_feature(contents: LotContents, feature: RawFeature, parts: list[FloatArray]) -> None:
    lists: dict[str, list[Any]] = {
        "lane": contents.lanes,
        "turn": contents.turns,
        "entry": contents.entries,
        "goal": contents.goals,
    }
    try:
        if feature.kind == "wall":
            contents.walls += parts
        elif feature.kind in _OPTIONS:
            made, names = _OPTIONS[feature.kind]
            given = {name: value for name in names if (value := feature.properties.get(name)) is not None}
            lists[feature.kind].append(made(parts[0], **given))
        else:
            contents.weights[feature.kind].append(read_weights(feature))
            lists[feature.kind].append(parts[0][0])
    except InputError as error:
        contents.error(feature.number, str(error))
    else:
        contents.numbers[feature.kind].append(feature.number)


def _check_head(document: Any, stem: str) -> str:
    if isinstance(document, dict) and "elements" in document:
        raise InputError("holds Overpass JSON, want XML (`[out:xml]`) or overpass-turbo's GeoJSON")
    if not isinstance(document, dict) or document.get("type") != "FeatureCollection":
        kind = document.get("type") if isinstance(document, dict) else type(document).__name__
        raise InputError(f"type is {kind!r:.40}, want a GeoJSON 'FeatureCollection'")
    if not isinstance(document.get("features"), list):
        raise InputError(f"features is {document.get('features')!r:.40}, want a list of features")
    header = document.get("parkenv", {"format": "lot", "version": LOT_VERSION})
    if not isinstance(header, dict) or header.get("format") != "lot":
        raise InputError(f'parkenv is {header!r:.60}, want {{"format": "lot", "version": {LOT_VERSION}}}')
    version: Any = header.get("version")
    require(type(version) is int and version >= 1, f"parkenv.version is {version!r:.40}, want {LOT_VERSION}")
    if version > LOT_VERSION:
        raise InputError(f"parkenv.version is {version}, want {LOT_VERSION}: made by a newer parkenv")
    name = document.get("name", stem)
    if not isinstance(name, str) or not is_plain(name):
        raise InputError(f"name is {name!a:.40}, want a text without control characters")
    if document.get("frame", "local") != "local":
        raise InputError(f"frame is {document['frame']!r:.40}, want 'local', or no frame for lon/lat")
    return name


def _check_feature(
    number: int, feature: Any, positions: list[tuple[float, float]], kinds_seen: set[object]
) -> RawFeature:
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        raise InputError("want a GeoJSON object of type 'Feature'")
    properties, geometry = (
        part if isinstance(part := feature.get(name), dict) else {} for name in ("properties", "geometry")
    )
    kind, shape = properties.get("kind"), geometry.get("type")
    if not isinstance(kind, str) or kind not in KINDS:
        raise InputError(f"kind is {kind!r:.40}, want one of {', '.join(KINDS)}")
    kinds_seen.add(kind)
    require(shape in KINDS[kind], f"{kind}: geometry is {shape!r:.40}, want {' or '.join(KINDS[kind])}")
    for of, name in (("lane", "oneway"), ("turn", "only")):
        if kind == of and not isinstance(properties.get(name, False), bool):
            raise InputError(f"{kind}: {name} is {properties[name]!r:.40}, want true or false")

    coordinates = geometry.get("coordinates")
    least = {"Point": 1, "LineString": 2}.get(str(shape), 4)
    lines: Any = {"Point": [[coordinates]], "LineString": [coordinates]}.get(str(shape), coordinates)
    if not isinstance(lines, list) or not lines:
        raise InputError(f"{kind}: coordinates are {lines!r:.40}, want a list of rings")
    require(kind != "slot" or len(lines) == 1, f"slot: the polygon has {len(lines)} rings, want 1")
    parts = []
    for line in lines:
        if not isinstance(line, list) or len(line) < least:
            raise InputError(f"{kind}: coordinates are {line!r:.40}, want at least {least} positions")
        start = len(positions)
        positions += [_position(kind, position) for position in line]
        if shape == "Polygon" and positions[start] != positions[-1]:
            raise InputError(f"{kind}: the polygon's ring is open, want its first position again at the end")
        parts.append(slice(start, len(positions)))
    return RawFeature(number, kind, properties, parts, properties.get("id", feature.get("id")))


def _position(kind: str, position: Any) -> tuple[float, float]:
    # Comparisons with NaN are false; a bool is an int in Python but not a number in JSON.
    numbers: Any = position if isinstance(position, list) and len(position) >= 2 else [None]
    if all(type(value) in (float, int) and abs(value) <= FARTHEST for value in numbers):
        return float(numbers[0]), float(numbers[1])
    raise InputError(f"{kind}: position {position!r:.60}, want two finite numbers, at most {FARTHEST:.0e}")


if TYPE_CHECKING:
    from pyproj import Transformer

# Extent, degrees, that no outline of parking exceeds (5 km); in metres all are larger than that.
LARGEST_DEGREES = 0.05
LONGEST_DEGREES = 1.0  # the same of a map of streets
_CRS = re.compile(
    r"(?:urn:ogc:def:crs:|https?://www\.opengis\.net/def/crs/)?(EPSG|OGC|ESRI)[:/].*?([A-Za-z0-9]+)"
)
_ADVICE = (
    'give the file "frame": "local" for metres, or "crs": '
    '{"type": "name", "properties": {"name": "EPSG:25832"}} with its own code for a map grid'
)


@dataclass(frozen=True)
class Positions:
    """What a file's pairs of numbers are."""

    # east and north in a frame of the file's own; else `to_lonlat` converts them to degrees
    in_metres: bool = False
    found: str = ""  # which map grid they are in, one line; else empty
    frame: LocalFrame | None = None  # of a file in metres, with its middle at longitude and latitude 0
    grid: Transformer | None = None

    def to_lonlat(self, points: FloatArray) -> FloatArray:
        if self.frame is not None:
            return self.frame.to_lonlat(points)
        if self.grid is None or not len(points):
            return points
        return np.column_stack(self.grid.transform(points[:, 0], points[:, 1]))

    @classmethod
    def of(cls, document: dict[str, Any]) -> Positions:
        """Recognise the positions of a FeatureCollection by `frame` and `crs`; others are degrees."""
        rings = _outlines(document)
        if "frame" in document:
            xy = np.concatenate([*rings, np.zeros((0 if rings else 1, 2))])
            middle = 0.5 * (xy.min(axis=0) + xy.max(axis=0))
            return cls(True, frame=LocalFrame(0.0, 0.0, tuple(middle.tolist())))
        if (grid := _grid(document.get("crs"))) is not None:
            xy = np.concatenate([*rings, np.empty((0, 2))])
            there_and_back = grid[0].transform(*grid[0].transform(xy[:, 0], xy[:, 1]), direction="INVERSE")
            # Far beyond a grid's own area a projection repeats itself.
            require(
                np.allclose(there_and_back, xy.T, rtol=0.0, atol=1.0),
                f"crs is {grid[1]}, in which the positions lie nowhere on the globe; {_ADVICE}",
            )
            return cls(found=f"positions are in {grid[1]}, as the file's crs says", grid=grid[0])
        if document.get("crs") is not None:
            return cls()  # degrees, as it says
        # The smaller side: a ring across the date line is 360° long.
        are_closed = [np.array_equal(ring[0], ring[-1]) and len(ring) > 3 for ring in rings]
        widest = LARGEST_DEGREES if all(are_closed) else LONGEST_DEGREES
        if rings and float(np.median([np.ptp(ring, axis=0).min() for ring in rings])) > widest:
            raise InputError(f"shapes are wider than {widest:g}, too wide for degrees; {_ADVICE}")
        return cls()


def _outlines(document: dict[str, Any]) -> list[FloatArray]:
    """Return the outer rings of polygons, (k, 2), else all other positions; the reader complains of wrong ones."""
    rings: list[FloatArray] = []
    others: list[FloatArray] = []
    for feature in document["features"] if isinstance(document.get("features"), list) else ():
        geometry = feature.get("geometry") if isinstance(feature, dict) else None
        if not isinstance(geometry, dict):
            continue
        shape: Any = geometry.get("type")
        line: Any = geometry.get("coordinates")
        try:
            for _ in range({"Polygon": 1, "MultiPolygon": 2}.get(shape, 0)):
                line = line[0]
            positions = [line] if shape == "Point" else line
            ring = np.array([p[:2] for p in positions], dtype=np.float64).reshape(-1, 2)
        except (TypeError, ValueError, LookupError, OverflowError):
            continue
        if np.isfinite(ring).all() and len(ring):
            (rings if shape in ("Polygon", "MultiPolygon") else others).append(ring)
    return rings or ([np.concatenate(others)] if others else [])


def _grid(crs: object) -> tuple[Transformer, str] | None:
    """Return the transformation of a file's `crs` to WGS 84, and its title; None for longitude and latitude itself."""
    if crs is None:
        return None
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(name, str):
        raise InputError(
            f'crs is {crs!r:.80}, want {{"type": "name", "properties": {{"name": "EPSG:25832"}}}} or none'
        )
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
