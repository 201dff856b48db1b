"""Lots made from OpenStreetMap: what is read, what by rule, what is refused."""

import bz2
import gzip
import re

import numpy as np
import osmium
import pytest
import shapely
from command_line import ran, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from lot_checks import refused_lot
from made_maps import AISLE, FREIBURG, SERVICE, SPACE, STREET, Map, car_park, one_street, outline_alone
from pictures import shows_color

from parkenv.errors import InputError
from parkenv.lots import packaged_lot, read_lot, write_lot
from parkenv.lots.draft import ImportOptions
from parkenv.lots.generators import nearest_on_lanes
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.lot_files import check_lot, import_lot
from parkenv.show.figures.lots import SOURCE_COLORS, TWO_WAY
from parkenv.world.drive_graph import SLOT_REACH


def reasons(draft):
    return {left.reason: left.ids for left in draft.left_out}


def in_map_metres(draft, xy):
    """Points of a draft in the metres that the map was drawn in."""
    return FREIBURG.to_xy(draft.frame.to_lonlat(xy))


def of_text(tmp_path, text, name="a.osm", **options):
    """The draft of a map's text."""
    (tmp_path / name).write_text(text, encoding="utf-8")
    return import_lot(tmp_path / name, ImportOptions(**options))


@pytest.mark.parametrize("flat", [True, False])
def test_all_formats_give_the_same_lot(tmp_path, flat):
    draft = car_park().draft(tmp_path)
    other = of_text(tmp_path, car_park().geojson(flat=flat), "a.geojson")
    assert reasons(other) == reasons(draft)
    for name in ("slot_ids", "slot_xy", "neighbors", "goals"):
        np.testing.assert_array_equal(getattr(other.lot(), name), getattr(draft.lot(), name))


def test_native_lots_pass_through_and_a_map_is_none(tmp_path):
    lot = packaged_lot("mini")
    write_lot(lot, tmp_path / "mini.geojson")
    assert import_lot(tmp_path / "mini.geojson").lot() == lot
    moved = import_lot(tmp_path / "mini.geojson", ImportOptions(goals=((3.0, 4.0),))).lot()
    assert moved.goals.tolist() == [[3.0, 4.0]]
    with pytest.raises(InputError, match="bounds apply to OpenStreetMap"):
        import_lot(tmp_path / "mini.geojson", ImportOptions(bounds=((0, 0), (9, 9))))
    for name, text in (("a.osm", car_park().xml()), ("a.json", car_park().geojson())):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=r"`parkenv lot import .* makes a lot of it"):
            read_lot(tmp_path / name)


@given(st.floats(-179.9, 179.9), st.floats(-85, 85), st.floats(-3000, 3000), st.floats(-3000, 3000))
def test_there_and_back_on_the_globe_is_less_than_a_centimetre(lon, lat, x, y):
    frame = LocalFrame(lon=lon, lat=lat)
    np.testing.assert_allclose(frame.to_xy(frame.to_lonlat([[x, y]])), [[x, y]], atol=0.01)


@pytest.mark.parametrize(
    ("new", "old"),
    [
        ({"parking:right": "lane"}, {"parking:lane:right": "parallel"}),
        (
            {"parking:left": "street_side", "parking:left:orientation": "perpendicular"},
            {"parking:lane:left": "perpendicular", "parking:lane:left:perpendicular": "street_side"},
        ),
        (
            {"parking:both": "lane", "parking:both:orientation": "diagonal"},
            {"parking:lane:both": "diagonal", "parking:lane:both:diagonal": "on_street"},
        ),
    ],
)
def test_the_old_tagging_says_the_same_as_the_new(tmp_path, new, old):
    slots = [one_street(**tags).draft(tmp_path).slots for tags in (new, old)]
    assert len(slots[0]) > 6
    for name in ("xy", "yaw", "length", "width", "mouth"):
        np.testing.assert_array_equal(*(getattr(each, name) for each in slots))


def test_given_entries_and_goals_count_by_metres_or_degrees(tmp_path):
    frame = car_park().draft(tmp_path).frame
    lon, lat = FREIBURG.to_lonlat([[25.0, 25.0]])[0].tolist()
    by_degrees = car_park().draft(tmp_path, goals=((lat, lon),), entries=((lat, lon),))
    np.testing.assert_allclose(in_map_metres(by_degrees, by_degrees.goals), [[25.0, 25.0]], atol=0.01)
    x, y = frame.to_xy([[lon, lat]])[0].tolist()
    by_metres = car_park().draft(tmp_path, goals=((x, y),), entries=((x, y),))
    np.testing.assert_allclose(by_metres.goals, by_degrees.goals, atol=1e-9)
    np.testing.assert_allclose(by_metres.entries, by_degrees.entries, atol=1e-9)


def test_without_goal_or_entry_it_refuses_and_says_how_to_give_one(tmp_path):
    place = Map().way([(0, 0), (50, 0)], AISLE).box(10, 3, 12.5, 8, SPACE).box(13, 3, 15.5, 8, SPACE)
    draft = place.draft(tmp_path)
    assert (len(draft.slots), len(draft.missing)) == (2, 2)
    with pytest.raises(InputError, match=r"no entry: .*--entry LAT,LON; lanes end at .*no goal: .*--goal"):
        draft.lot()
    problems = check_lot(tmp_path / "place.osm")
    assert [p.message.split(":")[0] for p in problems if p.severity == "error"] == ["no entry", "no goal"]
    ends = draft.missing[0].split("lanes end at ")[1].split(" and ")
    entry = tuple(float(word) for word in ends[0].split(","))
    lot = place.draft(tmp_path, entries=(entry,), goals=((30.0, 30.0),)).lot()
    assert lot.n_slots == 2


def test_bounds_cut_the_map(tmp_path):
    south, west = FREIBURG.to_lonlat([[-10.0, -30.0]])[0][::-1].tolist()
    north, east = FREIBURG.to_lonlat([[20.6, 60.0]])[0][::-1].tolist()
    draft = car_park().draft(tmp_path, bounds=((south, west), (north, east)))
    x = in_map_metres(draft, draft.slots.xy)[:, 0]
    assert len(x) == 3 + 5
    assert x.max() < 20.6
    with pytest.raises(InputError, match="want an area"):
        car_park().draft(tmp_path, bounds=((south, west), (south, east)))


def with_text(change):
    return lambda: change(car_park().xml())


FAULTS = {
    "gpx.osm": (lambda: "<gpx/>", "gpx"),
    "beyond.osm": (with_text(lambda t: t.replace('lat="', 'lat="1')), r"node/1: lat is 14\d"),
    "number.osm": (with_text(lambda t: t.replace('lon="', 'lon="NaN', 1)), "NaN7"),
    "id.osm": (with_text(lambda t: t.replace('id="1"', 'id="one"', 1)), "'one'"),
    "nodes.osm": (with_text(lambda t: re.sub('<nd ref="', '<nd ref="9', t)), "none of its ways has its nodes"),
    "node_twice.osm": (
        with_text(lambda t: t.replace("<way", '<node id="1" lat="48.1" lon="7.8"/><way', 1)), "node/1 appears twice"
    ),
    "swapped.osm": (
        with_text(lambda t: re.sub(r'(<node id="1" )lat="(.*?)" lon="(.*?)"', r'\1lat="\3" lon="\2"', t)),
        r"way/\d+ is at 7\.8\d+, 4\d\.\d+ .* swapped",
    ),
    "bare.osm": (lambda: "<osm version='0.6'/>", "no parking"),
    "street.osm": (lambda: Map().way([(0, 0), (9, 0)], STREET).xml(), "no parking"),
    "crossed.osm": (lambda: car_park().way([(1, 1), (4, 4), (4, 1), (1, 4), (1, 1)], SPACE).xml(), "way/30"),
    "ring.geojson": (
        lambda: car_park().geojson().replace('"Polygon", "coordinates": [[', '"Polygon", "coordinates": [[], [', 1),
        r"way/4: coordinates are \[\]",
    ),
    "far.geojson": (
        lambda: car_park().geojson().replace('"coordinates": [[', '"coordinates": [[200, ', 1), "way/1: lon is 200"
    ),
    "overpass.json": (lambda: '{"elements": []}', "no parking"),
    "a.shp": (lambda: "", r"'\.shp'"),
    "slots.csv": (lambda: "x,y\n0,0\n2.5,0", r"'\.csv', want .*02_your_own_lot\.py"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "text", "named"), [(n, *fault) for n, fault in FAULTS.items()], ids=FAULTS)
def test_faults_are_named_in_one_line(tmp_path, name, text, named):
    path = tmp_path / name
    path.write_text(text(), encoding="utf-8")
    assert re.search(named, refused_lot(import_lot, path))


def clipped(place, x):
    """The text of a map, without the nodes east of x."""
    number, _ = place.places()
    gone = "|".join(str(number[point]) for point in place.nodes if point[0] > x)
    return re.sub(rf'<node id="(?:{gone})" .*?</node>\n', "", place.xml())


def test_streets_and_areas_end_at_the_edge_of_the_map(tmp_path):
    """No lane leads across a gap; of a multipolygon or building that is cut, what is left counts."""
    points = [(0, 0), (40, 0), (80, 0), (80, 40), (40, 40), (0, 40)]
    place = Map().way(points, STREET, **{"parking:both": "lane"})
    whole, cut = place.draft(tmp_path), of_text(tmp_path, clipped(place, 50))
    assert len(whole.lanes) == 1
    assert sorted(np.hypot(*np.diff(lane.points, axis=0).T).sum().round() for lane in cut.lanes) == [40, 40]
    assert any(line.startswith("cut at the edge of the map: 1 (way/1)") for line in cut.found)
    assert 0 < len(cut.slots) < len(whole.slots)
    assert len(set(cut.slot_ids)) == len(cut.slot_ids)
    place = Map().way([(0, -20), (0, 0)], SERVICE).way([(0, 0), (50, 0)], AISLE)
    place.way([(-60, -20), (0, -20), (60, -20)], STREET)
    place.way([(0, -8), (50, -8)], {}).way([(50, -8), (50, 8), (0, 8)], {})
    for outer in ([4, 5, 99], [99], [1]):
        place.area(outer, [], amenity="parking")
    place.way([(20, 20), (60, 30), (40, 40), (20, 40), (20, 20)], {"building": "office"})
    draft = of_text(tmp_path, clipped(place, 59), entries=((0.0, -20.0),))
    assert {name.split("-")[0] for name in draft.slot_ids} == {"relation/1"}
    assert len(draft.slots) == len(outline_alone().draft(tmp_path).slots)
    assert len(draft.goals) == 1
    assert reasons(draft)["multipolygons without an outline in the file"] == ("relation/2",)
    assert reasons(draft)["multipolygons with an open outline"] == ("relation/3",)


def test_what_is_cut_deleted_or_stands_twice_counts_once_or_not(tmp_path):
    """Elements may stand twice, with and without tags, as Overpass writes them for `out body; >; out skel qt;`."""
    draft = of_text(tmp_path, clipped(car_park().box(90, 0, 95, 5, SPACE), 65))
    assert reasons(draft)["ways beyond the edge of the map"] == ("way/30",)
    assert len(draft.slots) == 22
    draft = of_text(tmp_path, car_park().xml().replace('<way id="4">', '<way id="4" visible="false">'))
    assert len(draft.slots) == 21
    assert "way/4" not in draft.slot_ids
    text = car_park().xml()
    again = re.sub(r"<tag [^>]*/>", "", text[text.index("<node") : text.index("</osm>")])
    once, twice = of_text(tmp_path, text), of_text(tmp_path, text.replace("</osm>", again + "</osm>"))
    assert twice.slot_ids == once.slot_ids
    assert np.array_equal(twice.slots.xy, once.slots.xy)


def test_packed_maps_and_extracts_give_the_same_lot(tmp_path):
    plain = car_park().write(tmp_path / "a.osm")
    for suffix, pack in (("gz", gzip.compress), ("bz2", bz2.compress)):
        (tmp_path / f"a.osm.{suffix}").write_bytes(pack(plain.read_bytes()))
    with osmium.SimpleWriter(str(tmp_path / "a.osm.pbf")) as writer:
        for element in osmium.FileProcessor(str(plain)):
            writer.add(element)
    for suffix in ("gz", "bz2", "pbf"):
        assert import_lot(tmp_path / f"a.osm.{suffix}").lot() == import_lot(plain).lot()


@settings(max_examples=6)
@given(
    turn=st.floats(-3.2, 3.2),
    aisle=st.floats(5.0, 9.0),
    n=st.integers(1, 9),
    width=st.floats(2.2, 3.0),
    tags=st.sampled_from([{}, {"oneway": "yes"}, {"oneway": "-1"}]),
    kerb=st.sampled_from([{}, {"parking:both": "lane"}, {"parking:right": "on_kerb", "width": "7"}]),
)
def test_every_slot_is_tied_to_a_lane_before_its_mouth(tmp_path, turn, aisle, n, width, tags, kerb):
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    plain = Map().way([(-60, -30), (0, -30), (80, -30)], STREET, **kerb)
    plain.way([(0, -30), (0, 0)], SERVICE).way([(0, 0), (40, 0)], AISLE, **tags)
    plain.way([(40, 0), (40, -30), (0, -30)], SERVICE).box(10, 40, 20, 50, {"building": "yes"})
    for k in range(n):
        x = 5 + width * k
        plain.box(x, aisle / 2, x + width, aisle / 2 + 5, SPACE)
    plain.box(3, -aisle / 2 - 5, 37, -aisle / 2 + 0.5, {"amenity": "parking"})
    place = Map()
    for points, own in plain.ways:
        place.way([tuple((matrix @ p).round(6).tolist()) for p in points], own)
    draft, again = place.draft(tmp_path), place.draft(tmp_path)
    lot = draft.lot()
    assert lot == again.lot()
    assert [str(left) for left in draft.left_out] == [str(left) for left in again.left_out]
    # What is drawn is there but for slots that a one-way aisle leaves behind.
    assert sum(i.count("/") == 1 and "-" not in i for i in lot.slot_ids) == n
    mouth = lot.mouth_xy()
    to_lane = nearest_on_lanes(lot.lanes, mouth)[0] - mouth
    assert np.hypot(*to_lane.T).max() <= SLOT_REACH
    outward = mouth - lot.slot_xy
    assert ((outward * to_lane).sum(axis=1) > 0).all()
    boxes = shapely.polygons(lot.slot_corners())
    lanes = shapely.union_all([shapely.LineString(lane.points) for lane in lot.lanes])
    assert not shapely.intersects(boxes, lanes).any()


def test_the_command_line_imports_draws_and_checks(tmp_path):
    lot, picture = tmp_path / "lot.geojson", tmp_path / "lot.png"
    words = ("lot", "import", car_park().write(tmp_path / "place.osm"), "--out", lot)
    done = ran(*words, "--picture", picture)
    assert "slots from amenity=parking_space: 22" in done.stdout
    assert "left out: spaces for disabled drivers: 2 (way/5, way/7)" in done.stdout
    assert read_lot(lot).n_slots == 22
    assert all(shows_color(picture, color) for color in (SOURCE_COLORS[0], TWO_WAY))
    assert "--goal is '48', want 2 numbers separated by commas, e.g. 10,90" in refused(*words, "--goal", "48")


def test_the_command_line_draws_what_it_refuses_and_writes_no_lot(tmp_path):
    Map().way([(0, 0), (50, 0)], AISLE).box(9, 3, 12, 8, SPACE).write(tmp_path / "bare.osm")
    said = refused("lot import bare.osm --out bare.geojson --picture bare.png", cwd=tmp_path)
    assert said.startswith("parkenv: error: bare.osm: no entry")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bare.osm", "bare.png"]


@pytest.mark.parametrize(
    ("out", "picture", "message"),
    [
        ("taken.geojson", "lot.png", "taken.geojson: cannot be written: Is a directory"),
        ("lot.geojson", "none/lot.png", "none/lot.png: cannot be written: No such file or directory"),
    ],
)
def test_no_output_is_written_if_one_cannot_be(tmp_path, out, picture, message):
    car_park().write(tmp_path / "place.osm")
    (tmp_path / "taken.geojson").mkdir()
    said = refused("lot import place.osm --out", out, "--picture", picture, cwd=tmp_path)
    assert said == f"parkenv: error: {message}\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["place.osm", "taken.geojson"]
