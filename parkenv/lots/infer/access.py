"""Where cars enter and where people walk to, if nobody says: guesses from the network and its surroundings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.infer.network import STREET, Line, largest_part
from parkenv.world.drive_graph import node_labels

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
    """Return the most plausible entry: a lane that can be continued out of the car park, with short drives to spaces.

    Args:
        lines: pieces of the network, cut at crossings.
        spaces_xy: (n, 2) m, stops before the spaces.
        blocked: polygons that no car drives over.
    """
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

    Args:
        lines: pieces of the network, cut at crossings.
        mouths: (n, 2) m, middles of the slots' open sides.
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
    """Return an entry at the end or crossing of lanes that is farthest out, for a car park closed on all sides."""
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
