"""The whole trip: lines along lanes, lane keeping, failed attempts, and calibration of speeds and costs."""

import dataclasses
import math
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_lots import CAR_PARKS

from parkenv import InputError, make_scenario
from parkenv.compiled.keyed_random import world_key
from parkenv.driving.driven_lines import KEPT_RIGHT_M, DrivenLines
from parkenv.driving.vehicle import SPEED, STEERING, VehicleParameters, advance
from parkenv.envs.search import SearchEnv
from parkenv.files.known_names import OBSERVED, UNOBSERVED
from parkenv.lots import packaged_lot
from parkenv.scenarios.calibration import Calibration
from parkenv.scenarios.selection import blind_scenario
from parkenv.studies.simulate import Observer
from parkenv.studies.trips.driven_car import NO_ROOM, TAKEN, DrivingStyle, ParkingAttempt
from parkenv.studies.trips.driven_search import DrivenSearch, DrivenSearchEnv, calibrate
from parkenv.studies.trips.vehicle_controller import VehicleController
from parkenv.world.lot_scene import LotScenes
from parkenv.world.traffic import Traffic
from planners.agent import make_agent
from planners.driving.car_path import rounded
from planners.driving.path_tracking import LaneKeeper, TrackingSettings
from sim_sensors.rig import SensorRig

CAR = VehicleParameters()
MINI = make_scenario("mini")


@lru_cache
def searched(name, blind=False):
    scenario = make_scenario(name)
    return DrivenSearch(blind_scenario(scenario) if blind else scenario)


class Calling(Observer):
    """Calls a function with every observation."""

    def __init__(self, function):
        self.on_reset = lambda _, observation: function(observation)
        self.on_step = lambda step: function(step.next_observation)


class GraphExecutor:
    """Drives as the graph has it: every edge at the speed limit, parking at once."""

    def __init__(self, scenario):
        self.scenario = scenario
        self.track = []

    def begin(self, key, world, vertex, time):
        pass

    def drive(self, source, column):
        return float(self.scenario.move_s[source, column])

    def park(self, slot, taken):
        name = self.scenario.lot.slot_ids[slot]
        return ParkingAttempt(name, "", "", self.scenario.failure_s if taken else 0.0, TAKEN if taken else "")

    def wait(self, seconds):
        return seconds

    def movers_at(self, point):
        return None


@pytest.mark.parametrize("name", CAR_PARKS)
def test_every_edge_lies_on_a_line_that_keeps_right_and_is_as_long_as_the_graph_says(name):
    lot = packaged_lot(name)
    lines = DrivenLines(lot)
    source, column = np.nonzero(lot.neighbors >= 0)
    across = 0
    for v, c in zip(source.tolist(), column.tolist(), strict=True):
        edge = lines.edge(v, int(lot.neighbors[v, c]), float(lot.edge_length[v, c]))
        if edge.across:
            across += 1
            assert v < lot.n_slots
            turned = lot.vertex_yaw[v] - lot.vertex_yaw[lot.neighbors[v, c]]
            assert abs(math.remainder(turned, 2 * math.pi)) > 2.0
        else:
            assert edge.end - edge.start == pytest.approx(lot.edge_length[v, c], abs=1.0)
        ends = ((v, edge.start), (int(lot.neighbors[v, c]), edge.end))
        for vertex, station in ends[edge.across :]:
            pose = lines.lines[edge.line].pose(station)
            assert np.hypot(*(pose[:2] - lot.vertex_xy[vertex])) < 2.1
            if vertex < lot.n_slots and not edge.across:
                assert math.cos(pose[2] - lot.vertex_yaw[vertex]) > 0.99
    assert (across > 0) == (name != "street"), "two-way lanes with slots on both sides have them"


@given(
    turns=st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=4),
    leg=st.floats(6.0, 20.0),
    radius=st.floats(1.0, 8.0),
)
@settings(max_examples=50)
def test_a_rounded_polyline_ends_where_the_polyline_does_and_turns_no_tighter_than_asked(turns, leg, radius):
    yaw = np.cumsum([0.0, *turns])
    points = np.concatenate([[[0.0, 0.0]], np.cumsum(leg * np.stack([np.cos(yaw), np.sin(yaw)], 1), axis=0)])
    path = rounded(points, radius)
    poses, curvature, _ = path.sampled(0.1)
    np.testing.assert_allclose(poses[-1, :2], points[-1], atol=1e-3)
    assert math.remainder(poses[-1, 2] - yaw[-1], 2 * math.pi) == pytest.approx(0.0, abs=1e-4)
    sharpest = max(abs(t) for t in turns)
    room = 0.5 * leg / math.tan(0.5 * sharpest) if sharpest > 1e-4 else np.inf
    assert np.abs(curvature).max() <= 1.0 / min(radius, room) + 1e-9
    assert path.driven_m <= leg * (len(turns) + 1) + 1e-9


@given(speed=st.floats(0.0, 4.0), turn=st.floats(-1.4, 1.4))
@settings(max_examples=20)
def test_a_lane_keeper_stays_near_its_path_at_any_speed_and_slows_down_in_turns(speed, turn):
    points = np.array([[0.0, 0.0], [20.0, 0.0], [20.0 + 20.0 * math.cos(turn), 20.0 * math.sin(turn)]])
    path = rounded(points, 6.0)
    keeper = LaneKeeper(CAR, path, TrackingSettings(speed=4.0, blend_m=2.0, firmness=0.5))
    state = np.zeros(6)
    state[SPEED] = speed
    poses, worst = path.sampled(0.05)[0], 0.0
    for _ in range(600):
        command = keeper.command(state[:3], float(state[SPEED]), float(state[STEERING]))
        if keeper.done:
            break
        for _ in range(2):
            advance(state, *command, CAR.limits)
        worst = max(worst, float(np.hypot(*(poses[:, :2] - state[:2]).T).min()))
        assert state[SPEED] ** 2 * abs(math.tan(state[STEERING])) / CAR.wheelbase < 2.2
    assert keeper.done
    assert worst < 0.35


def test_with_the_graphs_times_a_trip_is_the_search_itself():
    scenario = blind_scenario(MINI)
    agent = make_agent("mdp", scenario)
    plain, driven = SearchEnv(scenario), DrivenSearchEnv(scenario, GraphExecutor(scenario))
    failed = 0
    for seed in range(6):
        expected, observation = plain.reset(seed=seed)[0], driven.reset(seed=seed)[0]
        memory, over = None, False
        while not over:
            action, memory = agent.predict(expected, memory)
            expected, *outcome = plain.step(action)
            observation, *results = driven.step(action)
            assert results == outcome
            for key, value in expected.items():
                np.testing.assert_array_equal(observation[key], value)
            _, over, _, info = outcome
        failed += info["failed_parks"]
        assert driven.manoeuvre is None or driven.manoeuvre.seconds == 0.0
    assert failed > 0, "or tries at taken slots were never compared"


@pytest.mark.parametrize(
    ("name", "seed", "blind"),
    [("campus", 0, False), ("campus", 7, True), pytest.param("street", 4, True, marks=pytest.mark.slow)],
)
def test_a_trip_is_the_sum_of_its_parts_and_parks_without_a_contact(name, seed, blind):
    search = searched(name, blind)
    trip = search.run(seed)
    scenario, driver = search.scenario, search.driver
    assert trip.parked
    assert trip.contacts == 0
    assert trip.total_s == pytest.approx(trip.lanes_s + trip.manoeuvre_s + sum(trip.costs.values()))
    assert trip.lanes_s == pytest.approx(sum(leg.seconds for leg in trip.legs))
    assert trip.graph_m == pytest.approx(sum(leg.graph_m for leg in trip.legs))
    assert trip.costs["failed_s"] == pytest.approx(sum(t.seconds for t in trip.attempts if t.reason))
    assert trip.manoeuvre_s == trip.attempts[-1].seconds
    # The car's clock, the search's clock, and the parts agree.
    began = search.env.state.arrival.time
    assert driver.car.time - began == pytest.approx(trip.total_s - trip.costs["walk_s"])
    assert search.env.state.time == pytest.approx(driver.car.time)
    # It stands in the slot, which was free when it began to park.
    slot = scenario.lot.slot_ids.index(trip.slot)
    middle = driver.vehicle.at_middle(driver.car.state[:3])
    assert np.hypot(*(middle[:2] - scenario.lot.slot_xy[slot])) < 0.25
    assert driver.car.state[SPEED] == pytest.approx(0.0, abs=0.01)
    assert not search.env.state.world.occupied([slot], driver.car.time - trip.manoeuvre_s)[0]
    assert any(t.reason for t in trip.attempts) == blind


def test_equal_seeds_give_equal_trips_whatever_was_driven_before():
    search = searched("mini", blind=True)
    first = search.run(7)
    search.run(3)
    assert search.run(7) == first
    assert DrivenSearch(search.scenario).run(7) == first


def test_with_sensors_equal_seeds_give_equal_trips_and_captures_are_where_the_car_was():
    search = DrivenSearch(MINI, rig="laser", weather="sunny", captures=2)
    env, driver = search.env, search.driver
    poses, told = [], []

    def keep(observation):
        track = {spot.time: spot for spot in driver.car.track}
        results = env.perception.results
        # (ends of edges are no captures of their own where nothing was driven)
        assert len(results) <= 2
        assert bool(results) == bool(track) or env.state.parked
        for result in results:
            np.testing.assert_array_equal(result.vehicle, track[result.captured.time].pose)
            poses.append((result.captured.time, *result.vehicle))
        driven = [track[result.captured.time].driven_m for result in results]
        assert len(driven) < 2 or np.diff(driven).min() > 1.25 - 0.3
        told.append(observation["p_occupied"].copy())

    first = search.run(2, [Calling(keep)])
    assert first.parked
    assert first.contacts == 0
    times = np.array([pose[0] for pose in poses])
    assert len(times) > len(first.legs) / 2
    assert (np.diff(times) > 0.0).all()
    aside = max(abs(y) for _, _, y, _ in poses)
    assert 0.0 < aside < 1.5, "on the lane, right of its middle, and not on the graph's vertices"
    before, poses[:], told[:] = list(poses), [], []
    search.run(3)
    assert search.run(2, [Calling(keep)]) == first
    assert poses == before


def test_with_sensors_the_belief_is_what_the_stack_sees_and_not_what_is_so(monkeypatch):
    """A car whose sensors are shown an empty lot believes it, however full the lot is."""
    search = DrivenSearch(MINI, rig="laser", weather="sunny", captures=1)
    env, sampler, lot = search.env, search.env.perception.sampler, MINI.lot
    measure, scene = sampler.sample, LotScenes.at

    def emptied(self, time, ego=None):
        seen = scene(self, time, ego)
        for slot in seen.present.tolist():
            seen = seen.without_vehicle(slot)
        return seen

    def measured(state, stations):
        with monkeypatch.context() as patch:
            patch.setattr(LotScenes, "at", emptied)
            return measure(state, stations)

    for show_all in (True, False):
        if not show_all:
            monkeypatch.setattr(sampler, "sample", measured)
        env.reset(seed=1)
        truth = env.state.world.occupied(np.arange(lot.n_slots), env.state.time)
        for _ in range(3):
            observation, *_ = env.step(int(np.flatnonzero(lot.neighbors[env.state.vertex] >= 0)[-1]))
        seen = env.state.belief.observed
        believed = observation["p_occupied"] > 0.5
        assert (seen & truth).sum() >= 2, "or nothing is shown"
        assert ((believed == truth) if show_all else ~believed)[seen & truth].mean() >= 0.75


@pytest.mark.parametrize(
    ("name", "cars", "pedestrians", "seeds"),
    [
        ("mini", 2, 2, range(2)),
        pytest.param("mini", 2, 3, range(10), marks=pytest.mark.slow),
        pytest.param("campus", 8, 10, range(8), marks=pytest.mark.slow),
    ],
)
def test_among_others_trips_take_longer_and_end_parked_without_a_contact(name, cars, pedestrians, seeds):
    alone, among = searched(name), DrivenSearch(make_scenario(name, traffic=Traffic(cars, pedestrians)))
    waited = lost = 0.0
    for seed in seeds:
        trip, quiet = among.run(seed), alone.run(seed)
        assert trip.parked
        assert among.driver.car.log.contacts == []
        assert quiet.waited_s == 0.0
        if trip.waited_s == 0.0:
            assert trip == quiet
        waited += trip.waited_s
        lost += trip.lanes_s + trip.manoeuvre_s + trip.costs["failed_s"]
        lost -= quiet.lanes_s + quiet.manoeuvre_s + quiet.costs["failed_s"]
    assert waited > 0.0
    assert lost > 0.0


def test_others_are_in_the_pictures_where_the_car_meets_them(monkeypatch):
    search = DrivenSearch(MINI.replace(traffic=Traffic(1, 1)), rig="laser", weather="sunny", captures=1)
    driver, met = search.driver, []
    capture = SensorRig.capture

    def seen(self, scene, pose, weather, noise):
        met.append((scene.movers.vehicle_pose, scene.movers.walker_pose))
        return capture(self, scene, pose, weather, noise)

    monkeypatch.setattr(SensorRig, "capture", seen)
    checked = 0

    def keep(observation):
        nonlocal checked
        if met:
            poses = np.concatenate(met.pop())
            now = driver.car.others.poses[np.isfinite(driver.car.others.clocks)]
            np.testing.assert_allclose(poses, now)
            checked += len(now)

    search.run(1, [Calling(keep)])
    assert checked > 0


def test_a_failed_try_takes_longer_the_later_it_is_noticed_and_ends_on_the_lane():
    seconds, entry = [], int(MINI.lot.entry_vertices[0])
    column = int(np.flatnonzero(MINI.lot.neighbors[entry] >= 0)[0])
    slot = int(MINI.lot.neighbors[entry, column])
    for notice_m in (0.8, 4.0, 30.0):
        for seed in range(30):
            driver, key = VehicleController(MINI, style=DrivingStyle(notice_m=notice_m)), world_key(seed, 0)
            arrival = MINI.occupancy.draw_arrival(MINI.arrival, key)
            world = MINI.occupancy.world(key, arrival)
            driver.begin(key, world, entry, arrival.time)
            driver.drive(entry, column)
            if world.occupied([slot], driver.car.time)[0]:
                break
        result = driver.park(slot, taken=True)
        assert (result.reason, result.slot) == (TAKEN, driver.scenario.lot.slot_ids[slot])
        log = driver.car.log
        assert not log.contacts
        assert result.seconds == pytest.approx(driver.car.time - arrival.time - log.legs[0].seconds)
        pose = driver.vehicle.at_middle(driver.car.state[:3])
        assert abs(abs(pose[1]) - KEPT_RIGHT_M) < 0.4, "back on the lane, which lies along y = 0"
        assert min(abs(math.remainder(pose[2], math.pi)), 1.0) < 0.2
        seconds.append(result.seconds)
    assert seconds[0] > seconds[1] >= seconds[2]


def test_a_slot_too_narrow_for_the_car_is_left_and_not_sought_again():
    lot = packaged_lot("mini")
    width, narrow = lot.slot_width.copy(), np.arange(0, lot.n_slots, 2)
    width[narrow] = 2.2
    scenario = MINI.replace(lot=dataclasses.replace(lot, slot_width=width))
    search = DrivenSearch(scenario, "greedy-drive", vehicle=dataclasses.replace(CAR, width=2.25))
    refused = 0
    for seed in range(5):
        trip = search.run(seed)
        names = [t.slot for t in trip.attempts if t.reason == NO_ROOM]
        refused += len(names)
        assert len(set(names)) == len(names), "the same slot is not tried twice"
        assert set(names) <= {lot.slot_ids[i] for i in narrow}
        assert trip.slot not in {lot.slot_ids[i] for i in narrow}
        assert trip.costs["failed_s"] == pytest.approx(sum(t.seconds for t in trip.attempts if t.reason))
    assert refused > 0


def row(slots, seed, graph_m, lanes_s, tries):
    failed = sum(t[3] for t in tries if t[4])
    return {
        "slots": slots, "seed": seed, "graph_m": graph_m, "lanes_s": lanes_s, "costs": {"failed_s": failed},
        "legs": [["along", graph_m, lanes_s]], "attempts": tries,
    }  # fmt: skip


def test_a_calibration_is_metres_over_seconds_and_what_failed_tries_lose():
    done = ["A1", "perpendicular", "back-in", 12.0, "", 0.0]
    failed = [["A2", "perpendicular", "back-in", s, TAKEN, 5.0] for s in (16.0, 20.0)]
    rows = [
        row(OBSERVED, 0, 100.0, 40.0, [done]),
        row(OBSERVED, 1, 50.0, 35.0, [done]),
        row(UNOBSERVED, 0, 80.0, 90.0, [*failed, done]),
    ]
    calibration, table = calibrate(rows, MINI, 2.5)
    assert calibration.v_drive == pytest.approx(150.0 / 75.0)
    assert calibration.failure_s == pytest.approx(18.0 - 5.0 / 2.5)
    assert calibration.manoeuvre_s == 12.0
    by_name = {r["what"]: r for r in table}
    assert by_name["failed_s"]["median"] == 18.0
    low, high = by_name["v_drive_kmh"]["mean_ci95"]
    assert low <= 7.2 <= high
    assert calibration.applied(MINI).v_drive == calibration.v_drive
    with pytest.raises(InputError, match="no attempt has failed"):
        calibrate(rows[:2], MINI, 2.5)


def test_a_calibration_comes_back_from_its_file(tmp_path):
    calibration, file = Calibration("mini", 2.5, 16.0, 15.0, 100, 2.7), tmp_path / "calibrated.json"
    with pytest.raises(InputError, match="No such file"):
        Calibration.from_file(file)
    calibration.to_file(file)
    assert Calibration.from_file(file) == calibration
