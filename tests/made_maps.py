"""Maps drawn in metres and written in the formats of OpenStreetMap."""

import json
from dataclasses import dataclass, field
from xml.sax.saxutils import quoteattr

from parkenv import import_lot
from parkenv.lots.draft import ImportOptions
from parkenv.lots.local_frame import LocalFrame

FREIBURG = LocalFrame(lon=7.85, lat=48.0)
AISLE = {"highway": "service", "service": "parking_aisle"}
SERVICE = {"highway": "service"}
STREET = {"highway": "residential", "name": "Hauptstraße"}
SPACE = {"amenity": "parking_space"}
HOUSE_ROWS = (-20, 20, 180, 220, 380, 420)


@dataclass
class Map:
    """A map drawn in metres, written in any of the formats. Equal points are one node."""

    nodes: dict[tuple[float, float], dict[str, str]] = field(default_factory=dict)
    ways: list[tuple[list[tuple[float, float]], dict[str, str]]] = field(default_factory=list)
    areas: list[tuple[list[int], list[int], dict[str, str]]] = field(default_factory=list)
    turns: list[tuple[dict[str, int], tuple[str, ...], dict[str, str]]] = field(default_factory=list)

    def node(self, x, y, **tags):
        self.nodes.setdefault((x, y), {}).update(tags)
        return self

    def way(self, points, tags, **more):
        for point in points:
            self.node(*point)
        self.ways.append((points, {**tags, **more}))
        return self

    def box(self, x0, y0, x1, y1, tags, **more):
        return self.way([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)], tags, **more)

    def area(self, outer, inner, **tags):
        """A multipolygon of ways, by their numbers from 1."""
        self.areas.append((outer, inner, {"type": "multipolygon", **tags}))
        return self

    def turn(self, comes, via, leaves, roles=("from", "via", "to"), **tags):
        """A restriction of turns from a way to another one, by their numbers from 1, over a point."""
        refs = {"from": comes, "via": list(self.nodes).index(via) + 1, "to": leaves}
        self.turns.append((refs, roles, {"type": "restriction", **tags}))
        return self

    def places(self):
        lonlat = FREIBURG.to_lonlat(list(self.nodes)).round(7).tolist()
        number = {point: i + 1 for i, point in enumerate(self.nodes)}
        return number, {number[point]: at for point, at in zip(self.nodes, lonlat, strict=True)}

    def xml(self):
        number, at = self.places()

        def tags(values):
            return "".join(f"<tag k={quoteattr(k)} v={quoteattr(v)}/>" for k, v in values.items())

        lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<osm version="0.6" generator="a test">']
        for point, values in self.nodes.items():
            lon, lat = at[number[point]]
            lines.append(f'<node id="{number[point]}" lat="{lat}" lon="{lon}">{tags(values)}</node>')
        for i, (points, values) in enumerate(self.ways):
            refs = "".join(f'<nd ref="{number[point]}"/>' for point in points)
            lines.append(f'<way id="{i + 1}">{refs}{tags(values)}</way>')
        for i, (outer, inner, values) in enumerate(self.areas):
            members = "".join(
                f'<member type="way" ref="{way}" role="{role}"/>'
                for role, ways in (("outer", outer), ("inner", inner))
                for way in ways
            )
            lines.append(f'<relation id="{i + 1}">{members}{tags(values)}</relation>')
        for i, (refs, roles, values) in enumerate(self.turns):
            members = "".join(
                f'<member type="{"node" if role == "via" else "way"}" ref="{refs[role]}" role="{role}"/>'
                for role in roles
            )
            lines.append(f'<relation id="{i + 1001}">{members}{tags(values)}</relation>')
        return "\n".join([*lines, "</osm>"])

    def geojson(self, *, flat=True):
        """As osmtogeojson writes it: closed ways are polygons unless they are roads."""
        number, at = self.places()
        features = []

        def feature(name, tags, shape, coordinates):
            kind, _, digits = name.partition("/")
            own = {"@id": name, **tags} if flat else {"type": kind, "id": digits, "tags": tags}
            geometry = {"type": shape, "coordinates": coordinates}
            features.append({"type": "Feature", "id": name, "properties": own, "geometry": geometry})

        for i, (points, tags) in enumerate(self.ways):
            line = [at[number[point]] for point in points]
            if points[0] == points[-1] and "highway" not in tags:
                feature(f"way/{i + 1}", tags, "Polygon", [line])
            else:
                feature(f"way/{i + 1}", tags, "LineString", line)
        for point, tags in self.nodes.items():
            if tags:
                feature(f"node/{number[point]}", tags, "Point", at[number[point]])
        return json.dumps({"type": "FeatureCollection", "features": features})

    def write(self, path):
        path.write_text(self.xml(), encoding="utf-8")
        return path

    def draft(self, tmp_path, **options):
        return import_lot(self.write(tmp_path / "place.osm"), ImportOptions(**options))


def car_park():
    """Two rows on a one-way aisle that leaves a service road; a gate to the street; a shop."""
    place = Map()
    place.way([(-60, -20), (0, -20), (60, -20)], STREET)
    place.way([(0, -20), (0, 0), (0, 20)], SERVICE)
    place.way([(0, 0), (50, 0), (50, 20), (0, 20)], AISLE, oneway="yes")
    for k in range(12):
        x = 8 + 2.5 * k
        place.box(x, 3, x + 2.5, 8, SPACE)
        place.box(x, -8, x + 2.5, -3, SPACE, **({"parking_space": "disabled"} if k < 2 else {}))
    place.box(-4, -9, 54, 24, {"amenity": "parking", "parking": "surface", "capacity": "24"})
    place.box(10, 30, 40, 50, {"building": "retail"})
    return place.node(10, 40, entrance="yes").node(25, 30, entrance="main")


def outline_alone(half=8, **tags):
    """A 16 m × 50 m area round a 50 m aisle: 20 slots of 2.5 m on either side of it."""
    place = Map().way([(-60, -20), (0, -20), (60, -20)], STREET)
    place.way([(0, -20), (0, 0)], SERVICE).way([(0, 0), (50, 0)], AISLE)
    place.box(0, -half, 50, half, {"amenity": "parking", **tags})
    return place.box(20, 20, 40, 40, {"building": "office"})


def one_street(length=100.0, **tags):
    """A street without crossings, and a house."""
    place = Map().way([(0, 0), (length, 0)], {"highway": "residential", **tags})
    return place.box(30, 20, 50, 30, {"building": "house"})


def grid(**tags):
    """Three streets of 400 m each way, 200 m apart, with houses along them, and a shop; all leave the map."""
    place = Map()
    for y in (0, 200, 400):
        place.way([(-100, y), (0, y), (200, y), (400, y), (500, y)], {"highway": "residential"}, **tags)
    for x in (0, 200, 400):
        place.way([(x, -100), (x, 0), (x, 200), (x, 400), (x, 500)], {"highway": "residential"}, **tags)
    for along in range(-90, 500, 40):
        for beside in HOUSE_ROWS:
            place.box(along, beside - 8, along + 16, beside + 8, {"building": "house"})
            place.box(beside - 8, along, beside + 8, along + 16, {"building": "house"})
    return place.node(100, 215, shop="bakery")
