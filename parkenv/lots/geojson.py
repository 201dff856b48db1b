"""Native lot files (GeoJSON): writing, reading, and collecting all errors of a file.

The native file is a GeoJSON FeatureCollection with the further members
`"parkenv": {"format": "lot", "version": 1}`, `"name"` and `"frame": "local"` (metres). Without
`frame`, positions are longitude and latitude (RFC 7946), and are projected to metres east and north of the
middle of the features. `properties.kind` is the kind of a feature:

| kind | geometry | properties |
|---|---|---|
| `slot` | Polygon | `id`; `parking_cost_s`, 0 if absent; all or none of `center`, `yaw`, `length`, `width`, \
`mouth` (rear, left, right) |
| `lane` | LineString | `oneway`, false if absent |
| `entry`, `goal` | Point | |
| `wall` | LineString or Polygon | |
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.files.atomic_write import atomic_write
from parkenv.lots.generators import Slots, bay_row
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.slot_polygons import slots_from_polygons
from parkenv.world.drive_graph import GraphError, build_drive_graph, linestrings
from parkenv.world.lot import SLOT_SIDE, Lane, Mouth, ParkingLot, corner_points, is_building, mouth_points

FloatArray = NDArray[np.float64]

LOT_VERSION = 1
KINDS = {
    "slot": ("Polygon",),
    "lane": ("LineString",),
    "entry": ("Point",),
    "goal": ("Point",),
    "wall": ("LineString", "Polygon"),
}
"""The kinds of features, and the geometry types allowed for each."""
SLOT_SHAPE = ("center", "yaw", "length", "width", "mouth")
"""The properties that define a slot exactly."""
MOUTHS = {mouth.name.lower(): mouth for mouth in Mouth}
FARTHEST = 1e8
"""Greatest coordinate, m: enough for any map grid, and small enough for float64 to keep the millimetre."""
SLOT_AGREEMENT = 0.01
"""Greatest distance, m, between a slot's polygon and the rectangle that its properties describe."""


@dataclass(frozen=True)
class LotProblem:
    """An error or warning about a lot file; `feature` is the 0-based index in the FeatureCollection."""

    severity: Literal["error", "warning"]
    feature: int | None
    message: str

    def __str__(self) -> str:
        where = "" if self.feature is None else f"feature {self.feature}: "
        return f"{self.severity}: {where}{self.message}"


def write_lot(lot: ParkingLot, path: str | Path) -> None:
    """Write a lot as native GeoJSON, which `read_lot` reads back exactly. The file appears whole or not at all.

    Raises:
        InputError: the name does not end in `.geojson` or `.json`, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in (".geojson", ".json"):
        raise InputError(f"{path}: a lot is written as .geojson or .json")
    head = {
        "type": "FeatureCollection",
        "name": lot.name,
        "parkenv": {"format": "lot", "version": LOT_VERSION},
        "frame": "local",
    }
    features = ",\n".join(json.dumps(feature) for feature in _features(lot))
    text = f'{json.dumps(head)[:-1]},\n"features": [\n{features}\n]}}\n'
    with atomic_write(path) as beside:
        beside.write_text(text, encoding="utf-8")


def _features(lot: ParkingLot) -> Iterator[dict[str, Any]]:
    def feature(geometry: str, coordinates: object, **properties: object) -> dict[str, Any]:
        shape = {"type": geometry, "coordinates": coordinates}
        return {"type": "Feature", "properties": properties, "geometry": shape}

    rings = np.round(lot.slot_corners()[:, [0, 1, 2, 3, 0]], 3).tolist()
    shapes = zip(
        lot.slot_xy.tolist(),
        lot.slot_yaw.tolist(),
        lot.slot_length.tolist(),
        lot.slot_width.tolist(),
        (Mouth(mouth).name.lower() for mouth in lot.slot_mouth),
        strict=True,
    )
    costs = lot.slot_parking_cost_s.tolist()
    for slot_id, ring, shape, cost in zip(lot.slot_ids, rings, shapes, costs, strict=True):
        exact = dict(zip(SLOT_SHAPE, shape, strict=True))
        priced = {"parking_cost_s": cost} if cost else {}
        yield feature("Polygon", [ring], kind="slot", id=slot_id, **priced, **exact)
    for lane in lot.lanes:
        yield feature("LineString", lane.points.tolist(), kind="lane", oneway=lane.oneway)
    for kind, points in (("entry", lot.entries), ("goal", lot.goals)):
        for xy in points.tolist():
            yield feature("Point", xy, kind=kind)
    for wall in lot.walls:
        if is_building(wall):
            yield feature("Polygon", [wall.tolist()], kind="wall")
        else:
            yield feature("LineString", wall.tolist(), kind="wall")


# ---- reading: all errors are collected, so nothing below raises out of `read_contents` ----


@dataclass
class LotContents:
    """The valid features of a file; `numbers[kind]` are their feature numbers, `errors` the faults of the others."""

    name: str
    slot_ids: list[str] = field(default_factory=list)
    slots: Slots = field(default_factory=lambda: bay_row((0.0, 0.0), 0.0, 0))
    lanes: list[Lane] = field(default_factory=list)
    entries: list[FloatArray] = field(default_factory=list)
    goals: list[FloatArray] = field(default_factory=list)
    walls: list[FloatArray] = field(default_factory=list)
    numbers: dict[str, list[int]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    errors: list[LotProblem] = field(default_factory=list)

    def columns(self) -> dict[str, Any]:
        """The keyword arguments that `ParkingLot` takes."""
        return {
            "name": self.name,
            "slot_ids": tuple(self.slot_ids),
            **self.slots.columns(),
            "lanes": tuple(self.lanes),
            "entries": np.array(self.entries),
            "goals": np.array(self.goals),
            "walls": tuple(self.walls),
        }

    def error(self, feature: int | None, message: str) -> None:
        """Record an error of a feature, or of the file as a whole."""
        self.errors.append(LotProblem("error", feature, message))


@dataclass(frozen=True)
class _RawFeature:
    """A feature with a valid geometry: its parts are slices of one array of all positions."""

    number: int
    kind: str
    properties: dict[str, Any]
    parts: list[slice]
    given_id: object


def read_contents(path: Path) -> LotContents:
    """Read all valid features of a file, and record all errors. Does not raise."""
    contents = LotContents(path.stem)
    try:
        document = _load(path)
        contents.name, local = _check_head(document, path.stem)
    except InputError as error:
        contents.error(None, str(error))
        return contents

    raw: list[_RawFeature] = []
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
        if kind not in kinds_seen:
            contents.error(None, f"no {kind}: an empty lot, want at least one feature of kind {kind!r}")

    xy = np.array(positions, dtype=np.float64).reshape(-1, 2)
    if not local:
        off_globe = np.flatnonzero((np.abs(xy) > (180.0, 90.0)).any(axis=1))
        if len(off_globe):
            number = next(f.number for f in raw if any(p.stop > off_globe[0] for p in f.parts))
            lon, lat = xy[off_globe[0]].tolist()
            contents.error(
                number,
                f"position [{lon:g}, {lat:g}] is no longitude and latitude; "
                'for metres, the file needs the member "frame": "local"',
            )
            return contents
        xy = LocalFrame.around(xy).to_xy(xy) if len(xy) else xy

    for feature in raw:
        if feature.kind != "slot":
            _add_feature(contents, feature, [xy[part] for part in feature.parts])
    _read_slots(contents, [feature for feature in raw if feature.kind == "slot"], xy, exact=local)
    contents.errors.sort(key=lambda problem: -1 if problem.feature is None else problem.feature)
    return contents


def _add_feature(contents: LotContents, feature: _RawFeature, parts: list[FloatArray]) -> None:
    """Add a lane, an entry, a goal, or a wall with one part per ring."""
    if feature.kind == "lane":
        try:
            contents.lanes.append(Lane(parts[0], feature.properties.get("oneway", False)))
        except InputError as error:
            contents.error(feature.number, str(error))
            return
    elif feature.kind == "wall":
        contents.walls += parts
    else:
        points = contents.entries if feature.kind == "entry" else contents.goals
        points.append(parts[0][0])
    contents.numbers[feature.kind].append(feature.number)


def _load(path: Path) -> Any:
    if path.suffix.lower() not in (".geojson", ".json"):
        raise InputError(f"unknown kind of file {path.suffix!r}, want .geojson, .json or a Dragon Lake .yml")
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"not UTF-8 text: {error.reason} at byte {error.start}") from error
    except json.JSONDecodeError as error:
        raise InputError(f"not JSON: line {error.lineno}, column {error.colno}: {error.msg}") from error
    except (RecursionError, ValueError) as error:
        raise InputError(f"not JSON that a lot needs: {error}") from error


def _check_head(document: Any, stem: str) -> tuple[str, bool]:
    """Validate the head; return the lot's name, and whether positions are metres in a local frame."""
    if not isinstance(document, dict) or document.get("type") != "FeatureCollection":
        kind = document.get("type") if isinstance(document, dict) else type(document).__name__
        raise InputError(f"type is {kind!r:.40}, want a GeoJSON 'FeatureCollection'")
    if not isinstance(document.get("features"), list):
        raise InputError(f"features is {document.get('features')!r:.40}, want a list of features")
    header = document.get("parkenv", {"format": "lot", "version": LOT_VERSION})
    if not isinstance(header, dict) or header.get("format") != "lot":
        raise InputError(f'parkenv is {header!r:.60}, want {{"format": "lot", "version": {LOT_VERSION}}}')
    version = header.get("version")
    if type(version) is not int or version < 1:
        raise InputError(f"parkenv.version is {version!r:.40}, want {LOT_VERSION}")
    if version > LOT_VERSION:
        raise InputError(f"parkenv.version is {version}, want {LOT_VERSION}: made by a newer parkenv")
    name = document.get("name", stem)
    if not isinstance(name, str):
        raise InputError(f"name is {name!r:.40}, want a text")
    if document.get("frame", "local") != "local":
        raise InputError(f"frame is {document['frame']!r:.40}, want 'local', or no frame for lon/lat")
    return name, "frame" in document


def _check_feature(
    number: int, feature: Any, positions: list[tuple[float, float]], kinds_seen: set[object]
) -> _RawFeature:
    """Validate a feature and append its positions to `positions`."""
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        raise InputError("want a GeoJSON object of type 'Feature'")
    properties, geometry = (
        part if isinstance(part := feature.get(name), dict) else {} for name in ("properties", "geometry")
    )
    kind, shape = properties.get("kind"), geometry.get("type")
    if not isinstance(kind, str) or kind not in KINDS:
        raise InputError(f"kind is {kind!r:.40}, want one of {', '.join(KINDS)}")
    kinds_seen.add(kind)
    if shape not in KINDS[kind]:
        raise InputError(f"{kind}: geometry is {shape!r:.40}, want {' or '.join(KINDS[kind])}")
    if kind == "lane" and not isinstance(properties.get("oneway", False), bool):
        raise InputError(f"lane: oneway is {properties['oneway']!r:.40}, want true or false")

    coordinates = geometry.get("coordinates")
    lines: Any
    if shape == "Point":
        lines, least = [[coordinates]], 1
    elif shape == "LineString":
        lines, least = [coordinates], 2
    else:
        lines, least = coordinates, 4
    if not isinstance(lines, list) or not lines:
        raise InputError(f"{kind}: coordinates are {lines!r:.40}, want a list of rings")
    if kind == "slot" and len(lines) > 1:
        raise InputError(f"slot: the polygon has {len(lines)} rings, want 1")
    parts = []
    for line in lines:
        if not isinstance(line, list) or len(line) < least:
            raise InputError(f"{kind}: coordinates are {line!r:.40}, want at least {least} positions")
        start = len(positions)
        positions += [_position(kind, position) for position in line]
        if shape == "Polygon" and positions[start] != positions[-1]:
            raise InputError(f"{kind}: the polygon's ring is open, want its first position again at the end")
        parts.append(slice(start, len(positions)))
    return _RawFeature(number, kind, properties, parts, properties.get("id", feature.get("id")))


def _position(kind: str, position: Any) -> tuple[float, float]:
    if isinstance(position, list) and len(position) >= 2 and all(map(_is_number, position)):
        return float(position[0]), float(position[1])
    raise InputError(f"{kind}: position {position!r:.60}, want two finite numbers, at most {FARTHEST:.0e}")


def _is_number(value: Any) -> bool:
    # NaN compares as false; a bool is an int to Python but no number to JSON.
    return type(value) in (float, int) and abs(value) <= FARTHEST


def _read_slots(contents: LotContents, raw: list[_RawFeature], xy: FloatArray, exact: bool) -> None:
    """Validate the slots of a file and add the valid ones.

    Exact properties are used in a local frame only: after a projection stale ones would go unnoticed.
    """
    if not raw:
        return
    polygons = _polygons([xy[feature.parts[0]] for feature in raw])
    area = shapely.area(shapely.convex_hull(polygons))
    valid = shapely.is_valid(polygons)
    first_with: dict[str, int] = {}
    valid_rows: list[int] = []
    ids: list[str] = []
    shapes: list[tuple[float, ...] | None] = []
    costs: list[float] = []
    for i, feature in enumerate(raw):
        try:
            slot_id = _slot_id(feature)
            if slot_id in first_with:
                raise InputError(f"slot: id {slot_id!r:.40} appears already in feature {first_with[slot_id]}")
            first_with[slot_id] = feature.number
            if area[i] < SLOT_SIDE**2:
                raise InputError(f"slot {slot_id!r:.40}: the polygon is flat, want an area to park on")
            if not valid[i]:
                reason = shapely.is_valid_reason(polygons[i])
                raise InputError(f"slot {slot_id!r:.40}: the polygon is not a simple one: {reason}")
            cost = _parking_cost(feature.properties, slot_id)
            shapes.append(_slot_shape(feature.properties, slot_id) if exact else None)
        except InputError as error:
            contents.error(feature.number, str(error))
            continue
        valid_rows.append(i)
        ids.append(slot_id)
        costs.append(cost)

    polygons = polygons[valid_rows]
    bare = np.array([shape is None for shape in shapes], dtype=bool)
    slots = slots_from_polygons(polygons[bare], contents.lanes)
    if not bare.all():
        # x, y, yaw, length, width, mouth
        table = np.empty((len(valid_rows), 6))
        table[bare] = np.column_stack([slots.xy, slots.yaw, slots.length, slots.width, slots.mouth])
        table[~bare] = [shape for shape in shapes if shape is not None]
        slots = Slots(table[:, :2], table[:, 2], table[:, 3], table[:, 4], table[:, 5].astype(np.int8))

    boxes = shapely.polygons(corner_points(slots.xy, slots.yaw, slots.length, slots.width))
    apart = shapely.hausdorff_distance(polygons, boxes)
    disagrees = ~bare & (apart > SLOT_AGREEMENT)
    thin = slots.width < SLOT_SIDE
    for k in np.flatnonzero(disagrees):
        contents.error(
            raw[valid_rows[k]].number,
            f"slot {ids[k]!r:.40}: the polygon lies {apart[k]:.2f} m from what center, yaw, length and width "
            f"say, want at most {SLOT_AGREEMENT:g} m",
        )
    for k in np.flatnonzero(thin):
        contents.error(
            raw[valid_rows[k]].number,
            f"slot {ids[k]!r:.40}: the polygon is {slots.width[k]:.3f} m wide, want at least {SLOT_SIDE:g} m",
        )
    kept = np.flatnonzero(~disagrees & ~thin)
    contents.slots = replace(slots, parking_cost_s=np.array(costs, dtype=np.float64))[kept]
    contents.slot_ids = [ids[k] for k in kept]
    contents.numbers["slot"] = [raw[valid_rows[k]].number for k in kept]


def _polygons(rings: Sequence[FloatArray]) -> NDArray[np.object_]:
    which = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    return np.asarray(shapely.polygons(shapely.linearrings(np.concatenate(rings), indices=which)))


def _slot_id(feature: _RawFeature) -> str:
    given = feature.number if feature.given_id is None else feature.given_id
    if type(given) is int:
        return str(given)
    if not isinstance(given, str) or not given:
        raise InputError(f"slot: id is {given!r:.40}, want a text")
    return given


def _parking_cost(properties: dict[str, Any], slot_id: str) -> float:
    """Seconds that parking in a slot costs; 0 where the file does not say."""
    cost = properties.get("parking_cost_s", 0.0)
    if not _is_number(cost) or cost < 0.0:
        raise InputError(f"slot {slot_id!r:.40}: parking_cost_s is {cost!r:.40}, want seconds, at least 0")
    return float(cost)


def _slot_shape(properties: dict[str, Any], slot_id: str) -> tuple[float, ...] | None:
    """Exact x, y, yaw, length, width and mouth, or None for a slot with its polygon only."""
    absent = [name for name in SLOT_SHAPE if name not in properties]
    if len(absent) == len(SLOT_SHAPE):
        return None
    if absent:
        raise InputError(f"slot {slot_id!r:.40}: no {absent[0]}, want all of {', '.join(SLOT_SHAPE)} or none")
    center, yaw, length, width, mouth = (properties[name] for name in SLOT_SHAPE)
    if not (isinstance(center, list) and len(center) == 2 and all(map(_is_number, center))):
        raise InputError(f"slot {slot_id!r:.40}: center is {center!r:.40}, want two finite numbers")
    if not _is_number(yaw):
        raise InputError(f"slot {slot_id!r:.40}: yaw is {yaw!r:.40}, want a finite number")
    for name, value in (("length", length), ("width", width)):
        if not _is_number(value) or value < SLOT_SIDE:
            raise InputError(f"slot {slot_id!r:.40}: {name} is {value!r:.40}, want at least {SLOT_SIDE:g} m")
    if not isinstance(mouth, str) or mouth not in MOUTHS:
        raise InputError(f"slot {slot_id!r:.40}: mouth is {mouth!r:.40}, want one of {', '.join(MOUTHS)}")
    return (*center, yaw, length, width, MOUTHS[mouth])


def graph_errors(contents: LotContents) -> list[LotProblem]:
    """Errors of the drive graph: slots and entries that no lane serves, junctions of too many lanes."""
    lanes = [(lane.points, lane.oneway) for lane in contents.lanes]
    if not lanes:
        return []
    slots = contents.slots
    mouth_xy = mouth_points(slots.xy, slots.yaw, slots.length, slots.width, slots.mouth)
    left = {"slot": np.arange(len(slots)), "entry": np.arange(len(contents.entries))}
    entries = np.array(contents.entries).reshape(-1, 2)
    errors = []
    while True:
        # Faulty features are left out and the rest is tried again, so that all faults are found.
        try:
            build_drive_graph(lanes, mouth_xy[left["slot"]], entries[left["entry"]])
        except GraphError as error:
            kind = error.problems[0].kind
            for problem in error.problems:
                if kind == "junction":
                    distance = shapely.distance(
                        linestrings([points for points, _ in lanes]), shapely.Point(problem.xy)
                    )
                    feature = contents.numbers["lane"][int(np.argmin(distance))]
                    message = f"lane: the junction {problem.message}"
                else:
                    index = left[kind][problem.index]
                    feature = contents.numbers[kind][index]
                    name = f"slot {contents.slot_ids[index]!r:.40}" if kind == "slot" else kind
                    message = f"{name} {problem.message}"
                errors.append(LotProblem("error", feature, message))
            if kind == "junction":
                return errors
            left[kind] = np.delete(left[kind], [problem.index for problem in error.problems])
        else:
            return errors
