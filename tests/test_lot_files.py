import copy
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import ran
from hypothesis import given, settings
from hypothesis import strategies as st
from lot_checks import DRAGON_LAKE, needs_dragon_lake, refusal
from pyproj import Geod, Transformer

from parkenv.errors import InputError
from parkenv.files.file_names import is_plain
from parkenv.files.known_names import PACKAGED_LOTS
from parkenv.lots import grid_lot, import_lot, packaged_lot, read_lot, write_lot
from parkenv.lots.draft import ImportOptions
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.lot_files import check_lot
from parkenv.world.lot import Lane, Mouth, ParkingLot

PACKAGED = Path(__file__).parents[1] / "parkenv" / "lots" / "packaged"
LEFT, RIGHT = Mouth.LEFT, Mouth.RIGHT
points = st.tuples(*[st.floats(-1e6, 1e6)] * 2)


def feature(kind, shape, coordinates, **properties):
    geometry = {"type": shape, "coordinates": coordinates}
    return {"type": "Feature", "properties": {"kind": kind, **properties}, "geometry": geometry}


def box(x0, y0, x1, y1):
    return [[[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]]


def document():
    """A sound lot of two slots: features 0 and 1; 2 is the lane, 3 the entry, 4 the goal, 5 a wall."""
    return {
        "type": "FeatureCollection",
        "name": "two",
        "parkenv": {"format": "lot", "version": 1},
        "frame": "local",
        "features": [
            feature("slot", "Polygon", box(10, 3, 12.5, 8), id="a"),
            feature("slot", "Polygon", box(20, 3, 22.5, 8), id="b"),
            feature("lane", "LineString", [[0, 0], [40, 0]], oneway=False),
            feature("entry", "Point", [0, 0]),
            feature("goal", "Point", [45, 0]),
            feature("wall", "LineString", [[0, 12], [40, 12]]),
        ],
    }


def written(tmp_path, content) -> Path:
    path = tmp_path / "lot.geojson"
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def read(tmp_path, content) -> ParkingLot:
    return read_lot(written(tmp_path, content))


def with_exact(slot, **changes):
    shape = {"center": [11.25, 5.5], "yaw": np.pi / 2, "length": 5.0, "width": 2.5, "mouth": "rear"}
    slot["properties"].update({**shape, **changes})


@settings(max_examples=15)
@given(
    size=st.tuples(st.integers(1, 5), st.integers(1, 5), st.floats(2.0, 4.0), st.floats(3.0, 9.0)),
    turn=st.floats(-4.0, 4.0),
    at=st.tuples(points, points),
    name=st.text().filter(is_plain),
    walls=st.lists(st.lists(points, min_size=2, max_size=5), max_size=3),
    speed=st.floats(0.25, 4.0),
    cost=st.just(0.0) | st.floats(0.0, 1e8),
    zone=st.text(alphabet="centre, 1=ä", max_size=8),
)
def test_written_lots_are_read_back_to_the_bit(tmp_path, size, turn, at, name, walls, speed, cost, zone):
    (rows, columns, pitch, aisle), (shift, goal) = size, at
    grid = grid_lot(rows, columns, name=name, pitch=pitch, aisle=aisle)
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def moved(xy):
        return xy @ matrix.T + shift

    lot = replace(
        grid,
        slot_xy=moved(grid.slot_xy),
        slot_yaw=grid.slot_yaw + turn,
        lanes=tuple(Lane(moved(lane.points), k == 0, speed) for k, lane in enumerate(grid.lanes)),
        entries=moved(grid.entries),
        goals=[goal],
        walls=tuple(map(np.array, walls)),
        slot_parking_cost_s=np.linspace(0.0, cost, grid.n_slots),
        slot_zone=[zone, *[""] * (grid.n_slots - 1)],
    )
    path = tmp_path / "lot.geojson"
    write_lot(lot, path)
    again = read_lot(path)
    assert again == lot
    assert again.slot_xy.tobytes() == lot.slot_xy.tobytes()
    assert again.edge_length.tobytes() == lot.edge_length.tobytes()


def test_parking_costs_need_no_exact_shape_and_stand_with_their_slot(tmp_path):
    doc = document()
    doc["features"][1]["properties"]["parking_cost_s"] = 120
    assert read(tmp_path, doc).slot_parking_cost_s.tolist() == [0.0, 120.0]
    with_exact(doc["features"][0], parking_cost_s=7.5)
    lot = read(tmp_path, doc)
    assert lot.slot_parking_cost_s.tolist() == [7.5, 120.0]
    write_lot(replace(lot, slot_parking_cost_s=[0.0, 120.0]), tmp_path / "again.geojson")
    slots = [f["properties"] for f in json.loads((tmp_path / "again.geojson").read_text())["features"][:2]]
    assert "parking_cost_s" not in slots[0]  # files of lots without costs stay as they are
    assert slots[1]["parking_cost_s"] == 120.0


def test_files_that_cannot_be_written_or_read_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"written as \.geojson or \.json"):
        write_lot(packaged_lot("mini"), tmp_path / "lot.yml")
    with pytest.raises(InputError, match="cannot be written"):
        write_lot(packaged_lot("mini"), tmp_path / "nowhere" / "lot.geojson")
    assert list(tmp_path.iterdir()) == []
    assert "No such file" in refusal(read_lot, tmp_path / "lot.geojson")
    assert "unknown kind of file '.osm'" in refusal(read_lot, tmp_path / "lot.osm")
    with pytest.raises(InputError, match=r"not JSON: .* at line 1 column"):
        read(tmp_path, json.dumps(document())[:-37])
    (tmp_path / "lot.json").write_bytes(b'{"name": "\xff"}')
    assert "not UTF-8 text" in refusal(read_lot, tmp_path / "lot.json")


@pytest.mark.parametrize(
    ("y", "oneway", "mouth", "yaw"),
    [
        (-3.95, False, LEFT, 0.0),
        (3.95, False, LEFT, np.pi),
        (-3.95, True, LEFT, 0.0),
        (3.95, True, RIGHT, 0.0),
    ],
)
def test_kerbside_cars_stand_as_traffic_runs(tmp_path, y, oneway, mouth, yaw):
    doc = document()
    doc["features"][0] = feature("slot", "Polygon", box(10, y - 1.05, 16, y + 1.05), id="kerb")
    doc["features"][2]["properties"]["oneway"] = oneway
    lot = read(tmp_path, doc)
    assert lot.slot_mouth[0] == mouth
    assert np.cos(lot.slot_yaw[0] - yaw) == pytest.approx(1.0)


# At corners of a town, an outline alone does not say which of two streets a place at the kerb belongs to.
@pytest.mark.parametrize("name", [name for name in PACKAGED_LOTS if name not in ("town", "kerbs")])
def test_outlines_alone_tell_the_same_lots(tmp_path, name):
    doc = json.loads((PACKAGED / f"{name}.geojson").read_text())
    for f in doc["features"]:
        if f["properties"]["kind"] == "slot":
            f["properties"] = {"kind": "slot", "id": f["properties"]["id"]}
    lot, known = read(tmp_path, doc), packaged_lot(name)
    np.testing.assert_array_equal(lot.slot_mouth, known.slot_mouth)
    np.testing.assert_allclose(lot.slot_xy, known.slot_xy, atol=2e-3)
    np.testing.assert_allclose(lot.slot_length, known.slot_length, atol=4e-3)
    np.testing.assert_allclose(lot.slot_width, known.slot_width, atol=4e-3)
    assert np.cos(lot.slot_yaw - known.slot_yaw).min() > 0.9999


def test_longitude_and_latitude_become_metres(tmp_path):
    geod, known = Geod(ellps="WGS84"), packaged_lot("jam")

    def to_globe(x, y):
        lon, lat, _ = geod.fwd(7.8342, 48.0131, np.degrees(np.arctan2(x, y)), np.hypot(x, y))
        return lon, lat, 270.0

    doc = moved(json.loads((PACKAGED / "jam.geojson").read_text()), to_globe)
    del doc["parkenv"]
    lot = read(tmp_path, doc)
    assert lot.slot_ids == known.slot_ids
    offset = (lot.slot_xy - known.slot_xy).mean(axis=0)
    np.testing.assert_allclose(lot.slot_xy - offset, known.slot_xy, atol=0.01)
    np.testing.assert_allclose(lot.goals - offset, known.goals, atol=0.01)
    np.testing.assert_allclose(lot.slot_length, known.slot_length, atol=0.01)
    np.testing.assert_array_equal(lot.slot_mouth, known.slot_mouth)
    np.testing.assert_array_equal(lot.neighbors, known.neighbors)


def test_a_centimetre_and_points_that_lanes_share_are_no_faults(tmp_path):
    doc = document()
    with_exact(doc["features"][0], center=[11.255, 5.5])
    assert read(tmp_path, doc).slot_xy[0, 0] == 11.255
    doc = document()
    doc["features"][2] = feature("lane", "LineString", [[0, 0], [30, 0], [40, 0]])
    lanes([[30, -9], [30, 0], [30, 9]], [[45, 15], [30, 9]])(doc)
    assert check_lot(written(tmp_path, doc)) == []


@needs_dragon_lake
def test_dragon_lake_is_a_lot():
    lot = read_lot(DRAGON_LAKE)
    assert (lot.n_slots, lot.slot_ids[0]) == (364, "A-0-0")
    assert {"A-0-41", "B-1-24", "I-0-20"} < set(lot.slot_ids)
    np.testing.assert_allclose(lot.entries, [[14.38, 76.21]])
    np.testing.assert_allclose(lot.vertex_xy[lot.entry_vertices], lot.entries)
    np.testing.assert_allclose(lot.goals, [[80.0, -4.0]])
    assert check_lot(DRAGON_LAKE) == []


def lanes(*lines):
    return lambda doc: doc["features"].extend(feature("lane", "LineString", line) for line in lines)


BAD = json.loads(Path(__file__).with_name("bad_lots.json").read_text(encoding="utf-8"))
"""Changes of the sound lot, the number of the feature that is at fault, if it is one, and what is said of it."""


def changed(changes):
    doc, features = document(), changes.get("features", {})
    if isinstance(features, list):
        return doc | changes
    for number, its in features.items():
        doc["features"][int(number) : int(number) + 1] = [its]
    return doc | {name: value for name, value in changes.items() if name != "features"}


@pytest.mark.parametrize(("changes", "number", "message"), BAD["faults"])
def test_faults_are_named(tmp_path, changes, number, message):
    path = written(tmp_path, changed(changes))
    errors = [problem for problem in check_lot(path) if problem.severity == "error"]
    assert [problem.feature for problem in errors] == [number]
    assert message in errors[0].message
    where = "" if number is None else f"feature {number}: "
    assert refusal(read_lot, path) == f"{path}: {where}{errors[0].message}"


def moved(doc, change):
    """Return a document without `frame` whose positions are changed."""

    def of(xy):
        return [of(part) for part in xy] if isinstance(xy[0], list) else list(change(*xy[:2]))

    made = {key: value for key, value in doc.items() if key != "frame"}
    made["features"] = copy.deepcopy(doc["features"])
    for f in made["features"]:
        f["geometry"]["coordinates"] = of(f["geometry"]["coordinates"])
    return made


def crs(name):
    return {"type": "name", "properties": {"name": name}}


@pytest.mark.parametrize(("east", "north"), [(0, 0), (377_920, 5_823_000)])
def test_bare_outlines_in_metres_of_their_own_frame_keep_their_numbers(tmp_path, east, north):
    spaces = [feature(None, "Polygon", box(2.5 * i, 0, 2.5 * i + 2.5, 5)) for i in range(6)]
    for space in spaces:
        space["properties"] = {}
    doc = moved({"type": "FeatureCollection", "features": spaces}, lambda x, y: (x + east, y + north))
    options = ImportOptions(goals=((east + 0.5, north - 0.5),), entries=((east - 10.0, north - 3.0),))
    lot = import_lot(written(tmp_path, {**doc, "frame": "local"}), options).lot()
    assert sorted(lot.slot_xy[:, 0].round(3)) == [2.5 * i + 1.25 + east for i in range(6)]
    np.testing.assert_allclose(lot.goals, options.goals)
    assert "frame" in refusal(import_lot, written(tmp_path, doc), options)


@pytest.mark.parametrize("name", ["EPSG:25832", "urn:ogc:def:crs:EPSG::25832", "EPSG:2263"])
def test_positions_in_a_map_grid_are_converted(tmp_path, name):
    middle = (-74.0, 40.7) if "2263" in name else (9.0, 48.0)  # New York's grid is in feet
    to_grid = Transformer.from_crs("OGC:CRS84", f"EPSG:{name.rpartition(':')[2]}", always_xy=True)
    frame = LocalFrame(*middle)
    doc = moved(document(), lambda x, y: to_grid.transform(*frame.to_lonlat([x, y])[0]))
    lot = read_lot(written(tmp_path, {**doc, "crs": crs(name)}))
    np.testing.assert_allclose(np.diff(lot.slot_xy, axis=0), [[10.0, 0.0]], atol=0.01)
    np.testing.assert_allclose(lot.slot_width, 2.5, atol=0.01)


@pytest.mark.parametrize(
    ("change", "head"),
    [
        (lambda x, y: (x, y), {}),
        (lambda x, y: (x, y), {"crs": crs("EPSG:99999")}),
        (lambda x, y: (x, y), {"crs": crs("+proj=pipeline +step +init=/etc/passwd")}),
        (lambda x, y: (x, y), {"crs": {"type": "link", "properties": {"href": "http://localhost"}}}),
        (lambda x, y: (x + 1e7, y + 9e7), {"crs": crs("EPSG:25832")}),
    ],
)
def test_positions_of_no_known_kind_are_refused_with_what_to_add(tmp_path, change, head):
    path = written(tmp_path, {**moved(document(), change), **head})
    assert "crs" in refusal(read_lot, path)


def test_a_position_off_the_globe_among_others_is_named(tmp_path):
    frame = LocalFrame(9.0, 48.0)
    doc = moved(document(), lambda x, y: frame.to_lonlat([x, y])[0].tolist())
    doc["features"][4]["geometry"]["coordinates"] = [450.0, 0.0]
    (problem,) = check_lot(written(tmp_path, doc))
    assert problem.feature == 4


def test_all_faults_are_listed_at_once(tmp_path):
    doc = document()
    doc["features"][0]["properties"]["kind"] = "slott"
    doc["features"][1]["geometry"]["coordinates"] = box(20, 60, 22.5, 65)
    doc["features"][3]["geometry"]["coordinates"] = [0, 99]
    doc["features"][4]["geometry"]["coordinates"] = [None, 0]
    lanes([[20, -30], [20, 30]])(doc)
    path = written(tmp_path, doc)
    problems = check_lot(path)
    assert [p.severity for p in problems] == ["error"] * 4 + ["warning"]
    assert [p.feature for p in problems] == [0, 4, 3, 1, 6]
    assert str(problems[0]).startswith("error: feature 0: kind is 'slott'")
    with pytest.raises(InputError, match=r"feature 0: kind .* \(and 3 more"):
        read_lot(path)


@pytest.mark.parametrize(("changes", "number", "message"), BAD["warnings"])
def test_slips_of_the_pen_are_warned_of_and_read(tmp_path, changes, number, message):
    path = written(tmp_path, changed(changes))
    problems = check_lot(path)
    assert {p.severity for p in problems} == {"warning"}
    assert any(p.feature == number and message in p.message for p in problems), problems
    assert read_lot(path).n_slots == 2


def test_slots_that_cannot_be_reached_or_left_are_warned_of(tmp_path):
    doc = document()
    # A one-way lane away from the entry: its slot is a trap. One towards the entry: no way leads there.
    doc["features"] += [
        feature("lane", "LineString", [[40, 0], [80, 0]], oneway=True),
        feature("slot", "Polygon", box(60, 3, 62.5, 8), id="trap"),
        feature("lane", "LineString", [[-40, 0], [0, 0]], oneway=True),
        feature("slot", "Polygon", box(-20, 3, -17.5, 8), id="upstream"),
    ]
    problems = check_lot(written(tmp_path, doc))
    assert [(p.feature, p.message) for p in problems] == [
        (9, "slot 'upstream': cannot be reached from an entry"),
        (7, "slot 'trap': no other slot can be reached from it"),
        (None, "one-way lanes have a dead end at (80.0, 0.0) m: no lane leads on"),
    ]


def test_commands_state_parking_costs_and_draw_them(tmp_path):
    costs = np.array([0.0, 0.0, 30.0, 60.0, 90.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    write_lot(replace(packaged_lot("mini"), slot_parking_cost_s=costs), tmp_path / "priced.geojson")
    for words in (["check"], ["show", "--out", str(tmp_path / "priced.png")]):
        told = ran("lot", words[0], tmp_path / "priced.geojson", *words[1:])
        assert "parking costs 0 to 90 s (3 slots above 0)" in told.stdout
