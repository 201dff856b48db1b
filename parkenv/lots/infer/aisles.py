"""Aisles: centre lines before the open sides of rows, shared by rows that face or continue each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.lots.infer.openings import WIDEST_SHARED, OpenRow, is_on_road
from parkenv.lots.infer.spaces import Spaces
from parkenv.world.drive_graph import component_labels

HALF_WIDTH = 3.0  # distance, m, of the centre line from a row that no other row faces
NARROW_HALF_WIDTH = 2.2  # the same for oblique and kerbside rows
ACROSS_GAP = 16.0  # widest gap, m, across which an aisle continues
OFF_LINE = 1.6  # largest offset, m, of the parts of one aisle
SAME_DIRECTION = np.cos(np.radians(20.0))
BENT = 0.7  # deviation, m, from which an aisle is a curve and not a straight line
SMOOTH = 0.25  # tolerance, m, of a curve's corners
CAR_HALF_WIDTH = 1.1  # half the width, m, of a car with its mirrors
LEAST_ROOM = 0.95  # distance, m, of an aisle from obstacles at its narrowest
AHEAD = 1.3  # distance, m, that a lane's end keeps from obstacles
BEYOND = 3.0  # length, m, by which an aisle continues beyond its last space, to turn there
RECENTRED = 5.5  # width, m, up to which an aisle runs exactly in the middle between obstacles
SHORTEST = 1.5  # m, of the drivable parts of an aisle
MEETING = 12.0  # distance, m, within which an aisle continues straight on to another


@dataclass(frozen=True, eq=False)
class Aisle:
    """A centre line, the rows that open to it, and the width between them."""

    points: FloatArray  # (k, 2) m
    rows: IntArray  # (m,) indices of the rows it serves
    width: float  # m, median width between facing rows or obstacles; at most twice the look ahead
    one_way: int = (
        0  # 1 or -1: cars drive in or against the order of the points, by the slant of spaces; 0: both
    )

    @property
    def line(self) -> shapely.LineString:
        return shapely.LineString(self.points)


def find_aisles(
    spaces: Spaces,
    rows: Sequence[OpenRow],
    blocked: Sequence[shapely.Geometry],
    roads: Sequence[FloatArray] = (),
) -> list[Aisle]:
    """Return the aisles of the rows, clear of the `blocked` polygons; rows along `roads`, (k, 2) m each, need none."""
    on_road = [bool(is_on_road(spaces, p.row, p.side, p.view, roads).mean() > 0.5) for p in rows]
    if all(on_road):
        return []
    tree = shapely.STRtree(list(blocked))
    owner = np.full(len(spaces), -1)
    for r, part in enumerate(rows):
        owner[part.row.members] = r
    faced = [_faced(rows, owner, r) for r in range(len(rows))]
    depth = [_depth(part, facing >= 0) for part, facing in zip(rows, faced, strict=True)]
    stops = [
        part.row.mouths(spaces, part.side) + h[:, None] * part.row.normal(part.side)
        for part, h in zip(rows, depth, strict=True)
    ]
    links = {(min(r, q), max(r, q)) for r, facing in enumerate(faced) for q in facing[facing >= 0].tolist()}
    links |= _continuations(rows, stops, tree)
    label = component_labels(np.array(sorted(links), dtype=np.int64), len(rows))
    aisles = []
    for group in range(int(label.max()) + 1):
        members = np.flatnonzero(label == group)
        # A row that faces a row along a road uses the road.
        if not any(on_road[r] for r in members):
            aisle = _aisle(rows, members, stops, faced)
            points = _centred(aisle.points, tree) if aisle.width < RECENTRED else aisle.points
            aisles += [replace(aisle, points=part) for part in _clear_parts(points, tree)]
    return _extended(aisles, tree)


def _faced(rows: Sequence[OpenRow], owner: IntArray, r: int) -> IntArray:
    own = rows[r]
    result = np.full(len(own.row), -1)
    normal = own.row.normal(own.side)
    for k, hit in enumerate(own.view.hit.tolist()):
        q = int(owner[hit]) if hit >= 0 else -1
        if q < 0 or q == r or own.view.clear[k] > WIDEST_SHARED:
            continue
        other = rows[q]
        j = int(np.flatnonzero(other.row.members == hit)[0])
        if normal[k] @ other.row.normal(other.side)[j] < -0.9:
            result[k] = q
    return result


def _depth(part: OpenRow, is_faced: NDArray[np.bool_]) -> FloatArray:
    """Return the distances, (k,) m, from the mouths of a row to its centre line."""
    clear = part.view.clear
    usual = HALF_WIDTH if part.row.slant > np.radians(70.0) else NARROW_HALF_WIDTH
    depth = np.minimum(clear / 2, usual)
    if is_faced.any():
        typical = float(np.median(clear[is_faced])) / 2
        depth = np.where(is_faced, clear / 2, np.minimum(typical, np.maximum(clear - 1.4, clear / 2)))
    if len(depth) > 4:
        window = np.lib.stride_tricks.sliding_window_view(np.pad(depth, 2, mode="edge"), 5)
        depth = np.asarray(np.median(window, axis=1))
    return np.minimum(depth, np.maximum(clear - 1.2, clear / 2))


def _continuations(
    rows: Sequence[OpenRow], stops: Sequence[FloatArray], tree: shapely.STRtree
) -> set[tuple[int, int]]:
    ends = [(r, k) for r, part in enumerate(rows) for k in {0, len(part.row) - 1}]
    at = np.array([stops[r][k] for r, k in ends])
    found = set()
    for a, b in sorted(cKDTree(at).query_pairs(ACROSS_GAP)):
        (r, i), (q, j) = ends[a], ends[b]
        if r == q:
            continue
        one, other = rows[r].row, rows[q].row
        if one.normal(rows[r].side)[i] @ other.normal(rows[q].side)[j] < SAME_DIRECTION:
            continue
        step = at[b] - at[a]
        length = float(np.hypot(*step))
        if length < 1e-6:
            continue
        off = max(
            abs(float(step @ one.normal(rows[r].side)[i])), abs(float(step @ other.normal(rows[q].side)[j]))
        )
        if off > OFF_LINE:
            continue
        way = shapely.LineString([at[a], at[b]]).buffer(CAR_HALF_WIDTH, cap_style="flat")
        if len(tree.query(way, predicate="intersects")) == 0:
            found.add((min(r, q), max(r, q)))
    return found


def _aisle(
    rows: Sequence[OpenRow], members: IntArray, stops: Sequence[FloatArray], faced: Sequence[IntArray]
) -> Aisle:
    xy = np.concatenate([stops[r] for r in members])
    along = np.concatenate([rows[r].row.along for r in members])
    pitch = np.concatenate([rows[r].row.pitch for r in members])
    clear = np.concatenate([rows[r].view.clear for r in members])
    facing = np.concatenate([faced[r] >= 0 for r in members])
    points = _centre_line(xy, along, pitch)
    width = float(np.median(clear[facing])) if facing.any() else float(np.median(clear))
    ways = [_slant_direction(rows[r], points, stops[r]) for r in members]
    weight = sum(way * len(rows[r].row) for r, way in zip(members, ways, strict=True))
    agreed = all(way >= 0 for way in ways) or all(way <= 0 for way in ways)
    return Aisle(points, members, width, int(np.sign(weight)) if agreed else 0)


def _slant_direction(part: OpenRow, points: FloatArray, stops: FloatArray) -> int:
    """Return the direction of an aisle in which cars turn into an oblique row: 1 along its points, -1 against, or 0."""
    if not np.radians(15.0) < part.row.slant < np.radians(75.0):
        return 0
    line = shapely.LineString(points)
    station = shapely.line_locate_point(line, shapely.points(stops))
    ahead, behind = (
        shapely.get_coordinates(shapely.line_interpolate_point(line, np.clip(station + d, 0.0, line.length)))
        for d in (0.5, -0.5)
    )
    nose = -part.row.outward(part.side)
    return int(np.sign(np.median(((ahead - behind) * nose).sum(axis=1))))


def _centre_line(xy: FloatArray, along: FloatArray, pitch: FloatArray) -> FloatArray:
    """Return the line through points before the mouths: straight if that fits, otherwise a curve."""
    middle = xy.mean(axis=0)
    # The mean direction of the rows, as an axis.
    double = np.exp(2j * np.arctan2(along[:, 1], along[:, 0])).mean()
    angle = float(np.angle(double)) / 2
    if len(xy) > 3 and np.ptp(xy @ [np.cos(angle), np.sin(angle)]) > 12.0:
        direction = np.linalg.svd(xy - middle)[2][0]
        if abs(direction @ [np.cos(angle), np.sin(angle)]) > SAME_DIRECTION:
            angle = float(np.arctan2(direction[1], direction[0]))
    way = np.array([np.cos(angle), np.sin(angle)])
    left = np.array([-way[1], way[0]])
    station, off = (xy - middle) @ way, (xy - middle) @ left
    middle = middle + left * float(np.median(off))
    half = pitch / 2
    bent = np.abs(off - np.median(off))
    if abs(double) > 0.97 and np.quantile(bent, 0.9) <= BENT and bent.max() <= 2 * BENT:
        return np.asarray(middle + np.outer([(station - half).min(), (station + half).max()], way))
    return _curve(xy, float(np.median(half)))


def _curve(xy: FloatArray, half: float) -> FloatArray:
    """Return a curve through scattered points: the longest path in their minimum spanning tree, smoothed."""
    near = [np.flatnonzero(mask) for mask in _groups(xy, 1.6)]
    nodes = np.array([xy[group].mean(axis=0) for group in near])
    if len(nodes) < 3:
        far = np.unravel_index(
            np.argmax(np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))), (len(xy),) * 2
        )
        line = xy[list(far)]
        if np.hypot(*(line[1] - line[0])) < 0.5:
            line = line + np.array([[-half, 0.0], [half, 0.0]])
        return _lengthened(line, half)
    distance = np.hypot(*(nodes[:, None] - nodes[None]).transpose(2, 0, 1))
    tree = minimum_spanning_tree(distance)
    reach = dijkstra(tree, directed=False)
    start, end = (int(i) for i in np.unravel_index(int(np.argmax(reach)), reach.shape))
    _, before = dijkstra(tree, directed=False, return_predecessors=True)
    before = before[start]
    path = [end]
    while path[-1] != start:
        path.append(int(before[path[-1]]))
    line = nodes[path]
    if len(line) > 4:
        inner = (line[:-2] + line[1:-1] + line[2:]) / 3
        line = np.concatenate([line[:1], inner, line[-1:]])
        inner = (line[:-2] + line[1:-1] + line[2:]) / 3
        line = np.concatenate([line[:1], inner, line[-1:]])
    line = shapely.get_coordinates(shapely.simplify(shapely.LineString(line), SMOOTH))
    return _lengthened(line, half)


def _groups(xy: FloatArray, reach: float) -> list[NDArray[np.bool_]]:
    left = np.ones(len(xy), dtype=bool)
    groups = []
    while left.any():
        first = xy[np.flatnonzero(left)[0]]
        near = left & (np.hypot(*(xy - first).T) <= reach)
        groups.append(near)
        left &= ~near
    return groups


def _lengthened(line: FloatArray, by: float) -> FloatArray:
    start, end = line[0] - line[1], line[-1] - line[-2]
    return np.concatenate(
        [[line[0] + by * start / np.hypot(*start)], line[1:-1], [line[-1] + by * end / np.hypot(*end)]]
    )


def _centred(points: FloatArray, tree: shapely.STRtree) -> FloatArray:
    """Move a line to the middle between the obstacles on its two sides."""
    line = shapely.LineString(points)
    count = max(int(line.length / 1.5), 1) + 1
    station = np.linspace(0.0, line.length, count)
    xy = shapely.get_coordinates(shapely.line_interpolate_point(line, station))
    if len(xy) < 4:
        return points
    step = np.gradient(xy, axis=0)
    left = np.stack([-step[:, 1], step[:, 0]], axis=1) / np.hypot(step[:, 0], step[:, 1])[:, None]
    room = np.stack([_distances(xy, sign * left, RECENTRED, tree) for sign in (1.0, -1.0)])
    # The nearest obstacle within half a car's length counts.
    window = np.lib.stride_tricks.sliding_window_view(np.pad(room, ((0, 0), (2, 2)), mode="edge"), 5, axis=1)
    room = window.min(axis=2)
    between = (room < RECENTRED).all(axis=0)
    shift = np.where(between, (room[0] - room[1]) / 2, 0.0)
    window = np.lib.stride_tricks.sliding_window_view(np.pad(shift, 2, mode="edge"), 5)
    moved = xy + np.clip(window.mean(axis=1), -1.5, 1.5)[:, None] * left
    return shapely.get_coordinates(shapely.simplify(shapely.LineString(moved), 0.12))


def _distances(xy: FloatArray, way: FloatArray, most: float, tree: shapely.STRtree) -> FloatArray:
    """Return the distances, (n,) m, from points to the first obstacle in a direction, at most `most`."""
    rays = np.asarray(shapely.linestrings(np.stack([xy, xy + most * way], axis=1)))
    ray, shape = tree.query(rays, predicate="intersects")
    far = shapely.distance(
        np.asarray(shapely.points(xy))[ray], shapely.intersection(rays[ray], tree.geometries[shape])
    )
    result = np.full(len(xy), most)
    np.minimum.at(result, ray, far)
    return result


def _clear_parts(points: FloatArray, tree: shapely.STRtree) -> list[FloatArray]:
    line = shapely.LineString(points)
    near = tree.query(line, predicate="dwithin", distance=LEAST_ROOM)
    if not len(near):
        return [points]
    shut = shapely.union_all(shapely.buffer(tree.geometries[near], LEAST_ROOM))
    parts = [
        shapely.get_coordinates(part)
        for part in shapely.get_parts(shapely.difference(line, shut))
        if part.length > SHORTEST
    ]
    return parts or [points]


def _extended(aisles: Sequence[Aisle], tree: shapely.STRtree) -> list[Aisle]:
    """Continue every aisle straight on beyond its ends: to an aisle that it meets, or as far as cars turn."""
    lines = np.array([aisle.line for aisle in aisles])
    crossing = shapely.STRtree(lines)
    extended = []
    for a, aisle in enumerate(aisles):
        points = aisle.points
        for end in (0, -1):
            inner = points[1] if end == 0 else points[-2]
            way = (points[end] - inner) / np.hypot(*(points[end] - inner))
            free = _free_length(points[end], way, MEETING, tree)
            probe = shapely.LineString([points[end], points[end] + free * way])
            meets = [
                shapely.distance(shapely.Point(points[end]), shapely.intersection(probe, lines[b]))
                for b in crossing.query(probe, predicate="intersects").tolist()
                if b != a
            ]
            length = min(meets) if meets else min(BEYOND, free)
            if length > 0.05:
                tip = points[end] + length * way
                points = np.concatenate([[tip], points[1:]] if end == 0 else [points[:-1], [tip]])
        extended.append(Aisle(points, aisle.rows, aisle.width, aisle.one_way))
    return extended


def _free_length(start: FloatArray, way: FloatArray, most: float, tree: shapely.STRtree) -> float:
    """Return how far a car can drive straight on, m, with some room to spare, at most `most`."""
    corridor = shapely.LineString([start, start + (most + AHEAD) * way]).buffer(
        CAR_HALF_WIDTH + 0.3, cap_style="flat"
    )
    hits = tree.query(corridor, predicate="intersects")
    if not len(hits):
        return most
    near = shapely.intersection(tree.geometries[hits], corridor)
    corners = shapely.get_coordinates(near) - start
    return float(np.clip((corners @ way).min() - AHEAD, 0.0, most))
