"""Lots: what they hold and refuse, their generators, and the graph of drives that is made of their lanes."""

import pickle
from dataclasses import fields

import networkx as nx
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from lot_checks import DRAGON_LAKE, needs_dragon_lake
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components, dijkstra
from small_lots import CAR_PARKS

from parkenv.errors import InputError
from parkenv.lots import city_lot, grid_lot, load_lot, packaged_lot
from parkenv.lots.generators import CROSSING_CLEARANCE, KERB_SIZE, bay_row
from parkenv.show.figures.lot import draw_lot, save_lot_picture
from parkenv.world.drive_graph import (
    ENTRY_REACH,
    LANE_OFFSET,
    NODE_TOLERANCE,
    SLOT_REACH,
    VERTEX_SPACING,
    DriveGraph,
    GraphError,
    build_drive_graph,
)
from parkenv.world.lot import Lane, Mouth, ParkingLot

ONE_SLOT = {
    "name": "one",
    "slot_ids": ("a",),
    "slot_xy": [[10.0, 5.5]],
    "slot_yaw": [np.pi / 2],
    "slot_length": [5.0],
    "slot_width": [2.5],
    "slot_mouth": [Mouth.REAR],
    "lanes": (Lane([[0.0, 0.0], [20.0, 0.0]]),),
    "entries": [[0.0, 0.0]],
    "goals": [[20.0, 10.0]],
}
TWO_WAY, ONE_WAY = False, True


def overlapping_slots(lot: ParkingLot) -> int:
    boxes = shapely.buffer(shapely.polygons(lot.slot_corners()), -0.01)
    one, other = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    return int((one < other).sum())


def test_a_slot_knows_its_corners_and_its_mouth():
    lot = ParkingLot(**ONE_SLOT)
    np.testing.assert_allclose(lot.mouth_xy(), [[10.0, 3.0]])
    np.testing.assert_allclose(lot.slot_corners(), [[[11.25, 3.0], [11.25, 8.0], [8.75, 8.0], [8.75, 3.0]]])
    np.testing.assert_allclose(lot.walk_m(), [np.hypot(10.0, 4.5)])
    assert (lot.bounds(), lot.n_slots, lot.n_vertices) == ((0.0, 0.0, 20.0, 10.0), 1, 3)


def test_a_lot_is_read_only_and_compares_and_pickles_by_what_it_holds():
    lot = ParkingLot(**ONE_SLOT)
    for field in fields(lot):
        value = getattr(lot, field.name)
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0
    assert lot == ParkingLot(**ONE_SLOT)
    assert lot == pickle.loads(pickle.dumps(lot))
    assert lot != ParkingLot(**{**ONE_SLOT, "goals": [[20.0, 11.0]]})
    assert lot != ParkingLot(**{**ONE_SLOT, "lanes": (Lane([[0.0, 0.0], [20.0, 0.0]], oneway=True),)})
    assert lot != "one"


def test_grid_is_laid_out_as_documented():
    lot = grid_lot(4, 3, pitch=2.5, depth=5.0, aisle=6.0)
    assert lot.slot_ids[:4] == ("0-0", "0-1", "0-2", "1-0")
    by_id = dict(zip(lot.slot_ids, lot.slot_xy, strict=True))
    assert by_id["0-0"][1] < 0.0 < by_id["1-0"][1]  # either side of the south aisle
    np.testing.assert_allclose(by_id["2-0"] - by_id["1-0"], (0.0, 5.0))  # back to back
    np.testing.assert_allclose(by_id["0-1"] - by_id["0-0"], (2.5, 0.0))
    np.testing.assert_allclose(lot.entries, [[-3.0, 0.0]])
    assert lot.goals[0, 0] > lot.slot_corners()[..., 0].max()
    assert overlapping_slots(lot) == 0


def test_angled_row_touches_its_line_and_does_not_overlap():
    slots = bay_row((1.0, 2.0), 0.0, 5, angle=np.radians(60.0))
    lanes = (Lane([[0.0, 0.0], [30.0, 0.0]]),)
    lot = ParkingLot(**ONE_SLOT | {"slot_ids": tuple("abcde"), **slots.columns(), "lanes": lanes})
    assert lot.slot_corners()[..., 1].min() == pytest.approx(2.0)
    assert overlapping_slots(lot) == 0
    np.testing.assert_allclose(lot.slot_yaw, np.radians(60.0))


@pytest.mark.parametrize("n_slots", [1, 37, 600])
def test_city_has_exactly_the_slots_asked_for_and_every_place_leads_to_every_other(n_slots):
    lot = city_lot(n_slots, seed=3)
    assert lot.n_slots == n_slots
    assert len(lot.entries) == len(lot.goals) == 1
    assert connected_components(lot.drive_matrix(), connection="strong")[0] == 1
    assert overlapping_slots(lot) == 0
    assert any(lane.oneway for lane in lot.lanes) or n_slots < 600


def test_city_is_that_of_its_seed_and_numbers_neighbours_near_each_other():
    assert city_lot(300, seed=1) == city_lot(300, seed=1)
    assert city_lot(300, seed=1) != city_lot(300, seed=2)
    step = np.hypot(*np.diff(city_lot(5000, seed=0).slot_xy, axis=0).T)
    assert np.median(step) < 10.0
    assert np.mean(step) < 60.0


def test_city_parks_at_the_kerb_and_clear_of_crossings():
    lot = city_lot(2000, seed=5)
    assert set(zip(lot.slot_length, lot.slot_width, strict=True)) == {KERB_SIZE}
    lanes = shapely.union_all([shapely.LineString(lane.points) for lane in lot.lanes])
    distance = shapely.distance(shapely.points(lot.mouth_xy()), lanes)
    assert distance.min() > LANE_OFFSET
    assert distance.max() < 3.01
    crossings = lot.vertex_xy[lot.n_slots :]
    to_crossing = shapely.distance(shapely.polygons(lot.slot_corners()), shapely.multipoints(crossings))
    assert to_crossing.min() >= CROSSING_CLEARANCE - 0.01
    houses = shapely.union_all(shapely.polygons([wall[:4] for wall in lot.walls]))
    assert not shapely.intersects(shapely.polygons(lot.slot_corners()), houses).any()
    assert not shapely.intersects(houses, lanes)
    assert not shapely.contains_xy(houses, *lot.goals.T).any()


@pytest.mark.parametrize("name", ["street", "mini"])
def test_every_packaged_lot_can_be_drawn(name, tmp_path):
    path = tmp_path / f"{name}.png"
    save_lot_picture(packaged_lot(name), path, show_graph=name == "mini")
    assert path.read_bytes().startswith(b"\x89PNG")


def test_slots_take_one_colour_each():
    lot = packaged_lot("mini")
    colors = np.linspace(0.0, 1.0, 4 * lot.n_slots).reshape(-1, 4)
    ax = Figure().add_subplot()
    draw_lot(lot, ax, slot_color=colors)
    drawn = [c.get_facecolor() for c in ax.collections if isinstance(c, PolyCollection)]
    assert any(np.shape(c) == colors.shape and np.allclose(c, colors) for c in drawn)


def graph_of(lanes, mouths=(), entries=((0.0, 0.0),)) -> DriveGraph:
    return build_drive_graph(
        [(np.array(points, dtype=float), oneway, *(speed or (1.0,))) for points, oneway, *speed in lanes],
        np.array(mouths, dtype=float).reshape(-1, 2),
        np.array(entries, dtype=float).reshape(-1, 2),
    )


def moves(graph: DriveGraph) -> set[tuple[int, int]]:
    source, column = np.nonzero(graph.neighbors >= 0)
    return set(zip(source.tolist(), graph.neighbors[source, column].tolist(), strict=True))


def drive_from(lot: ParkingLot, vertex: int) -> np.ndarray:
    return dijkstra(lot.drive_matrix(), indices=vertex)


def test_two_way_lane_keeps_to_the_right_and_turns_at_its_ends():
    graph = graph_of([([(0, 0), (30, 0)], TWO_WAY)], [(10, -3), (20, -3), (20, 3)])
    west, east = 3, 4
    wanted = [(10, -LANE_OFFSET), (20, -LANE_OFFSET), (20, LANE_OFFSET), (0, 0), (30, 0)]
    np.testing.assert_allclose(graph.vertex_xy, wanted)
    # Along each side and round the ends; and across, between the two slots that face each other.
    assert moves(graph) == {(west, 0), (0, 1), (1, east), (east, 2), (2, west), (1, 2), (2, 1)}
    np.testing.assert_allclose(np.cos(graph.vertex_yaw[:3]), [1, 1, -1])


def test_edges_have_the_speed_of_their_lane_also_behind_an_entry():
    lanes = [([(0, 0), (30, 0)], TWO_WAY, 2.0), ([(30, 0), (60, 0)], TWO_WAY)]
    graph = graph_of(lanes, [(10, -3), (10, 3), (50, -3)], entries=((20.0, 0.0),))
    for vertex, row in enumerate(graph.neighbors.tolist()):
        for column, target in enumerate(row):
            fast = target >= 0 and graph.vertex_xy[[vertex, target], 0].mean() < 30.0
            assert graph.edge_speed[vertex, column] == (2.0 if fast else 1.0)


def test_vertices_stand_before_their_slots_along_one_way_bent_and_full_lanes():
    graph = graph_of([([(0, 0), (30, 0)], ONE_WAY)], [(20, 3), (10, -3), (15, 3)])
    assert moves(graph) == {(3, 1), (1, 2), (2, 0), (0, 4)}
    np.testing.assert_allclose(graph.vertex_xy[:3, 1], 0.0)
    graph = graph_of([([(0, 0), (10, 0), (10, 10)], ONE_WAY)], [(5, -2), (12, 5)])
    assert graph.edge_length[0, graph.neighbors[0] == 1].item() == pytest.approx(10.0)
    assert graph.vertex_yaw[1] == pytest.approx(np.pi / 2)
    stations = np.arange(1.25, 39.0, 2.5)
    graph = graph_of([([(0, 0), (40, 0)], TWO_WAY)], [(x, -3.0) for x in stations])
    np.testing.assert_allclose(graph.vertex_xy[: len(stations), 0], stations)


@given(
    stations=st.lists(st.floats(-5.0, 45.0), min_size=1, max_size=70),
    sides=st.lists(st.booleans(), min_size=70, max_size=70),
    oneway=st.booleans(),
)
def test_vertices_keep_their_distance(stations, sides, oneway):
    mouths = [(x, 3.0 if left else -3.0) for x, left in zip(stations, sides, strict=False)]
    graph = graph_of([([(0, 0), (40, 0)], oneway)], mouths)
    length = graph.edge_length[graph.neighbors >= 0]
    assert length.min() > 0.0
    for left in (True, False):
        chain = [oneway or (y > 0) == left for _, y in mouths]
        along = np.sort(graph.vertex_xy[: len(mouths), 0][chain])
        gap = min(VERTEX_SPACING, 40.0 / (len(along) + 1))
        assert (np.diff(np.r_[0.0, along, 40.0]) >= gap - 1e-6).all()


def test_loops_can_be_driven_round_and_are_no_edges_to_themselves():
    ring = [(0, 0), (30, 0), (30, 20), (0, 20), (0, 0)]
    graph = graph_of([(ring, ONE_WAY)], [(15, -3), (15, 23)])
    g = nx.DiGraph(sorted(moves(graph)))
    assert nx.is_strongly_connected(g)
    assert not any(i == j for i, j in moves(graph))
    assert sum(graph.edge_length[graph.neighbors >= 0]) == pytest.approx(100.0)
    graph = graph_of([([(-20, 0), (0, 0)], TWO_WAY), ([(0, 0), (10, 5), (10, -5), (0, 0)], TWO_WAY)])
    assert not any(i == j for i, j in moves(graph))
    assert nx.is_strongly_connected(nx.DiGraph(sorted(moves(graph))))


def test_entry_in_the_middle_of_a_lane_becomes_a_junction():
    graph = graph_of([([(0, 0), (40, 0)], TWO_WAY)], [(10, -3), (30, -3)], entries=[(20, 6)])
    entry = graph.entry_vertices[0]
    np.testing.assert_allclose(graph.vertex_xy[entry], (20, 0))
    assert {(0, entry), (entry, 1)} <= moves(graph)
    assert entry >= 2


def test_points_closer_than_the_tolerance_are_one_junction_wherever_they_lie():
    # 0.0005 m is where rounding to the tolerance would part the two points.
    near = 0.0005
    lanes = [([(-20, 0), (near - 1e-9, 0)], TWO_WAY), ([(near + 1e-9, 0), (20, 0)], TWO_WAY)]
    assert len(graph_of(lanes, entries=[(-20, 0)]).vertex_xy) == 3
    apart = graph_of([lanes[0], ([(3 * NODE_TOLERANCE, 0), (20, 0)], TWO_WAY)], entries=[(-20, 0)])
    assert len(apart.vertex_xy) == 4


@given(bearings=st.lists(st.floats(0.0, 6.27), min_size=1, max_size=4, unique_by=lambda b: round(b, 2)))
def test_columns_are_the_best_assignment_of_bearings(bearings):
    ends = 50.0 * np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    graph = graph_of([([(0, 0), tuple(end)], TWO_WAY) for end in ends], entries=[(0, 0)])
    hub = graph.entry_vertices[0]
    wanted = np.array([np.pi / 2, -np.pi / 2, np.pi, 0.0])
    misfit = 1.0 - np.cos(np.array(bearings)[:, None] - wanted)
    used = np.flatnonzero(graph.neighbors[hub] >= 0)
    assert len(used) == len(bearings)
    spot = graph.vertex_xy[graph.neighbors[hub, used]]
    got = (1.0 - np.cos(np.arctan2(spot[:, 1], spot[:, 0]) - wanted[used])).sum()
    assert got == pytest.approx(misfit[linear_sum_assignment(misfit)].sum(), abs=1e-9)


def test_what_no_lane_serves_and_junctions_of_five_lanes_are_listed():
    angles = np.arange(5) * 2 * np.pi / 5
    with pytest.raises(GraphError, match=r"junction .* has 5 lanes that lead away") as caught:
        graph_of([([(0, 0), (50 * np.cos(a), 50 * np.sin(a))], TWO_WAY) for a in angles])
    np.testing.assert_allclose(caught.value.problems[0].xy, (0, 0))
    # Five that meet are fine as long as four lead away.
    graph_of([([(50 * np.cos(a), 50 * np.sin(a)), (0, 0)], a == 0.0) for a in angles])
    lane = [([(0, 0), (40, 0)], TWO_WAY)]
    with pytest.raises(GraphError, match="slot 1: is on no lane") as caught:
        graph_of(lane, [(10, -3), (10, SLOT_REACH + 1), (20, -30)])
    assert [(p.kind, p.index) for p in caught.value.problems] == [("slot", 1), ("slot", 2)]
    with pytest.raises(GraphError, match=r"entry 0: is 20\.0 m from the nearest lane"):
        graph_of(lane, entries=[(10, ENTRY_REACH + 5)])
    assert issubclass(GraphError, InputError)


@given(rows=st.integers(1, 7), columns=st.integers(1, 9))
def test_grids_are_strongly_connected_and_their_matrix_is_their_graph(rows, columns):
    lot = grid_lot(rows, columns)
    matrix = lot.drive_matrix()
    assert connected_components(matrix, connection="strong")[0] == 1
    source, column = np.nonzero(lot.neighbors >= 0)
    dense = np.full((lot.n_vertices, lot.n_vertices), np.inf)
    np.minimum.at(dense, (source, lot.neighbors[source, column]), lot.edge_length[source, column])
    np.testing.assert_array_equal(np.where(np.isinf(dense), 0.0, dense), matrix.toarray())
    assert (lot.edge_length[lot.neighbors < 0] == 0.0).all()


@pytest.mark.parametrize("name", [*CAR_PARKS, pytest.param(DRAGON_LAKE, marks=needs_dragon_lake)])
def test_known_lots_are_driven_on_lanes_only(name):
    lot = load_lot(name)
    assert connected_components(lot.drive_matrix(), connection="strong")[0] == 1
    source, column = np.nonzero(lot.neighbors >= 0)
    ways = np.stack([lot.vertex_xy[source], lot.vertex_xy[lot.neighbors[source, column]]], axis=1)
    slots = shapely.STRtree(shapely.polygons(lot.slot_corners()))
    assert slots.query(shapely.linestrings(ways), predicate="intersects").shape == (2, 0)


def test_from_aisle_to_aisle_the_way_is_round_the_end_of_the_rows():
    lot = grid_lot(4, 10)
    back_to_back = [lot.slot_ids.index(name) for name in ("1-4", "2-4")]
    assert np.hypot(*(lot.slot_xy[back_to_back[0]] - lot.slot_xy[back_to_back[1]])) == pytest.approx(5.0)
    assert drive_from(lot, back_to_back[0])[back_to_back[1]] > 16.0 + 2 * 4 * 2.5


def test_street_of_kerbside_slots_runs_as_traffic_does():
    slots = {
        "slot_ids": ("right", "left"),
        "slot_xy": [[20.0, -3.0], [40.0, 3.0]],
        "slot_yaw": [0.0, 0.0],
        "slot_length": [6.0, 6.0],
        "slot_width": [2.1, 2.1],
        "slot_mouth": [Mouth.LEFT, Mouth.RIGHT],
    }
    lanes = (Lane([[0.0, 0.0], [60.0, 0.0]], oneway=True),)
    lot = ParkingLot(**ONE_SLOT | slots | {"lanes": lanes})
    np.testing.assert_allclose(lot.mouth_xy(), [[20.0, -1.95], [40.0, 1.95]])
    assert drive_from(lot, 0)[1] == pytest.approx(20.0)
    assert np.isinf(drive_from(lot, 1)[0])
