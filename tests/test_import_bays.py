"""Registers of bays at the kerbs of streets: side, place, ids and rules; what does not fit is listed."""

import json
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from command_line import ran, refused, rows_in
from hypothesis import given, settings
from hypothesis import strategies as st
from lot_checks import refusal
from made_maps import FREIBURG, Map
from test_import_town import VALUES

from parkenv.lots import check_lot, import_lot, read_lot, write_lot
from parkenv.lots.bays.register import read_bays
from parkenv.lots.bays.rules import tags_of
from parkenv.lots.draft import ImportOptions
from parkenv.lots.generators import nearest_on_lanes
from parkenv.lots.town.draft import import_town
from parkenv.lots.town.supply import rules_of
from parkenv.world.lot import Mouth

ROOT = Path(__file__).parents[1]
KERBS = ROOT.parent / "shared" / "data" / "kerbs"


def degrees(points):
    return FREIBURG.to_lonlat(points).round(7)[:, ::-1].tolist()


def meters(path, points, **columns):
    """A table of meters at points, m, with ids A0, A1, ... and columns of texts."""
    names = ["bay_id", "lat", "lon", *columns]
    values = [[f"A{i}", *at] for i, at in enumerate(degrees(points))]
    rows = [[*row, *texts] for row, *texts in zip(values, *columns.values(), strict=True)]
    path.write_text("\n".join(",".join(map(str, row)) for row in [names, *rows]))
    return path


def outlines(path, boxes):
    """A register of boxes: centre, length, width, m, and angle, degrees."""
    features = []
    for k, (x, y, length, width, angle) in enumerate(boxes):
        turn = np.radians(angle)
        axis = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * (length / 2, width / 2) @ axis
        ring = [[lon, lat] for lat, lon in degrees(np.add(corners, [x, y]))]
        outline = {"type": "Polygon", "coordinates": [ring]}
        features.append({"properties": {"id": 1000 + k}, "geometry": outline})
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def cross(tmp_path, **tags):
    """Two streets that cross at (0, 0), and an alley in the north-east."""
    elm = {"highway": "residential", "name": "Elm St"}
    place = Map().way([(-200, 0), (0, 0), (120, 0), (200, 0)], elm, **tags)
    place.way([(0, -200), (0, 0), (0, 200)], {"highway": "residential", "name": "Oak St"})
    place.way([(120, 0), (120, 60)], {"highway": "service"})
    return place.write(tmp_path / "streets.osm")


def imported(tmp_path, bays, **options):
    return import_town(cross(tmp_path), bays=bays, bays_only=True, **options)


def left_out(town):
    return {left.reason: set(left.ids) for left in town.bays_left_out}


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    angle=st.floats(0.0, 180.0), half_width=st.floats(4.2, 11.0), noise=st.floats(0.0, 1.5),
    oneway=st.booleans(), left_hand=st.booleans(), seed=st.integers(0, 99),
)  # fmt: skip
def test_meters_become_slots_on_their_side_of_their_street(
    tmp_path_factory, angle, half_width, noise, oneway, left_hand, seed
):
    """A generated street of known kerbs, meters with noise: all keep id, side and place; the lane keeps its way."""
    tmp_path, turn = tmp_path_factory.mktemp("town"), np.radians(angle)
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    ends = [tuple((s * along).round(3).tolist()) for s in (-180, 0, 180)]
    place = Map().way(ends, {"highway": "tertiary"}, **({"oneway": "yes"} if oneway else {}))
    place.way(
        [ends[0], *(tuple((s * along + 150 * across).round(3).tolist()) for s in (-180, 180)), ends[2]],
        {"highway": "tertiary"},
    )
    rng, side = np.random.default_rng(seed), np.repeat([-1.0, 1.0], 40)
    station = np.tile(-150 + 7.0 * np.arange(40), 2)
    true = station[:, None] * along + (half_width * side)[:, None] * across
    bays = meters(tmp_path / "bays.csv", true + rng.uniform(-noise, noise, true.shape))
    town = import_town(place.write(tmp_path / "town.osm"), bays=bays, bays_only=True, left_hand=left_hand)
    lot = town.draft.in_left_hand_traffic().lot() if left_hand else town.draft.lot()
    assert lot.slot_ids == tuple(sorted((f"A{i}" for i in range(80)), key=lot.slot_ids.index))
    of = np.array([int(name[1:]) for name in lot.slot_ids])
    xy = lot.slot_xy + town.draft.frame.to_xy([[FREIBURG.lon, FREIBURG.lat]]) * -1.0
    assert np.hypot(*(xy - true[of]).T).max() < 5.0 + 1.5 * noise
    assert ((xy @ across) * side[of] > 0.0).all()
    _, tangent, one = nearest_on_lanes(lot.lanes, lot.mouth_xy())
    assert (np.abs(tangent @ along) > 0.99).all()
    assert (one == oneway).all()
    heading = np.cos(lot.slot_yaw) * along[0] + np.sin(lot.slot_yaw) * along[1]
    traffic = np.ones(80) if oneway else np.where((side[of] < 0) ^ left_hand, 1.0, -1.0)
    np.testing.assert_allclose(heading, traffic, atol=1e-3)


def test_outlines_are_slots_as_drawn_and_keep_their_ids(tmp_path):
    """Along the street, across it and at an angle, with their own sizes, entered from the street."""
    boxes = [(-90, 5, 6.1, 2.2, 2), (-70, -7, 5.2, 2.6, 90), (-60, -7, 5, 2.5, 60), (-50, -7, 5, 2.5, 120)]
    draft = imported(tmp_path, outlines(tmp_path / "bays.geojson", boxes)).draft
    assert dict(zip(draft.slot_ids, draft.slots.mouth.tolist(), strict=True)) == {
        "1000": Mouth.LEFT, "1001": Mouth.REAR, "1002": Mouth.REAR, "1003": Mouth.REAR,
    }  # fmt: skip
    order = np.argsort(draft.slot_ids)
    np.testing.assert_allclose(draft.slots.length[order], [6.1, 5.2, 5.0, 5.0], atol=0.02)
    np.testing.assert_allclose(np.degrees(draft.slots.yaw[order]) % 360, [182, 270, 240, 300], atol=0.3)
    assert (draft.slots.outward()[order, 1] * [-1, 1, 1, 1] > 0.8).all()
    spaces = outlines(tmp_path / "spaces.geojson", [(2.6 * k, 0, 5.0, 2.5, 90) for k in range(12)])
    names = import_lot(spaces, ImportOptions(guess_entry=True, guess_goal=True)).slot_ids
    assert set(names) == {str(1000 + k) for k in range(12)}


def test_bays_stand_at_the_street_of_their_name_and_close_meters_across_it(tmp_path):
    row = [(-100 + 2.7 * k, 6.0) for k in range(8)]
    post = [(-100.0, -6.0)] * 3 + [(-50.0, -6.0)] * 5
    town = imported(tmp_path, meters(tmp_path / "bays.csv", row + post))
    mouth = dict(zip(town.draft.slot_ids, town.draft.slots.mouth.tolist(), strict=True))
    assert all(mouth[f"A{k}"] == Mouth.REAR for k in range(8))
    assert {"A8", "A9", "A10"} <= mouth.keys()
    assert left_out(town) == {"bays without room at the kerb within 4.9 m, beside others": {"A11", "A15"}}
    write_lot(town.draft.lot(), tmp_path / "lot.geojson")
    assert not [problem for problem in check_lot(tmp_path / "lot.geojson") if "overlaps" in problem.message]
    at = [(-10.0, 9.0), (-9.0, -10.0), (110.0, 7.0), (117.0, 40.0)]
    streets = ["100 ELM STREET", "Oak St between Elm St and Ash St", "", ""]
    town = imported(tmp_path, meters(tmp_path / "bays.csv", at, block_face=streets))
    street = dict(zip(town.draft.slot_ids, town.draft.slots.facility.tolist(), strict=True))
    assert street["A0"].startswith("Elm St")
    assert street["A1"].startswith("Oak St")
    assert street["A2"].startswith("Elm St")
    assert street["A3"].startswith("way/3")


def test_kerb_lines_hold_the_most_cars_counted(tmp_path):
    line = ";".join(f"{lat} {lon}" for lat, lon in degrees([(-100, 5), (-60, 5)]))
    rows = [f"K,{line},{a},{b}" for a, b in ((1, ""), (5, 2), (3, 3))] + ["Z,,1,1"]
    bays = tmp_path / "counts.csv"
    bays.write_text("\n".join(["block,line,green,red", *rows]))
    town = imported(tmp_path, bays, columns="cars=green+red")
    assert set(town.draft.slot_ids) == {f"K-{k}" for k in range(1, 8)}
    assert left_out(town) == {"bays without a position": {"Z"}}
    assert "capacity of kerb lines, which is not given: the most cars in any row" in town.draft.found


def test_what_does_not_fit_is_listed_by_reason_and_refuses_nothing(tmp_path):
    at = [(-90, 5), (-80, 5), (500, 90), (-60, 0), (-40, 5), (-40, 5)]
    bays = meters(tmp_path / "bays.csv", at, policy=["", "TAXI", "", "", "", ""])
    text = bays.read_text().replace("A5", "A0") + "\nA7,,7.8,\n,48,7.85,\nA8,91,7,"
    bays.write_text(text)
    town = imported(tmp_path, bays)
    assert set(town.draft.slot_ids) == {"A0", "A4"}
    assert left_out(town) == {
        "bays whose id is that of another place": {"A0"},
        "bays without a position": {"A7", "A8"},
        "bays without an id": {"line 9"},
        "bays where no car may park at any hour": {"A1"},
        "bays without a street within 20 m": {"A2"},
        "bays on the centre line of their street": {"A3"},
    }
    assert "2 of 9 bays, 22 %, stand on a street" in town.draft.found


@pytest.mark.parametrize(("rule", "zone"), VALUES["registers"])
def test_rules_in_words_and_columns_become_zones(rule, zone):
    tags, unread = tags_of((tuple(rule.items()),) if rule else ())
    assert not unread
    assert rules_of(tags).zone("kerb").name == f"kerb {zone}"


def test_what_of_a_rule_is_not_read_is_counted_with_its_words(tmp_path):
    bays = meters(
        tmp_path / "bays.csv", [(-90, 5), (-80, 5), (-70, 5)],
        rate=["$1 - $3"] * 2 + ["0"], time_limit=["soon", "60", "60"], type=["Alien", "Metered", "Metered"],
    )  # fmt: skip
    unread = {(u.tag, u.value): (u.count, u.assumed) for u in imported(tmp_path, bays).draft.unread}
    assert unread == {
        ("rate", "$1 - $3"): (2, "the middle, as the hours of each price are not given"),
        ("limit", "soon"): (1, "no limit of stays"),
        ("class", "Alien"): (1, "open to everybody"),
    }


def test_registers_that_cannot_be_read_say_what_was_wanted(tmp_path):
    bays = tmp_path / "bays.csv"
    bays.write_text("Ref,Northing,Easting\n1,48.0,7.85\n")
    assert "no position in its columns Ref, Northing, Easting; want --columns" in refusal(read_bays, bays)
    assert "'Nording'" in refusal(read_bays, bays, "lat=Nording")
    assert "'latitude'" in refusal(read_bays, bays, "latitude=Northing")
    assert len(read_bays(bays, "bay=Ref,lat=Northing,lon=Easting").ids) == 1
    bays.write_text("bay_id,lat,lon\n1,,\n")
    assert "no bay in it (bays without a position: 1)" in refusal(read_bays, bays)
    far = meters(tmp_path / "far.csv", [(9_000.0, 9_000.0)])
    assert "by overpass-turbo.eu" in refusal(imported, tmp_path, far)
    near = meters(tmp_path / "near.csv", [(60.0, 60.0)])
    said = refusal(imported, tmp_path, near)
    assert "no bay stands at a street of the map (bays without a street within 20 m: 1" in said


def test_the_command_writes_the_lot_and_what_is_left_out(tmp_path):
    bays = meters(tmp_path / "bays.csv", [(-100 + 6 * k, 6) for k in range(9)] + [(300, 300)])
    streets, out = cross(tmp_path, oneway="yes"), tmp_path / "lot.geojson"
    said = ran("lot", "import", str(streets), "--bays", str(bays), "--out", str(out))
    assert "9 of 10 bays, 90 %, stand on a street" in said.stdout
    missing = [{"reason": "bays without a street within 20 m", "id": "A9"}]
    assert rows_in(tmp_path / "lot.left_out.csv") == missing
    assert set(read_lot(out).slot_ids) == {f"A{k}" for k in range(9)}
    assert not any(problem.severity == "error" for problem in check_lot(out))
    assert "--columns wants --bays" in refused("lot import", streets, "--columns", "lat=y", "--out", out)
    beside = ("lot", "import", str(streets), "--bays", str(bays), "--out", str(bays.with_suffix(".geojson")))
    assert f"would replace {bays}, which is read" in refused(*beside)
    assert len(rows_in(bays)) == 10


def streets_of(register, out, columns, monkeypatch):
    words = ["streets_of_bays.py", str(register), "--out", str(out), "--columns", columns]
    monkeypatch.setattr(sys, "argv", words)
    import_module("examples.streets_of_bays").main()
    return import_town(out, bays=register, columns=columns, bays_only=True)


def test_streets_are_drawn_between_bays_where_no_map_is_at_hand(tmp_path, monkeypatch):
    """Facing rows have a street between them; a single one has one beside it; all are one network."""
    rows = [(-100 + 6 * k, y) for k in range(12) for y in (-7, 7)] + [(30, 40 + 6 * k) for k in range(9)]
    bays = meters(tmp_path / "bays.csv", rows)
    town = streets_of(bays, tmp_path / "streets.osm", "", monkeypatch)
    assert len(town.draft.slot_ids) == len(rows)
    assert town.draft.lot().n_slots == len(rows)


@pytest.mark.slow
@pytest.mark.skipif(not KERBS.exists(), reason="no shared data here")
@pytest.mark.parametrize(
    ("register", "columns", "share"),
    [
        ("la_meters/meters.csv.gz", "", 0.98),
        ("melbourne_bays/bays.geojson.gz", "", 0.95),
        ("denver_rounds/counts.csv", "cars=green+red+disabled", 0.95),
        ("boston_rounds/counts.csv", "", 0.95),
    ],
)
def test_real_registers_stand_on_streets(register, columns, share, tmp_path, monkeypatch):
    town = streets_of(KERBS / register, tmp_path / "streets.osm", columns, monkeypatch)
    n_out = sum(len(left.ids) for left in town.bays_left_out)
    assert len(town.draft.slot_ids) / (len(town.draft.slot_ids) + n_out) >= share
    assert town.draft.lot().n_slots == len(town.draft.slot_ids)
