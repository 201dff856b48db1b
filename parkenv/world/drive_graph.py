"""Build the drive graph of a lot: stop positions and the moves between them.

Every slot has one vertex, the point on the lane before its mouth; lane ends and junctions are further vertices.
A two-way lane has one directed chain of slot vertices per side, to the right of the centre line: a car passes the
slots on its right in order, turns round at the ends of the lane, and may cross to the opposite slots. A one-way lane
has a single chain that serves both sides. A junction has one vertex, and one more for each chain whose cars may not
turn everywhere there: the chain ends at it, and its edges are the permitted turns. All computations are vectorised: a
million slots take seconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError

# Distance, m, of a slot's vertex from the centre line of a two-way lane, to the right of travel.
LANE_OFFSET = 1.5
SLOT_REACH = 8.0  # greatest distance, m, of a slot's mouth from the centre line of its lane
ENTRY_REACH = 15.0  # greatest distance, m, of an entry from a lane
# Least distance, m, between two slot vertices of one chain, so that every move takes time.
VERTEX_SPACING = 1.0
CROSSING_REACH = 3.0  # greatest distance, m along the lane, of a move across to a slot on the other side
NODE_TOLERANCE = 1e-3  # lane points closer than this, m, are one node


# Cosine of the largest angle between the point that a turn names and the lane that it means.
SAME_WAY = np.cos(np.radians(30.0))
SAME_NODE = 0.01  # m, between the middle point of a turn and the junction that it means

# Three points of a turn: on the lane by which cars come, the junction, on the lane by which they leave; and whether
# it is the only one that they may make.
TurnParts = tuple[FloatArray, bool]


@dataclass(frozen=True)
class GraphProblem:
    """A problem of a drive graph: kind of feature, index within its kind, reason, and position."""

    kind: str
    index: int
    message: str
    xy: tuple[float, float]  # m


class GraphError(InputError):
    """Lanes, slots and entries do not form a drive graph; `problems` lists all reasons."""

    def __init__(self, problems: Sequence[GraphProblem]) -> None:
        self.problems = tuple(problems)
        first = self.problems[0]
        more = f" (and {len(self.problems) - 1} more)" if len(self.problems) > 1 else ""
        super().__init__(f"{first.kind} {first.index}: {first.message}{more}")


@dataclass(frozen=True, eq=False)
class DriveGraph:
    """A drive graph; vertices 0..n_slots-1 belong to the slots in order, the others are junctions and lane ends."""

    vertex_xy: FloatArray  # (n_vertices, 2) float64, m, lot frame
    vertex_yaw: FloatArray  # (n_vertices,) float64, rad, direction of travel at a slot's vertex; 0 elsewhere
    # (n_vertices, 4) int32, columns up, down, left, right; -1 where there is no edge
    neighbors: NDArray[np.int32]
    edge_length: FloatArray  # (n_vertices, 4) float64, m; 0 where there is no edge
    edge_speed: FloatArray  # (n_vertices, 4) float64, speed of its lane; 1 where there is no edge
    entry_vertices: IntArray  # (n_entries,) int64, the vertex of each entry


class Chains(NamedTuple):
    """The directions of all segments of lanes between nodes: chain 2k runs along segment k, 2k + 1 against it."""

    first: IntArray  # (2n,) int64, node where each begins and where it ends
    last: IntArray
    leaving: FloatArray  # (2n, 2) float64, unit vector, its direction at its first node
    drivable: BoolArray  # (2n,) bool, whether cars may drive it
    node_xy: FloatArray  # (n_nodes, 2) float64, m

    def onward(self, chain: int) -> IntArray:
        return np.flatnonzero((self.first == self.last[chain]) & self.drivable)


class Rule(NamedTuple):
    chain: int
    forbidden: IntArray


@dataclass(frozen=True, eq=False)
class Centrelines:
    """All lanes in one array of points; `station` is the cumulative length along it.

    A segment is the part of a lane between two consecutive nodes, a leg is a straight piece between two points.
    """

    xy: FloatArray  # (n_points, 2)
    station: FloatArray  # (n_points,)
    leg_start: IntArray  # (n_legs,) index of the point where the leg starts
    leg_tangent: FloatArray  # (n_legs, 2) unit vectors
    leg_segment: IntArray  # (n_legs,)
    segment_nodes: IntArray  # (n_segments, 2) node at the start and at the end
    segment_stations: FloatArray  # (n_segments, 2)
    segment_oneway: BoolArray  # (n_segments,)
    segment_speed: FloatArray  # (n_segments,)
    node_xy: FloatArray  # (n_nodes, 2)

    @cached_property
    def chains(self) -> Chains:
        n = len(self.segment_oneway)
        segment = np.arange(n)
        # The first leg of a segment starts at its start, the last leg ends at its end.
        begin = self.leg_tangent[np.searchsorted(self.leg_segment, segment, side="left")]
        end = self.leg_tangent[np.searchsorted(self.leg_segment, segment, side="right") - 1]
        first, last = (np.stack([self.segment_nodes[:, k], self.segment_nodes[:, 1 - k]], 1) for k in (0, 1))
        drivable = np.stack([np.ones(n, bool), ~self.segment_oneway], axis=1)
        leaving = np.stack([begin, -end], axis=1).reshape(-1, 2)
        return Chains(first.ravel(), last.ravel(), leaving, drivable.ravel(), self.node_xy)


LaneParts = tuple[FloatArray, bool, float]  # the points of a lane, whether it is one-way, and its speed


def build_drive_graph(
    lanes: Sequence[LaneParts],
    mouth_xy: FloatArray,
    entry_xy: FloatArray,
    turns: Sequence[TurnParts] = (),
    side: int = 1,
) -> DriveGraph:
    """Build the drive graph: assign slots and entries to lanes, and connect vertices by moves.

    Slots are given by the middles of the sides by which they are entered, (n_slots, 2) m. Lanes are connected where
    they share a point. With `side` -1 cars keep to the left, and all of this is its mirror image.

    Raises:
        GraphError: a slot or an entry out of reach of all lanes, a junction with more than four lanes out, or a turn
            between lanes that there are not, or that leaves no way on.
    """
    lanes, entry_point = _with_entry_points(lanes, entry_xy)
    lines = centrelines(lanes)
    n_slots = len(mouth_xy)

    station, leg, left = _attach_slots(lines, mouth_xy)
    segment = lines.leg_segment[leg]
    # Chain 2k runs along segment k and serves its right side, 2k+1 runs against it and serves the left;
    # a one-way segment has the first only.
    against = (left == (side > 0)) & ~lines.segment_oneway[segment]
    chain = 2 * segment + against
    order = np.lexsort((station * np.where(against, -1.0, 1.0), chain))
    station = _spread(lines, station, segment, chain, order)

    leg = np.searchsorted(lines.station[lines.leg_start], station, side="right") - 1
    leg = np.clip(leg, 0, len(lines.leg_start) - 1)
    tangent = lines.leg_tangent[leg] * np.where(against, -1.0, 1.0)[:, None]
    right = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    offset = np.where(lines.segment_oneway[segment], 0.0, side * LANE_OFFSET)
    start = lines.leg_start[leg]
    on_lane = lines.xy[start] + (station - lines.station[start])[:, None] * lines.leg_tangent[leg]

    along = _chain_edges(lines, station, tangent, chain, order)
    along, node = _turning_edges(lines.chains, turns, along, n_slots)
    edges = [along, *_crossing_edges(lines, station, side * tangent, segment, against)]
    every: Any = tuple(np.concatenate(part) for part in zip(*edges, strict=True))
    neighbors, edge_length, edge_speed = _four_columns(lines, n_slots, n_slots + len(node), every)
    vertex_yaw = np.zeros(n_slots + len(node))
    vertex_yaw[:n_slots] = np.arctan2(tangent[:, 1], tangent[:, 0])
    return DriveGraph(
        vertex_xy=np.concatenate([on_lane + offset[:, None] * right, lines.node_xy[node]]),
        vertex_yaw=vertex_yaw,
        neighbors=neighbors,
        edge_length=edge_length,
        edge_speed=edge_speed,
        entry_vertices=n_slots + np.asarray(cKDTree(lines.node_xy).query(entry_point)[1], dtype=np.int64),
    )


def _with_entry_points(
    lanes: Sequence[LaneParts], entry_xy: FloatArray
) -> tuple[list[LaneParts], FloatArray]:
    """Insert a node into the lane nearest to each entry; return the lanes and the nodes, (n_entries, 2) m."""
    parts = [[lane] for lane in lanes]
    points = np.empty((len(entry_xy), 2))
    problems = []
    tree = shapely.STRtree(linestrings([centre for centre, _, _ in lanes]))
    of, near = tree.query_nearest(shapely.points(entry_xy))
    for i, xy in enumerate(entry_xy):
        point = shapely.Point(xy)
        # Earlier entries may have split the nearest lanes.
        at = [(k, j) for k in np.sort(near[of == i]).tolist() for j in range(len(parts[k]))]
        lines = linestrings([parts[k][j][0] for k, j in at])
        distance = np.asarray(shapely.distance(lines, point))
        nearest_line = int(np.argmin(distance))
        if distance[nearest_line] > ENTRY_REACH:
            reason = (
                f"is {distance[nearest_line]:.1f} m from the nearest lane, want at most {ENTRY_REACH:g} m"
            )
            problems.append(GraphProblem("entry", i, reason, tuple(xy.tolist())))
            continue
        k, j = at[nearest_line]
        line, (centre, oneway, speed) = lines[nearest_line], parts[k][j]
        along = shapely.line_locate_point(line, point)
        station = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(centre, axis=0).T))])
        nearest = int(np.argmin(np.abs(station - along)))
        if abs(station[nearest] - along) > NODE_TOLERANCE:
            nearest = int(np.searchsorted(station, along))
            on_lane = shapely.get_coordinates(shapely.line_interpolate_point(line, along))
            centre = np.insert(centre, nearest, on_lane, axis=0)
        points[i] = centre[nearest]
        if 0 < nearest < len(centre) - 1:
            # Splitting the lane at the entry makes it a node.
            halves = centre[: nearest + 1], centre[nearest:]
            parts[k][j : j + 1] = [(half, oneway, speed) for half in halves]
    if problems:
        raise GraphError(problems)
    return [part for lane in parts for part in lane], points


def nearest_legs(ends: FloatArray, points: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return which straight leg, of ends (n, 2, 2) m, is nearest to each point, and how far it is, m, (k,) each."""
    tree = shapely.STRtree(np.asarray(shapely.linestrings(ends)))
    (index, leg), distance = tree.query_nearest(
        shapely.points(points), all_matches=False, return_distance=True
    )
    order = np.argsort(index)
    return leg[order].astype(np.int64), distance[order]


def linestrings(parts: Sequence[FloatArray]) -> NDArray[np.object_]:
    which = np.repeat(np.arange(len(parts)), [len(points) for points in parts])
    return np.atleast_1d(np.asarray(shapely.linestrings(np.concatenate(parts), indices=which)))


def node_labels(xy: FloatArray) -> IntArray:
    """Label points, (n, 2) m: those closer than `NODE_TOLERANCE` share a label, (n,) int64, and are one node."""
    return component_labels(cKDTree(xy).query_pairs(NODE_TOLERANCE, output_type="ndarray"), len(xy))


def component_labels(links: IntArray, n: int) -> IntArray:
    links = np.reshape(links, (-1, 2))
    graph = coo_array((np.ones(len(links), dtype=bool), tuple(links.T)), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def centrelines(lanes: Sequence[LaneParts]) -> Centrelines:
    xy = np.concatenate([centre for centre, _, _ in lanes])
    count = np.array([len(centre) for centre, _, _ in lanes])
    oneway, speed = (np.array([lane[k] for lane in lanes]) for k in (1, 2))
    lane = np.repeat(np.arange(len(lanes)), count)
    last = np.cumsum(count) - 1
    is_end = np.zeros(len(xy), dtype=bool)
    is_end[last] = True
    is_end[last - count + 1] = True

    label = node_labels(xy)
    is_node = is_end | (np.bincount(label)[label] > 1)
    cut = np.flatnonzero(is_node)
    loops = (lane[cut[:-1]] == lane[cut[1:]]) & (label[cut[:-1]] == label[cut[1:]]) & (np.diff(cut) > 1)
    # A closed lane would be an edge from a vertex to itself: add a node halfway.
    is_node[(cut[:-1][loops] + cut[1:][loops]) // 2] = True
    cut = np.flatnonzero(is_node)

    same_lane = lane[:-1] == lane[1:]
    leg_start = np.flatnonzero(same_lane)
    step = xy[leg_start + 1] - xy[leg_start]
    leg_length = np.hypot(*step.T)
    run = np.zeros(len(xy))
    run[leg_start + 1] = leg_length
    station = np.cumsum(run)

    in_segment = lane[cut[:-1]] == lane[cut[1:]]
    first, end = cut[:-1][in_segment], cut[1:][in_segment]
    _, node = np.unique(label[cut], return_inverse=True)
    node_of_point = np.full(len(xy), -1)
    node_of_point[cut] = node
    node_xy = np.empty((node.max() + 1, 2))
    node_xy[node[::-1]] = xy[cut[::-1]]  # the first of the points within the tolerance counts
    return Centrelines(
        xy=xy,
        station=station,
        leg_start=leg_start,
        leg_tangent=step / leg_length[:, None],
        leg_segment=np.searchsorted(first, leg_start, side="right") - 1,
        segment_nodes=np.stack([node_of_point[first], node_of_point[end]], axis=1),
        segment_stations=np.stack([station[first], station[end]], axis=1),
        segment_oneway=oneway[lane[first]],
        segment_speed=speed[lane[first]],
        node_xy=node_xy,
    )


def _attach_slots(lines: Centrelines, mouth_xy: FloatArray) -> tuple[FloatArray, IntArray, BoolArray]:
    """Station, leg and side (True: left of the lane's direction) of the lane point nearest to each mouth."""
    start = lines.leg_start
    leg, distance = nearest_legs(np.stack([lines.xy[start], lines.xy[start + 1]], axis=1), mouth_xy)
    problems = [
        GraphProblem(
            "slot",
            i,
            f"is on no lane: the nearest is {distance[i]:.1f} m from its mouth, want at most {SLOT_REACH:g} m",
            tuple(mouth_xy[i].tolist()),
        )
        for i in np.flatnonzero(distance > SLOT_REACH).tolist()
    ]
    if problems:
        raise GraphError(problems)
    away = mouth_xy - lines.xy[start[leg]]
    tangent = lines.leg_tangent[leg]
    leg_length = lines.station[start[leg] + 1] - lines.station[start[leg]]
    along = np.clip((away * tangent).sum(axis=1), 0.0, leg_length)
    left = tangent[:, 0] * away[:, 1] - tangent[:, 1] * away[:, 0] > 0.0
    return lines.station[start[leg]] + along, leg, left


def _spread(
    lines: Centrelines, station: FloatArray, segment: IntArray, chain: IntArray, order: IntArray
) -> FloatArray:
    """Move vertices along their lane, as little as possible, until they keep a distance from each other and nodes."""
    if not len(order):
        return station
    sign = np.where(chain % 2 == 1, -1.0, 1.0)
    low, high = np.sort(lines.segment_stations[segment] * sign[:, None], axis=1).T
    sorted_chain = chain[order]
    starts = np.flatnonzero(np.r_[True, sorted_chain[1:] != sorted_chain[:-1]])
    size = np.diff(np.r_[starts, len(order)])
    rank = np.arange(len(order)) - np.repeat(starts, size)
    size = np.repeat(size, size)
    low, high, wanted = low[order], high[order], (station * sign)[order]
    gap = np.minimum(VERTEX_SPACING, (high - low) / (size + 1))
    # After subtracting k gaps, "each at least a gap after its predecessor" is a running maximum per chain.
    shift = np.cumsum(np.r_[0.0, np.where(sorted_chain[1:] != sorted_chain[:-1], 1.0, 0.0)])
    stride = float(np.max(high - low)) + 1.0
    free = np.clip(wanted - low, gap, high - low - gap)
    pushed = np.maximum.accumulate(free - rank * gap + shift * stride * 2) - shift * stride * 2 + rank * gap
    room = high - low - (size - rank) * gap
    spread = np.empty_like(station)
    spread[order] = (low + np.minimum(pushed, room)) * sign[order]
    return spread


Edges = tuple[IntArray, IntArray, FloatArray, FloatArray, IntArray]


def _chain_edges(
    lines: Centrelines, station: FloatArray, tangent: FloatArray, chain: IntArray, order: IntArray
) -> Edges:
    """Edges along every chain, node to slots to node: sources, targets, lengths, m, bearings, rad, and chains."""
    n_slots = len(order)
    chains = np.flatnonzero(lines.chains.drivable)
    first_node, last_node, leaving = (values[chains] for values in lines.chains[:3])
    # Stations grow along even chains.
    at = lines.segment_stations[chains // 2]
    first_at, last_at = np.where((chains % 2 == 1)[:, None], at[:, ::-1], at).T

    # The stops of all chains: first node, slots in order, last node.
    stop_chain = np.concatenate([chains, chain[order], chains])
    stop_rank = np.concatenate([np.zeros(len(chains)), np.ones(len(order)), np.full(len(chains), 2.0)])
    stop_vertex = np.concatenate([n_slots + first_node, order, n_slots + last_node])
    stop_station = np.concatenate([first_at, station[order], last_at])
    stop_direction = np.concatenate([leaving, tangent[order], leaving])
    row = np.lexsort((np.arange(len(stop_chain)), stop_rank, stop_chain))
    linked = stop_chain[row][:-1] == stop_chain[row][1:]
    here, there = row[:-1][linked], row[1:][linked]
    direction = stop_direction[here]
    return (
        stop_vertex[here],
        stop_vertex[there],
        np.abs(stop_station[there] - stop_station[here]),
        np.arctan2(direction[:, 1], direction[:, 0]),
        stop_chain[here],
    )


def _turning_edges(
    chains: Chains, turns: Sequence[TurnParts], edges: Edges, n_slots: int
) -> tuple[Edges, IntArray]:
    """Let the cars of chains with turns stop at vertices of their own; return edges, and the node of each vertex."""
    node = np.arange(len(chains.node_xy))
    forbidden, wrong = forbidden_after(chains, turns)
    if wrong:
        raise GraphError(
            [GraphProblem("turn", i, reason, tuple(turns[i][0][1].tolist())) for i, reason in wrong.items()]
        )
    if not forbidden:
        return edges, node
    source, target, length, bearing, of = edges
    target, ends = target.copy(), target >= n_slots
    rows, at = [np.arange(len(source))], [source]
    for own, (chain, others) in enumerate(forbidden.items(), start=n_slots + len(node)):
        target[ends & (of == chain)] = own
        onward = np.flatnonzero((source == n_slots + chains.last[chain]) & ~np.isin(of, others))
        rows.append(onward)
        at.append(np.full(len(onward), own))
    row = np.concatenate(rows)
    more = (np.concatenate(at), target[row], length[row], bearing[row], of[row])
    return more, np.concatenate([node, chains.last[list(forbidden)]])


def _crossing_edges(
    lines: Centrelines, station: FloatArray, tangent: FloatArray, segment: IntArray, against: BoolArray
) -> list[Edges]:
    edges = []
    two_way = ~lines.segment_oneway[segment]
    for side in (False, True):
        here = np.flatnonzero(two_way & (against == side))
        there = np.flatnonzero(two_way & (against != side))
        if not len(here) or not len(there):
            continue
        there = there[np.argsort(station[there], kind="stable")]
        after = np.searchsorted(station[there], station[here])
        before = np.clip(after - 1, 0, len(there) - 1)
        after = np.clip(after, 0, len(there) - 1)
        ahead, behind = (np.abs(station[there[i]] - station[here]) for i in (after, before))
        mate = np.where(ahead < behind, there[after], there[before])
        along = np.abs(station[mate] - station[here])
        linked = (along <= CROSSING_REACH) & (segment[mate] == segment[here])
        here, mate, along = here[linked], mate[linked], along[linked]
        # A crossing leads to the left of the direction of travel.
        bearing = np.arctan2(tangent[here, 0], -tangent[here, 1])
        edges.append((here, mate, np.hypot(2 * LANE_OFFSET, along), bearing, 2 * segment[here]))
    return edges


_COLUMN_BEARINGS = np.array([np.pi / 2, -np.pi / 2, np.pi, 0.0])
_CHUNK = 65536


def _four_columns(
    lines: Centrelines, n_slots: int, n_vertices: int, edges: Edges
) -> tuple[NDArray[np.int32], FloatArray, FloatArray]:
    """Assign the edges of every vertex to the columns up, down, left, right with the least total bearing error.

    The assignment problem has at most 4! solutions, so all are tried, for many vertices at once.
    """
    order = np.argsort(edges[0], kind="stable")
    source, target, length, bearing, of = (column[order] for column in edges)
    degree = np.bincount(source, minlength=n_vertices)
    crowded = np.flatnonzero(degree[: n_slots + len(lines.node_xy)] > 4)
    if len(crowded):
        crowded_xy = lines.node_xy[crowded - n_slots].tolist()
        raise GraphError(
            [
                GraphProblem(
                    "junction",
                    int(v - n_slots),
                    f"at ({x:.1f}, {y:.1f}) m has {degree[v]} lanes that lead away; "
                    "up, down, left and right leave room for 4",
                    (x, y),
                )
                for v, (x, y) in zip(crowded, crowded_xy, strict=True)
            ]
        )
    rank = np.arange(len(source)) - np.repeat(np.cumsum(degree) - degree, degree)
    misfit = np.zeros((n_vertices, 4, 4))  # vertex, edge, column; absent edges fit everywhere
    misfit[source, rank] = 1.0 - np.cos(bearing[:, None] - _COLUMN_BEARINGS)
    choices = np.array(list(permutations(range(4))))
    column = np.empty((n_vertices, 4), dtype=np.int64)
    for i in range(0, n_vertices, _CHUNK):
        total = np.zeros((len(misfit[i : i + _CHUNK]), len(choices)))
        for edge in range(4):
            total += misfit[i : i + _CHUNK, edge][:, choices[:, edge]]
        column[i : i + _CHUNK] = choices[np.argmin(total, axis=1)]
    neighbors = np.full((n_vertices, 4), -1, dtype=np.int32)
    edge_length, edge_speed = np.zeros((n_vertices, 4)), np.ones((n_vertices, 4))
    at = source, column[source, rank]
    neighbors[at], edge_length[at], edge_speed[at] = target, length, lines.segment_speed[of // 2]
    return neighbors, edge_length, edge_speed


# ---- turn restrictions: which turns a car may make depends on the chain by which it reaches the junction


def rules_of(chains: Chains, turns: Sequence[TurnParts]) -> list[Rule | str]:
    if not turns:
        return []
    far, nearest = cKDTree(chains.node_xy).query([points[1] for points, _ in turns])
    at = zip(turns, np.atleast_1d(far).tolist(), np.atleast_1d(nearest).tolist(), strict=True)
    return [
        _rule_at(chains, node, turn)
        if away <= SAME_NODE
        else f"has no junction or end of a lane at {_place(turn[0][1])}"
        for turn, away, node in at
    ]


def _rule_at(chains: Chains, node: int, turn: TurnParts) -> Rule | str:
    (before, at, after), only = turn
    arms = np.flatnonzero(chains.first == node)
    comes, leaves = (_arm(chains, arms, point - at) for point in (before, after))
    if comes < 0 or not chains.drivable[comes ^ 1]:
        return f"has no lane by which cars come from {_place(before)} to {_place(at)}"
    if leaves < 0 or not chains.drivable[leaves]:
        return f"has no lane by which cars leave {_place(at)} for {_place(after)}"
    out = chains.onward(comes ^ 1)
    return Rule(comes ^ 1, out[out != leaves] if only else out[out == leaves])


def _arm(chains: Chains, arms: IntArray, way: FloatArray) -> int:
    alike = chains.leaving[arms] @ way / max(float(np.hypot(*way)), 1e-9)
    return int(arms[alike.argmax()]) if alike.max() >= SAME_WAY else -1


def _place(xy: FloatArray) -> str:
    return f"({xy[0]:.1f}, {xy[1]:.1f}) m"


def forbidden_after(chains: Chains, turns: Sequence[TurnParts]) -> tuple[dict[int, IntArray], dict[int, str]]:
    """Return which chains cars may not take after each chain with turns, and what is wrong with turns, by number."""
    wrong: dict[int, str] = {}
    forbidden: dict[int, IntArray] = {}
    for number, rule in enumerate(rules_of(chains, turns)):
        if isinstance(rule, str):
            wrong[number] = rule
            continue
        together = np.union1d(forbidden.get(rule.chain, rule.forbidden), rule.forbidden)
        if len(together) == len(chains.onward(rule.chain)):
            wrong[number] = f"prohibits the last turn that cars may make at {_place(turns[number][0][1])}"
        else:
            forbidden[rule.chain] = together
    return forbidden, wrong


def connected(chains: Chains, rules: Sequence[Rule]) -> BoolArray:
    """Return which chains are in the largest part in which each leads to every other one, (2n,) bool."""
    drivable, n = np.flatnonzero(chains.drivable), len(chains.first)
    ones, shape = np.ones(len(drivable)), (n, len(chains.node_xy))
    ends, starts = (
        csr_array((ones, (drivable, nodes[drivable])), shape=shape) for nodes in (chains.last, chains.first)
    )
    graph = (ends @ starts.T).tocoo()
    forbidden = np.concatenate([np.empty(0, np.int64), *(rule.chain * n + rule.forbidden for rule in rules)])
    graph.data[np.isin(graph.row.astype(np.int64) * n + graph.col, forbidden)] = 0.0
    graph.eliminate_zeros()
    part = connected_components(graph, connection="strong")[1]
    return chains.drivable & (part == np.bincount(part[drivable]).argmax())  # type: ignore[no-any-return]
