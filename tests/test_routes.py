"""Shortest drives, and the neighbourhoods of large lots that planners look at."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import dijkstra
from small_lots import lasting

from parkenv import InputError, Lane, ParkingLot, make_scenario
from parkenv.lots import city_lot, grid_lot, packaged_lot
from parkenv.studies.compare.cases import at_occupancy
from parkenv.studies.episodes import EpisodeRunner
from parkenv.world.scenario import drive_times
from planners import make_agent
from planners.neighborhood import Neighborhoods
from planners.routes import DriveRoutes

LOTS = {name: packaged_lot(name) for name in ("campus", "street")} | {
    "grid": grid_lot(4, 10), "city": city_lot(300),
}  # fmt: skip


@pytest.fixture(scope="module", params=LOTS)
def drives(request):
    scenario = make_scenario(LOTS[request.param])
    return scenario, DriveRoutes(scenario), dijkstra(scenario.lot.drive_matrix() / scenario.v_drive)


def test_drive_times_and_ways_are_those_of_scipy(drives):
    scenario, routes, seconds = drives
    for vertex in range(0, scenario.lot.n_vertices, 7):
        np.testing.assert_allclose(routes.seconds_from(vertex), seconds[vertex], rtol=1e-12)
        np.testing.assert_allclose(drive_times(scenario, vertex), seconds[vertex, : scenario.lot.n_slots])
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
    rng, lot = np.random.default_rng(seed), LOTS["grid"]
    routes = DriveRoutes(make_scenario(lot))
    vertex, slots = int(rng.integers(lot.n_vertices)), rng.random(lot.n_slots) < chance
    seconds = np.where(slots, routes.seconds_from(vertex)[: lot.n_slots], np.inf)
    found, least = routes.nearest(vertex, slots)
    assert least == seconds.min()
    np.testing.assert_array_equal(found, np.flatnonzero(np.isfinite(seconds) & (seconds == seconds.min())))


def test_what_no_way_leads_to_is_left_out():
    """The entry to a one-way lane lies between its slots: the first cannot be driven to."""
    lane = Lane(np.array([[0.0, 0.0], [20.0, 0.0], [40.0, 0.0]]), oneway=True)
    lot = ParkingLot(
        "one way", ("before", "after"), [[10.0, -5.0], [30.0, -5.0]], [-np.pi / 2] * 2, [5.0] * 2, [2.5] * 2,
        [0, 0], [lane], entries=[[20.0, 0.0]], goals=[[0.0, -10.0]],
    )  # fmt: skip
    routes, entry = DriveRoutes(make_scenario(lot)), int(lot.entry_vertices[0])
    assert routes.nearest(entry, np.array([True, False]))[1] == np.inf
    assert list(routes.nearest(entry, np.array([True, True]))[0]) == [1]
    for vertex, target in ((entry, 0), (1, 1)):
        with pytest.raises(InputError, match="no route"):
            routes.move_toward(vertex, target)
    assert list(routes.hops(1, 1)) == []


def everything_at_best(problem, start):
    """Drives, s, from a vertex and between all, and g: the drive to a vertex and the best from there if all is free."""
    seconds = dijkstra(problem.lot.drive_matrix() / problem.v_drive)
    least = (seconds[:, : problem.lot.n_slots] + problem.walk_s).min(axis=1)
    return seconds, seconds[start] + least


def test_a_small_lot_is_one_neighbourhood():
    problem = make_scenario("street").public()
    near = Neighborhoods(problem).toward(0)
    assert near.whole
    np.testing.assert_array_equal(near.slots, np.arange(problem.lot.n_slots))
    np.testing.assert_array_equal(near.cost_s, problem.walk_s)
    assert Neighborhoods(problem).around(3, np.arange(5)).whole


@pytest.mark.parametrize("name", ["campus", "street"])
def test_a_part_holds_the_vertices_that_may_do_best_and_the_ways_to_them(name):
    problem = make_scenario(name).public()
    lot, most = problem.lot, problem.lot.n_vertices // 2
    start = int(lot.neighbors[problem.walk_s.argmin()].max())
    near = Neighborhoods(problem, most).around(start, np.empty(0, dtype=np.int64))
    seconds, g = everything_at_best(problem, start)
    assert len(near.vertices) == most
    assert not near.whole
    inside = np.isin(np.arange(lot.n_vertices), near.vertices)
    assert g[inside].max() <= g[~inside].min() + 1e-9
    np.testing.assert_allclose(near.table.seconds[near.index(start)], seconds[start, near.vertices])
    # Ways among the others may leave the part; what is there is true.
    assert (near.table.seconds >= seconds[np.ix_(near.vertices, near.vertices)] - 1e-9).all()
    for v, vertex in enumerate(near.vertices):
        starts, slots = problem.slots_in_view
        here = near.slots[near.in_view(v)["slot"]]
        seen = slots[starts[vertex] : starts[vertex + 1]]
        np.testing.assert_array_equal(here, seen[inside[seen]])
        assert near.index(int(vertex)) == v
    assert near.index(int(np.flatnonzero(~inside)[0])) == -1


def test_slots_known_to_be_taken_draw_nobody():
    problem = make_scenario("campus").public()
    start, parts = int(problem.walk_s.argmin()), Neighborhoods(problem, 80)
    before = parts.around(start, np.empty(0, dtype=np.int64))
    after = parts.around(start, before.slots[np.argsort(before.cost_s)[:60]])
    assert not np.isin(after.slots, before.slots).all()


def test_far_from_the_goal_the_part_is_entered_on_a_shortest_route():
    problem = make_scenario(city_lot(3000)).public()
    entry, parts = int(problem.lot.entry_vertices[0]), Neighborhoods(problem, 500)
    near = parts.toward(entry)
    assert near is parts.toward(entry)
    assert near.index(entry) == -1
    _, g = everything_at_best(problem, entry)
    assert g[near.entry] == pytest.approx(g[entry])
    assert near.index(int(problem.walk_s.argmin())) >= 0


@pytest.mark.parametrize(("level", "seeds"), [(0.6, 4), (0.9, 4)])
def test_leaving_out_what_cannot_matter_changes_nothing(level, seeds):
    """The farthest tenth of a lot: the searches are the same to the last second."""
    scenario = at_occupancy(make_scenario(grid_lot(8, 40)), level)
    most = scenario.lot.n_vertices * 9 // 10
    whole, part = (
        EpisodeRunner(scenario, "belief", make_agent("belief", scenario, day=False, most_vertices=m))
        for m in (scenario.lot.n_vertices, most)
    )
    for seed in range(seeds):
        assert part.run(seed).row["total_s"] == pytest.approx(whole.run(seed).row["total_s"], abs=1e-6)


@pytest.mark.parametrize("name", ["belief", "mdp-tuned"])
def test_where_a_part_is_full_the_search_goes_on_beyond_it(name):
    lot = city_lot(600)
    free = np.argsort(lot.walk_m())[-40:]
    scenario = lasting(lot, ~np.isin(np.arange(lot.n_slots), free), said=1.0)
    runner = EpisodeRunner(scenario, name, make_agent(name, scenario, most_vertices=150))
    near = Neighborhoods(scenario.public(), 150).toward(int(lot.entry_vertices[0]))
    row = runner.run(0).row
    assert row["parked"]
    assert row["failed_parks"] == 0
    assert not np.isin(near.slots, free).any()
