"""Lots from outlines of parking spaces alone, and the survey of lots."""

import copy
import json
import re
import sys

import numpy as np
import pytest
import shapely
from command_line import ran, refused, summary_of
from hypothesis import given, settings
from hypothesis import strategies as st
from lot_checks import refusal
from made_maps import AISLE
from made_outlines import document, double_row, kerb, row, write
from pictures import shows_color
from small_lots import features

from parkenv.errors import InputError
from parkenv.lots import check_lot, grid_lot, import_lot, packaged_lot, read_lot, write_lot
from parkenv.lots.draft import ImportOptions, Provenance, read_provenance
from parkenv.lots.infer.layout import infer_lot
from parkenv.lots.infer.spaces import spaces_from_outlines
from parkenv.show.scene import PALETTE
from parkenv.studies.lots import check_drivability, lot_columns
from parkenv.world.lot import Lane, ParkingLot

AUTO = ImportOptions(guess_entry=True, guess_goal=True)


def imported(tmp_path, rows, options=AUTO, **how):
    """The draft of made rows."""
    return import_lot(write(tmp_path / "made.geojson", document(rows, **how)), options)


def inferred(rows, obstacles=()):
    """What is inferred from made rows in metres."""
    corners = np.concatenate(rows)
    outlines = np.array([shapely.Polygon(space) for space in corners], dtype=object)
    return infer_lot(spaces_from_outlines([f"s{k}" for k in range(len(corners))], outlines), list(obstacles))


def clean(lot, tmp_path):
    """Whether a lot has no problem after it was written, neither in its file nor for a driver."""
    path = tmp_path / "lot.geojson"
    write_lot(lot, path)
    return not check_lot(path) and not check_drivability(read_lot(path)).problems


class TestLayouts:
    @pytest.mark.parametrize(
        ("name", "rows", "n_aisles"),
        [
            ("double row", double_row(), 2),
            ("single row", [row((0.0, 0.0), 0.0, 12)], 1),
            ("curve", [row((0.0, 0.0), 0.0, 24, bend=2.0), row((60.0, 6.0), 150.0, 6)], 2),
            ("step", [np.concatenate([row((0.0, 0.0), 0.0, 8), row((20.0, 1.2), 0.0, 8)])], 1),
            ("broken", [row((0.0, 0.0), 0.0, 6), row((20.0, 0.0), 0.0, 6)], 1),
            ("kerbs", [kerb((0.0, 0.0), 0.0, 6), kerb((36.0, -5.5), 180.0, 6)], 1),
            ("dead end", [row((0.0, 6.0), 0.0, 9), row((22.5, 0.0), 180.0, 9), row((25.0, 0.0), 90.0, 2)], 1),
        ],
    )
    def test_every_space_has_a_lane_and_a_driver_gets_there_and_back(self, tmp_path, name, rows, n_aisles):
        draft = imported(tmp_path, rows)
        lot = draft.lot()
        assert lot.n_slots == sum(map(len, rows)), (name, draft.left_out)
        assert clean(lot, tmp_path), name
        if name not in ("curve", "dead end"):
            assert len(inferred(rows).aisles) == n_aisles

    def test_a_row_opens_to_the_aisle_that_it_shares_and_not_to_the_verge_behind_it(self):
        # Gaps of 6, 3.9 and 6 m: the middle one separates backs.
        places = ((20.0, 0.0), 180.0), ((0.0, 6.0), 0.0), ((20.0, 19.9), 180.0), ((0.0, 25.9), 0.0)
        lot = inferred([row(*place, 8) for place in places])
        assert sorted(round(float(np.median(a.points[:, 1])), 1) for a in lot.aisles) == [3.0, 22.9]

    def test_an_oblique_row_makes_its_aisle_one_way_by_its_slant(self):
        rows = [row((0.0, 4.5), 0.0, 10, angle_deg=60.0), row((29.0, 0.0), 180.0, 10, angle_deg=120.0)]
        lot = inferred([*rows, row((30.0, 13.9), 180.0, 12), row((0.0, 19.9), 0.0, 12)])
        assert sorted(abs(aisle.one_way) for aisle in lot.aisles) == [0, 1]
        one_way = [lane for lane in lot.lanes if lane.oneway]
        assert one_way
        for lane in one_way:
            assert lane.points[-1][0] > lane.points[0][0]
            assert lane.points[:, 1] == pytest.approx(2.25, abs=0.3)

    def test_spaces_behind_other_spaces_are_left_out_by_name(self, tmp_path):
        rows = [row((0.0, 5.0 * k), 0.0, 8) for k in range(3)]
        rows += [row((0.0, 21.0), 0.0, 16), row((40.0, 38.0), 180.0, 16)]
        draft = imported(tmp_path, rows)
        assert len(draft.slots) == sum(map(len, rows)) - 8
        assert [str(left) for left in draft.left_out] == [
            "spaces that only another space leads to: 8 (way/9, way/10, way/11, way/12, way/13, ...)"
        ]

    def test_no_lane_leads_over_a_building(self, tmp_path):
        hut = [(24.0, 1.0), (28.0, 1.0), (28.0, 20.0), (24.0, 20.0), (24.0, 1.0)]
        lot = imported(tmp_path, double_row(), more=[({"building": "yes"}, hut)]).lot()
        wall = shapely.Polygon(lot.walls[0])
        assert all(shapely.LineString(lane.points).distance(wall) > 1.0 for lane in lot.lanes)
        assert clean(lot, tmp_path)


class TestRoads:
    def test_a_service_road_wins_with_its_direction(self, tmp_path):
        aisle = (AISLE | {"oneway": "yes"}, [(30.0, 3.4), (-8.0, 3.4)])
        street = ({"highway": "residential"}, [(-8.0, -20.0), (-8.0, 50.0)])
        back = ({"highway": "service"}, [(30.0, 3.4), (30.0, 30.0), (-8.0, 30.0)])
        lot = imported(tmp_path, double_row(), more=[aisle, street, back]).lot()
        one_way = [lane for lane in lot.lanes if lane.oneway]
        assert lot.n_slots == 32
        assert one_way
        assert all(lane.points[-1][0] < lane.points[0][0] for lane in one_way)

    def test_rows_that_no_road_reaches_get_aisles_and_cars_enter_from_the_street(self, tmp_path):
        aisle = (AISLE, [(-8.0, 3.2), (30.0, 3.2)])
        street = ({"highway": "residential"}, [(-8.0, -40.0), (-8.0, 3.2), (-8.0, 60.0)])
        draft = imported(tmp_path, double_row(), more=[aisle, street])
        lot = draft.lot()
        assert lot.n_slots == 32
        assert "aisles along the rows' fronts: 1" in draft.guesses
        assert any("where a lane meets a street" in guess for guess in draft.guesses)
        assert lot.entries[:, 0] == pytest.approx(lot.slot_xy[:, 0].min() - 9.25, abs=0.1)
        assert clean(lot, tmp_path)

    def test_the_goal_is_a_buildings_entrance(self, tmp_path):
        door = ({"entrance": "main"}, (40.0, 12.0))
        draft = imported(tmp_path, double_row(), more=[door])
        middle = draft.slots.xy.mean(axis=0)
        assert draft.goals - middle == pytest.approx(np.array([[30.0, 1.0]]), abs=0.3)
        assert any("entrance node/" in guess for guess in draft.guesses)


class TestGuesses:
    def test_without_leave_to_guess_the_entry_is_missing_and_a_place_is_proposed(self, tmp_path):
        entry, goal = imported(tmp_path, double_row(), ImportOptions()).missing
        assert "--entry auto" in entry
        assert "--goal auto" in goal

    def test_a_given_entry_counts(self, tmp_path):
        free = imported(tmp_path, double_row())
        options = ImportOptions(entries=(tuple(free.entries[0].tolist()),), guess_goal=True)
        guesses = imported(tmp_path, double_row(), options).guesses
        assert not any(guess.startswith("entry") for guess in guesses)

    @pytest.mark.parametrize(
        "rows", [[row((0.0, 0.0), 0.0, 8)], [row((0.0, y), 0.0, 8) for y in (0.0, 11.0, 22.0)]]
    )
    def test_rows_that_could_open_to_either_side_are_guessed_and_said(self, tmp_path, rows):
        draft = imported(tmp_path, rows)
        assert draft.lot().n_slots == sum(map(len, rows))
        assert "1 could open to either side" in " ".join(draft.guesses)
        assert draft.issues[0].reason == "rows could open to either side"

    def test_the_file_keeps_guesses_and_issues(self, tmp_path):
        draft, path = imported(tmp_path, double_row()), tmp_path / "lot.geojson"
        write_lot(draft.lot(), path, Provenance("made.geojson", draft.guesses, draft.issues))
        kept = read_provenance(path)
        assert kept.guesses == draft.guesses
        assert [issue.reason for issue in kept.issues] == [issue.reason for issue in draft.issues]
        assert read_lot(path) == draft.lot()

    def test_damaged_guesses_are_refused(self, tmp_path):
        path = tmp_path / "lot.geojson"
        path.write_text(json.dumps({"import": [1]}), encoding="utf-8")
        assert "import is" in refusal(read_provenance, path)


class TestInvariance:
    @settings(max_examples=6, deadline=None)
    @given(turned=st.floats(0.0, 360.0), east=st.floats(-3000.0, 3000.0), north=st.floats(-3000.0, 3000.0))
    def test_turning_and_moving_the_map_changes_the_frame_alone(self, tmp_path_factory, turned, east, north):
        folder = tmp_path_factory.mktemp("turned")
        rows = [*double_row(6), kerb((25.0, 0.0), 90.0, 3)]
        here = imported(folder, rows).lot()
        there = imported(folder, rows, turned_deg=turned, moved=(east, north)).lot()
        assert there.slot_ids == here.slot_ids
        assert np.array_equal(there.slot_mouth, here.slot_mouth)
        turn = there.slot_yaw - here.slot_yaw
        assert np.abs(np.exp(1j * (turn - turn[0])) - 1.0).max() < 0.02
        assert there.n_vertices - there.n_slots == pytest.approx(here.n_vertices - here.n_slots, abs=2)
        length = [sum(shapely.LineString(lane.points).length for lane in lot.lanes) for lot in (here, there)]
        assert length[1] == pytest.approx(length[0], rel=0.1)

    def test_the_order_of_spaces_does_not_matter(self, tmp_path):
        made = document(double_row())
        shuffled = made | {"features": list(np.random.default_rng(3).permutation(made["features"]))}
        lots = [import_lot(write(tmp_path / "made.geojson", d), AUTO).lot() for d in (made, shuffled)]
        one, other = (dict(zip(lot.slot_ids, lot.slot_yaw.round(6).tolist(), strict=True)) for lot in lots)
        assert one == other


def with_ring(change):
    """Change the outline of one space of a document."""
    return lambda made: change(made["features"][5]["geometry"]["coordinates"][0])


def named(made, k, name):
    made["features"][k]["id"] = made["features"][k]["properties"]["@id"] = name


def swapped(*features):
    for each in features:
        each["geometry"]["coordinates"][0] = [p[::-1] for p in each["geometry"]["coordinates"][0]]


def six_times_as_large(ring):
    ring[:] = [[a + 6.0 * (b - a) for a, b in zip(ring[0], p, strict=True)] for p in ring]


def twice(made):
    made["features"].append(copy.deepcopy(made["features"][5]))
    named(made, -1, "way/77")


class TestFaults:
    @pytest.mark.parametrize(
        ("spoil", "says"),
        [
            (lambda made: named(made, 5, "way/9"), "way/9 appears twice"),
            (with_ring(lambda ring: ring.pop()), "way/6: its outline is open"),
            (lambda made: swapped(made["features"][5]), "latitude and longitude swapped"),
            (lambda made: swapped(*made["features"]), "latitude and longitude swapped"),
            (with_ring(lambda r: r.__setitem__(slice(1, 4), [r[0]] * 3)), "way/6: .*(outline|0.0 m²)"),
            (with_ring(six_times_as_large), "way/6: .*m²"),
            (twice, "way/77: lies on way/6"),
        ],
        ids=range(7),
    )
    def test_each_is_said_in_a_line(self, tmp_path, spoil, says):
        made = document(double_row())
        spoil(made)
        assert re.search(says, refusal(import_lot, write(tmp_path / "made.geojson", made), AUTO))

    def test_an_outline_that_crosses_itself_is_left_out(self, tmp_path):
        made, cross = document(double_row()), with_ring(lambda ring: ring.insert(1, ring.pop(2)))
        cross(made)
        draft = import_lot(write(tmp_path / "made.geojson", made), AUTO)
        assert ("outlines that cross themselves", ("way/6",)) in [(o.reason, o.ids) for o in draft.left_out]
        assert "way/6" not in draft.slot_ids

    def test_too_many_spaces(self, monkeypatch, tmp_path):
        monkeypatch.setattr("parkenv.lots.osm.draft.MOST_SPACES", 10)
        with pytest.raises(InputError, match="32 parking spaces, want at most 10 in one lot"):
            imported(tmp_path, double_row())

    @pytest.mark.parametrize(
        ("rows", "says"),
        [
            ([row((0, 5 * k), 0, 16) for k in range(4)], "32 of 64 spaces have no aisle: .* another space"),
            ([row((0.0, 0.0), 0.0, 8, size=(16.0, 3.5))], "for cars: spaces larger than 30 m²"),
        ],
        ids=["landlocked", "lorries"],
    )
    def test_what_no_car_can_use_is_no_car_park(self, tmp_path, rows, says):
        assert re.search(says, refusal(imported, tmp_path, rows))


class TestExtracts:
    def test_polygons_without_tags_are_parking_spaces(self, tmp_path):
        made = document(double_row())
        for each in made["features"]:
            each["properties"] = {"fid": 1}
            del each["id"]
        path = write(tmp_path / "plain.geojson", made)
        lot = import_lot(path, AUTO).lot()
        assert (lot.n_slots, lot.slot_ids[0]) == (32, "feature/0")
        with pytest.raises(InputError, match=r"`parkenv lot import .* makes a lot of it"):
            read_lot(path)

    def test_without_osmium_a_line_says_what_to_install(self, monkeypatch, tmp_path):
        monkeypatch.setitem(sys.modules, "osmium", None)
        said = refused("lot import town.osm.pbf --split --out lots", cwd=tmp_path)
        assert 'pip install "parkenv[osm]"' in said


class TestSurvey:
    @pytest.mark.parametrize("name", ["mini", "campus", "street"])
    def test_packaged_lots_are_clean(self, name):
        survey = check_drivability(packaged_lot(name))
        assert (survey.problems, survey.error_probability) == ((), 0.0)

    def test_one_way_lanes_without_a_loop(self):
        mini = packaged_lot("mini")
        lot = ParkingLot(**{**features(mini), "lanes": (Lane(mini.lanes[0].points, oneway=True),)})
        assert any("form no loop" in p.message for p in check_drivability(lot).problems)

    def test_a_lane_over_a_slot(self):
        mini = packaged_lot("mini")
        over = Lane(np.array([mini.lanes[0].points[1], mini.slot_xy[0]]))
        survey = check_drivability(ParkingLot(**{**features(mini), "lanes": (*mini.lanes, over)}))
        assert any("leaves less than 1 m to the slot" in p.message for p in survey.problems)
        assert survey.error_probability >= 0.5


class TestTown:
    def town(self):
        parts = [document(double_row(6), moved=(200.0 * k, 0.0), turned_deg=30.0 * k) for k in range(3)]
        parts.append(document([row((0.0, 0.0), 0.0, 4)], moved=(0.0, 300.0)))
        for k, part in enumerate(parts):
            for each in part["features"]:
                number = int(each["id"].split("/")[1]) + 1000 * k
                each["id"] = each["properties"]["@id"] = f"way/{number}"
        parts[1]["features"][3]["geometry"]["coordinates"][0].pop()
        return {"type": "FeatureCollection", "features": [f for part in parts for f in part["features"]]}

    def test_each_car_park_becomes_a_lot_or_says_why_not(self, tmp_path):
        path, out = write(tmp_path / "town.geojson", self.town()), tmp_path / "lots"
        assert "3 car parks" in ran("lot", "import", path, "--split", "--out", out).stdout
        rows = summary_of(out)["rows"]
        assert sorted(row["result"] for row in rows) == ["clean", "clean", "refused"]
        (reason,) = (row["reason"] for row in rows if row["result"] == "refused")
        assert "way/1004: its outline is open" in reason
        files = {f"{row['lot']}.geojson" for row in rows if row["slots"]}
        assert {p.name for p in out.iterdir()} == {"summary.json", "contact-sheet-1.png", *files}
        picture = tmp_path / "lot.png"
        shown = ran("lot", "show", out / f"{rows[0]['lot']}.geojson", "--out", picture)
        assert "guessed: entry at" in shown.stdout
        assert all(shows_color(picture, PALETTE[name]) for name in ("ground", "asphalt", "entry"))

    @pytest.mark.parametrize(
        ("words", "says"),
        [("--entry 0,0", "--split finds entries"), ("--least 50", "of at most 24, want a group of 50")],
    )
    def test_what_cannot_be_split_is_refused(self, tmp_path, words, says):
        path = write(tmp_path / "town.geojson", self.town())
        assert says in refused(f"lot import --split {words}", path, "--out", tmp_path / "lots")
        assert not (tmp_path / "lots").exists()


def columns_of(lot):
    return lot_columns(lot, check_drivability(lot))


@pytest.fixture
def lots(tmp_path):
    folder = tmp_path / "lots"
    folder.mkdir()
    for name, lot in (("b", grid_lot(2, 5)), ("a", grid_lot(4, 30)), ("mini", packaged_lot("mini"))):
        write_lot(lot, folder / f"{name}.geojson")
    (folder / "notes.txt").write_text("no lot")
    return folder


@pytest.mark.parametrize(
    ("rows", "kind"),
    [
        (double_row(), "perpendicular"),
        ([row((0.0, 0.0), 0.0, 12, angle_deg=60.0)], "oblique"),
        ([kerb((0.0, 0.0), 0.0, 6), kerb((36.0, -5.5), 180.0, 6)], "kerbside"),
        ([kerb((0.0, 0.0), 0.0, 6), row((30.0, -5.5), 180.0, 10)], "mixed"),
    ],
)
def test_lots_are_of_the_kind_of_their_slots(tmp_path, rows, kind):
    lot = import_lot(write(tmp_path / "made.geojson", document(rows)), AUTO).lot()
    row = columns_of(lot)
    assert (row["kind"], row["slots"]) == (kind, lot.n_slots)
    assert sum(row[name] for name in ("perpendicular", "oblique", "kerbside")) == lot.n_slots


def test_the_drive_is_that_to_the_farthest_slot():
    # 30 slots of 2.5 m, 3 m from the entry, and across the lane.
    assert columns_of(grid_lot(2, 30))["drive_s"] == pytest.approx(79.75 * 0.36, abs=0.06)
    sizes = [columns_of(grid_lot(2, n))["size"] for n in (39, 40, 99, 100)]
    assert sizes == ["small", "medium", "medium", "large"]
