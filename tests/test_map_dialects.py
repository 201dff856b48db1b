"""Maps of other tools and other habits: barriers, left-hand traffic, exports that say things twice."""

import json
import re

import numpy as np
import pytest
from made_maps import FREIBURG, STREET, Map
from scipy.sparse.csgraph import dijkstra
from test_import_town import VALUES

from parkenv import InputError
from parkenv.cli.lot import _square
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.town.draft import import_town

TYPED = {"yes": True, "no": False, "9": 9.0}


def blocks(tags, at=(100, 0)):
    """Two streets side by side, joined at their ends, with a node on the first one."""
    place = Map().way([(0, 0), (100, 0)], STREET).way([(100, 0), (200, 0)], STREET)
    place.way([(0, 0), (0, 90), (200, 90), (200, 0)], STREET, name="Umweg")
    place.way([(0, 0), (-90, 0)], STREET).way([(200, 0), (290, 0)], STREET)
    place.way([(100, 0), (100, -90)], STREET)
    place.box(150, 20, 160, 30, {"amenity": "parking", "capacity": "9"})
    place.box(60, 20, 80, 30, {"building": "house"})
    return place.node(*at, **tags)


def metres(lot, one, other):
    """The way from one place to another along the lanes, m."""
    near = [int(np.hypot(*(lot.vertex_xy - at).T).argmin()) for at in (one, other)]
    return float(dijkstra(lot.drive_matrix(), indices=near[0])[near[1]])


@pytest.mark.parametrize(("tags", "passes"), VALUES["barriers"])
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


def hstore(tags):
    quoted = {key: value.replace('"', '\\"') for key, value in tags.items()}
    return ",".join(f'"{key}"=>"{value}"' for key, value in quoted.items())


DIALECTS = {
    "typed": lambda f, tags: {"@id": f["id"], **{k: TYPED.get(v, v) for k, v in tags.items()}, "ref": None},
    "ogr2ogr": lambda f, t: {"osm_id": f["id"][4:], "highway": t.pop("highway", None), "other_tags": hstore(t)},
    "pyrosm": lambda f, tags: {"id": int(f["id"][4:]), "osm_type": "way", "tags": json.dumps(tags), "name": None},
    "osmium": lambda f, tags: {"@type": "way", "@id": int(f["id"][4:]), **tags},
    "osmnx": lambda f, tags: {**tags, "osmid": [3, 4], "oneway": str("oneway" in tags), "lanes": [1, 2]},
    "quickosm": lambda f, tags: {"full_id": "w" + f["id"][4:], "osm_type": "way", **tags},
}  # fmt: skip


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
    oneway = [lane.points for lane in town.draft.lot().lanes if lane.oneway]
    length_m = sum(np.hypot(*np.diff(points, axis=0).T).sum() for points in oneway)
    assert length_m == pytest.approx(200, abs=1)


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
        shape = {"geometry": corners} if geometry else {"nodes": nodes}
        elements.append({"type": "way", "id": k + 1, "tags": tags} | shape)
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
    for k, geometry in enumerate((False, True)):
        (tmp_path / f"{k}.json").write_text(overpass(place, geometry=geometry))
    for other in (path, tmp_path / "0.json", tmp_path / "1.json"):
        town = import_town(other)
        ours, wanted = ([lane.points.round(2).tolist() for lane in its.draft.lanes] for its in (town, want))
        assert ours == wanted
        assert [row["capacity"] for row in town.facilities] == [9]


@pytest.mark.parametrize("remark", ['runtime error: timed out in "query"', "runtime error: out of memory"])
def test_partial_answers_are_refused(tmp_path, remark):
    (tmp_path / "t.json").write_text(overpass(one_way_town(), remark=remark))
    xml = one_way_town().xml().replace("</osm>", f"<remark> {remark} </remark></osm>")
    (tmp_path / "t.osm").write_text(xml)
    for name in ("t.json", "t.osm"):
        with pytest.raises(InputError, match=r"its remark says .*partial"):
            import_town(tmp_path / name)


@pytest.mark.parametrize(("tags", "meets"), [({"bridge": "yes"}, False), ({"layer": "1"}, False), ({}, True)])
def test_viaducts_do_not_meet_the_street_below(tmp_path, tags, meets):
    """In XML by the ids of nodes at one position, in GeoJSON by position alone."""
    place = Map().way([(0, 0), (100, 0), (200, 0)], STREET)
    place.way([(0, 0), (0, 90), (200, 90), (200, 0)], STREET)
    place.way([(100.0, 90), (100.0, 1e-5), (100, -90), (0, -90), (0, 0)], STREET, **tags)
    place.way([(0, 0), (-90, 0)], STREET).way([(200, 0), (290, 0)], STREET)
    place.way([(100, -90), (100, -190)], STREET).box(60, 20, 80, 30, {"building": "yes"})
    place.box(150, 20, 160, 30, {"amenity": "parking", "capacity": "9"})
    (tmp_path / "t.geojson").write_text(place.geojson())
    for path in (place.write(tmp_path / "t.osm"), tmp_path / "t.geojson"):
        town = import_town(path).draft
        one, other = town.frame.to_xy(FREIBURG.to_lonlat([[200, 0], [100, -90]]))
        assert metres(town.lot(), one, other) == pytest.approx(190 if meets else 390, abs=5)


def test_a_node_in_its_car_park_is_that_car_park(tmp_path):
    place = one_way_town().node(155, 25, amenity="parking", capacity="12", fee="yes")
    place.node(152, 25, amenity="parking", capacity="5", name="Other")
    town = import_town(place.write(tmp_path / "t.osm"))
    assert sorted((row["name"], row["capacity"]) for row in town.facilities) == [("Other", 5), ('P "1"', 9)]


def test_a_box_across_the_date_line_is_cut_there(tmp_path):
    path, frame = one_way_town().write(tmp_path / "t.osm"), LocalFrame(180.0, -16.8)

    def moved(match):
        there = frame.to_lonlat(FREIBURG.to_xy([[float(match[2]), float(match[1])]]))
        ((lon, lat),) = there.round(7).tolist()
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


def ring_town():
    """A car park that is a relation of two ways, around a garden, and nothing else with its tags."""
    place = Map().way([(0, 0), (100, 0), (200, 0)], STREET, **{"parking:both": "no"})
    place.way([(0, 0), (0, 90), (200, 90), (200, 0)], STREET, **{"parking:both": "no"})
    place.way([(200, 90), (290, 90)], STREET, **{"parking:both": "no"})
    place.way([(100, 20), (160, 20), (160, 70)], {}).way([(160, 70), (100, 70), (100, 20)], {})
    place.box(110, 30, 120, 40, {}).box(60, 20, 80, 30, {"building": "house"})
    return place.area([4, 5], [6], amenity="parking", capacity="9", name="Ring")


def test_relations_of_answers_with_geometry_are_areas(tmp_path):
    place = ring_town()
    want = import_town(place.write(tmp_path / "w.osm"))
    number, at = place.places()
    answer = json.loads(overpass(place, geometry=True))

    def member(way, role):
        corners = [at[number[point]] for point in place.ways[way - 1][0]]
        line = [{"lat": lat, "lon": lon} for lon, lat in corners]
        return {"type": "way", "ref": way, "role": role, "geometry": line}

    (outer, inner, tags), *_ = place.areas
    members = [*(member(way, "outer") for way in outer), *(member(way, "inner") for way in inner)]
    relation = {"type": "relation", "id": 1, "tags": tags, "members": members}
    # The ways of the relation are not in the answer on their own.
    left = [e for e in answer["elements"] if not (e["type"] == "way" and e["id"] in (*outer, *inner))]
    (tmp_path / "t.json").write_text(json.dumps({"version": 0.6, "elements": [*left, relation]}))
    town = import_town(tmp_path / "t.json")
    assert town.facilities == want.facilities
    assert [(row["name"], row["capacity"]) for row in town.facilities] == [("Ring", 9)]


@pytest.mark.parametrize("skeleton_first", [False, True])
def test_a_relation_that_is_given_again_without_tags_keeps_them(tmp_path, skeleton_first):
    """As `(._;>;); out body; out skel qt;` gives it."""
    place = ring_town()
    xml = place.xml()
    relation = re.search(r"<relation.*</relation>", xml)[0]
    skeleton = re.sub(r"<tag [^>]*/>", "", relation)
    both = (skeleton, relation) if skeleton_first else (relation, skeleton)
    (tmp_path / "t.osm").write_text(xml.replace(relation, "\n".join(both)))
    want, town = import_town(place.write(tmp_path / "w.osm")), import_town(tmp_path / "t.osm")
    assert town.facilities == want.facilities


@pytest.mark.parametrize("crs", ["urn:ogc:def:crs:OGC:1.3:CRS84", "urn:ogc:def:crs:EPSG::4326", None])
def test_streets_of_eight_kilometres_are_in_degrees_as_their_crs_says(tmp_path, crs):
    place = Map()
    for k in (0.0, 90):
        place.way([(0, k), (4_000, k), (4_090, k), (8_000, k)], STREET, **{"parking:both": "lane"})
        place.way([(4_000 + k, -4_000), (4_000 + k, 0), (4_000 + k, 90), (4_000 + k, 4_000)], STREET)
    content = json.loads(place.geojson())
    if crs is not None:
        content["crs"] = {"type": "name", "properties": {"name": crs}}
    (tmp_path / "t.geojson").write_text(json.dumps(content))
    town = import_town(tmp_path / "t.geojson")
    extent = np.ptp(np.concatenate([lane.points for lane in town.draft.lanes]), axis=0)
    np.testing.assert_allclose(extent, 8_000, rtol=0.01)


def test_conditions_of_roads_are_listed(tmp_path):
    place = blocks({})
    place.way([(200, 90), (290, 90)], STREET, **{"motor_vehicle:conditional": "no @ (Sa)", "oneway": "no"})
    rows = import_town(place.write(tmp_path / "t.osm")).draft.unread
    found = [(row.tag, row.value, row.assumed) for row in rows]
    assert found == [("motor_vehicle:conditional", "no @ (Sa)", "as without it")]
