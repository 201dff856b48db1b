"""The lanes of an inferred lot: connections of aisles through free space, directions, and its entry and goal."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import networkx as nx
import numpy as np
import shapely
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.world.drive_graph import NODE_TOLERANCE, component_labels, node_labels
from parkenv.world.lot import MOVES, Lane

STREET = -2  # source of a public street
GRID = 0.01  # precision, m, of crossings
LEAST_DIRECTED = 0.3  # m, least length of a one-way piece
LOOSE = 1.2  # ends closer to another line than this, m, are moved onto it
SHORTEST_STUB = 6.0  # dead ends shorter than this, m, are dropped if no space needs them
# Distance from the junction, m, at which an excess lane joins its neighbour; half the length of a shorter one.
JOIN_DISTANCE = 4.0


@dataclass(frozen=True, eq=False)
class Line:
    """A piece of the road network before it is cut at crossings."""

    points: FloatArray  # (k, 2) m
    one_way: bool = False  # in the order of the points
    source: int = -1  # index of its aisle; -1 for connections and service roads, `STREET` for public streets


def noded(lines: Sequence[Line]) -> list[Line]:
    points = _joined_ends([np.round(line.points / GRID) * GRID for line in lines])
    lines = [line for line, part in zip(lines, points, strict=True) if len(part) > 1]
    original = np.array([shapely.LineString(part) for part in points if len(part) > 1])
    pieces = shapely.get_parts(shapely.union_all(original, grid_size=GRID))
    # Where lines coincide, the one that is one-way decides, then the first.
    result = []
    for piece in (piece for piece in pieces if piece.length > GRID):
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
    nodes: list[FloatArray] = []
    users: list[list[tuple[int, int]]] = []
    for k, end in ((k, end) for k in range(len(points)) for end in (0, -1)):
        here = points[k][end]
        is_other = [all(other != k for other, _ in own) for own in users]
        away = [np.hypot(*(xy - here)) if ok else np.inf for xy, ok in zip(nodes, is_other, strict=True)]
        if min(away, default=np.inf) <= LOOSE:
            users[int(np.argmin(away))].append((k, end))
        else:
            nodes.append(here)
            users.append([(k, end)])

    shapes = np.array([shapely.LineString(part) for part in points])
    tree = shapely.STRtree(shapes)
    corners: dict[int, list[FloatArray]] = {}
    for n, node in enumerate(nodes):
        here, own = shapely.Point(node), {k for k, _ in users[n]}
        around = tree.query(here, predicate="dwithin", distance=LOOSE).tolist()
        near = [(round(shapes[j].distance(here), 6), j) for j in around if j not in own]
        if near:
            j = min(near)[1]
            at = shapely.line_interpolate_point(shapes[j], shapes[j].project(here))
            nodes[n] = np.round(shapely.get_coordinates(at)[0] / GRID) * GRID
            corners.setdefault(j, []).append(nodes[n])
    moved = [part.copy() for part in points]
    for node, ends_there in zip(nodes, users, strict=True):
        for k, end in ends_there:
            moved[k][end] = node
    for j, more in corners.items():
        inner = np.concatenate([np.array(more), moved[j][1:-1]])
        station = shapely.line_locate_point(shapes[j], shapely.points(inner))
        moved[j] = np.concatenate([moved[j][:1], inner[np.argsort(station, kind="stable")], moved[j][-1:]])
    return [part[np.r_[True, np.hypot(*np.diff(part, axis=0).T) > GRID / 2]] for part in moved]


def without_stubs(lines: Sequence[Line], count_served: Callable[[Sequence[Line]], int]) -> list[Line]:
    kept, needed = list(lines), set[int]()
    served = count_served(kept)
    while True:
        label = _end_nodes(kept)
        dead = np.flatnonzero((np.bincount(label.ravel())[label] == 1).any(axis=1)).tolist()
        length = {k: shapely.LineString(kept[k].points).length for k in dead if id(kept[k]) not in needed}
        k = min(length, key=lambda k: (length[k], k), default=-1)
        if len(kept) == 1 or k < 0 or length[k] >= SHORTEST_STUB:
            return kept
        without = kept[:k] + kept[k + 1 :]
        left = count_served(without)
        if left >= served:
            kept, served = without, left
        else:
            needed.add(id(kept[k]))


def directed(lines: Sequence[Line], wanted: dict[int, int]) -> tuple[list[Line], list[int]]:
    """Make aisles one-way while every lane leads to every other; return the lines, and aisles that stay two-way.

    `wanted` has, for each aisle with a direction, the number of spaces that ask for it; larger ones come first.
    """
    refused = []
    chosen = {k for k, line in enumerate(lines) if line.one_way and line.source < 0}
    groups = {a: {k for k, line in enumerate(lines) if line.one_way and line.source == a} for a in wanted}
    ways = _end_nodes(lines).tolist()

    def is_strong(one_way: set[int]) -> bool:
        back = [(b, a) for k, (a, b) in enumerate(ways) if k not in one_way]
        return bool(nx.is_strongly_connected(nx.DiGraph([*ways, *back])))

    for aisle in sorted(groups, key=lambda a: (-wanted[a], a)):
        trial = chosen | groups[aisle]
        if not (is_whole := is_strong(trial)):
            # The ends of an aisle may be dead ends although its middle is on a loop.
            trial = chosen | {k for k in groups[aisle] if is_strong(chosen | {k})}
        if is_whole or (trial > chosen and is_strong(trial)):
            chosen = trial
        else:
            refused.append(aisle)
    return [Line(line.points, k in chosen, line.source) for k, line in enumerate(lines)], refused


def _end_nodes(lines: Sequence[Line]) -> IntArray:
    """Return the nodes at the first and at the last point of lines, (n, 2)."""
    return node_labels(np.concatenate([line.points[[0, -1]] for line in lines])).reshape(-1, 2)


def largest_part(lines: Sequence[Line]) -> list[list[int]]:
    label = _end_nodes(lines)
    part = component_labels(label, int(label.max()) + 1)[label[:, 0]]
    length = [shapely.LineString(line.points).length for line in lines]
    parts = [np.flatnonzero(part == k).tolist() for k in np.unique(part)]
    return sorted(parts, key=lambda members: (-sum(length[k] for k in members), members))


def limit_junctions(lanes: Sequence[Lane]) -> list[Lane]:
    """Change lanes so that at most four lead away from every junction.

    Where there are more, one that ends there joins the next arm a few metres before, if enough lanes end there.
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


def _crowded_nodes(lines: Sequence[FloatArray], oneway: Sequence[bool]) -> list[set[tuple[int, int]]]:
    pairs = [(k, i) for k, line in enumerate(lines) for i in range(len(line))]
    at: dict[int, set[tuple[int, int]]] = defaultdict(set)
    for label, pair in zip(node_labels(np.concatenate(lines)).tolist(), pairs, strict=True):
        at[label].add(pair)
    return [
        users
        for users in at.values()
        if sum((i + 1 < len(lines[k])) + (i > 0 and not oneway[k]) for k, i in users) > len(MOVES)
        and any(i in (0, len(lines[k]) - 1) for k, i in users)
    ]


def _move_lane_end(
    lines: list[FloatArray], oneway: Sequence[bool], users: set[tuple[int, int]]
) -> tuple[int, ...]:
    """Move the end of the lane closest to another arm onto it, but two-way ones onto no one-way arm; return both."""
    arms = []  # lane, point, neighbouring point
    for k, i in sorted(users):
        arms += [(k, i, j) for j in (i - 1, i + 1) if 0 <= j < len(lines[k]) and (j > i or not oneway[k])]
    turns: list[tuple[float, int, int]] = []
    for (a, (k, i, j)), (b, (other, i_b, j_b)) in product(enumerate(arms), repeat=2):
        if i in (0, len(lines[k]) - 1) and other != k and (oneway[k] or not oneway[other]):
            one, two = lines[k][j] - lines[k][i], lines[other][j_b] - lines[other][i_b]
            turns.append((float(one @ two / (np.hypot(*one) * np.hypot(*two))), -a, -b))
    if not turns:
        return ()
    _, a, b = max(turns)
    (k, i, _), (other, i_b, j_b) = arms[-a], arms[-b]
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
# Half the width, m, that a way out needs, and half of that of the narrowest.
CORRIDOR, NARROW_CORRIDOR = 1.5, 1.1
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
    """Return the lanes, the entries, (k, 2) m, and the first one's description, if there are public streets.

    They stay lanes if spaces open to them or only they connect others; then cars enter where they leave the map.
    """
    is_street = np.array([line.source == STREET for line in lines])
    if not is_street.any():
        return None
    label = _end_nodes(lines)
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
    return kept, entries, Entry(np.stack([corner_near(entries[0], kept), entries[0]]), reason, 1.0)


def corner_near(xy: FloatArray, lines: Sequence[Line]) -> FloatArray:
    """Return the corner of lines nearest to a point, (2,) m each, but for those within 1 m."""
    corners = np.concatenate([line.points for line in lines])
    away = np.hypot(*(corners - xy).T)
    return np.asarray(corners[int(np.argmin(np.where(away > 1.0, away, np.inf)))])


def _outermost(lines: Sequence[Line]) -> Entry:
    ends = np.concatenate([line.points[[0, -1]] for line in lines])
    hull = shapely.convex_hull(shapely.MultiPoint(np.concatenate([line.points for line in lines])))
    inside = shapely.distance(shapely.boundary(hull), shapely.points(ends))
    degree = np.bincount(node_labels(ends))[node_labels(ends)]
    k = int(np.lexsort((ends[:, 1], ends[:, 0], np.round(inside, 1), degree))[0])
    line = lines[k // 2].points
    before = line[1] if k % 2 == 0 else line[-2]
    return Entry(np.array([before, ends[k]]), "the outermost end of a lane: no free way leads out", 0.0)


def _best_way_out(
    lines: Sequence[Line],
    spaces_xy: FloatArray,
    blocked: Sequence[shapely.Geometry],
    corridor: float,
    longest: float,
) -> Entry | None:
    tree = shapely.STRtree(list(blocked))
    whole = shapely.union_all([*blocked, *(shapely.LineString(line.points).buffer(2.0) for line in lines)])
    try:
        ground = shapely.concave_hull(whole, ratio=0.3)
    except shapely.errors.GEOSException:  # it cannot triangulate, as with many corners on one line
        ground = shapely.convex_hull(whole)
    shapely.prepare(ground)
    ends, label = np.concatenate([line.points[[0, -1]] for line in lines]), _end_nodes(lines)
    at = {int(k): xy for k, xy in zip(label.ravel()[::-1], ends[::-1], strict=True)}
    graph = nx.Graph()
    for (a, b), line in zip(label.tolist(), lines, strict=True):
        graph.add_edge(a, b, weight=shapely.LineString(line.points).length)
    names = sorted(at)
    nodes = np.array([at[k] for k in names])
    at_nodes = shapely.STRtree(np.asarray(shapely.points(nodes)))
    weight = np.bincount(at_nodes.nearest(np.asarray(shapely.points(spaces_xy))), minlength=len(names))
    guesses: list[tuple[float, float, float, FloatArray, bool]] = []
    for name, xy in zip(names, nodes, strict=True):
        ways = _ways_out(name, xy, lines, label.ravel(), graph)
        reach = nx.single_source_dijkstra_path_length(graph, name, weight="weight")
        drive = float(sum(weight[i] * reach.get(other, 1e3) for i, other in enumerate(names)) / weight.sum())
        for way, is_end in ways:
            # A ray leaves the car park for good at the last point inside.
            inside = shapely.intersection(shapely.LineString([xy, xy + 150.0 * way]), ground)
            length = 0.0 if inside.is_empty else float(((shapely.get_coordinates(inside) - xy) @ way).max())
            points = np.array([xy, xy + (length + WAY_OUT) * way])
            road = shapely.LineString(points)
            if length > longest or len(tree.query(road, predicate="dwithin", distance=corridor)):
                continue
            score = drive + 2.0 * (length + WAY_OUT) - DEAD_END_GAIN * is_end
            guesses.append((round(score, 3), *np.round(xy, 3), points, is_end))
    if not guesses:
        return None
    guesses.sort(key=lambda guess: guess[:3])
    score, *_, points, is_end = guesses[0]
    others = [guess[0] for guess in guesses[1:] if np.hypot(*(guess[3][1] - points[1])) > 15.0]
    certainty = float(np.clip((others[0] - score) / 30.0, 0.0, 1.0)) if others else 1.0
    where = "an aisle's free end at the edge" if is_end else "a free way from a lane to the edge"
    return Entry(points, f"{where}, with the shortest drives to the spaces", certainty)


def _ways_out(
    name: int, xy: FloatArray, lines: Sequence[Line], label: IntArray, graph: nx.Graph
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


# Clearance, m, of a wide connection, and the longest drive between the ends of a possible connection without it, as a
# multiple of its length: of a wide one, of one between ends of aisles, and of any other.
WIDE, DETOUR_WIDE, DETOUR_ENDS, DETOUR_MIDWAY = 2.2, 1.8, 2.2, 4.0
SAMPLE = 1.0  # spacing, m, of the points of an aisle from which connections may start
NEAR_END = 6.0  # distance, m, from the end of an aisle within which a connection starts at the end
SHORTEST = 0.3  # m


@dataclass(frozen=True, eq=False)
class Connection:
    points: FloatArray  # (k, 2) m
    clearance: float  # m, distance to the nearest obstacle


def connect(lines: Sequence[FloatArray], space: FreeSpace, longest: float) -> list[Connection]:
    """Connect centre lines, (k, 2) m each, that share no point, by ways up to `longest` m."""
    stations, xy, owner = _samples(lines)
    cells = space.cells(xy)
    distance, before, source, pairs = space.spread(np.unique(cells))
    # Of the points in a cell the first counts, of all those the end of a line.
    is_end = np.r_[True, owner[1:] != owner[:-1]] | np.r_[owner[1:] != owner[:-1], True]
    order = np.lexsort((stations, owner, ~is_end))
    order = order[np.unique(cells[order], return_index=True)[1]]
    at_cell = np.zeros(len(distance), np.int64)
    at_cell[cells[order]] = order
    graph = _road_graph(lines, stations, xy, owner)
    length = np.array([shapely.LineString(line).length for line in lines])[owner]
    late = np.where(stations >= length - NEAR_END, 1, 2)
    kind = np.where(stations <= np.minimum(NEAR_END, length / 2), 0, late)

    gap = np.hypot(*(space.centers(pairs[:, 0]) - space.centers(pairs[:, 1])).T)
    cost = distance[pairs[:, 0]] + distance[pairs[:, 1]] + gap
    turned = np.diff(owner[at_cell[source[pairs]]], axis=1) < 0
    pairs = np.where(turned, pairs[:, ::-1], pairs)
    one, other = at_cell[source[pairs]].T
    far = np.flatnonzero((owner[one] != owner[other]) | (np.abs(stations[one] - stations[other]) >= 20.0))
    far = far[np.lexsort((far, cost[far]))]
    keys = np.stack([owner[one], kind[one], owner[other], kind[other]])[:, far]
    best = far[np.unique(keys, axis=1, return_index=True)[1]]
    best = best[np.lexsort((pairs[best, 1], pairs[best, 0], cost[best]))]

    found: list[Connection] = []
    for c, i, j, (p, q) in zip(*(a[best].tolist() for a in (cost, one, other, pairs)), strict=True):
        if c > longest:
            break
        try:
            known = nx.dijkstra_path_length(graph, i, j)
        except nx.NetworkXNoPath:
            known = np.inf
        if known <= DETOUR_WIDE * max(c, SHORTEST):
            continue
        path = np.concatenate([_trace(space, before, p)[::-1], _trace(space, before, q)])
        path = np.concatenate([[xy[i]], path[1:-1], [xy[j]]])
        room = float(space.clearance.ravel()[space.cells(path)].min())
        detour = DETOUR_ENDS if max(kind[i], kind[j]) < 2 else DETOUR_MIDWAY
        if known <= (DETOUR_WIDE if room >= WIDE else detour) * max(c, SHORTEST):
            continue
        points = space.pulled_straight(path)
        points = points[np.r_[True, np.hypot(*np.diff(points, axis=0).T) > 0.05]]
        graph.add_edge(i, j, weight=c)
        if len(points) > 1:
            found.append(Connection(points, space.room(points)))
    return found


def _samples(lines: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return points every metre along lines, ends included: stations, (n,) m, points, (n, 2) m, and lines, (n,)."""
    shapes = [shapely.LineString(points) for points in lines]
    counts = [max(2, int(np.ceil(line.length / SAMPLE)) + 1) for line in shapes]
    at = [np.linspace(0.0, line.length, count) for line, count in zip(shapes, counts, strict=True)]
    owner = np.repeat(np.arange(len(lines)), counts)
    stations = np.concatenate(at)
    on_line = shapely.line_interpolate_point(np.array(shapes)[owner], stations)
    return stations, shapely.get_coordinates(on_line), owner


def _road_graph(
    lines: Sequence[FloatArray], stations: FloatArray, xy: FloatArray, owner: IntArray
) -> nx.Graph:
    graph = nx.Graph()
    graph.add_nodes_from(range(len(xy)))
    along = owner[1:] == owner[:-1]
    for i in np.flatnonzero(along).tolist():
        graph.add_edge(i, i + 1, weight=float(stations[i + 1] - stations[i]))
    shapes = np.array([shapely.LineString(points) for points in lines])
    one, other = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=0.05)
    first = np.searchsorted(owner, np.arange(len(lines)))
    for a, b in zip(one[one < other].tolist(), other[one < other].tolist(), strict=True):
        meeting = shapely.get_coordinates(shapely.shortest_line(shapes[a], shapes[b]))[0]
        i, j = (int(first[k] + np.argmin(np.hypot(*(xy[owner == k] - meeting).T))) for k in (a, b))
        graph.add_edge(i, j, weight=0.1)
    return graph


def _trace(space: FreeSpace, before: IntArray, cell: int) -> FloatArray:
    cells = [cell]
    while before[cells[-1]] >= 0:
        cells.append(int(before[cells[-1]]))
    return space.centers(np.array(cells))


LEAST_CLEARANCE = 1.4  # half the width of a one-way road, m
COMFORTABLE = 2.9  # clearance, m, from which more is worth nothing
MARGIN = 14.0  # m around the obstacles
# Sizes of cells, m, and the number of fine cells above which they are coarse.
FINE, COARSE, FINE_CELLS = 0.7, 1.0, 250_000


class FreeSpace:
    """A grid over the surroundings of obstacles, polygons, m, that no car drives over."""

    def __init__(self, obstacles: Sequence[shapely.Geometry]) -> None:
        whole = shapely.union_all(list(obstacles))
        x0, y0, x1, y1 = whole.bounds
        area = (x1 - x0 + 2 * MARGIN) * (y1 - y0 + 2 * MARGIN)
        self.cell = FINE if area / FINE**2 <= FINE_CELLS else max(COARSE, (area / FINE_CELLS) ** 0.5)
        self.low = np.array([x0, y0]) - MARGIN
        nx, ny = np.ceil((np.array([x1, y1]) + MARGIN - self.low) / self.cell).astype(int)
        self.shape = (int(nx), int(ny))
        centers = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
        self.xy = self.low + (np.stack(centers, -1) + 0.5) * self.cell
        shapely.prepare(whole)
        covered = shapely.contains_xy(whole, self.xy[..., 0], self.xy[..., 1])
        self.clearance = np.asarray(distance_transform_edt(~covered)) * self.cell - 0.5 * self.cell
        self._whole = whole
        self._boundary = shapely.STRtree(shapely.get_parts(whole))

    def cells(self, xy: FloatArray) -> IntArray:
        """Return the flat index of the cell of each point, (n, 2) m."""
        index = np.clip(((xy - self.low) / self.cell).astype(int), 0, np.array(self.shape) - 1)
        return np.asarray(np.ravel_multi_index((index[:, 0], index[:, 1]), self.shape))

    def centers(self, cells: IntArray) -> FloatArray:
        return self.xy.reshape(-1, 2)[cells]

    def spread(self, start: IntArray) -> tuple[FloatArray, IntArray, IntArray, IntArray]:
        """Drive from cells to all others at once.

        Returns the cost, (n_cells,) m, predecessor and start of each cell, and neighbours, (m, 2), of different starts.
        """
        flat = self.clearance.ravel()
        price = 1.0 + 1.5 * np.clip((COMFORTABLE - flat) / (COMFORTABLE - LEAST_CLEARANCE), 0.0, 1.0)
        passable = flat >= LEAST_CLEARANCE - 0.35 * self.cell
        passable[start] = True
        number = np.arange(flat.size).reshape(self.shape)
        links, ways = [], ((1, 0), (0, 1), (1, 1), (1, -1))
        for dx, dy in ways:
            a = number[: self.shape[0] - dx, max(0, -dy) : self.shape[1] - max(0, dy)].ravel()
            b = number[dx:, max(0, dy) : self.shape[1] - max(0, -dy)].ravel()
            links.append(np.stack([a, b])[:, passable[a] & passable[b]])
        tail, head = np.concatenate(links, axis=1)
        step = np.repeat([np.hypot(*way) for way in ways], [link.shape[1] for link in links])
        cost = (price[tail] + price[head]) / 2 * step * self.cell
        graph = coo_array((cost, (tail, head)), shape=(flat.size,) * 2).tocsr()
        distance, before, source = dijkstra(
            graph, directed=False, indices=start, min_only=True, return_predecessors=True
        )
        apart = (source[tail] != source[head]) & np.isfinite(distance[tail]) & np.isfinite(distance[head])
        pairs = np.stack([tail[apart], head[apart]], axis=1).astype(np.int64)
        return np.asarray(distance), before.astype(np.int64), source.astype(np.int64), pairs

    def room(self, points: FloatArray) -> float:
        return float(shapely.distance(shapely.LineString(points), self._whole))

    def pulled_straight(self, path: FloatArray) -> FloatArray:
        """Return a path with as few corners as its clearance allows, (k, 2) m."""
        wide = self.clearance.ravel()[self.cells(path)]
        kept, last = [0], len(path) - 1
        while (at := kept[-1]) < last:
            ahead = last
            while ahead > at + 1:
                room = wide[at : ahead + 1].min() - 0.6 * self.cell
                least = float(np.clip(room, LEAST_CLEARANCE - 0.1, COMFORTABLE - 0.3))
                way = shapely.LineString(path[[at, ahead]])
                if not len(self._boundary.query(way, predicate="dwithin", distance=least)):
                    break
                ahead -= max(1, (ahead - at) // 12)
            kept.append(max(ahead, at + 1))
        return path[kept]
