"""`benchmarks/run.py`: its rows, and that the peers do the same job."""

import itertools
import json
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from benchmarks import env, fleet, planning, sensors, town
from benchmarks import sumo_days as sumo
from parkenv import make_scenario
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.lots import city_lot, grid_lot
from parkenv.world.demand import Demand, ExponentialTime, PoissonArrivals
from planners.heuristics import POLICIES
from planners.thesis.label_repair import repair
from planners.thesis.label_setting import StoppingGraph, set_labels
from sim_sensors.laser.scanner import LaserScanner

PROGRAM = Path(__file__).parents[1] / "benchmarks" / "run.py"
KEYS = ["part", "case", "value", "unit", "peer", "peer_value", "ratio"]


def run(*words):
    return subprocess.run([sys.executable, PROGRAM, *map(str, words)], capture_output=True, text=True)


def test_a_part_writes_its_rows(tmp_path):
    done = run("drive", "--seconds", 0.01, "--out", tmp_path / "b")
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "b" / "summary.json").read_text())["rows"]
    assert all(list(row) == KEYS for row in rows)
    assert {row["unit"] for row in rows} == {"physics steps/s", "ms"}
    assert all(row["value"] > 0 for row in rows if "not installed" not in row["case"])
    assert all(row["case"] in done.stdout for row in rows)


def test_the_help_page_names_the_parts_and_an_unknown_one_is_refused():
    assert "pomdp" in run("--help").stdout
    refused = run("engine")
    assert (refused.returncode, "'engine'" in refused.stderr) == (2, True)


def rows_of(part):
    if part == "sensors":
        rows = sensors.laser_rows(seconds=0.0) + sensors.camera_rows(seconds=0.0)
        return rows + sensors.search_rows(seconds=0.0, scenario="mini")
    if part == "planning":
        return planning.planning_rows(seconds=0.01, largest=2_000)
    if part == "fleet":
        return fleet.fleet_rows(seconds=0.0, worlds=2, large=400, day_cars=20, growth=(5,))
    return env.env_rows(seconds=0.0, batch=4, large=300, places=3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "parts", "missing"),
    [
        ("sensors", {"laser", "camera", "environment"}, 0),
        ("planning", {"plan", "replan", "search"}, 0),
        ("fleet", {"decisions", "day", "memory", "growth"}, 1),
        ("env", {"batch", "single", "memory"}, 3),
    ],
)
def test_parts_have_rows(part, parts, missing, monkeypatch):
    monkeypatch.setattr(env, "find_spec", lambda name: None)
    monkeypatch.setattr(sumo, "sumo_folder", lambda: None)
    rows = rows_of(part)
    assert all(list(row) == KEYS for row in rows)
    assert {row["part"] for row in rows} == parts
    absent = [row["case"] for row in rows if row["value"] is None]
    assert len(absent) == missing
    assert all(case.endswith(": not installed") for case in absent)
    assert all(row["value"] > 0 for row in rows if row["value"] is not None)


@pytest.mark.parametrize(
    ("scanner", "tolerance"),
    [
        (sensors.marching_scanner, 2 * sensors.GRID_CELL),
        (sensors.pymunk_scanner, 2e-3),
        (sensors.embree_scanner, 2e-3),
    ],
)
def test_peers_measure_what_the_laser_measures(scanner, tolerance):
    laser = LaserScanner()
    plane, draw = sensors.walled_lot(np.random.default_rng(3), 30)
    peer = scanner(plane, laser)
    poses = draw(3)
    ours, theirs = (np.minimum(s, laser.max_range) for s in (laser.scan_batch(plane, poses), peer(poses)))
    assert ((np.abs(ours - theirs) > tolerance).mean(axis=1) < 0.05).all()
    np.testing.assert_array_equal(peer(poses), np.concatenate([peer(pose[None]) for pose in poses]))


def test_a_peer_that_sees_something_else_is_not_compared(monkeypatch):
    def blind(plane, laser):
        return lambda poses: np.zeros((len(poses), laser.n_beams))

    monkeypatch.setattr(sensors, "pymunk_scanner", blind)
    with pytest.raises(AssertionError, match="pymunk segment_query_first differs from the laser on 100%"):
        sensors.laser_rows(seconds=0.0)


def test_solvers_are_given_the_same_process():
    mdp = planning.forecast_process(grid_lot(2, 6), 0)
    p = planning.transitions(mdp)
    n = mdp.n_states
    np.testing.assert_allclose(np.asarray(p.sum(axis=1)).ravel(), 1.0)
    values = np.random.default_rng(0).normal(size=n)
    ahead = (p @ np.append(values, 0.0))[:-1].reshape(n, 5)
    np.testing.assert_allclose(mdp.rewards() + mdp.gamma * ahead, mdp.action_values(values))


def test_the_measured_drive_ends_and_sees_each_slot_once():
    lot = grid_lot(4, 10)
    mdp = planning.forecast_process(lot, 0)
    graph = StoppingGraph.of(mdp)
    for seed in range(5):
        labels = set_labels(graph, mdp.p_free.copy())
        seen = []
        for slot, p_free in planning.drive(graph, labels, lot.n_slots, np.random.default_rng(seed)):
            seen.append(int(slot[0]))
            repair(graph, labels, slot, p_free)
        assert len(seen) == len(set(seen)) > 0


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


def test_a_district_of_counted_kerbs_keeps_its_spaces_and_its_garage():
    blocks = town.blocks_of(town.with_garage(city_lot(200, 1), 30))
    assert blocks.capacity.sum() == 230
    assert blocks.is_counted.all()
    assert blocks.capacity[-1] == 30
    streets = sumo.streets_of(blocks)
    assert sorted(slot for street in streets for slot, _ in street.slots) == list(range(blocks.n_slots))
    assert len({street.name for street in streets}) == len(streets)
    slot = np.array([blocks.n_slots - 1, blocks.n_slots - 1, -1])
    began, left = np.array([0.0, 50.0, np.nan]), np.array([100.0, np.inf, np.nan])
    share = sumo.ParkedDay(began, slot, began, left, 0.0).parked_share(blocks.capacity, 100.0)
    assert share[-1] == 1.5 / 30
    assert not share[:-1].any()
