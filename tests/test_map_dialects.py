"""Maps of other tools and other habits: barriers, left-hand traffic, exports that say things twice."""

import json
import re

import numpy as np
import pytest
from made_maps import FREIBURG, STREET, Map
from scipy.sparse.csgraph import dijkstra

from parkenv import InputError
from parkenv.cli.lot import _square
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.town.draft import import_town

PASSES = [
    {},
    {"barrier": "gate", "motor_vehicle": "yes"},
    {"barrier": "gate", "access": "permissive"},
    {"barrier": "bollard", "access": "no", "motorcar": "yes"},
    {"barrier": "cattle_grid"},
    {"barrier": "toll_booth"},
    {"barrier": "kerb", "kerb": "lowered"},
    {"barrier": "swing_gate", "locked": "no"},
    {"highway": "crossing", "access": "no"},
]
STOPS = [
    *({"barrier": kind} for kind in ("bollard", "block", "lift_gate", "chain", "cycle_barrier", "planter")),
    {"barrier": "bollard", "bollard": "removable", "bicycle": "yes"},
    {"barrier": "gate", "access": "private"},
    {"barrier": "entrance", "vehicle": "no"},
    {"barrier": "gate", "access": "yes", "locked": "yes"},
    {"barrier": "kerb", "kerb": "raised"},
    {"motor_vehicle": "no"},
]


def blocks(tags, at=(100, 0)):
    """Two streets side by side, joined at their ends, with a node on the first one."""
    place = Map().way([(0, 0), (100, 0)], STREET).way([(100, 0), (200, 0)], STREET)
    place.way([(0, 0), (0, 90), (200, 90), (200, 0)], STREET, name="Umweg")
    place.way([(0, 0), (-90, 0)], STREET).way([(200, 0), (290, 0)], STREET).way(
        [(100, 0), (100, -90)], STREET
    )
    place.box(150, 20, 160, 30, {"amenity": "parking", "capacity": "9"})
    place.box(60, 20, 80, 30, {"building": "house"})
    return place.node(*at, **tags)


def metres(lot, one, other):
    """The way from one place to another along the lanes, m."""
    near = [int(np.hypot(*(lot.vertex_xy - at).T).argmin()) for at in (one, other)]
    return float(dijkstra(lot.drive_matrix(), indices=near[0])[near[1]])


@pytest.mark.parametrize(("tags", "passes"), [(t, True) for t in PASSES] + [(t, False) for t in STOPS])
def test_cars_pass_no_node_that_stops_them(tmp_path, tags, passes):
    """At a junction between two ways, in each format."""
    place = blocks(tags)
    (tmp_path / "t.geojson").write_text(place.geojson())
    for path in (place.write(tmp_path / "t.osm"), tmp_path / "t.geojson"):
        town = import_town(path).draft
        lot, corner = town.lot(), FREIBURG.to_lonlat([[0, 0], [200, 0]])
        assert metres(lot, *town.frame.to_xy(corner)) == pytest.approx(200 if passes else 380, abs=5)


def features(place=None):
    """The features of a town with a one-way street and a car park of 9, its kerbs tagged."""
    place = place or one_way_town()
    return json.loads(place.geojson(flat=False))["features"]


def one_way_town():
    place = Map().way([(0, 0), (100, 0), (200, 0)], STREET, oneway="yes", **{"parking:both": "no"})
    place.way([(0, 0), (0, 90), (200, 90), (200, 0)], STREET, **{"parking:both": "no"})
    place.way([(200, 90), (290, 90)], STREET, **{"parking:both": "no"})
    place.box(150, 20, 160, 30, {"amenity": "parking", "capacity": "9", "name": 'P "1"'})
    return place.box(60, 20, 80, 30, {"building": "house"})


TYPED = {"yes": True, "no": False, "9": 9.0}


def hstore(tags):
    quoted = {key: value.replace('"', '\\"') for key, value in tags.items()}
    return ",".join(f'"{key}"=>"{value}"' for key, value in quoted.items())


DIALECTS = {
    "typed": lambda f, tags: {"@id": f["id"], **{k: TYPED.get(v, v) for k, v in tags.items()}, "ref": None},
    "ogr2ogr": lambda f, tags: {
        "osm_id": f["id"][4:],
        "highway": tags.pop("highway", None),
        "other_tags": hstore(tags),
    },
    "pyrosm": lambda f, tags: {
        "id": int(f["id"][4:]),
        "osm_type": "way",
        "tags": json.dumps(tags),
        "name": None,
    },
    "osmium": lambda f, tags: {"@type": "way", "@id": int(f["id"][4:]), **tags},
    "osmnx": lambda f, tags: {**tags, "osmid": [3, 4], "oneway": str("oneway" in tags), "lanes": [1, 2]},
    "quickosm": lambda f, tags: {"full_id": "w" + f["id"][4:], "osm_type": "way", **tags},
}


@pytest.mark.parametrize("twice", ["no", "areas", "same", "version"])
@pytest.mark.parametrize("dialect", DIALECTS)
def test_exports_are_read_as_they_are_meant_and_each_thing_once(tmp_path, dialect, twice):
    listed = []
    for f in features():
        plain = {"type": "Feature", "geometry": f["geometry"]}
        tags = dict(f["properties"]["tags"])
        plain["properties"] = DIALECTS[dialect](f, tags)
        listed.append(plain)
        shape, line = f["geometry"]["type"], f["geometry"]["coordinates"]
        if twice == "areas" and shape == "Polygon":
            plain["geometry"] = {"type": "LineString", "coordinates": line[0]}
            area = {"type": "MultiPolygon", "coordinates": [[line[0][::-1]]]}
            listed.append({**plain, "geometry": area})
        elif twice in ("same", "version"):
            old = {**plain["properties"], "@version": 1}
            plain["properties"] = {**plain["properties"], "@version": 2}
            listed.insert(0, {**plain, "properties": old if twice == "version" else plain["properties"]})
    path = tmp_path / "t.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": listed}))
    town = import_town(path)
    assert [(row["capacity"], row["capacity_from"]) for row in town.facilities] == [(9, "tag")]
    assert [row["name"] for row in town.facilities] == ['P "1"']
    lot = town.draft.lot()
    assert sum(np.hypot(*np.diff(lane.points, axis=0).T).sum() for lane in lot.lanes if lane.oneway) == (
        pytest.approx(200, abs=1)
    )


def overpass(place, *, geometry=False, **more):
    """An answer of Overpass in JSON."""
    number, at = place.places()
    elements = [
        {"type": "node", "id": i, "lat": lat, "lon": lon, "tags": tags}
        for ((point, tags), (i, (lon, lat))) in zip(place.nodes.items(), at.items(), strict=True)
        if tags or not geometry
    ]
    for k, (points, tags) in enumerate(place.ways):
        nodes = [number[point] for point in points]
        corners = [{"lat": at[i][1], "lon": at[i][0]} for i in nodes]
        elements.append(
            {"type": "way", "id": k + 1, "tags": tags}
            | ({"geometry": corners} if geometry else {"nodes": nodes})
        )
    return json.dumps({"version": 0.6, "elements": elements, **more})


def test_answers_of_overpass_are_read_with_and_without_geometry(tmp_path):
    place = one_way_town()
    number, at = place.places()
    xml, path = place.xml(), tmp_path / "t.osm"
    for i in number.values():
        xml = xml.replace(f'<nd ref="{i}"/>', f'<nd ref="{i}" lat="{at[i][1]}" lon="{at[i][0]}"/>')
    xml = re.sub(r"<node [^>]*></node>\n", "", xml)
    path.write_text(xml)
    want = import_town(place.write(tmp_path / "w.osm"))
    texts = [overpass(place), overpass(place, geometry=True)]
    for k, text in enumerate(texts):
        (tmp_path / f"{k}.json").write_text(text)
    for other in (path, tmp_path / "0.json", tmp_path / "1.json"):
        town = import_town(other)
        assert [lane.points.round(2).tolist() for lane in town.draft.lanes] == [
            lane.points.round(2).tolist() for lane in want.draft.lanes
        ]
        assert [row["capacity"] for row in town.facilities] == [9]


@pytest.mark.parametrize(
    "remark", ['runtime error: Query timed out in "query"', "runtime error: out of memory"]
)
def test_partial_answers_are_refused(tmp_path, remark):
    (tmp_path / "t.json").write_text(overpass(one_way_town(), remark=remark))
    xml = one_way_town().xml().replace("</osm>", f"<remark> {remark} </remark></osm>")
    (tmp_path / "t.osm").write_text(xml)
    for name in ("t.json", "t.osm"):
        with pytest.raises(InputError, match=r"its remark says .*partial"):
            import_town(tmp_path / name)


@pytest.mark.parametrize(
    ("layer", "joined"), [({"bridge": "yes"}, False), ({"layer": "1"}, False), ({}, True)]
)
def test_viaducts_do_not_meet_the_street_below(tmp_path, layer, joined):
    """In XML by the ids of nodes at one position, in GeoJSON by position alone."""
    place = (
        Map().way([(0, 0), (100, 0), (200, 0)], STREET).way([(0, 0), (0, 90), (200, 90), (200, 0)], STREET)
    )
    place.way([(100.0, 90.0), (100.0, 1e-5), (100, -90), (0, -90), (0, 0)], STREET, **layer)
    place.way([(0, 0), (-90, 0)], STREET).way([(200, 0), (290, 0)], STREET).way(
        [(100, -90), (100, -190)], STREET
    )
    place.box(150, 20, 160, 30, {"amenity": "parking", "capacity": "9"}).box(
        60, 20, 80, 30, {"building": "yes"}
    )
    (tmp_path / "t.geojson").write_text(place.geojson())
    for path in (place.write(tmp_path / "t.osm"), tmp_path / "t.geojson"):
        town = import_town(path).draft
        one, other = town.frame.to_xy(FREIBURG.to_lonlat([[200, 0], [100, -90]]))
        assert metres(town.lot(), one, other) == pytest.approx(190 if joined else 390, abs=5)


def test_a_node_in_its_car_park_is_that_car_park(tmp_path):
    place = one_way_town().node(155, 25, amenity="parking", capacity="12", fee="yes")
    place.node(152, 25, amenity="parking", capacity="5", name="Other")
    town = import_town(place.write(tmp_path / "t.osm"))
    assert sorted((row["name"], row["capacity"]) for row in town.facilities) == [("Other", 5), ('P "1"', 9)]


def test_a_box_across_the_date_line_is_cut_there(tmp_path):
    path, frame = one_way_town().write(tmp_path / "t.osm"), LocalFrame(180.0, -16.8)

    def moved(match):
        ((lon, lat),) = (
            frame.to_lonlat(FREIBURG.to_xy([[float(match[2]), float(match[1])]])).round(7).tolist()
        )
        return f'lat="{lat}" lon="{lon}"'

    path.write_text(re.sub(r'lat="([^"]*)" lon="([^"]*)"', moved, path.read_text()))
    whole = import_town(path)
    south, west, north, east = _square("-16.8,180,1000")
    assert west > 179.9
    assert east < -179.9
    town = import_town(path, bounds=((south, west), (north, east)))
    assert [row["capacity"] for row in town.facilities] == [9]
    assert len(town.draft.lanes) == len(whole.draft.lanes)
    assert _square("89.999,0,1000")[1::2] == (-180.0, 180.0)
