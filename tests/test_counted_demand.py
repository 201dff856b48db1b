"""A town from a map and a list of car parks, whose demand follows counts, and predictions of days held out."""

import csv
import json
from datetime import date

import numpy as np
import pytest
from car_park_counts import write_counts
from command_line import parkenv, ran, summary_of
from made_maps import FREIBURG, STREET, grid

from parkenv import InputError, ParkingLot, make_scenario
from parkenv.lots import write_lot
from parkenv.lots.generators import NO_SLOTS, Slots
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.elements import read_map
from parkenv.lots.town.draft import import_town
from parkenv.lots.town.streets import read_streets
from parkenv.world.facility import Facility
from parkenv.world.scenario import drive_times
from parkenv.world.tariff import PUBLIC

LIST = {"P1": (100, 100.0, 205.0), "Parkhaus P0": (100, 260.0, 330.0), "empty": (100, 300.0, 205.0)}
"""Capacity and position of the car parks, m: one as in the map, one far from its namesake, one that the map lacks."""


def listed(folder, changes=()):
    lonlat = FREIBURG.to_lonlat([at for _, *at in LIST.values()]).tolist()
    rows = [[name, n, lat, lon] for (name, (n, *_)), (lon, lat) in zip(LIST.items(), lonlat, strict=True)]
    for row, column, value in changes:
        rows[row][column] = value
    path = folder / "list.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([("name", "capacity", "lat", "lon"), *rows])
    return path


def a_map(folder):
    place = grid().box(
        95, 210, 115, 230, {"amenity": "parking"}, capacity="80", fee="no", access="customers",
        opening_hours="Mo-Fr 08:00-18:00",
    )  # fmt: skip
    place.box(370, 305, 390, 325, {"amenity": "parking", "parking": "multi-storey"}, name="P0", capacity="30")
    place.way([(200, 200), (150, 150)], STREET)
    (folder / "town.osm").write_text(place.xml(), encoding="utf-8")
    return folder / "town.osm"


def test_car_parks_of_a_list_have_its_names_and_capacities(tmp_path):
    town = import_town(a_map(tmp_path), listed(tmp_path))
    rows = {row["name"]: row for row in town.facilities if row["capacity_from"] == "list"}
    assert {name: row["capacity"] for name, row in rows.items()} == dict.fromkeys(LIST, 100)
    assert rows["P1"]["tagged"] == 80  # of the place
    assert rows["Parkhaus P0"]["kind"] == "garage"
    assert rows["Parkhaus P0"]["tagged"] == 30  # of the name, as it is too far away for another one
    assert rows["empty"]["element"] == ""
    lot = town.draft.lot()
    zones = {lot.zone_rules[facility.zone] for facility in lot.facilities if facility.name in rows}
    assert {(zone.users, zone.hours) for zone in zones} == {((PUBLIC,), None)}  # counted at night, too
    assert len({zone.price for zone in zones}) == 1  # nothing is known, so that none draws drivers
    alone = import_town(a_map(tmp_path), listed(tmp_path), listed_only=True).draft.lot()
    assert set(alone.slot_ids) == set(rows)


def test_only_streets_that_cars_need_are_left_and_no_way_is_longer(tmp_path):
    place = grid(maxspeed="50").way([(200, 200), (150, 150)], STREET)
    place.way([(100, 200), (100, 300), (100, 400)], STREET, oneway="yes", maxspeed="20")
    (tmp_path / "town.osm").write_text(place.xml(), encoding="utf-8")
    elements = read_map(tmp_path / "town.osm").elements
    lines = [line for one in elements if "highway" in one.tags for line in one.lines]
    streets = read_streets(elements, LocalFrame.around(np.concatenate(lines)), {}, left_hand=False)
    entries, _ = streets.entries()
    doors = np.array([streets.points(piece).mean(axis=0) + 3.0 for piece in (1, 6, 10, 13)])
    facilities = tuple(Facility(f"P{k}", capacity=9, xy=tuple(xy)) for k, xy in enumerate(doors.tolist()))
    drives = []
    for _, lanes in (streets.lanes(doors), streets.lanes(doors, entries)):
        drawn = Slots.joined([NO_SLOTS]).columns()
        drawn |= {"lanes": tuple(lanes), "entries": entries, "goals": doors[:1]}
        lot = ParkingLot("doors", (), **drawn, facilities=facilities)
        ends = np.r_[lot.entry_vertices, np.arange(lot.n_slots)]
        metres = sum(np.hypot(*np.diff(lane.points, axis=0).T).sum() for lane in lanes)
        drives.append((metres, drive_times(make_scenario(lot), ends)))
    # Crowded junctions are moved by some metres.
    assert drives[0][1] == pytest.approx(drives[1][1], abs=1.0)
    assert drives[0][0] - drives[1][0] > 50.0


@pytest.mark.parametrize(
    ("row", "column", "value", "named"),
    [
        (1, 1, "2.5", "line 3: capacity is '2.5'"),
        (0, 1, "nan", "line 2: capacity"),
        (2, 2, "91", "line 4: lat is '91'"),
        (2, 0, "P1", "line 4: name is 'P1'"),
        (0, 0, "", "line 2: name is ''"),
    ],
)
def test_a_bad_list_is_one_line(tmp_path, row, column, value, named):
    with pytest.raises(InputError) as error:
        import_town(a_map(tmp_path), listed(tmp_path, [(row, column, value)]))
    assert named in str(error.value)
    assert "\n" not in str(error.value)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    folder = tmp_path_factory.mktemp("town")
    draft = import_town(a_map(folder), listed(folder), listed_only=True).draft
    write_lot(draft.lot(), folder / "town.geojson")
    text = 'lot = "town.geojson"\n[arrivals]\nhours = "00:00-24:00"\ndays = "all"\n'
    (folder / "town.toml").write_text(text)
    return folder


def predicted(town, counts, *more):
    out = counts.with_suffix("")
    ran(
        "occupancy", "demand", counts, "--scenario", town / "town.toml", "--from", "2024-01-01", "--weeks", "2",
        "--held-out", "1", "--roll-outs", "2", "--rounds", "2", "-n", "1", "-j", "1", "--out", out, *more,
    )  # fmt: skip
    with (out / "predicted.csv").open() as file:
        rows = {(row["car_park"], row["date"], row["hour"]): row for row in csv.DictReader(file)}
    return rows, summary_of(out), out


def test_days_held_out_are_predicted_from_the_counts_before_them(town, tmp_path):
    """What is counted from a day on changes no prediction of that day, but all of the next one."""
    names = {"P0": "Parkhaus P0", "P1": "P1", "empty": "empty"}

    def counts(name, change):
        path = write_counts(tmp_path / name, first=date(2024, 1, 1), days=30, change=change)
        lines = [line.partition(",") for line in path.read_text().splitlines()]
        path.write_text("\n".join(f"{names.get(park, park)},{rest}" for park, _, rest in lines))
        return path

    rows, summary, folder = predicted(town, counts("a.csv", lambda park, day, taken: taken))
    other, *_ = predicted(town, counts("b.csv", lambda park, day, taken: 0.5 * taken if day >= 24 else taken))
    assert len({day for _, day, _ in rows}) == 14  # two weeks held out, of all kinds of days
    for key, row in rows.items():
        assert row["simulated"] == other[key]["simulated"] or key[1] > "2024-01-25"
        assert row["counted"] == other[key]["counted"] or key[1] >= "2024-01-25"
    assert any(rows[key]["simulated"] != other[key]["simulated"] for key in rows if key[1] == "2024-01-26")
    for row in summary["rows"]:
        lines = [line for (park, *_), line in rows.items() if park == row["car_park"]]
        pairs = [(float(line["simulated"]), float(line["counted"])) for line in lines]
        simulated, counted = np.array(pairs).T
        assert row["simulated_error"] == pytest.approx(np.mean(abs(simulated - counted)), abs=1e-3)
        assert row["counted"] == pytest.approx(np.mean(counted), abs=1e-3)
    # Days differ by half a logit from their forecasts, and the town by little more.
    assert summary["simulated_error"] < 1.5 * summary["forecast_error"] + 0.02
    for name in ("scenario", "saturday", "sunday"):
        assert set(json.loads((folder / f"{name}.json").read_text())["demand"]) >= {"P1", "Parkhaus P0"}
    words = ("--weeks", "2", "--held-out", "1", "--roll-outs", "4", "--out", tmp_path / "c")
    result = parkenv("occupancy", "demand", tmp_path / "a.csv", "--scenario", town / "town.toml", *words)
    assert (result.returncode, "roll_outs is 4" in result.stderr) == (2, True), result.stderr
