"""The same day in SUMO: its network, parking areas and trips are those of the lot and the fleet.

SUMO itself is no dependency: `parkenv bench fleet` compares with it where it is installed.
"""

import itertools
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from parkenv import make_scenario
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.errors import InputError
from parkenv.studies.bench import sumo
from parkenv.world.demand import Demand, ExponentialTime, PoissonArrivals
from planners.heuristics import POLICIES

STREET = make_scenario("street")


def test_streets_hold_every_slot_once_and_have_the_lengths_of_the_lot():
    lot = STREET.lot
    streets = sumo.streets_of(lot)
    slots = [slot for street in streets for slot, _ in street.slots]
    assert sorted(slots) == list(range(lot.n_slots))
    assert sum(street.length for street in streets) == pytest.approx(
        lot.edge_length[lot.neighbors >= 0].sum()
    )
    for street in streets:
        along = [at for _, at in street.slots]
        assert along == sorted(along)
        assert all(0.0 < at < street.length for at in along)
        assert min(street.start, street.end) >= lot.n_slots


def test_a_lot_with_two_way_lanes_is_refused():
    with pytest.raises(InputError, match=r"lot 'campus': slot \d+ is on no one-way lane"):
        sumo.streets_of(make_scenario("campus").lot)


def test_sumo_gets_the_cars_of_the_fleet_and_its_stops_are_read(monkeypatch):
    demand = Demand(PoissonArrivals(60.0, 8 * 3600, 9 * 3600), ExponentialTime(3600.0))
    kind = DriverKind(policy=POLICIES["greedy-drive"])
    fleet = Fleet(STREET, demand, background="none", drivers=[kind], leave_full_lot=False)
    fleet.reset(0)
    arrival_s = fleet.cars["arrival"] - fleet.begin
    seen = {}

    def run(command):
        """Stand for SUMO: every car but the last stops a minute after its departure."""
        options = {str(a): Path(b) for a, b in itertools.pairwise(command)}
        for option in ("-n", "-e", "-x", "-a", "-r"):
            if option in options and options[option].exists():
                seen[options[option].name] = ElementTree.parse(options[option]).getroot()
        if "--stop-output" in options:
            root = ElementTree.Element("stops")
            for trip in seen["trips.rou.xml"].findall("trip")[:-1]:
                started = str(float(trip.get("depart")) + 60.0)
                ElementTree.SubElement(root, "stopinfo", {"id": trip.get("id"), "started": started})
            ElementTree.ElementTree(root).write(options["--stop-output"])
        return ""

    monkeypatch.setattr(sumo, "_run", run)
    day = sumo.run_sumo(fleet, Path("/nowhere"), 1.0, 7200.0)
    np.testing.assert_allclose(day.search_s[:-1], 60.0, atol=1e-3)
    assert np.isnan(day.search_s[-1])
    edges = {edge.get("id") for edge in seen["lot.edg.xml"]}
    nodes = {node.get("id") for node in seen["lot.nod.xml"]}
    assert {edge.get(end) for edge in seen["lot.edg.xml"] for end in ("from", "to")} <= nodes
    turns = {(turn.get("from"), turn.get("to")) for turn in seen["lot.con.xml"]}
    assert turns == {(a, b) for a in edges for b in edges if a.split("-")[1] == b.split("-")[0]}
    areas = {area.get("id"): area for area in seen["parking.add.xml"].findall("parkingArea")}
    assert len(areas) == STREET.lot.n_slots
    assert {area.get("lane").removesuffix("_0") for area in areas.values()} <= edges
    for street in sumo.streets_of(STREET.lot):
        (places,) = seen["parking.add.xml"].findall(f"rerouter[@edges='{street.name}']/interval")
        assert len(places) == min(sumo.ALTERNATIVES, len(areas))
        # The nearest come first: those of the street itself, in their order.
        names = [place.get("id") for place in places]
        assert names[: len(street.slots)] == [f"slot{slot}" for slot, _ in street.slots]
    trips = seen["trips.rou.xml"].findall("trip")
    assert len(trips) == len(fleet.cars)
    for trip, car, arrival in zip(trips, fleet.cars, arrival_s, strict=True):
        assert float(trip.get("depart")) == pytest.approx(arrival, abs=1e-3)
        assert float(trip.find("stop").get("duration")) == pytest.approx(car["stay_s"], abs=1e-3)
        assert trip.get("from").startswith(f"{car['entry']}-")
        assert areas[trip.find("stop").get("parkingArea")].get("lane") == f"{trip.get('to')}_0"


def test_without_sumo_a_row_says_so(monkeypatch):
    monkeypatch.setattr(sumo, "sumo_folder", lambda: None)
    ((row,), days) = sumo.sumo_rows(None, "a day", 0, 3600.0, (1.0,))
    assert (row["case"], row["value"], days) == ("SUMO: not installed", None, {})


def test_an_error_of_sumo_is_told_in_a_line():
    with pytest.raises(InputError, match=r"^python.*: no such file"):
        sumo._run([Path(sys.executable), "-c", "raise SystemExit('no such file')"])
