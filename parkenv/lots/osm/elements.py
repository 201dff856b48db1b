"""Read OpenStreetMap files: nodes, ways and multipolygons with their tags and positions.

Four formats are read: OSM XML (`.osm`, `.xml`: the map's own export, JOSM, Overpass `[out:xml]`), packed as `.gz` and
`.bz2`, too, and PBF, both by the package osmium; GeoJSON as overpass-turbo and osmtogeojson write it (an element's
id in `id` or `@id`, its tags in `properties` or `properties.tags`; `export_tags` has others); and Overpass JSON.
GeoJSON of polygons without any such tag holds outlines of parking spaces.

Extracts are clipped: ways lack the nodes beyond the edge, multipolygons some of their ways. Streets are cut there,
areas are closed by a straight line between what is left, and what has nothing left is listed.

Turn restrictions are relations. Those for cars at all hours are read, `no_*` and `only_*` from ways over a node to
ways; others are listed: over a way, at some hours only (`restriction:conditional`), without cars (`except=motorcar`,
`restriction:hgv`), and those that lack a member or whose ways do not end where they should.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, Self
from xml.etree import ElementTree

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, naming, require, with_extra
from parkenv.files.file_names import is_plain
from parkenv.files.limited_reading import open_limited, read_json, require_file, unpacked_path
from parkenv.lots.draft import LeftOut
from parkenv.lots.formats.geojson import Positions
from parkenv.lots.osm.export_tags import NESTED, OSM_ID, id_of_feature, tags_of_feature

# Keys that distinguish elements of OpenStreetMap from other GeoJSON.
MAPPED_KEYS = ("amenity", "highway", "building", "entrance")
# Keys of the elements that an import reads.
KEYS = (*MAPPED_KEYS, "noexit", "shop", "office", "craft", "healthcare", "tourism", "leisure")
# Keys of the nodes that an import reads.
NODE_KEYS = (*KEYS, "barrier", "motorcar", "motor_vehicle", "vehicle")
MOST_XML_BYTES = 4_000_000_000  # maximum size of unpacked XML
# Maximum number of nodes, ways and relations of one file: a city of a million people.
MOST_ELEMENTS = 5_000_000
CAR_KEYS = frozenset(("motorcar", "motor_vehicle", "vehicle"))
# Keys of a restriction of turns that holds for cars, the most specific first.
TURN_KEYS = (*(f"restriction:{key}" for key in ("motorcar", "motor_vehicle", "vehicle")), "restriction")
_FAILED = re.compile(r"error|timed out|out of memory|limit|abort", re.IGNORECASE)
_APART = 3e-8  # degrees, some 3 mm: nodes at this distance are not the same
_SAME = 1e-6  # degrees, some 0.1 m: a cut nearer to a node is at the node
BEYOND = (np.nan, np.nan)  # position of a node that is not in the file


@dataclass(frozen=True, eq=False)
class OsmElement:
    id: str  # such as `way/123`, as in OpenStreetMap URLs
    tags: Mapping[str, str]  # its keys and values
    # (k, 2) degrees, longitude first: the single position of a node, the line of a way, the outer rings of a
    # multipolygon. A closed line ends where it starts.
    lines: tuple[FloatArray, ...]
    holes: tuple[FloatArray, ...] = ()  # a multipolygon's inner rings
    cut: bool = False  # whether parts of it are beyond the edge of the map

    @property
    def is_node(self) -> bool:
        return len(self.lines[0]) == 1

    @property
    def is_closed(self) -> bool:
        return all(map(_is_ring, self.lines))

    def closed(self) -> Self:
        """Return the element with its outline closed by a straight line, as where the edge of a map cuts it."""
        rings = tuple(_closed(self.lines))
        return self if self.is_closed or not rings else replace(self, lines=rings, cut=True)


class OsmTurn(NamedTuple):
    """A turn that cars may not make, or the only one that they may."""

    id: str  # of its relation
    # (3, 2) degrees, longitude first: on the way by which cars come, the junction, on the way by which they leave
    line: FloatArray
    only: bool


@dataclass(frozen=True, eq=False)
class OsmMap:
    elements: list[OsmElement]  # the tagged nodes, ways and multipolygons, in order
    positions: Positions = field(default_factory=Positions)  # what the positions in the file are
    left_out: tuple[LeftOut, ...] = ()  # those without an outline or a line
    turns: tuple[OsmTurn, ...] = ()  # those restricted for cars
    turns_left_out: tuple[LeftOut, ...] = ()  # restrictions of turns that are not read

    def cut_elements(self) -> tuple[str, ...]:
        cut = [e.id for e in self.elements if e.cut]
        return tuple(map(str, LeftOut.by_reason({"cut at the edge of the map": cut})))

    def within(self, bounds: tuple[tuple[float, float], tuple[float, float]]) -> Self:
        """Cut roads at a box, two corners of latitude and longitude; others need half of their corners inside."""
        corners = np.array(bounds)[:, ::-1]
        # West of east; on the globe, a box of more than half of it is across the date line.
        across = np.ptp(corners[:, 0]) > 180.0 and np.ptp(corners[:, 0]) < 360.0
        corners[:, 0] += 360.0 * (across & (corners[:, 0] < 0.0))
        elements = [_beyond_date_line(e) for e in self.elements] if across else self.elements
        low, high = corners.min(axis=0), corners.max(axis=0)
        inside = [
            float(((xy >= low) & (xy <= high)).all(axis=1).mean()) if len(xy) else 0.0
            for xy in (np.concatenate(e.lines) for e in elements)
        ]
        kept, beyond = [], []
        for element, share in zip(elements, inside, strict=True):
            if share < 1.0 and not element.is_node and "highway" in element.tags:
                clipped = shapely.clip_by_rect(shapely.MultiLineString(list(element.lines)), *low, *high)
                parts = shapely.get_parts(shapely.remove_repeated_points(clipped, _SAME))
                lines = tuple(shapely.get_coordinates(part) for part in parts if shapely.length(part) > _SAME)
                element, share = replace(element, lines=lines, cut=True), float(bool(lines))
            if share >= 0.5:
                kept.append(element)
            else:
                beyond.append(element.id)
        require(kept, f"nothing of the map is within latitudes and longitudes {bounds[0]} to {bounds[1]}")
        outside = LeftOut.by_reason({"clipped: outside the bounds": beyond})
        return replace(self, elements=kept, left_out=(*self.left_out, *outside))


def read_map(path: Path) -> OsmMap:
    if unpacked_path(path).suffix.lower() in (".pbf", ".osm", ".xml"):
        return _read_osm(path)
    content = read_json(path)
    with naming(path):
        if isinstance(content, dict) and isinstance(content.get("elements"), list):
            _refuse_partial(content.get("remark"))
            return _map_of_overpass(content["elements"])
        if not isinstance(content, dict) or not isinstance(content.get("features"), list):
            raise InputError("no features, want a GeoJSON FeatureCollection, or a map as .osm or .osm.pbf")
        return _map_of_geojson(content["features"], Positions.of(content))


def place_name(path: Path) -> str:
    return unpacked_path(path).stem.removesuffix(".osm")


def holds_osm(document: object) -> bool:
    if isinstance(document, dict) and isinstance(document.get("elements"), list):
        return True
    features = document.get("features") if isinstance(document, dict) else None
    if not isinstance(document, dict) or not isinstance(features, list) or "parkenv" in document:
        return False
    if _holds_outlines(features):
        return True
    if "frame" in document:
        return False
    properties = [f["properties"] for f in features if isinstance(f, dict) and _is_object(f, "properties")]
    return not any("kind" in p for p in properties) and any(
        "@id" in p or any(key in p for key in (*NESTED, *MAPPED_KEYS)) for p in properties
    )


def _holds_outlines(features: list[Any]) -> bool:
    """Whether features are polygons alone, without a tag that says what they are: outlines of parking spaces."""
    return bool(features) and all(
        isinstance(f, dict)
        and _is_object(f, "geometry")
        and f["geometry"].get("type") == "Polygon"
        and not any(key in (f.get("properties") or {}) for key in ("kind", "@id", *NESTED, *MAPPED_KEYS))
        for f in features
    )


# ---- XML and PBF: references are resolved when everything has been read ----


class _NoTurnError(Exception):
    """Why a restriction of turns is not read."""


# A node: its id, or where it is, degrees, if a file has positions in place of ids.
Ref = int | tuple[float, float]


class _Way(NamedTuple):
    tags: dict[str, str]
    refs: list[Ref]
    rank: tuple[int, bool, int]  # version, whether it has tags, number of nodes: the greater wins


class _Relation(NamedTuple):
    """A relation with its member ways: reference and role; and its nodes with the role via."""

    tags: dict[str, str]
    members: list[tuple[int, str]]
    via: list[int]


@dataclass
class _RawElements:
    positions: dict[Ref, tuple[float, float]] = field(default_factory=dict)
    versions: dict[int, int] = field(default_factory=dict)  # of nodes
    node_tags: dict[int, dict[str, str]] = field(default_factory=dict)
    ways: dict[int, _Way] = field(default_factory=dict)
    relations: dict[int, _Relation] = field(default_factory=dict)
    relation_ranks: dict[int, tuple[int, int]] = field(default_factory=dict)
    needed_ways: set[int] = field(default_factory=set)
    needed_nodes: set[Ref] = field(default_factory=set)
    left_out: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))

    # What refers to others is added first.

    def add_relation(self, relation: Any) -> None:
        tags = dict(relation.tags)
        is_area = tags.get("type") == "multipolygon" and ("amenity" in tags or "building" in tags)
        if is_area or tags.get("type") == "restriction":
            rank = (relation.version or 0, len(relation.members))
            if self.relation_ranks.setdefault(relation.id, rank) > rank:
                return
            self.relation_ranks[relation.id] = rank
            ways = [(m.ref, m.role) for m in relation.members if m.type == "w"]
            via = [m.ref for m in relation.members if m.type == "n" and m.role == "via"]
            self.relations[relation.id] = _Relation(tags, ways, via)
            self.needed_ways.update(ref for ref, _ in ways)
            self.needed_nodes.update(via)

    def add_way(self, way: Any) -> None:
        if way.id in self.needed_ways or any(key in way.tags for key in KEYS):
            refs, tags = [node.ref for node in way.nodes], dict(way.tags)
            new = _Way(tags, refs, (way.version or 0, bool(tags), len(refs)))
            old = self.ways.get(way.id, _Way({}, [], (-1, False, 0)))
            if old.refs != refs and old.rank == new.rank:
                raise InputError(f"way/{way.id} appears twice, with other nodes")
            new, old = sorted((new, old), key=lambda w: w.rank, reverse=True)
            self.ways[way.id] = new._replace(tags=new.tags or old.tags, refs=new.refs or old.refs)
            self.needed_nodes.update(refs)

    def add_node(self, node: Any) -> None:
        is_wanted = any(key in node.tags for key in NODE_KEYS)
        if is_wanted or node.id in self.needed_nodes:
            name, at, version = f"node/{node.id}", node.location, node.version or 0
            position = at if isinstance(at, tuple) else (at.lat_without_check(), at.lon_without_check())
            position = _position(name, *position)
            before = self.versions.get(node.id, -1)
            if before == version and self.positions[node.id] != position:
                raise InputError(f"{name} appears twice, at different positions")
            if version >= before:
                self.positions[node.id], self.versions[node.id] = position, version
            if is_wanted and (version >= before or node.id not in self.node_tags):
                self.node_tags[node.id] = dict(node.tags)

    def part_levels(self) -> None:
        """Move nodes a few millimetres that lie where nodes of streets of other levels do, as viaducts do."""
        levels: dict[Ref, set[int]] = defaultdict(set)
        for way in self.ways.values():
            for ref in way.refs if "highway" in way.tags else ():
                levels[ref].add(level_of(way.tags))
        at: dict[tuple[float, float], list[set[int]]] = defaultdict(list)
        for ref, own in sorted(levels.items(), key=lambda item: min(map(abs, item[1]))):
            if (position := self.positions.get(ref)) is None:
                continue
            groups = at[position]
            k = next((k for k, group in enumerate(groups) if group & own), len(groups))
            groups[k:] = [group | own for group in groups[k : k + 1]] + groups[k + 1 :] or [own]
            self.positions[ref] = position[0], position[1] + k * _APART

    def map(self) -> OsmMap:
        self.part_levels()
        nodes = [
            OsmElement(f"node/{i}", tags, (np.array([self.positions[i]]),))
            for i, tags in self.node_tags.items()
            if i in self.positions
        ]
        tagged = {i: way for i, way in self.ways.items() if way.tags}
        ways = [way for i, raw in tagged.items() if (way := self._way(i, raw)) is not None]
        require(
            ways or not self.left_out,
            "none of its ways has its nodes in the file; export with complete ways (Overpass: "
            "`out body; >; out skel qt;`)",
        )
        areas, turns = list[OsmElement](), list[OsmTurn]()
        no_turns: dict[str, list[str]] = defaultdict(list)
        for i, raw in self.relations.items():
            if raw.tags["type"] == "multipolygon":
                if (area := self._area(i, raw)) is not None:
                    areas.append(area)
                continue
            try:
                turns += self._turns(f"relation/{i}", raw)
            except _NoTurnError as reason:
                no_turns[str(reason)].append(f"relation/{i}")
        left_out, no_turns_read = LeftOut.by_reason(self.left_out), LeftOut.by_reason(no_turns)
        once = _each_once([(e, (False, 0, -len(e.tags))) for e in nodes + ways + areas])
        return OsmMap(once, Positions(), left_out, tuple(turns), no_turns_read)

    def _turns(self, name: str, relation: _Relation) -> list[OsmTurn]:
        tags = relation.tags
        key = next((key for key in TURN_KEYS if key in tags), None)
        if key is None:
            some = any(f"{key}:conditional" in tags for key in TURN_KEYS)
            raise _NoTurnError("at some hours only" if some else "for other vehicles")
        if CAR_KEYS.intersection(tags.get("except", "").replace(" ", "").split(";")):
            raise _NoTurnError("except cars")
        ways = {role: [m for m in relation.members if m[1] == role] for role in ("from", "via", "to")}
        if ways["via"]:
            raise _NoTurnError("over a way")
        only = tags[key].startswith("only_")
        if (
            not re.fullmatch(r"(no|only)_(left_turn|right_turn|straight_on|u_turn|entry|exit)", tags[key])
            or len(relation.via) != 1
            or not ways["from"]
            or not ways["to"]
            or (only and len(ways["to"]) > 1)
        ):
            raise _NoTurnError("damaged")
        via = np.array(self.positions.get(relation.via[0], BEYOND))
        comes, leaves = ([self._beside(via, ref) for ref, _ in ways[role]] for role in ("from", "to"))
        return [OsmTurn(name, np.array([a, via, b]), only) for a in comes for b in leaves]

    def _beside(self, via: FloatArray, ref: int) -> FloatArray:
        """Return the position of a way next to the junction at one of its ends, (2,) degrees."""
        if ref not in self.ways or np.isnan(via).any():
            raise _NoTurnError("beyond the edge of the map")
        line = self._line_of(self.ways[ref])
        steps = line[(line != via).any(axis=1)]
        ends = [np.array_equal(line[k], via) for k in (0, -1)]
        if sum(ends) != 1 or not len(steps):
            raise _NoTurnError("damaged")
        beside: FloatArray = steps[0 if ends[0] else -1]
        if np.isnan(beside).any():
            raise _NoTurnError("beyond the edge of the map")
        return beside

    def _line_of(self, way: _Way) -> FloatArray:
        return np.array([self.positions.get(ref, BEYOND) for ref in way.refs]).reshape(-1, 2)

    def _way(self, number: int, way: _Way) -> OsmElement | None:
        name, line = f"way/{number}", self._line_of(way)
        cut = bool(np.isnan(line).any())
        if not cut:
            return OsmElement(name, way.tags, (line,)) if len(line) > 1 else None
        lines = _runs(line) if "highway" in way.tags else _closed([line[~np.isnan(line[:, 0])]])
        if not lines:
            self.left_out["ways beyond the edge of the map"].append(name)
            return None
        return OsmElement(name, way.tags, tuple(lines), cut=True)

    def _area(self, number: int, relation: _Relation) -> OsmElement | None:
        name, cut = f"relation/{number}", False
        parts: dict[str, list[FloatArray]] = {"outer": [], "inner": []}
        for ref, role in relation.members:
            line = self._line_of(self.ways[ref]) if ref in self.ways else np.full((1, 2), np.nan)
            cut |= bool(np.isnan(line).any())
            parts["inner" if role == "inner" else "outer"] += _runs(line)
        outer, inner = (_joined(parts[role]) for role in ("outer", "inner"))
        if cut:
            outer, inner = _closed(outer), _closed(inner)
        elif not all(_is_ring(line) for line in (*outer, *inner)):
            self.left_out["multipolygons with an open outline"].append(name)
            return None
        if not outer:
            self.left_out["multipolygons without an outline in the file"].append(name)
            return None
        return OsmElement(name, relation.tags, tuple(outer), tuple(inner), cut)


def _beyond_date_line(element: OsmElement) -> OsmElement:
    """Return the element with longitudes from 0 to 360."""
    lines, holes = (
        [np.column_stack([line[:, 0] % 360.0, line[:, 1]]) for line in own]
        for own in (element.lines, element.holes)
    )
    return replace(element, lines=tuple(lines), holes=tuple(holes))


def _is_ring(line: FloatArray) -> bool:
    return len(line) >= 4 and np.array_equal(line[0], line[-1])


def _runs(line: FloatArray) -> list[FloatArray]:
    beyond = np.isnan(line[:, 0])
    parts = np.split(line, np.flatnonzero(np.diff(beyond)) + 1)
    return [part for part in parts if len(part) > 1 and not np.isnan(part[0, 0])]


def _joined(lines: Sequence[FloatArray]) -> list[FloatArray]:
    if not lines:
        return []
    joined = shapely.line_merge(shapely.MultiLineString([line.tolist() for line in lines]))
    return [shapely.get_coordinates(part) for part in shapely.get_parts(joined)]


def _closed(lines: Sequence[FloatArray]) -> list[FloatArray]:
    """Close lines by a straight line at the edge of the map; those that enclose nothing are dropped."""
    rings = [
        line if len(line) and np.array_equal(line[0], line[-1]) else np.concatenate([line, line[:1]])
        for line in lines
    ]
    return [ring for ring in rings if len(ring) >= 4]


def _position(name: str, lat: object, lon: object) -> tuple[float, float]:
    values = []
    for what, value, most in (("lat", lat, 90.0), ("lon", lon, 180.0)):
        try:
            number = float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            number = np.nan
        if isinstance(value, bool) or not abs(number) <= most:
            raise InputError(f"{name}: {what} is {value!r:.40}, want a number from {-most:g} to {most:g}")
        values.append(number)
    return values[1], values[0]


def _read_osm(path: Path) -> OsmMap:
    with naming(path), with_extra("OpenStreetMap", "osm"):
        import osmium
    require_file(path)
    # so is what waits to be read, such as a link to /proc/kmsg
    require(path.stat().st_size, f"{path}: is empty")
    packed = path.suffix.lower() if path != unpacked_path(path) else ""
    source = osmium.io.File(str(path), "pbf" if path.suffix.lower() == ".pbf" else f"osm{packed}")
    raw, count = _RawElements(), 0
    with naming(path):
        if path.suffix.lower() != ".pbf" and _has_geometry(path):
            return _map_of_overpass(_elements_of_xml(path))
        try:
            for kind, add in (
                (osmium.osm.RELATION, raw.add_relation),
                (osmium.osm.WAY, raw.add_way),
                (osmium.osm.NODE, raw.add_node),
            ):
                for element in osmium.FileProcessor(source, kind):
                    count += 1
                    if count > MOST_ELEMENTS:
                        raise InputError(
                            f"has more than {MOST_ELEMENTS:,} nodes, ways and relations, the most that is read; cut "
                            "the town out of it, e.g. by `osmium extract`"
                        )
                    if element.visible:
                        add(element)
        except InputError:
            raise
        except (RuntimeError, ValueError, osmium.InvalidLocationError) as error:
            raise InputError(f"not an OpenStreetMap file: {error}") from error
        return raw.map()


# ---- GeoJSON ----


def _map_of_geojson(features: list[Any], positions: Positions) -> OsmMap:
    to_lonlat = positions.to_lonlat if positions.frame or positions.grid else None
    elements = [_feature_element(index, feature, to_lonlat) for index, feature in enumerate(features)]
    pairs = [(e, _preference(f, e)) for e, f in zip(elements, features, strict=True) if e is not None]
    if _holds_outlines(features):
        tags = {"amenity": "parking_space"}
        given = [_given_id(feature) for e, feature in zip(elements, features, strict=True) if e is not None]
        is_id = len(set(given)) == len(given) and all(name and is_plain(name) for name in given)
        names = given if is_id else [element.id for element, _ in pairs]
        outlines = zip(pairs, names, strict=True)
        return OsmMap([replace(element, id=name, tags=tags) for (element, _), name in outlines], positions)
    return OsmMap(_parted_levels(_each_once(pairs)), positions)


def _given_id(feature: dict[str, Any]) -> str:
    """Return the id of an outline to the letter, of whatever form; empty text if it has none."""
    properties = feature.get("properties") or {}
    if name := id_of_feature(feature, properties):
        return name
    values = (properties.get("bay_id"), properties.get("id"), feature.get("id"))
    return next((str(value) for value in values if isinstance(value, str | int)), "")


_Preference = tuple[bool, int, int]


def _preference(feature: Any, element: OsmElement) -> _Preference:
    """Return what sorts the same element given several times: a closed street is a line; the newest; the fullest."""
    properties = feature["properties"] if _is_object(feature, "properties") else {}
    meta = properties.get("meta")
    version = properties.get("@version", meta.get("version") if isinstance(meta, dict) else None)
    is_area = str(feature["geometry"]["type"]).endswith("Polygon") and "highway" in element.tags
    return is_area, -int(str(version)) if str(version).isdecimal() else 0, -len(element.tags)


def _each_once(pairs: Sequence[tuple[OsmElement, _Preference]]) -> list[OsmElement]:
    """Return elements, those given several times once: with one id, or closed, with one outline and kind."""
    for key_of in (lambda element: element.id, _outline_of):
        groups: dict[object, list[tuple[OsmElement, _Preference]]] = defaultdict(list)
        for pair in pairs:
            groups[key_of(pair[0])].append(pair)
        pairs = [(_union(group), min(p for _, p in group)) for group in groups.values()]
    return [element for element, _ in pairs]


def _outline_of(element: OsmElement) -> object:
    tags = element.tags
    kind = tags.get("amenity") or ("building" if "building" in tags else tags.get("highway"))
    named = OSM_ID.fullmatch(element.id)
    is_alike = element.lines and (element.is_closed or not named)
    # Spaces with ids that lie on others are faults of a map.
    is_outline = kind and is_alike and not element.is_node and not (kind == "parking_space" and named)
    return (kind, _corners(element.lines)) if is_outline else element.id


def _corners(lines: Iterable[FloatArray]) -> frozenset[tuple[float, ...]]:
    return frozenset(tuple(p) for line in lines for p in line.round(7).tolist())


def _union(group: list[tuple[OsmElement, _Preference]]) -> OsmElement:
    if len(group) == 1:
        return group[0][0]
    group = sorted(group, key=lambda pair: pair[1])
    best = group[0][0]
    lines: list[FloatArray] = []
    # The newest: of a street its parts, of an area the fullest outline.
    for line in (line for e, p in group if p[1] == group[0][1][1] for line in e.lines):
        if not _corners([line]) <= _corners(lines):
            lines = [other for other in lines if not _corners([other]) <= _corners([line])] + [line]
    if "highway" not in best.tags and any(
        e.id == best.id and p[1] == group[0][1][1] and _corners(e.lines).isdisjoint(_corners(best.lines))
        for e, p in group
    ):
        raise InputError(f"{best.id} appears twice, at different positions")
    if "highway" not in best.tags and best.is_closed:
        lines = list(max((e.lines for e, _ in group), key=lambda own: sum(map(len, own))))
    name = next((e.id for e, _ in group if OSM_ID.fullmatch(e.id)), best.id)
    return replace(best, id=name, lines=tuple(lines), holes=max((e.holes for e, _ in group), key=len))


def _parted_levels(elements: list[OsmElement]) -> list[OsmElement]:
    """Move the points of streets that cross others of another level at a common position, but do not end there."""
    arms: dict[tuple[float, ...], Counter[int]] = defaultdict(Counter)
    for e in elements:
        for line in e.lines if "highway" in e.tags and not e.is_node else ():
            for i, point in enumerate(map(tuple, line.tolist())):
                arms[point][level_of(e.tags)] += 1 + (0 < i < len(line) - 1)
    crossed = {p: min(own, key=abs) for p, own in arms.items() if len(own) > 1 and min(own.values()) > 1}
    if not crossed:
        return elements

    def moved(line: FloatArray, level: int) -> FloatArray:
        away = [level != crossed.get(point, level) for point in map(tuple, line.tolist())]
        return line + np.outer(away, (0.0, _APART * level))

    return [
        replace(e, lines=tuple(moved(line, level_of(e.tags)) for line in e.lines))
        if "highway" in e.tags and not e.is_node
        else e
        for e in elements
    ]


def level_of(tags: Mapping[str, str]) -> int:
    """Return the level of a way: its layer, else 1 for bridges, -1 for tunnels, 0 for others."""
    with suppress(ValueError):
        return (
            int(float(tags["layer"])) if "layer" in tags else _is_on(tags, "bridge") - _is_on(tags, "tunnel")
        )
    return 0


def _is_on(tags: Mapping[str, str], key: str) -> int:
    return tags.get(key, "no") not in ("no", "building_passage", "culvert")


# ---- Overpass JSON, and XML with positions in place of nodes (`out geom`) ----


def _map_of_overpass(elements: list[Any]) -> OsmMap:
    raw = _RawElements()

    def refs_of(name: str, given: dict[str, Any]) -> list[Any]:
        refs, geometry = given.get("nodes"), given.get("geometry") or []
        points = [_position(name, p.get("lat"), p.get("lon")) if p else BEYOND for p in geometry]
        if not isinstance(refs, list) or (points and len(refs) != len(points)):
            refs = points
        raw.positions.update({ref: p for ref, p in zip(refs, points, strict=False) if p is not BEYOND})
        return [SimpleNamespace(ref=ref) for ref in refs]

    for kind, add in (("relation", raw.add_relation), ("way", raw.add_way), ("node", raw.add_node)):
        for index, given in enumerate(elements):
            if not isinstance(given, dict) or type(given.get("id")) is not int:
                raise InputError(f"elements[{index}] is {given!r:.40}, want an object with type and id")
            if given.get("type") != kind:
                continue
            name, listed = f"{kind}/{given['id']}", given.get("members", ())
            element = SimpleNamespace(id=given["id"], version=given.get("version") or 0)
            element.tags = tags_of_feature({"tags": given.get("tags") or {}})
            element.location = (given.get("lat"), given.get("lon"))
            try:
                element.members = [
                    SimpleNamespace(ref=m["ref"], type=m["type"][:1], role=m.get("role", "")) for m in listed
                ]
                element.nodes = refs_of(name, given)
                more = [(m["ref"], refs_of(name, m)) for m in listed if m.get("geometry")]
            except (AttributeError, KeyError, TypeError) as error:
                raise InputError(
                    f"{name}: want members, nodes and geometry as Overpass writes them"
                ) from error
            add(element)
            for ref, line in more:
                if ref in raw.needed_ways:
                    raw.add_way(SimpleNamespace(id=ref, version=-1, tags={}, nodes=line))
            for m in listed:
                if m["type"] == "node" and "lat" in m and m["ref"] in raw.needed_nodes:
                    raw.positions.setdefault(m["ref"], _position(name, m["lat"], m["lon"]))
    return raw.map()


def _elements_of_xml(path: Path) -> list[Any]:
    elements: list[Any] = []
    with open_limited(path) as file, naming(path):
        try:
            for _, node in ElementTree.iterparse(file):
                if node.tag in ("node", "way", "relation"):
                    elements.append(_answer_of_xml(node))
                    node.clear()
        except (ElementTree.ParseError, ValueError) as error:
            raise InputError(f"not an OpenStreetMap file: {error}") from error
    return elements


def _answer_of_xml(node: ElementTree.Element) -> dict[str, Any]:
    answer: dict[str, Any] = {"type": node.tag, "tags": {t.get("k"): t.get("v") for t in node.iter("tag")}}
    for name, value in node.attrib.items():
        answer[name] = int(value) if name in ("id", "ref", "version") else value
    points = node.findall("nd")
    answer["geometry"] = [dict(nd.attrib) if nd.get("lat") else None for nd in points]
    if points and all(nd.get("ref") for nd in points):
        answer["nodes"] = [int(nd.get("ref", 0)) for nd in points]
    answer["members"] = [{**_answer_of_xml(m), "type": m.get("type")} for m in node.findall("member")]
    return answer


def _has_geometry(path: Path) -> bool:
    """Whether an XML file has positions of ways in place; one whose remark says that it is partial is refused."""
    found = False
    with open_limited(path, MOST_XML_BYTES) as file:
        for line in file:
            found |= b"<nd" in line and b"lat=" in line
            if b"<remark" in line:
                _refuse_partial(line.decode(errors="replace").partition("<remark")[2].strip("<>/ \n"))
    return found


def _refuse_partial(remark: object) -> None:
    if isinstance(remark, str) and _FAILED.search(remark):
        raise InputError(
            f"its remark says {remark.strip()!a:.160}: the answer is partial, want a whole one; ask for a "
            "smaller area, or with a longer [timeout:] and a larger [maxsize:]"
        )


def _feature_element(
    index: int, feature: Any, to_lonlat: Callable[[FloatArray], FloatArray] | None
) -> OsmElement | None:
    if not isinstance(feature, dict):
        raise InputError(f"features[{index}] is {feature!r:.40}, want a GeoJSON feature")
    properties = feature["properties"] if _is_object(feature, "properties") else {}
    name, tags = id_of_feature(feature, properties) or f"feature/{index}", tags_of_feature(properties)
    geometry = feature["geometry"] if _is_object(feature, "geometry") else {}
    coordinates = geometry.get("coordinates")

    def line(positions: Any) -> FloatArray:
        listed = positions if isinstance(positions, list) else ()
        if not listed or not all(isinstance(p, list) and len(p) >= 2 for p in listed):
            raise InputError(f"{name}: coordinates are {positions!r:.40}, want positions")
        points: Any = positions
        with suppress(TypeError, ValueError, OverflowError):  # named below
            if to_lonlat is not None:
                points = to_lonlat(np.array([p[:2] for p in positions], dtype=np.float64)).tolist()
        return np.array([_position(name, p[1], p[0]) for p in points]).reshape(-1, 2)

    match geometry.get("type"):
        case "Point":
            return OsmElement(name, tags, (line([coordinates]),))
        case "LineString":
            lines = (line(coordinates),)
            return OsmElement(name, tags, lines) if len(lines[0]) > 1 else None
        case "Polygon" | "MultiPolygon" as shape:
            polygons = [coordinates] if shape == "Polygon" else coordinates
            if not (
                isinstance(polygons, list) and polygons and all(isinstance(p, list) and p for p in polygons)
            ):
                raise InputError(f"{name}: coordinates are {coordinates!r:.40}, want rings")
            rings = [[line(ring) for ring in polygon] for polygon in polygons]
            holes = tuple(hole for polygon in rings for hole in polygon[1:])
            return OsmElement(name, tags, tuple(polygon[0] for polygon in rings), holes)
    return None


def _is_object(holder: Mapping[str, Any], key: str) -> bool:
    return isinstance(holder.get(key), dict)
