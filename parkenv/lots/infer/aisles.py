"""The side on which each row of spaces opens, and aisles: centre lines before open sides, shared by facing rows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import median_filter, minimum_filter1d
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.lots.infer.spaces import Row, Spaces
from parkenv.world.drive_graph import SLOT_REACH, component_labels

LOOK = 18.0  # how far ahead of a mouth obstacles are looked for, m
WIDEST_SHARED = 13.0  # widest aisle, m, that two facing rows share
# Least width, m, of an aisle along kerbside and along perpendicular spaces; oblique ones are in between.
LEAST_KERBSIDE, LEAST_PERPENDICULAR = 2.7, 3.9
# Fraction of that width that is enough before single spaces of an oblique and of a perpendicular row.
TOLERATED, TOLERATED_ACROSS = 0.75, 0.95
EXHAUSTIVE = 14  # undecided rows up to which all combinations of sides are tried
ON_ROAD = 4.0  # gain per space of a row that opens to a road of the map
# Costs per space of a row that opens to free ground, of a gap as wide as an aisle that nothing opens to, and the gain
# per space of two rows that share an aisle.
ALONE, UNUSED, SHARED = 0.55, 0.45, 1.0


@dataclass(frozen=True, eq=False)
class View:
    """What lies ahead of the mouths of a row, on one side."""

    clear: FloatArray  # (k,) m to the nearest obstacle, at most `LOOK`
    hit: IntArray  # (k,) the space that the middle of the view ends at; -1 for none


@dataclass(frozen=True, eq=False)
class OpenRow:
    """A row, the side that it opens to, and how sure that is (0 to 1)."""

    row: Row
    side: int
    view: View
    certainty: float


def least_aisle(row: Row) -> float:
    return LEAST_KERBSIDE + (LEAST_PERPENDICULAR - LEAST_KERBSIDE) * float(np.sin(row.slant)) ** 2


def open_rows(
    spaces: Spaces,
    rows: Sequence[Row],
    obstacles: Sequence[shapely.Geometry],
    roads: Sequence[FloatArray] = (),
) -> tuple[list[OpenRow], IntArray]:
    """Return the rows with their open sides, divided where these differ, and the spaces that no aisle can reach."""
    shapes = np.concatenate([spaces.boxes(shrink=0.1), np.array(list(obstacles), dtype=object)])
    tree = shapely.STRtree(shapes)
    parts: list[tuple[Row, list[View]]] = []
    lost: list[int] = []
    for row in rows:
        views = [_view(spaces, shapes, tree, row, side) for side in (0, 1)]
        is_open = np.stack([_is_open(view.clear, row) for view in views], axis=1)
        if len(row) == 1 and not is_open.any():
            lost += row.members.tolist()
            continue
        for index in _runs(is_open):
            index = index[is_open[index].any(axis=1)]
            if len(index):
                parts.append((row.part(index), [View(v.clear[index], v.hit[index]) for v in views]))
        lost += row.members[~is_open.any(axis=1)].tolist()
    sides, certainty = _choose(spaces, parts, roads)
    opened = [
        OpenRow(row, side, views[side], sure)
        for (row, views), side, sure in zip(parts, sides, certainty, strict=True)
    ]
    return opened, np.array(sorted(lost), dtype=np.int64)


def _view(spaces: Spaces, shapes: NDArray[np.object_], tree: shapely.STRtree, row: Row, side: int) -> View:
    k, n = len(row), len(spaces)
    normal = row.normal(side)
    mouths = row.mouths(spaces, side)
    clear, hits = np.full((3, k), LOOK), np.full((3, k), -1)
    for j, share in enumerate((0.0, -0.3, 0.3)):
        start = mouths + share * row.pitch[:, None] * row.along
        rays = np.asarray(shapely.linestrings(np.stack([start, start + LOOK * normal], axis=1)))
        ray, shape = tree.query(rays, predicate="intersects")
        # The row itself ends no view, except around a tight bend.
        position = np.full(len(shapes), -(10**6))
        position[row.members] = np.arange(k)
        other = np.abs(position[shape] - ray) > 3
        ray, shape = ray[other], shape[other]
        far = shapely.distance(
            np.asarray(shapely.points(start))[ray], shapely.intersection(rays[ray], shapes[shape])
        )
        order = np.lexsort((shape, far))[::-1]
        clear[j, ray[order]] = far[order]
        hits[j, ray[order]] = np.where(shape[order] < n, shape[order], -1)
    return View(clear=np.minimum(clear[0], np.median(clear, axis=0)), hit=hits[0])


def _runs(is_open: BoolArray) -> list[IntArray]:
    runs: list[list[int]] = [[]]
    common = np.array([True, True])
    for i, sides in enumerate(is_open):
        if sides.any():
            if not (common & sides).any():
                runs.append([])
                common = np.array([True, True])
            common &= sides
        runs[-1].append(i)
    return [np.array(run) for run in runs]


def is_on_road(spaces: Spaces, row: Row, side: int, view: View, roads: Sequence[FloatArray]) -> BoolArray:
    if not len(roads):
        return np.zeros(len(row), dtype=bool)
    mouths = row.mouths(spaces, side)
    reach = np.minimum(view.clear, SLOT_REACH - 0.1)[:, None]
    rays = np.asarray(shapely.linestrings(np.stack([mouths, mouths + reach * row.normal(side)], axis=1)))
    lines = shapely.multilinestrings([shapely.LineString(road) for road in roads])
    return np.asarray(shapely.intersects(rays, lines))


def _is_open(clear: FloatArray, row: Row) -> BoolArray:
    """Whether cars reach spaces from a side, (k,): where most of a row has the width that it needs, less is enough."""
    need = least_aisle(row)
    tolerated = TOLERATED if row.slant < np.radians(75.0) else TOLERATED_ACROSS
    return clear >= (tolerated * need if np.median(clear) >= need else need)


def _choose(
    spaces: Spaces, parts: Sequence[tuple[Row, list[View]]], roads: Sequence[FloatArray]
) -> tuple[list[int], list[float]]:
    """Choose sides of least cost: rows share aisles where they can, and no gap like an aisle stays unused."""
    n = len(parts)
    owner = np.full(len(spaces), -1)
    for r, (row, _) in enumerate(parts):
        owner[row.members] = r
    unary = np.zeros((n, 2))
    pairs: dict[tuple[int, int], FloatArray] = {}
    for r, (row, views) in enumerate(parts):
        need = least_aisle(row)
        for side, view in enumerate(views):
            if not _is_open(view.clear, row).all():
                unary[r, side] += np.inf
                continue
            # How much a gap is like an aisle: most from 5 to 7.5 m.
            widths = [need - 0.01, need, 4.5, 5.2, 7.5, WIDEST_SHARED, LOOK]
            like = np.interp(view.clear, widths, [0.0, 0.25, 0.8, 1.0, 1.0, 0.35, 0.2])
            facing = np.zeros(len(row), dtype=bool)
            for k in np.flatnonzero(view.hit >= 0).tolist():
                other = int(owner[view.hit[k]])
                if other < 0 or other == r:
                    continue
                opposite = parts[other][0]
                j = int(np.flatnonzero(opposite.members == view.hit[k])[0])
                cosine = float(row.normal(side)[k] @ opposite.normal(0)[j])
                if abs(cosine) < 0.82:
                    continue  # the view ends at a flank
                facing[k] = True
                table = pairs.setdefault((min(r, other), max(r, other)), np.zeros((2, 2)))
                faced, weight = int(cosine > 0.0), 0.5 * float(like[k])
                cells = table if r < other else table.T
                cells[side, faced] -= weight * SHARED
                cells[1 - side, 1 - faced] += weight * UNUSED
            unary[r, side] += ALONE * float((~facing & (view.clear > 9.0)).sum())
            unary[r, side] += 0.3 * float((~facing & (view.clear <= 9.0)).sum())
            unary[r, side] -= ON_ROAD * float(is_on_road(spaces, row, side, view, roads).sum())
            # A wider view costs less than a narrow one, all else being equal.
            unary[r, side] += 0.25 * float((1.0 - like).sum()) - 0.01 * float(
                np.minimum(view.clear, 8.0).sum()
            )
    label = component_labels(np.array(list(pairs), dtype=np.int64), n) if n else np.empty(0, np.int64)
    sides, cost, own = np.zeros(n, dtype=int), unary.copy(), np.arange(n)
    for part in np.unique(label):
        members = np.flatnonzero(label == part)
        inside = {pair: table for pair, table in pairs.items() if label[pair[0]] == part}
        sides[members] = _least_cost(unary[members], members, inside)
    for (a, b), table in pairs.items():
        cost[a] += table[:, sides[b]]
        cost[b] += table[sides[a]]
    with np.errstate(invalid="ignore"):
        gain = cost[own, 1 - sides] - cost[own, sides]
    sure = np.clip(gain / (0.6 * np.array([len(row) for row, _ in parts])), 0.0, 1.0)
    return sides.tolist(), np.where(np.isfinite(cost).all(axis=1), sure, 1.0).tolist()


def _least_cost(unary: FloatArray, members: IntArray, pairs: dict[tuple[int, int], FloatArray]) -> IntArray:
    """Return the sides of least total cost: all combinations for few rows, otherwise by changes of one or two rows."""
    where = {int(r): i for i, r in enumerate(members)}
    tables = [(where[a], where[b], table) for (a, b), table in pairs.items()]
    free = np.flatnonzero(np.isfinite(unary).all(axis=1))
    fixed = np.argmin(unary, axis=1)

    def total(sides: IntArray) -> FloatArray:
        cost = np.asarray(unary[np.arange(len(unary)), sides].sum(axis=-1))
        for a, b, table in tables:
            cost = cost + table[sides[..., a], sides[..., b]]
        return cost

    if len(free) <= EXHAUSTIVE:
        sides = np.tile(fixed, (2 ** len(free), 1))
        sides[:, free] = np.array(list(product((0, 1), repeat=len(free))), dtype=int)
        return np.asarray(sides[int(np.argmin(total(sides)))])
    groups = [[i] for i in free.tolist()] + [[a, b] for a, b, _ in tables if a in free and b in free]
    changes = [(group, values) for group in groups for values in product((0, 1), repeat=len(group))]
    found = []
    for start in (fixed[free], 0, 1):
        sides = fixed.copy()
        sides[free] = start
        cost, changed = float(total(sides)), True
        while changed:
            changed = False
            for group, values in changes:
                trial = sides.copy()
                trial[group] = values
                if (trial_cost := float(total(trial))) < cost - 1e-9:
                    sides, cost, changed = trial, trial_cost, True
        found.append((cost, sides))
    return np.asarray(min(found, key=lambda pair: pair[0])[1])


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
        if q >= 0 and q != r and own.view.clear[k] <= WIDEST_SHARED:
            j = int(np.flatnonzero(rows[q].row.members == hit)[0])
            if normal[k] @ rows[q].row.normal(rows[q].side)[j] < -0.9:
                result[k] = q
    return result


def _depth(part: OpenRow, is_faced: BoolArray) -> FloatArray:
    clear = part.view.clear
    depth = np.minimum(clear / 2, HALF_WIDTH if part.row.slant > np.radians(70.0) else NARROW_HALF_WIDTH)
    if is_faced.any():
        typical = float(np.median(clear[is_faced])) / 2
        depth = np.where(is_faced, clear / 2, np.minimum(typical, np.maximum(clear - 1.4, clear / 2)))
    if len(depth) > 4:
        depth = median_filter(depth, 5, mode="nearest")
    return np.minimum(depth, np.maximum(clear - 1.2, clear / 2))


def _continuations(
    rows: Sequence[OpenRow], stops: Sequence[FloatArray], tree: shapely.STRtree
) -> set[tuple[int, int]]:
    ends = [(r, k) for r, part in enumerate(rows) for k in {0, len(part.row) - 1}]
    at = np.array([stops[r][k] for r, k in ends])
    pairs = set()
    for a, b in sorted(cKDTree(at).query_pairs(ACROSS_GAP)):
        (r, i), (q, j) = ends[a], ends[b]
        if r == q:
            continue
        normals = rows[r].row.normal(rows[r].side)[i], rows[q].row.normal(rows[q].side)[j]
        step = at[b] - at[a]
        off = max(abs(float(step @ normal)) for normal in normals)
        if normals[0] @ normals[1] < SAME_DIRECTION or np.hypot(*step) < 1e-6 or off > OFF_LINE:
            continue
        way = shapely.LineString([at[a], at[b]]).buffer(CAR_HALF_WIDTH, cap_style="flat")
        if len(tree.query(way, predicate="intersects")) == 0:
            pairs.add((min(r, q), max(r, q)))
    return pairs


def _aisle(
    rows: Sequence[OpenRow], members: IntArray, stops: Sequence[FloatArray], faced: Sequence[IntArray]
) -> Aisle:
    xy = np.concatenate([stops[r] for r in members])
    along = np.concatenate([rows[r].row.along for r in members])
    pitch = np.concatenate([rows[r].row.pitch for r in members])
    clear = np.concatenate([rows[r].view.clear for r in members])
    facing = np.concatenate([faced[r] >= 0 for r in members])
    points = _centre_line(xy, along, pitch)
    width = float(np.median(clear[facing] if facing.any() else clear))
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
    return int(np.sign(np.median(((ahead - behind) * (-part.row.outward(part.side))).sum(axis=1))))


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
    left, middles = np.ones(len(xy), dtype=bool), []
    while left.any():
        near = left & (np.hypot(*(xy - xy[left.argmax()]).T) <= 1.6)
        middles.append(xy[near].mean(axis=0))
        left &= ~near
    nodes = np.array(middles)
    if len(nodes) < 3:
        apart = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
        line = xy[list(np.unravel_index(np.argmax(apart), apart.shape))]
        if np.hypot(*(line[1] - line[0])) < 0.5:
            line = line + np.array([[-half, 0.0], [half, 0.0]])
        return _lengthened(line, half)
    distance = np.hypot(*(nodes[:, None] - nodes[None]).transpose(2, 0, 1))
    reach, before = dijkstra(minimum_spanning_tree(distance), directed=False, return_predecessors=True)
    start, end = (int(i) for i in np.unravel_index(int(np.argmax(reach)), reach.shape))
    path = [end]
    while path[-1] != start:
        path.append(int(before[start, path[-1]]))
    line = nodes[path]
    for _ in range(2 if len(line) > 4 else 0):
        line = np.concatenate([line[:1], (line[:-2] + line[1:-1] + line[2:]) / 3, line[-1:]])
    line = shapely.get_coordinates(shapely.simplify(shapely.LineString(line), SMOOTH))
    return _lengthened(line, half)


def _lengthened(line: FloatArray, by: float) -> FloatArray:
    start, end = line[0] - line[1], line[-1] - line[-2]
    return np.concatenate(
        [[line[0] + by * start / np.hypot(*start)], line[1:-1], [line[-1] + by * end / np.hypot(*end)]]
    )


def _centred(points: FloatArray, tree: shapely.STRtree) -> FloatArray:
    line = shapely.LineString(points)
    station = np.linspace(0.0, line.length, max(int(line.length / 1.5), 1) + 1)
    xy = shapely.get_coordinates(shapely.line_interpolate_point(line, station))
    if len(xy) < 4:
        return points
    step = np.gradient(xy, axis=0)
    left = np.stack([-step[:, 1], step[:, 0]], axis=1) / np.hypot(step[:, 0], step[:, 1])[:, None]
    room = np.stack([_distances(xy, sign * left, RECENTRED, tree) for sign in (1.0, -1.0)])
    # The nearest obstacle within half a car's length counts.
    room = minimum_filter1d(room, 5, axis=1, mode="nearest")
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
    lines = np.array([shapely.LineString(aisle.points) for aisle in aisles])
    crossing = shapely.STRtree(lines)
    extended = []
    for a, aisle in enumerate(aisles):
        points = aisle.points.copy()
        for end, inner in ((0, 1), (-1, -2)):
            way = (points[end] - points[inner]) / np.hypot(*(points[end] - points[inner]))
            free = _free_length(points[end], way, MEETING, tree)
            probe = shapely.LineString([points[end], points[end] + free * way])
            others = np.setdiff1d(crossing.query(probe, predicate="intersects"), [a])
            meets = shapely.distance(shapely.Point(points[end]), shapely.intersection(probe, lines[others]))
            length = meets.min() if len(others) else min(BEYOND, free)
            if length > 0.05:
                points[end] += length * way
        extended.append(replace(aisle, points=points))
    return extended


def _free_length(start: FloatArray, way: FloatArray, most: float, tree: shapely.STRtree) -> float:
    """Return how far a car can drive straight on, m, with some room to spare, at most `most`."""
    corridor = shapely.LineString([start, start + (most + AHEAD) * way]).buffer(
        CAR_HALF_WIDTH + 0.3, cap_style="flat"
    )
    hits = tree.query(corridor, predicate="intersects")
    if not len(hits):
        return most
    corners = shapely.get_coordinates(shapely.intersection(tree.geometries[hits], corridor)) - start
    return float(np.clip((corners @ way).min() - AHEAD, 0.0, most))
