"""The lanes of an inferred lot, their one-way directions, and its entry and goal where the map has none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import networkx as nx
import numpy as np
import shapely
from numpy.typing import NDArray

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
    """Drop short dead ends, the shortest first, unless fewer spaces have a lane before them without it."""
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
    """Make aisles one-way while every lane leads to every other; return the lines, and aisles that stay two-way.

    `wanted` has, for each aisle with a direction, the number of spaces that ask for it; larger ones come first.
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


WAY_OUT = 8.0  # length, m, of the road from the edge of the car park to the entry
LONGEST_WAY_OUT = 30.0  # m, from a lane to the edge
BEYOND_ENTRY = 12.0  # distance, m, from the entry to the goal that lies on its side
CORRIDOR, NARROW_CORRIDOR = 1.5, 1.1
"""Half the width, m, that a way out needs, and half of that of the narrowest."""
DEAD_END_GAIN = 15.0  # metres of driving that an aisle's free end is preferred by


@dataclass(frozen=True, eq=False)
class Entry:
    """A guessed entry: the road from a node of the network to it, and how sure it is."""

    points: FloatArray  # (2, 2) m, from the lane outward; cars enter at the second point
    reason: str
    certainty: float  # 0 to 1


def guess_entry(lines: Sequence[Line], spaces_xy: FloatArray, blocked: Sequence[shapely.Geometry]) -> Entry:
    """Return the most plausible entry; `spaces_xy`, (n, 2) m, are stops before the spaces."""
    for corridor, longest in ((CORRIDOR, LONGEST_WAY_OUT), (NARROW_CORRIDOR, 3 * LONGEST_WAY_OUT)):
        entry = _best_way_out(lines, spaces_xy, blocked, corridor, longest)
        if entry is not None:
            return entry
    return _outermost(lines)


def entries_from_streets(
    lines: Sequence[Line], mouths: FloatArray
) -> tuple[list[Line], FloatArray, Entry] | None:
    """Return the lanes, the entries, (k, 2) m, and a description of the first where the map has public streets.

    Cars enter where lanes meet a street. A street remains a lane if spaces open to it or only it connects other lanes;
    then cars enter where it leaves the map.
    """
    is_street = np.array([line.source == STREET for line in lines])
    if not is_street.any():
        return None
    label = node_labels(np.concatenate([line.points[[0, -1]] for line in lines])).reshape(-1, 2)
    shapes = np.array([shapely.LineString(line.points) for line in lines])
    used = np.unique(np.asarray(shapely.STRtree(shapes).nearest(shapely.points(mouths))))
    inner = [line for line, street in zip(lines, is_street, strict=True) if not street]
    on_street, on_lane = (np.unique(label[mask]) for mask in (is_street, ~is_street))
    if not is_street[used].any() and inner and len(largest_part(inner)) == 1:
        nodes, kept, reason = np.intersect1d(on_street, on_lane), inner, "where a lane meets a street"
    else:
        degree = np.bincount(label.ravel())
        nodes, kept = on_street[degree[on_street] == 1], list(lines)
        reason = "where a street leaves the map"
    ends = np.concatenate([line.points[[0, -1]] for line in lines])
    entries = np.array([ends[np.flatnonzero(label.ravel() == node)[0]] for node in nodes]).reshape(-1, 2)
    if not len(entries):
        return None
    corners = np.concatenate([line.points for line in kept])
    away = np.hypot(*(corners - entries[0]).T)
    before = corners[int(np.argmin(np.where(away > 1.0, away, np.inf)))]
    return kept, entries, Entry(np.stack([before, entries[0]]), reason, 1.0)


def _outermost(lines: Sequence[Line]) -> Entry:
    ends = np.concatenate([line.points[[0, -1]] for line in lines])
    hull = shapely.convex_hull(shapely.MultiPoint(np.concatenate([line.points for line in lines])))
    inside = shapely.distance(shapely.boundary(hull), shapely.points(ends))
    degree = np.bincount(node_labels(ends))[node_labels(ends)]
    k = int(np.lexsort((ends[:, 1], ends[:, 0], np.round(inside, 1), degree))[0])
    line = lines[k // 2].points
    before = line[1] if k % 2 == 0 else line[-2]
    return Entry(np.array([before, ends[k]]), "the outermost end of a lane: no free way leads out", 0.0)


def _outline(shapes: shapely.Geometry) -> shapely.Geometry:
    """Return the concave hull; the convex one where GEOS cannot triangulate, as with many corners on one line."""
    try:
        return shapely.concave_hull(shapes, ratio=0.3)
    except shapely.errors.GEOSException:
        return shapely.convex_hull(shapes)


def _best_way_out(
    lines: Sequence[Line],
    spaces_xy: FloatArray,
    blocked: Sequence[shapely.Geometry],
    corridor: float,
    longest: float,
) -> Entry | None:
    tree = shapely.STRtree(list(blocked))
    ground = _outline(
        shapely.union_all([*blocked, *(shapely.LineString(line.points).buffer(2.0) for line in lines)])
    )
    shapely.prepare(ground)
    ends = np.concatenate([line.points[[0, -1]] for line in lines])
    label = node_labels(ends)
    at = {int(k): xy for k, xy in zip(label[::-1], ends[::-1], strict=True)}
    graph = nx.Graph()
    for (a, b), line in zip(label.reshape(-1, 2).tolist(), lines, strict=True):
        graph.add_edge(a, b, weight=shapely.LineString(line.points).length)
    nodes = np.array([at[k] for k in sorted(at)])
    names = sorted(at)
    nearest = shapely.STRtree(np.asarray(shapely.points(nodes))).nearest(
        np.asarray(shapely.points(spaces_xy))
    )
    weight = np.bincount(np.asarray(nearest), minlength=len(names))
    found: list[tuple[float, float, float, FloatArray, bool]] = []
    for number, name in enumerate(names):
        ways = _ways_out(name, nodes[number], lines, label, graph)
        if not ways:
            continue
        reach = nx.single_source_dijkstra_path_length(graph, name, weight="weight")
        drive = float(sum(weight[i] * reach.get(other, 1e3) for i, other in enumerate(names)) / weight.sum())
        for way, is_end in ways:
            length = _length_out(nodes[number], way, ground, longest)
            if length is None:
                continue
            length += WAY_OUT
            road = shapely.LineString([nodes[number], nodes[number] + length * way])
            if len(tree.query(road, predicate="dwithin", distance=corridor)):
                continue
            score = drive + 2.0 * length - DEAD_END_GAIN * is_end
            found.append(
                (
                    round(score, 3),
                    *np.round(nodes[number], 3),
                    np.array([nodes[number], nodes[number] + length * way]),
                    is_end,
                )
            )
    if not found:
        return None
    found.sort(key=lambda guess: guess[:3])
    score, *_, points, is_end = found[0]
    others = [guess[0] for guess in found[1:] if np.hypot(*(guess[3][1] - points[1])) > 15.0]
    certainty = float(np.clip((others[0] - score) / 30.0, 0.0, 1.0)) if others else 1.0
    where = "an aisle's free end at the edge" if is_end else "a free way from a lane to the edge"
    return Entry(points, f"{where}, with the shortest drives to the spaces", certainty)


def _ways_out(
    name: int, xy: FloatArray, lines: Sequence[Line], label: NDArray[np.int64], graph: nx.Graph
) -> list[tuple[FloatArray, bool]]:
    """Return directions, (2,) unit vectors, in which a road may leave a node, and whether it continues a dead end."""
    arms = []
    for k in np.flatnonzero(label == name).tolist():
        line = lines[k // 2].points
        inner = line[1] if k % 2 == 0 else line[-2]
        arms.append((inner - xy) / np.hypot(*(inner - xy)))
    if len(arms) >= 4:
        return []
    turns = (
        [0.0, np.pi / 4, -np.pi / 4, np.pi / 2, -np.pi / 2]
        if len(arms) == 1
        else [0.0, np.pi / 2, -np.pi / 2]
    )
    ways = []
    for arm in arms:
        for turn in turns:
            cos, sin = np.cos(turn), np.sin(turn)
            way = -arm @ np.array([[cos, sin], [-sin, cos]])
            if all(way @ other < 0.6 for other in arms):
                ways.append((way, graph.degree(name) == 1 and turn == 0.0))
    return ways


def _length_out(xy: FloatArray, way: FloatArray, ground: shapely.Geometry, longest: float) -> float | None:
    """Return the distance, m, from a point to where a ray leaves the car park for good; None if that is too far."""
    ray = shapely.LineString([xy, xy + 150.0 * way])
    inside = shapely.intersection(ray, ground)
    if inside.is_empty:
        return 0.0
    far = float(((shapely.get_coordinates(inside) - xy) @ way).max())
    return far if far <= longest else None


def goal_beyond(entry: FloatArray, before: FloatArray) -> FloatArray:
    """Return a goal, (1, 2) m, beyond an entry, as seen from the lane point before it."""
    way = (entry - before) / np.hypot(*(entry - before))
    return np.asarray((entry + BEYOND_ENTRY * way)[None])
