"""Shortest drives: against scipy's, from both ends, and no farther than is asked for."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import dijkstra

from parkenv import InputError, Lane, ParkingLot, make_scenario
from parkenv.lots import city_lot, grid_lot, packaged_lot
from planners.routes import DriveRoutes

LOTS = {name: packaged_lot(name) for name in ("campus", "street")} | {
    "grid": grid_lot(4, 10), "city": city_lot(300),
}  # fmt: skip


@pytest.fixture(scope="module", params=LOTS)
def drives(request):
    scenario = make_scenario(LOTS[request.param])
    return scenario, DriveRoutes(scenario), dijkstra(scenario.lot.drive_matrix() / scenario.v_drive)


def test_drive_times_are_those_of_scipy(drives):
    scenario, routes, seconds = drives
    for vertex in range(0, scenario.lot.n_vertices, 7):
        np.testing.assert_allclose(routes.seconds_from(vertex), seconds[vertex], rtol=1e-12)


def test_ways_are_as_long_as_they_should_be(drives):
    scenario, routes, seconds = drives
    rng = np.random.default_rng(0)
    for _ in range(100):
        vertex, target = rng.integers(scenario.lot.n_vertices, size=2)
        here, took = int(vertex), 0.0
        for move, following in routes.hops(int(vertex), int(target)):
            assert scenario.lot.neighbors[here, move] == following
            took += scenario.move_s[here, move]
            here = following
        assert here == target
        assert took == pytest.approx(seconds[vertex, target], abs=1e-9)


@given(seed=st.integers(0, 2**32 - 1), chance=st.sampled_from([0.0, 0.01, 0.1, 1.0]))
@settings(max_examples=60)
def test_the_nearest_are_all_that_are_as_near(seed, chance):
    rng = np.random.default_rng(seed)
    lot = LOTS["grid"]
    routes = DriveRoutes(make_scenario(lot))
    vertex, slots = int(rng.integers(lot.n_vertices)), rng.random(lot.n_slots) < chance
    seconds = np.where(slots, routes.seconds_from(vertex)[: lot.n_slots], np.inf)
    found, least = routes.nearest(vertex, slots)
    assert least == seconds.min()
    np.testing.assert_array_equal(found, np.flatnonzero(np.isfinite(seconds) & (seconds == seconds.min())))


def one_way_past_two_slots():
    """The entry lies between the slots: the first cannot be driven to."""
    lane = Lane(np.array([[0.0, 0.0], [20.0, 0.0], [40.0, 0.0]]), oneway=True)
    return ParkingLot(
        "one way", ("before", "after"), [[10.0, -5.0], [30.0, -5.0]], [-np.pi / 2] * 2, [5.0] * 2, [2.5] * 2,
        [0, 0], [lane], entries=[[20.0, 0.0]], goals=[[0.0, -10.0]],
    )  # fmt: skip


def test_what_no_way_leads_to_is_left_out():
    lot = one_way_past_two_slots()
    scenario = make_scenario(lot)
    routes, entry = DriveRoutes(scenario), int(lot.entry_vertices[0])
    assert routes.nearest(entry, np.array([True, False]))[1] == np.inf
    assert list(routes.nearest(entry, np.array([True, True]))[0]) == [1]
    for vertex, target in ((entry, 0), (1, 1)):
        with pytest.raises(InputError, match="no route"):
            routes.move_toward(vertex, target)
    assert list(routes.hops(1, 1)) == []
