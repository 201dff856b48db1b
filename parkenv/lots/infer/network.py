"""The lanes of a lot: aisles, connections and roads cut at their crossings, and the directions of one-way aisles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import networkx as nx
import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.world.drive_graph import NODE_TOLERANCE, node_labels
from parkenv.world.lot import MOVES, Lane

STREET = -2  # source of a public street
GRID = 0.01  # precision, m, of crossings
LEAST_DIRECTED = 0.3  # m, least length of a one-way piece
LOOSE = 1.2  # ends closer to another line than this, m, are moved onto it
SHORTEST_STUB = 6.0  # dead ends shorter than this, m, are dropped if no space needs them
JOIN_DISTANCE = 4.0
"""Distance from the junction, m, at which an excess lane joins its neighbour; half the length of a shorter one."""


@dataclass(frozen=True, eq=False)
class Line:
    """A piece of the road network before it is cut at crossings."""

    points: FloatArray  # (k, 2) m
    one_way: bool = False  # in the order of the points
    source: int = -1  # index of its aisle; -1 for connections and service roads, `STREET` for public streets


def noded(lines: Sequence[Line]) -> list[Line]:
    """Cut lines where they cross or touch, and move loose ends onto the lines beside them."""
    points = _joined_ends([np.round(line.points / GRID) * GRID for line in lines])
    lines = [line for line, part in zip(lines, points, strict=True) if len(part) > 1]
    original = np.array([shapely.LineString(part) for part in points if len(part) > 1])
    merged = shapely.union_all(original, grid_size=GRID)
    pieces = [part for part in shapely.get_parts(merged) if part.length > GRID]
    # Where lines coincide, the one that is one-way decides, then the first.
    result = []
    for piece in pieces:
        probes = shapely.line_interpolate_point(piece, np.linspace(0.0, 1.0, 5), normalized=True)
        distance = shapely.distance(original[:, None], probes[None]).max(axis=1)
        near = np.flatnonzero(distance <= distance.min() + 0.03)
        k = int(min(near, key=lambda i: (not lines[i].one_way, lines[i].source < 0, i)))
        coordinates = shapely.get_coordinates(piece)
        stations = shapely.line_locate_point(original[k], shapely.points(coordinates[[0, -1]]))
        if lines[k].one_way and stations[0] > stations[1]:
            coordinates = coordinates[::-1]
        # The direction of a piece that is hardly longer than the grid is lost in rounding.
        result.append(Line(coordinates, lines[k].one_way and piece.length > LEAST_DIRECTED, lines[k].source))
    return result


def _joined_ends(points: list[FloatArray]) -> list[FloatArray]:
    """Let ends that nearly touch coincide, move ends onto lines that they nearly touch, with a corner there."""
    ends = [(k, end) for k in range(len(points)) for end in (0, -1)]
    nodes: list[FloatArray] = []
    users: list[list[tuple[int, int]]] = []
    for k, end in ends:
        here = points[k][end]
        near = [
            (float(np.hypot(*(node - here))), n)
            for n, node in enumerate(nodes)
            if all(other != k for other, _ in users[n])
        ]
        if near and min(near)[0] <= LOOSE:
            users[min(near)[1]].append((k, end))
        else:
            nodes.append(here)
            users.append([(k, end)])

    shapes = np.array([shapely.LineString(part) for part in points])
    tree = shapely.STRtree(shapes)
    corners: dict[int, list[FloatArray]] = {}
    for n, node in enumerate(nodes):
        here = shapely.Point(node)
        own = {k for k, _ in users[n]}
        near = [
            (round(float(shapely.distance(here, shapes[j])), 6), j)
            for j in tree.query(here, predicate="dwithin", distance=LOOSE).tolist()
            if j not in own
        ]
        if near:
            j = min(near)[1]
            at = shapely.get_coordinates(shapely.line_interpolate_point(shapes[j], shapes[j].project(here)))[
                0
            ]
            nodes[n] = np.round(at / GRID) * GRID
            corners.setdefault(j, []).append(nodes[n])
    moved = [part.copy() for part in points]
    for node, its_users in zip(nodes, users, strict=True):
        for k, end in its_users:
            moved[k][end] = node
    for j, more in corners.items():
        inner = np.concatenate([np.array(more), moved[j][1:-1]])
        station = shapely.line_locate_point(shapes[j], shapely.points(inner))
        moved[j] = np.concatenate([moved[j][:1], inner[np.argsort(station, kind="stable")], moved[j][-1:]])
    return [part[np.r_[True, np.hypot(*np.diff(part, axis=0).T) > GRID / 2]] for part in moved]


def without_stubs(lines: Sequence[Line], count_served: Callable[[Sequence[Line]], int]) -> list[Line]:
    """Drop short dead ends, the shortest first, unless fewer spaces have a lane before them without it.

    Args:
        lines: pieces of the network, cut at crossings.
        count_served: returns the number of spaces with a lane before them.
    """
    kept = list(lines)
    served = count_served(kept)
    needed: set[int] = set()
    while len(kept) > 1:
        label = node_labels(np.concatenate([line.points[[0, -1]] for line in kept]))
        degree = np.bincount(label)[label].reshape(-1, 2)
        stubs = [
            (length, k)
            for k, line in enumerate(kept)
            if degree[k].min() == 1
            and id(line) not in needed
            and (length := shapely.LineString(line.points).length) < SHORTEST_STUB
        ]
        if not stubs:
            break
        k = min(stubs)[1]
        without = kept[:k] + kept[k + 1 :]
        left = count_served(without)
        if left >= served:
            kept, served = without, left
        else:
            needed.add(id(kept[k]))
    return kept


def directed(lines: Sequence[Line], wanted: dict[int, int]) -> tuple[list[Line], list[int]]:
    """Make aisles one-way as far as every lane can still be reached from every other.

    Args:
        lines: pieces of the network.
        wanted: for each aisle with a direction, the number of spaces that ask for it; larger ones come first.

    Returns:
        The lines, and the aisles that had to stay two-way.
    """
    refused = []
    chosen = {k for k, line in enumerate(lines) if line.one_way and line.source < 0}
    groups = {a: [k for k, line in enumerate(lines) if line.one_way and line.source == a] for a in wanted}
    label = node_labels(np.concatenate([line.points[[0, -1]] for line in lines])).reshape(-1, 2)
    tails = set(label.ravel().tolist())

    def is_strong(one_way: set[int]) -> bool:
        graph = nx.DiGraph()
        graph.add_nodes_from(tails)
        for k, (a, b) in enumerate(label.tolist()):
            graph.add_edge(a, b)
            if k not in one_way:
                graph.add_edge(b, a)
        return bool(nx.is_strongly_connected(graph))

    for aisle in sorted(groups, key=lambda a: (-wanted[a], a)):
        trial = chosen | set(groups[aisle])
        if is_strong(trial):
            chosen = trial
            continue
        # The ends of an aisle may be dead ends although its middle is on a loop.
        inner = [k for k in groups[aisle] if is_strong(chosen | {k})]
        trial = chosen | set(inner)
        if inner and is_strong(trial):
            chosen = trial
        else:
            refused.append(aisle)
    return [Line(line.points, k in chosen, line.source) for k, line in enumerate(lines)], refused


def largest_part(lines: Sequence[Line]) -> list[list[int]]:
    """Return the connected parts of a network as indices of lines, the longest part first."""
    graph = nx.Graph()
    label = node_labels(np.concatenate([line.points[[0, -1]] for line in lines])).reshape(-1, 2)
    for k, (a, b) in enumerate(label.tolist()):
        graph.add_edge(("node", a), ("line", k))
        graph.add_edge(("node", b), ("line", k))
    parts = [sorted(k for kind, k in part if kind == "line") for part in nx.connected_components(graph)]
    length = [shapely.LineString(line.points).length for line in lines]
    return sorted(parts, key=lambda part: (-sum(length[k] for k in part), part))


def lanes_of(lines: Sequence[Line]) -> list[Lane]:
    """Return the lanes, with at most four ways out of every junction."""
    return limit_junctions([Lane(line.points, line.one_way) for line in lines])


def limit_junctions(lanes: Sequence[Lane]) -> list[Lane]:
    """Change lanes so that at most four lead away from every junction.

    At junctions with more, a lane that ends there joins the neighbouring arm a few metres before the junction instead.
    A junction at which too few lanes end stays unchanged.
    """
    lines = [lane.points for lane in lanes]
    oneway = [lane.oneway for lane in lanes]
    for _ in range(sum(map(len, lines))):
        moved: set[int] = set()
        for users in _crowded_nodes(lines, oneway):
            # The points of a moved lane are numbered anew: its other junctions wait for the next round.
            if moved.isdisjoint(k for k, _ in users):
                moved.update(_move_lane_end(lines, oneway, users))
        if not moved:
            break
    return [replace(lane, points=line) for lane, line in zip(lanes, lines, strict=True) if len(line) > 1]


def _leaving(lines: Sequence[FloatArray], oneway: Sequence[bool], at: set[tuple[int, int]]) -> int:
    """Count the ways that lead away from a node, given as (lane, point) pairs."""
    forward = sum(i + 1 < len(lines[k]) for k, i in at)
    return forward + sum(i > 0 and not oneway[k] for k, i in at)


def _crowded_nodes(lines: Sequence[FloatArray], oneway: Sequence[bool]) -> list[set[tuple[int, int]]]:
    pairs = [(k, i) for k, line in enumerate(lines) for i in range(len(line))]
    at: dict[int, set[tuple[int, int]]] = {}
    for label, pair in zip(node_labels(np.concatenate(lines)).tolist(), pairs, strict=True):
        at.setdefault(label, set()).add(pair)
    return [
        users
        for users in at.values()
        if _leaving(lines, oneway, users) > len(MOVES) and any(i in (0, len(lines[k]) - 1) for k, i in users)
    ]


def _move_lane_end(
    lines: list[FloatArray], oneway: Sequence[bool], users: set[tuple[int, int]]
) -> tuple[int, ...]:
    """Move the end of the lane closest to another arm onto that arm; return the two lanes, if there are any.

    Both lead away from the junction, and a two-way lane does not join a one-way arm: cars would not come back by it.
    """
    arms = []  # lane, point, neighbouring point
    for k, i in sorted(users):
        arms += [(k, i, j) for j in (i - 1, i + 1) if 0 <= j < len(lines[k]) and (j > i or not oneway[k])]
    best: tuple[float, int, int] | None = None
    for a, (k, i, j) in enumerate(arms):
        for b, (other, i_b, j_b) in enumerate(arms):
            ends = i in (0, len(lines[k]) - 1)
            if not ends or other == k or (oneway[other] and not oneway[k]):
                continue
            one, two = lines[k][j] - lines[k][i], lines[other][j_b] - lines[other][i_b]
            turn = float(one @ two / (np.hypot(*one) * np.hypot(*two)))
            if best is None or turn > best[0]:
                best = (turn, a, b)
    if best is None:
        return ()
    k, i, _ = arms[best[1]]
    other, i_b, j_b = arms[best[2]]
    arm = lines[other][j_b] - lines[other][i_b]
    length = float(np.hypot(*arm))
    joint = lines[other][i_b] + min(JOIN_DISTANCE, length / 2) / length * arm
    lines[other] = np.insert(lines[other], max(i_b, j_b), joint, axis=0)
    moved = lines[k].copy()
    moved[i] = joint
    # A short lane whose ends have both moved is a point.
    lines[k] = moved[np.r_[True, np.hypot(*np.diff(moved, axis=0).T) > NODE_TOLERANCE]]
    return k, other
