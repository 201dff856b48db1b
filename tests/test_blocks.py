"""What a day with many cars tells: blocks, lanes and hours, in which no car, metre or coin is lost."""

import re

import numpy as np
import pytest
from small_lots import driven, features
from test_report import data_of

from parkenv import ParkingLot, fleet
from parkenv.engine.records import STATES
from parkenv.lots import packaged_lot, write_lot
from parkenv.studies.fleet.day import ALL
from parkenv.studies.fleet.day_replay import town_data
from parkenv.studies.fleet.tables import BLOCKS, HOURS, LANES, NOWHERE, Blocks
from parkenv.world.facility import Facility

BLOCKS_OF_RUN = {
    ("Mill Street", "kerb", "centre", 3), ("P1", "garage", "centre", 2), ("centre", "zone", "centre", 2),
    ("other", "zone", "other", 5), (NOWHERE, NOWHERE, NOWHERE, 0),
}  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder, plain = tmp_path_factory.mktemp("blocks"), packaged_lot("mini")
    zone = np.where(plain.walk_m() <= np.median(plain.walk_m()), "centre", "")
    inside = {"capacity": 2, "xy": (10.0, 14.0), "gate_s": 5.0, "inside_s": (10.0, 30.0)}
    supply = {
        "facilities": (Facility("Mill Street", "kerb"), Facility("P1", "garage", "centre", **inside)),
        "slot_facility": np.where((zone == "centre") & (np.cumsum(zone == "centre") <= 3), "Mill Street", ""),
    }
    write_lot(ParkingLot(**features(plain) | {"slot_zone": zone} | supply), folder / "zoned.geojson")
    spec = {
        "lot": str(folder / "zoned.geojson"),
        "costs": {"prices": {"centre": 3.0}},
        "arrivals": {"hours": "08:30-10:30"},
        "demand": {
            "shoppers": {"arrivals_per_hour": 40, "stay_s": 1800, "patience_s": 200, "walks_back": True},
            "commuters": {"arrivals_per_hour": 20, "patience_s": 200},
        },
    }
    result = fleet(scenarios=[spec], agents=["random"], knows=["own"], days=2, jobs=1, folder=folder / "run")
    study = result.study
    worlds = [(study.fleet(study.fleet_settings[0]), day) for day in range(2)]
    return result, [driven(world, study.seed, day, agents=agents).cars for (world, agents), day in worlds]


def columns(run, table, purpose=ALL):
    names, days = table.columns, []
    for row in run[0].results.rows(table).values():
        lines = {name: np.array(row[name]) for name in names}
        chosen = lines["purpose"] == purpose if "purpose" in names else slice(None)
        days.append({name: values[chosen] for name, values in lines.items()})
    return days


def test_blocks_and_hours_hold_all_cars_attempts_seconds_metres_and_coins(run):
    for day, cars in zip(columns(run, HOURS), run[1], strict=True):
        assert (sum(day[state] for state in STATES) == len(cars)).all()
        assert day["due"][-1] == day["searching"][-1] == 0
        assert day["balked"][-1] == (cars["slot"] < 0).sum() > 0
    for blocks, hours, cars in zip(columns(run, BLOCKS), columns(run, HOURS), run[1], strict=True):
        assert blocks["arrivals"].sum() == len(cars)
        assert blocks["refused"].sum() == cars["failed_parks"].sum() > 0
        search_s = cars["ended_at"] - cars["arrival"]
        for name, of_cars in (("search_s", search_s), ("walk_s", cars["walk_s"])):
            total = np.nansum(blocks[name] * blocks["arrivals"])
            assert total == pytest.approx(of_cars.sum(), abs=0.005 * len(cars))
        # Cars that are parked at the end of an hour have come and not left, block by block.
        inside = blocks["block"] != NOWHERE
        for hour, parked in zip(hours["hour"], hours["parked"], strict=True):
            until = inside & (blocks["hour"] <= hour)
            assert (blocks["arrivals"] - blocks["departures"])[until].sum() == parked
        centre = blocks["zone"] == "centre"
        assert blocks["paid"][centre].sum() == pytest.approx(blocks["paid"].sum())
        names = (blocks[name] for name in ("block", "type", "zone", "slots"))
        assert {*zip(*names, strict=True)} == BLOCKS_OF_RUN


def test_purposes_add_up_to_all_cars(run):
    for table, counts in ((BLOCKS, ("arrivals", "refused", "departures", "paid")), (HOURS, STATES)):
        parts = [columns(run, table, purpose) for purpose in ("shoppers", "commuters")]
        for day, every in enumerate(columns(run, table)):
            for name in counts:
                of_purposes = sum(part[day][name].sum() for part in parts)
                assert of_purposes == pytest.approx(every[name].sum())
    names = [purpose.name for purpose in run[0].study.built["zoned"].demand.purposes]
    for row in run[0].summary["purposes"]:
        days = [cars[cars["purpose"] == names.index(row["purpose"])] for cars in run[1]]
        search_s = np.mean([(cars["ended_at"] - cars["arrival"]).mean() for cars in days])
        assert row["parked_a_day"] == np.mean([(cars["slot"] >= 0).sum() for cars in days])
        assert row["balked_fraction"] == pytest.approx(np.mean([(cars["slot"] < 0).mean() for cars in days]))
        assert row["search_s"] == pytest.approx(search_s, abs=0.01)
        # Occupancy by purpose is that of its cars; residents have none.
        assert 0.0 < row["occupancy"] < 1.0


def test_detours_of_lanes_are_those_of_cars(run):
    days = run[0].study.rows_of(run[0].study.cells()[0], run[0].results)
    for lanes, blocks, day, cars in zip(columns(run, LANES), columns(run, BLOCKS), days, run[1], strict=True):
        cruised_m = lanes["cruised_m"].sum()
        assert lanes["driven_m"].sum() == pytest.approx(cars["driven_m"].sum(), rel=1e-3)
        assert cruised_m == pytest.approx(day["cruised_m"] * len(cars), rel=1e-3)
        assert np.nansum(blocks["cruised_m"] * blocks["arrivals"]) == pytest.approx(cruised_m, rel=1e-3)
        assert (lanes["cruised_m"] <= lanes["driven_m"]).all()


def test_zones_are_groups_of_blocks(run):
    zones = {row["zone"]: row for row in run[0].summary["zones"]}
    days = columns(run, BLOCKS)
    assert {name: row["slots"] for name, row in zones.items()} == {"centre": 7, "other": 5}
    for name, row in zones.items():
        assert row["parked_a_day"] == np.mean([day["arrivals"][day["zone"] == name].sum() for day in days])
    taken = [np.nansum((day["occupancy"] * day["slots"])[day["zone"] == "centre"]) for day in days]
    hours = [np.isfinite(day["occupancy"][day["block"] == "centre"]).sum() for day in days]
    assert zones["centre"]["occupancy"] == pytest.approx(np.mean(np.divide(taken, hours)) / 7)


def test_the_map_holds_the_means_of_the_tables_in_one_small_file(run):
    text, data = (run[0].folder / "fleet.html").read_text(), data_of(run[0].folder / "fleet.html")
    (shown,), (town,) = data["maps"], data["towns"]
    assert [block["name"] for block in town["blocks"]] == ["Mill Street", "P1", "centre", "other"]
    assert town["blocks"][0]["rules"] == "per_hour 3"
    days = columns(run, BLOCKS)
    for number, block in enumerate(town["blocks"]):
        for i, hour in enumerate(shown["hours"]):
            here = [(day["block"] == block["name"]) & (day["hour"] == hour) for day in days]
            cars = [day["arrivals"][which].sum() for day, which in zip(days, here, strict=True)]
            assert shown["blocks"]["arrivals"][number][i] == np.mean(cars)
    for cars in zip(*shown["states"].values(), strict=True):
        assert sum(cars) == pytest.approx(np.mean([len(cars) for cars in run[1]]))
    assert len(text) < 300_000
    assert not re.findall(r"https?://(?!www.w3.org)", text)


def test_a_counted_facility_is_a_block_of_its_capacity_and_a_square_at_its_place():
    plain = packaged_lot("mini")
    garage = Facility("other", "garage", capacity=600, xy=(30.0, 12.0))
    lot = ParkingLot(**features(plain) | {"facilities": (garage,)})
    blocks = Blocks.of(lot)
    assert (blocks.names, blocks.slots.tolist()) == (("other (garage)", "other (zone)"), [600, 10])
    square, slots = town_data(lot, ["", ""])["blocks"]
    assert square["at"] == [30.0, 12.0]
    corners = np.array(square["areas"][0][0]).reshape(-1, 2)
    np.testing.assert_allclose(corners.mean(axis=0), garage.xy)
    assert np.ptp(corners, axis=0) == pytest.approx([60.0, 60.0], abs=0.1)
    assert 1 <= len(slots["areas"]) <= 4
