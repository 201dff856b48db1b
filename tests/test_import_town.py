"""Towns from OpenStreetMap: what a small map gives by tags and by rules, and what real extracts give."""

import bz2
import gzip
import json
import random
import struct
import zlib
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from car_park_counts import write_counts
from command_line import ran, refused, rows_in
from hypothesis import given, settings
from hypothesis import strategies as st
from lot_checks import refusal
from made_maps import FREIBURG, HOUSE_ROWS, STREET, Map, grid
from scipy.sparse.csgraph import dijkstra

from benchmarks.parking_rules import fit_kerbs, kerb_table
from parkenv import make_scenario
from parkenv.lots import read_lot, write_lot
from parkenv.lots.draft import read_provenance
from parkenv.lots.infer.network import limit_junctions
from parkenv.lots.osm import elements
from parkenv.lots.osm.conditions import Charge, charge_in, closed_parking, duration, hours_text, week_of
from parkenv.lots.osm.elements import read_map
from parkenv.lots.osm.roads import closed_to_cars, whole_number
from parkenv.lots.town.draft import import_town
from parkenv.lots.town.supply import PLACES_PER_METRE, Rules, kerb_rules, rules_of
from parkenv.scenarios.spec import lot_scenario
from parkenv.studies.fleet.study import FleetStudy
from parkenv.world.drive_graph import build_drive_graph
from parkenv.world.lot import Lane
from parkenv.world.tariff import Hours

TOWNS = Path(__file__).parents[2] / "shared" / "data" / "towns"
EXTRACTS = sorted((TOWNS / "osm").glob("*.osm.*"))
VALUES = json.loads(Path(__file__).with_name("osm_values.json").read_text(encoding="utf-8"))
"""What values of tags mean: `null` where nobody can read them."""
READERS = {
    "capacity": whole_number,
    "charge": lambda text: None if (read := charge_in(text)) is None else asdict(read),
    "maxstay": duration,
    "opening_hours": lambda text: None if (week := week_of(text)) is None else hours_text(week.minutes),
}


def draft(place, tmp_path):
    return import_town(place.write(tmp_path / "town.osm"))


def row_of(town, name):
    (row,) = (row for row in town.facilities if row["name"] == name)
    return row


@settings(max_examples=12, deadline=None)
@given(st.lists(st.sampled_from([0, 1, -1]), min_size=5, max_size=9), st.randoms(use_true_random=False))
def test_junctions_of_many_streets_are_split_and_lead_where_they_led(directions, random):
    """Of streets that meet in one place, some one-way into it or out of it."""
    angles = np.sort([random.uniform(0.0, 2 * np.pi) for _ in directions]) + 0.05 * np.arange(len(directions))
    ends = 80.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    lanes = [
        Lane(np.array([[0.0, 0.0], end] if way >= 0 else [end, [0.0, 0.0]]), oneway=way != 0)
        for way, end in zip(directions, ends, strict=True)
    ]
    split = limit_junctions(lanes)
    graph = build_drive_graph([(lane.points, lane.oneway, 1.0) for lane in split], np.empty((0, 2)), ends)
    matrix = np.zeros((len(graph.vertex_xy),) * 2)
    source, column = np.nonzero(graph.neighbors >= 0)
    matrix[source, graph.neighbors[source, column]] = 1.0
    reached = np.isfinite(dijkstra(matrix, indices=graph.entry_vertices))[:, graph.entry_vertices]
    comes, goes = np.array(directions) <= 0, np.array(directions) >= 0
    assert reached[np.ix_(comes, goes)].all()


def test_cars_drive_as_fast_as_the_street_allows(tmp_path):
    """Streets have their limit over 30 km/h, and a move takes its metres at the speed of its edge."""
    place = grid().way([(0, 0), (0, -50)], STREET).way([(0, -50), (150, -50)], STREET, maxspeed="50")
    lot = draft(place, tmp_path).draft.lot()
    moves, scenario = lot.neighbors >= 0, make_scenario(lot, v_drive=5.0)
    metres = scenario.move_s[moves] * lot.edge_speed[moves] * 5.0
    np.testing.assert_allclose(metres, lot.edge_length[moves], rtol=1e-12)
    assert lot.drive_matrix(timed=True).sum() / 5.0 == pytest.approx(scenario.move_s[moves].sum(), rel=0.02)


def test_untagged_streets_have_as_many_places_as_their_class(tmp_path):
    """200 m of a street between two crossings: 10.1 m are free at each corner."""
    lot = draft(grid(), tmp_path).draft.lot()
    assert all(facility.kind == "kerb" for facility in lot.facilities)
    crossings, arms = 9, 4
    free = 2 * 6 * 600.0 - crossings * arms * 2 * (3.0 + 2.1 + 5.0)
    assert lot.n_slots == pytest.approx(PLACES_PER_METRE["residential"] * free, rel=0.06)


def test_values_that_nobody_can_read_are_as_none(tmp_path):
    """Odd values of tags, as maps of the world have them, make a lot with the places that are tagged plainly."""
    odd = {
        "capacity": ("12;14", "-3", "many", "99999999", "12 x 3", "\u0661\u0662"),
        "charge": ("free", "0 EUR/0 min", "1e9 EUR/hour", "999999 EUR/hour", "\u20ac2; \u20ac3", "2 EUR/"),
        "maxstay": ("P1D", "unlimited", "0 min", "2 hours @ (Mo-Fr 08:00-18:00)", "1e99 h", "-1 h"),
        "opening_hours": ("sunrise-sunset", "Mo-Su 22:00-06:00", "Mo-Fr 25:00-99:00", "PH off", "open", ";;"),
        "access": ("destination", "?", "permissive", "customers", "yes;no", ""),
        "building:levels": ("-1", "0", "3.5", "1e9", "x", "12;3"),
    }
    road = {
        "maxspeed": ("none", "signals", "-1", "20;30", "DE:urban", "0"),
        "width": ("0.1", "99", "-3", "12'", "narrow", "3 m"),
        "lanes": ("0", "1.5", "99", "x", "-2", "2;3"),
        "parking:both": ("lane", "??", "yes", "separate", "half_on_kerb", "street_side"),
        "parking:both:orientation": ("diagonal", "x", "parallel", "perpendicular", "", "marked"),
        "parking:both:capacity": ("20-30", "50+", "-1", "0", "x", "1,500"),
    }
    place = grid()
    for k in range(6):
        own = {"amenity": "parking", **{name: values[k] for name, values in odd.items()}}
        x, named = 20 + 30 * k, {"fee": "yes", "name": f"P{k}"}
        place.box(x, 20, x + 20, 60, own, **named)
        plain = own | {"capacity": str(70 + k), "name": f"Q{k}", "access": "yes"}
        place.box(x, 120, x + 20, 160, plain, parking="multi-storey")
        x, way = 200 + 40 * k, {name: values[k] for name, values in road.items()}
        place.way([(x, 200), (x + 20, 290), (x, 400)], way, highway="unclassified")
    town = draft(place, tmp_path)
    assert [row_of(town, f"Q{k}")["capacity"] for k in range(6)] == [70 + k for k in range(6)]
    lot = town.draft.lot()
    assert lot.capacity.sum() == sum(row["capacity"] for row in town.facilities)
    assert all(1.0 <= facility.capacity < 1e5 for facility in lot.facilities if facility.is_counted)


@pytest.mark.parametrize(("tag", "text"), [(tag, text) for tag in READERS for text in VALUES[tag]])
def test_values_are_read_as_people_write_them(tag, text):
    wanted = VALUES[tag][text]
    if isinstance(wanted, dict):
        wanted = asdict(Charge(**wanted))
    assert READERS[tag](text) == wanted


@pytest.mark.parametrize(("tags", "closed"), VALUES["closed"])
def test_the_most_specific_access_closes_or_opens(tags, closed):
    assert closed_to_cars(tags) == closed == closed_parking(tags)


@pytest.mark.parametrize(("tags", "fields"), VALUES["rules"])
def test_fees_stays_and_access_become_rules(tags, fields):
    """Kerbs are read by both tagging schemes, on the right; an hour from ten costs what the rules say."""
    rules, at_kerb = Rules(**fields), any(name.startswith("parking:") for name in tags)
    assert (kerb_rules(tags, "right") if at_kerb else rules_of(tags)) == rules
    zone, paid_s = rules.zone("lot"), 3600.0 - rules.free_s
    charged = Hours.parse(rules.charged) if rules.charged else None
    assert (zone.users, zone.max_stay_s, zone.price.charged) == ((rules.users,), rules.max_stay_s, charged)
    assert zone.hours == (Hours.parse(rules.hours) if rules.hours else None)
    if not rules.hourly:
        paid_s = charged.within(36_000.0, paid_s) if charged else paid_s
        expected = 24 * rules.per_hour if rules.by_day else rules.per_hour * paid_s / 3600.0
        assert float(zone.price.amount(36_000.0, 3600.0)) == expected


def test_what_cannot_be_read_is_listed(tmp_path):
    place = grid(**{"parking:both": "no"})
    tags = {"amenity": "parking", "capacity": "a few", "opening_hours": "Mo-Fr bis 20:00", "maxstay": "brief"}
    place.box(20, 20, 60, 60, tags, name="P1").box(80, 20, 120, 60, tags, name="P2", charge="2 EUR")
    third = {"amenity": "parking", "capacity": "30", "capacity:disabled": "30"}
    place.box(140, 20, 180, 60, third, name="P3")
    path, out = place.write(tmp_path / "town.osm"), tmp_path / "town.geojson"
    assert "by area and levels" in ran("lot", "import", path, "--town", "--out", out).stdout
    rows = rows_in(tmp_path / "town.unread.csv")
    assert [(row["tag"], row["value"], row["count"], row["assumed"]) for row in rows] == [
        ("capacity", "a few", "2", "by area and levels"),
        ("charge", "2 EUR", "1", "2 an hour"),
        ("maxstay", "brief", "2", "no limit of stays"),
        ("opening_hours", "Mo-Fr bis 20:00", "2", "always open"),
    ]
    town = import_town(path)
    assert [str(vars(row)["count"]) for row in town.draft.unread] == [row["count"] for row in rows]
    disabled = next(f for f in town.draft.facilities if f.name == "P3, disabled")
    assert disabled.capacity == 30
    assert town.draft.zone_rules[disabled.zone].users == ("disabled",)


def test_goals_weigh_by_what_stands_there(tmp_path):
    lot = draft(grid(), tmp_path).draft.lot()
    assert set(lot.goal_weights) == {"residents", "commuters", "shoppers", "visitors", "deliveries"}
    assert len(lot.goals) <= 100
    # The only shop: all shoppers go to its goal.
    assert (lot.goal_weights["shoppers"] > 0).sum() == 1
    houses = 2 * 15 * len(HOUSE_ROWS)
    assert lot.goal_weights["residents"].sum() == pytest.approx(houses * 16 * 16 * 2 / 1e3, rel=0.02)


def test_a_town_comes_back_from_its_file_and_the_command_writes_its_table(tmp_path):
    place = grid().box(20, 20, 60, 60, {"amenity": "parking", "name": "P1", "fee": "yes", "capacity": "77"})
    path, out = place.write(tmp_path / "town.osm"), tmp_path / "out" / "town.geojson"
    out.parent.mkdir()
    ran("lot", "import", path, "--town", "--out", out, "--picture", tmp_path / "town.png")
    town = import_town(path)
    write_lot(town.draft.lot(), tmp_path / "again.geojson")
    assert read_lot(out) == read_lot(tmp_path / "again.geojson") == town.draft.lot()
    rows = rows_in(out.with_suffix(".csv"))
    assert sum(int(row["capacity"]) for row in rows) == read_lot(out).capacity.sum()
    assert {row["capacity_from"] for row in rows} == {"tag", "rule"}
    assert json.loads(out.read_text(encoding="utf-8"))["import"]["guesses"]
    assert (tmp_path / "town.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("place", "message"),
    [
        (Map().box(0, 0, 9, 9, {"amenity": "parking"}), "no street in it"),
        (Map().way([(0, 0), (90, 0)], STREET, oneway="yes"), "no street in it leads back"),
        (grid(**{"parking:both": "no"}), "no parking in it"),
    ],
)
def test_what_is_no_town_is_refused_in_one_line(tmp_path, place, message):
    assert message in refusal(draft, place, tmp_path)


def test_a_part_is_cut_out_and_a_town_of_guessed_kerbs_says_so(tmp_path):
    """A square of 400 m holds 350 m of two streets each way, and four of nine crossings."""
    whole, path, out = draft(grid(), tmp_path), tmp_path / "town.osm", tmp_path / "part.geojson"
    lat, lon = FREIBURG.lat + 50 / 111_195, FREIBURG.lon + 50 / 111_195 / np.cos(np.radians(FREIBURG.lat))
    around = ("--around", f"{lat:.7f},{lon:.7f},200")
    done = ran("lot", "import", path, "--town", *around, "--untagged-kerbs", 0.5, "--out", out)
    part = read_lot(out)
    assert "left out: clipped: outside the bounds" in done.stdout
    assert np.ptp([p for lane in part.lanes for p in lane.points], axis=0) == pytest.approx([350, 350], abs=1)
    assert len(part.entries) == 8
    free, all_of_it = 4 * 2 * 350.0 - 4 * 4 * 2 * 10.1, 6 * 2 * 600.0 - 9 * 4 * 2 * 10.1
    assert part.n_slots / whole.draft.lot().n_slots == pytest.approx(0.5 * free / all_of_it, rel=0.1)
    caution = read_provenance(out).caution
    assert f"{part.n_slots} of {part.n_slots} spaces (100 %)" in caution
    fleet = FleetStudy().changed(scenarios=(lot_scenario(out),))
    assert list(fleet.cautions().values()) == [caution]


@pytest.mark.slow
@pytest.mark.skipif(not EXTRACTS, reason="the extracts that README of shared/data names are not here")
@pytest.mark.parametrize("path", EXTRACTS, ids=lambda path: path.name.split("_")[0])
def test_real_extracts_become_towns(path):
    pytest.importorskip("osmium", reason="the extra osm is not installed")
    town = import_town(path)
    lot = town.draft.lot()
    # Bollards close streets in the centre of Dortmund: 96.6 % without them.
    assert float(town.draft.found[0].split("km, ")[1].split("%")[0]) >= 94.5
    elements = {e.id: e.tags for e in read_map(path).elements if e.tags.get("amenity") == "parking"}
    listed = {row["element"] for row in town.facilities} & set(elements)
    lost = {name for left in town.draft.left_out for name in left.ids}
    assert len(listed) >= 0.95 * len(elements)
    assert set(elements) - listed <= lost
    for row in town.facilities:
        said = whole_number(elements.get(row["element"], {}).get("capacity"))
        if said and row["kind"] != "kerb":
            assert row["capacity"] >= said, row
            assert row["capacity"] == said or row["capacity_from"] == "drawn"
    assert sum(row["capacity"] for row in town.facilities) == lot.capacity.sum()
    # Every restriction of turns is kept or listed, and most are kept.
    import osmium

    ways = osmium.FileProcessor(str(path), osmium.osm.RELATION)
    named = {f"relation/{r.id}" for r in ways if r.tags.get("type") == "restriction"}
    out = {one for left in town.draft.left_out if left.reason.startswith("turn") for one in left.ids}
    (line,) = (line for line in town.draft.found if line.startswith("turn restrictions"))
    assert int(line.split()[2]) == len(named - out) >= 0.6 * len(named)
    assert out <= named
    assert len(lot.turns) >= len(named - out)


@pytest.mark.slow
@pytest.mark.skipif(not (TOWNS / "neukoelln_kerb").exists(), reason="the kerbs of Neukölln are not here")
def test_the_rule_of_kerbs_holds_where_all_are_known():
    roads, free, places = kerb_table(TOWNS / "neukoelln_kerb")
    assert places.sum() == pytest.approx(43_863, rel=0.01)
    kind = [road.tags["highway"] for road in roads]
    _, street = np.unique([road.tags.get("name", road.id) for road in roads], return_inverse=True)
    half = street % 2 == 0
    for chosen in (half, ~half):
        rule = fit_kerbs(roads, free, places, chosen)
        expected = np.array([rule.get(name, 0.0) for name in kind]) * free
        judged = ~chosen
        assert expected[judged].sum() == pytest.approx(places[judged].sum(), rel=0.1)
        by_street = [np.bincount(street[judged], values[judged]) for values in (expected, places)]
        assert np.corrcoef(by_street)[0, 1] > 0.85


def test_a_bad_demand_of_counts_leaves_nothing(tmp_path):
    """The lot of the scenario has none of the car parks that were counted."""
    counts, words = write_counts(tmp_path / "counts.csv"), ("--scenario", "mini", "--from", "2024-01-01")
    assert "counts.csv" in refused("occupancy", "demand", counts, *words, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


# ---- maps ----


def number(n):
    """A varint of Protocol Buffers."""
    return (n & 127 | 128 if n > 127 else n).to_bytes(1) + (number(n >> 7) if n > 127 else b"")


def field(k, value):
    if isinstance(value, int):
        return number(k << 3) + number(value)
    return number(k << 3 | 2) + number(len(value)) + value


def blob(kind, content, size=None):
    data = field(2, len(content) if size is None else size) + field(3, zlib.compress(content))
    head = field(1, kind) + field(3, len(data))
    return struct.pack(">I", len(head)) + head + data


def nodes(count, first=1):
    """`count` untagged nodes in one place, in 40 bytes of a file: 1,250 such blobs of 8,000 are ten million nodes."""
    ids, zeros = number(2 * first) + b"\2" * (count - 1), b"\0" * count
    group = field(2, field(2, field(1, ids) + field(8, zeros) + field(9, zeros)))
    return blob(b"OSMData", field(1, field(1, b"")) + group)


HEAD = blob(b"OSMHeader", field(4, b"OsmSchema-V0.6") + field(4, b"DenseNodes"))
XML = grid().way([(0, 0), (50, 50)], STREET).xml().encode()
GZ = gzip.compress(XML)


def flipped(data, n):
    rng, changed = random.Random(n), bytearray(data)
    for _ in range(n):
        changed[rng.randrange(len(data) // 4, len(data))] ^= 1 << rng.randrange(8)
    return bytes(changed)


MAPS = {
    "truncated.osm.pbf": (HEAD + nodes(8_000))[:-9],
    "flipped.osm.pbf": HEAD + flipped(nodes(8_000), 8),
    "empty.osm.pbf": b"",
    "bomb.osm.pbf": HEAD + blob(b"OSMData", bytes(1 << 26)),
    "lie.osm.pbf": HEAD + blob(b"OSMData", bytes(99), size=1 << 30),
    "long.osm.pbf": struct.pack(">I", 1 << 31) + b"x",
    "many.osm.pbf": HEAD + b"".join(nodes(8_000, 1 + 8_000 * k) for k in range(2)),
    "truncated.osm.bz2": bz2.compress(XML)[:-40],
    "truncated.osm.gz": GZ[: len(GZ) // 2],
    "flipped.osm.gz": flipped(GZ, 8),
    "bomb.osm.gz": gzip.compress(b"<osm>" + b" " * 4_000_000),
    "truncated.osm": XML[: len(XML) // 2],
    "entities.osm": b'<!DOCTYPE x [<!ENTITY a "b">]><osm>&a;</osm>',
    "nowhere.osm": b'<osm version="0.6"><node id="1" lat="nan" lon="1"/></osm>',
}


@pytest.mark.parametrize(("name", "content"), MAPS.items(), ids=MAPS)
def test_a_damaged_map_is_one_line(tmp_path, monkeypatch, name, content):
    if name.endswith("pbf"):
        pytest.importorskip("osmium", reason="the extra osm is not installed")
    monkeypatch.setattr(elements, "MOST_ELEMENTS", 10_000)
    path = tmp_path / name
    path.write_bytes(content)
    line = refusal(import_town, path)
    assert name in line
    assert name != "many.osm.pbf" or "more than 10,000 nodes" in line
