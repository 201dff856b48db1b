"""Survey route: a closed drive that passes every slot on the side of the camera."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.world.lot import ParkingLot

_MILLIMETRES = 1000.0


class SurveyRoute(NamedTuple):
    vertices: NDArray[np.int64]  # (k,) int64, in driving order
    path: FloatArray  # (k, 2) float64, m, lot frame
    # number of slots passed against the direction of a one-way lane, because they are on its left
    against: int
    length: float  # m


class _Pass(NamedTuple):
    """A section of a lane from one junction to the next: its vertices, junctions included, and its length, m."""

    stops: tuple[int, ...]
    length: float
    against: bool = False


def survey_route(lot: ParkingLot, *, both_sides: bool = False) -> SurveyRoute:
    """Drive from the first entry past every slot, with the slot on the right, and back.

    Each side of a two-way lane is driven in its own direction. Slots on the left of a one-way lane would need a camera
    on the left; with a camera on the right, that lane is driven again against its direction, as in real surveys at
    quiet hours. The required lanes are known, so this is the rural postman problem on a directed graph: a minimum-cost
    flow gives the cheapest extra sections that balance arrivals and departures at every junction, and an Eulerian
    circuit then drives them all (Christofides et al., "An algorithm for the rural postman problem on a directed
    graph", 1986). With `both_sides` a camera also points to the left.
    """
    passes = _passes(lot)
    # A section begins at each vertex of its junction from which cars may take it.
    needed = list({p.stops[1:]: p for p in reversed(passes) if len(p.stops) > 2}.values())[::-1]
    if not both_sides:
        needed += [_Pass(p.stops[::-1], p.length, True) for p in needed if _left_slots(lot, p)]
    start = int(lot.entry_vertices[0])
    ways = nx.DiGraph()
    for p in passes:
        a, b = p.stops[0], p.stops[-1]
        if not ways.has_edge(a, b) or ways.edges[a, b]["length"] > p.length:
            ways.add_edge(a, b, length=p.length, stops=p.stops)
    drive: nx.MultiDiGraph[Any] = nx.MultiDiGraph()
    junction = lot.junction_of_vertex
    for number, p in enumerate(needed):
        begin = p.stops[0]
        if p.against:
            begins = np.flatnonzero(junction == junction[begin]).tolist()
        else:
            begins = [q.stops[0] for q in passes if q.stops[1:] == p.stops[1:]]
        if len(begins) > 1:
            begin = -1 - number  # a node before all of them
            for vertex in begins:
                ways.add_edge(vertex, begin, length=0.0, stops=(vertex,))
            ways.add_edge(begin, p.stops[-1], length=p.length, stops=p.stops)
        drive.add_edge(begin, p.stops[-1], stops=p.stops)
    try:
        _join(drive, ways, start)
        _balance(drive, ways)
    except nx.NetworkXException as error:
        raise InputError(
            f"lot {lot.name!r}: no drive leads from its first entry past every slot and back"
        ) from error
    stops = [start]
    for a, b, key in nx.eulerian_circuit(drive, start, keys=True):
        stops.extend(drive.edges[a, b, key]["stops"][1:])
    vertices = np.array(stops, dtype=np.int64)
    path = lot.vertex_xy[vertices]
    length = float(np.hypot(*np.diff(path, axis=0).T).sum())
    against = sum(_left_slots(lot, _Pass(p.stops[::-1], 0.0)) for p in needed if p.against)
    return SurveyRoute(vertices, path, against, length)


def _passes(lot: ParkingLot) -> list[_Pass]:
    passes = []
    for junction in range(lot.n_slots, lot.n_vertices):
        for column in np.flatnonzero(lot.neighbors[junction] >= 0):
            stops, length = [junction], 0.0
            vertex: int | None = int(lot.neighbors[junction, column])
            length += float(lot.edge_length[junction, column])
            while vertex is not None:
                stops.append(vertex)
                vertex, step = _straight_on(lot, vertex)
                length += step
            passes.append(_Pass(tuple(stops), length))
    return passes


def _straight_on(lot: ParkingLot, vertex: int) -> tuple[int | None, float]:
    if vertex >= lot.n_slots:
        return None, 0.0
    heading = lot.vertex_yaw[vertex]
    best, choice = -2.0, -1
    for column in np.flatnonzero(lot.neighbors[vertex] >= 0).tolist():
        to = lot.neighbors[vertex, column]
        way = lot.vertex_xy[to] - lot.vertex_xy[vertex]
        # The other side of a two-way lane has the opposite direction.
        if to < lot.n_slots and np.cos(lot.vertex_yaw[to] - heading) < 0.0:
            continue
        ahead = float(way @ [np.cos(heading), np.sin(heading)]) / max(float(np.hypot(*way)), 1e-9)
        if ahead > best:
            best, choice = ahead, column
    return int(lot.neighbors[vertex, choice]), float(lot.edge_length[vertex, choice])


def _left_slots(lot: ParkingLot, way: _Pass) -> int:
    """Return the number of slots on the far side of a section, where no camera looks."""
    slots = np.array(way.stops[1:-1], dtype=np.int64)
    yaw = lot.vertex_yaw[slots]
    away = lot.slot_xy[slots] - lot.vertex_xy[slots]
    return int((lot.side * (np.cos(yaw) * away[:, 1] - np.sin(yaw) * away[:, 0]) > 0.0).sum())


def _join(drive: nx.MultiDiGraph[Any], ways: nx.DiGraph[Any], start: int) -> None:
    drive.add_node(start)
    while True:
        parts = list(nx.weakly_connected_components(drive))
        if len(parts) == 1:
            return
        home = next(part for part in parts if start in part)
        out = nx.multi_source_dijkstra(ways, home, weight="length")
        away = [v for part in parts if part is not home for v in part if v in out[0]]
        if not away:
            raise nx.NetworkXNoPath
        _drive_along(drive, ways, out[1][min(away, key=lambda v: (out[0][v], v))])


def _balance(drive: nx.MultiDiGraph[Any], ways: nx.DiGraph[Any]) -> None:
    """Add the cheapest sections that balance arrivals and departures at every vertex (Eulerian circuit)."""
    flow_graph = nx.DiGraph()
    flow_graph.add_nodes_from(ways)
    for v in drive:
        flow_graph.add_node(v, demand=drive.out_degree(v) - drive.in_degree(v))
    for a, b, length in ways.edges(data="length"):
        # The network simplex is exact only for integers.
        flow_graph.add_edge(a, b, weight=round(length * _MILLIMETRES))
    for a, onward in nx.min_cost_flow(flow_graph).items():
        for b, times in onward.items():
            for _ in range(times):
                _drive_along(drive, ways, [a, b])


def _drive_along(drive: nx.MultiDiGraph[Any], ways: nx.DiGraph[Any], junctions: list[int]) -> None:
    for a, b in pairwise(junctions):
        drive.add_edge(a, b, stops=ways.edges[a, b]["stops"])
