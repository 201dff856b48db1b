"""The streets of a town: the part in which every way leads back, where cars come in, and the lanes.

Streets are cut at their junctions into pieces. Those from which cars can drive on to every other one are kept: what a
fence or a missing junction parts from them is left out. Beyond the edge of the map streets go on: where a one-way
street leaves it or enters it, and where the edge parts streets from the others, a way to the nearest street that
crosses the edge within 600 m is assumed. Service roads that lead to no parking are dropped. The speed of a lane is its
limit over 30 km/h: where 30 is allowed, cars drive at the scenario's speed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np
import shapely
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.errors import require
from parkenv.lots.infer.network import limit_junctions
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.elements import OsmElement
from parkenv.lots.osm.roads import BARRIER_GAP, Rank, Road, barriers_of, read_roads
from parkenv.world.drive_graph import linestrings, node_labels
from parkenv.world.lot import MOVES, Lane

# How much traffic a street brings into town, by its class; others 0.25. Assumed: each class has twice the next.
ENTRY_WEIGHT = {
    "motorway": 16.0,
    "trunk": 12.0,
    "primary": 8.0,
    "secondary": 4.0,
    "tertiary": 2.0,
    "unclassified": 1.0,
    "residential": 0.5,
}
# Classes of streets that do not end in a town: where they end, the map does.
THROUGH = ("motorway", "trunk", "primary", "secondary", "tertiary")
# Limit, km/h, where cars drive at the scenario's speed; least and most speeds of lanes, multiples of it.
BASE_LIMIT, SPEEDS = 30.0, (0.2, 4.0)
AT_EDGE = 50.0  # distance, m, from the hull of all streets within which streets that end leave the map
BEYOND = "beyond"  # ids of the ways beyond the edge begin with it
LONGEST_BEYOND = 600.0  # m, longest way beyond the edge of the map that is assumed


class Streets:
    """The roads of a town, whole ways that cars may drive, in pieces between junctions; `cut` are those at the edge."""

    def __init__(self, roads: tuple[Road, ...], cut: frozenset[str], blind: FloatArray) -> None:
        require(roads, "no street that cars may drive in it")
        self.roads, self.cut = roads, cut
        self.blind = shapely.multipoints(blind)  # m, barriers, where no street leads on
        count = np.array([len(road.points) for road in roads])
        xy = np.concatenate([road.points for road in roads])
        label, of = node_labels(xy), np.repeat(np.arange(len(count)), count)
        last = np.cumsum(count) - 1
        is_node = np.bincount(label)[label] > 1
        is_node[last] = is_node[last - count + 1] = True
        at = np.flatnonzero(is_node)
        same = of[at[:-1]] == of[at[1:]]
        first, end = at[:-1][same], at[1:][same]
        run = np.r_[0.0, np.cumsum(np.hypot(*np.diff(xy, axis=0).T))]
        self.node_xy = np.empty((label.max() + 1, 2))  # m
        self.node_xy[label[::-1]] = xy[::-1]
        self.road = of[first]  # (n,) of each piece
        offset = (last - count + 1)[self.road]
        self.span = np.stack(
            [first - offset, end - offset], axis=1
        )  # (n, 2) first and last point on its road
        self.nodes = np.stack(
            [label[first], label[end]], axis=1
        )  # (n, 2) junction at its start and at its end
        self.length = run[end] - run[first]  # (n,) m
        self.oneway = np.array([road.oneway for road in roads])[self.road]  # (n,) bool
        self.is_beyond = np.array([road.id.startswith(BEYOND) for road in roads])[self.road]
        part = np.asarray(connected_components(self._graph(), connection="strong")[1], np.int64)
        inside = part[self.nodes[:, 0]] == part[self.nodes[:, 1]]
        metres = np.bincount(part[self.nodes[inside, 0]], self.length[inside], minlength=part.max() + 1)
        require(metres.any(), "no street in it leads back to where it began: all are one-way")
        self.kept: BoolArray = inside & (
            part[self.nodes[:, 0]] == int(metres.argmax())
        )  # (n,) whether in the connected part

    def _graph(
        self, pieces: slice | BoolArray = slice(None), links: Iterable[tuple[int, int]] = ()
    ) -> csr_array[np.float64]:
        """Return which junction leads to which by pieces, and by further links, (n_nodes, n_nodes)."""
        (a, b), back = self.nodes[pieces].T, ~self.oneway[pieces]
        more, n = np.array(list(links), np.int64).reshape(-1, 2), len(self.node_xy)
        source, target = np.r_[a, b[back], more[:, 0]], np.r_[b, a[back], more[:, 1]]
        return csr_array((np.ones(len(source)), (source, target)), shape=(n, n))

    def points(self, piece: int) -> FloatArray:
        first, last = self.span[piece].tolist()
        points: FloatArray = self.roads[self.road[piece]].points[first : last + 1]
        return points

    def unconnected(self) -> list[str]:
        """Return the names of streets that are not kept, the longest first."""
        alone = np.flatnonzero(~self.kept)
        roads = [self.roads[k] for k in self.road[alone[np.argsort(-self.length[alone])]].tolist()]
        return list(dict.fromkeys(road.tags.get("name", road.id) for road in roads))

    def _edge(self) -> tuple[FloatArray, BoolArray, BoolArray]:
        """Return where streets leave the map: their traffic, 0 elsewhere, whether cars come in, and leave, (n_nodes,).

        That is where the edge cuts them, or where they end and are of a class that leads on, or near the hull of all.
        """
        real = np.flatnonzero(~self.is_beyond)
        n, road = len(self.node_xy), self.road[real]
        users = np.bincount(self.nodes[real].ravel(), minlength=n)
        oneway = self.oneway[real]
        two_way = self.nodes[real[~oneway]].ravel()
        hull = shapely.concave_hull(shapely.multipoints(self.node_xy), ratio=0.4)
        away = np.asarray(shapely.distance(shapely.points(self.node_xy), shapely.boundary(hull)))
        blind = np.asarray(shapely.dwithin(shapely.points(self.node_xy), self.blind, BARRIER_GAP + 0.1))
        kinds = [r.tags["highway"].removesuffix("_link") for r in self.roads]
        street = np.array([r.rank is Rank.STREET for r in self.roads])
        weight = np.where(street, [ENTRY_WEIGHT.get(kind, 0.25) for kind in kinds], 0.0)[road]
        cut = np.array([r.id in self.cut for r in self.roads])[road]
        goes_on = np.isin(kinds, THROUGH)[road] | cut
        last = np.array([len(r.points) - 1 for r in self.roads])[road]
        traffic, (enters, leaves) = np.zeros(n), np.zeros((2, n), bool)
        for end, of_road in ((0, 0), (1, last)):
            node = self.nodes[real, end]
            # Ways that lead to the start of a piece, or away from its end.
            ways = np.bincount(np.r_[self.nodes[real, 1 - end], two_way], minlength=n)[node]
            near = away[node] <= AT_EDGE * np.where(oneway, 4, 1)
            leads_on = (users[node] == 1) & (near | goes_on) | (oneway & near & (ways == 0))
            # Where the edge cuts a way at a junction, other streets end there, too.
            leads_on |= (self.span[real, end] == of_road) & cut & (away[node] <= AT_EDGE)
            leads_on &= ~blind[node]
            np.maximum.at(traffic, node[leads_on], weight[leads_on])
            enters[node[leads_on & (~oneway | (end == 0))]] = True
            leaves[node[leads_on & (~oneway | (end == 1))]] = True
        return traffic, enters, leaves

    def ways_beyond(self) -> list[Road]:
        _, enters, leaves = self._edge()
        start = int(self.nodes[self.kept][0, 0])
        links: dict[tuple[int, int], None] = {}
        while True:
            graph = self._graph(links=links)
            reached, returns = np.zeros((2, len(self.node_xy)), bool)
            reached[breadth_first_order(graph, start, return_predecessors=False)] = True
            returns[breadth_first_order(graph.T.tocsr(), start, return_predecessors=False)] = True
            count = len(links)
            links |= dict.fromkeys(self._nearest(leaves & ~returns, enters & returns))
            links |= dict.fromkeys((a, b) for b, a in self._nearest(enters & ~reached, leaves & reached))
            if len(links) == count:
                break
        tags = {"highway": "road", "parking:both": "no"}
        return [
            Road(f"{BEYOND}/{i + 1}", tags, self.node_xy[list(ends)], Rank.STREET, True, False)
            for i, ends in enumerate(links)
        ]

    def _nearest(self, here: BoolArray, there: BoolArray) -> Iterable[tuple[int, int]]:
        """Yield pairs of the junctions here and the nearest one there, if it is near enough for a way beyond."""
        to = np.flatnonzero(there)
        for node in np.flatnonzero(here).tolist() if len(to) else ():
            away = np.hypot(*(self.node_xy[to] - self.node_xy[node]).T)
            if away.min() <= LONGEST_BEYOND:
                yield node, int(to[away.argmin()])

    def entries(self) -> tuple[FloatArray, FloatArray]:
        """Return where cars come in, or reach the connected part, (n, 2) m, and how much traffic each brings, (n,)."""
        traffic, enters, _ = self._edge()
        inside = np.zeros(len(self.node_xy), bool)
        inside[self.nodes[self.kept].ravel()] = True
        graph = self._graph(~self.kept)
        graph.data[np.repeat(inside, np.diff(graph.indptr))] = 0.0  # what is reached is not left again
        graph.eliminate_zeros()
        brought = np.zeros(len(inside))
        for edge in np.flatnonzero(enters & (traffic > 0.0)).tolist():
            reached = breadth_first_order(graph, edge, return_predecessors=False)
            brought[reached] = np.maximum(brought[reached], traffic[edge])
        nodes = np.flatnonzero(inside & (brought > 0.0))
        return self.node_xy[nodes], brought[nodes]

    def outermost(self) -> tuple[FloatArray, FloatArray]:
        """Return entries as `entries` does, where the connected part reaches farthest: no street leaves the map."""
        xy = self.node_xy[np.unique(self.nodes[self.kept])]
        farthest = np.unique([*xy.argmin(axis=0), *xy.argmax(axis=0)])
        return xy[farthest], np.ones(len(farthest))

    def lanes(self, mouths: FloatArray, entries: FloatArray | None = None) -> tuple[list[Lane], list[Lane]]:
        """Return the lanes before and after junctions are split: those that lead to the mouths, (n, 2) m.

        With entries, (m, 2) m, only the shortest ways between these and the mouths are left.
        """
        kept = self._useful(mouths)
        if entries is not None:
            kept = self._between(kept, mouths, entries)
        a, b = self.nodes[kept].T
        back = ~self.oneway[kept]
        ways_out = np.bincount(np.r_[a, b[back]], minlength=len(self.node_xy))
        crowded = set(np.flatnonzero(ways_out > len(MOVES)).tolist())
        whole = [Lane(road.points, road.oneway, _speed(road)) for road in self.roads_of(kept, crowded)]
        lanes = limit_junctions(whole)
        return whole, lanes if entries is None else _joined(lanes, mouths)

    def _between(self, kept: BoolArray, mouths: FloatArray, entries: FloatArray) -> BoolArray:
        """Return the pieces of those kept that are on a shortest way between entries and mouths, (n,) bool."""
        index = np.flatnonzero(kept)
        seconds = self.length[index] / np.array([_speed(self.roads[k]) for k in self.road[index].tolist()])
        lines = linestrings([self.points(piece) for piece in index.tolist()])
        nearest = index[shapely.STRtree(lines).query_nearest(shapely.points(mouths))[1]]
        ends = [self.node_xy - xy for xy in entries]
        stops = np.unique(
            np.r_[[int(np.hypot(*away.T).argmin()) for away in ends], self.nodes[nearest].ravel()]
        )
        back = np.flatnonzero(~self.oneway[index])
        (a, b), piece = self.nodes[np.r_[index, index[back]]].T, np.r_[index, index[back]]
        a[len(index) :], b[len(index) :] = self.nodes[index[back]].T[::-1]
        seconds = np.r_[seconds, seconds[back]]
        # Of several pieces between two junctions the fastest counts.
        order = np.lexsort((seconds, b, a))
        _, first = np.unique(np.stack([a, b])[:, order], axis=1, return_index=True)
        quickest = order[first]
        at, n = (a[quickest], b[quickest]), len(self.node_xy)
        graph, of = (csr_array((values[quickest], at), shape=(n, n)) for values in (seconds, piece))
        wanted = np.zeros(len(kept), bool)
        wanted[nearest] = True
        for before in dijkstra(graph, indices=stops, return_predecessors=True)[1]:
            node = stops
            while (node := np.unique(node[before[node] >= 0])).size:
                wanted[of[before[node], node]] = True
                node = before[node]
        return wanted

    def roads_of(self, kept: BoolArray, cuts: Collection[int] = ()) -> list[Road]:
        """Return pieces as roads, consecutive ones of one way as one, but cut at some junctions."""
        runs: list[tuple[int, list[FloatArray]]] = []
        before = -1
        for piece in np.flatnonzero(kept).tolist():
            follows = runs and before == piece - 1 and self.road[piece] == self.road[before]
            if follows and int(self.nodes[piece, 0]) not in cuts:
                runs[-1][1].append(self.points(piece)[1:])
            else:
                runs.append((int(self.road[piece]), [self.points(piece)]))
            before = piece
        return [replace(self.roads[k], points=np.concatenate(parts)) for k, parts in runs]

    def _useful(self, mouths: FloatArray) -> BoolArray:
        """Return the pieces kept, without dead ends of service roads that are nearest to no mouth, (n,) bool."""
        lines = linestrings([self.points(piece) for piece in np.flatnonzero(self.kept).tolist()])
        loose = self.kept & (np.array([road.rank for road in self.roads])[self.road] < Rank.STREET)
        if len(mouths):
            _, nearest = shapely.STRtree(lines).query_nearest(shapely.points(mouths))
            loose[np.flatnonzero(self.kept)[nearest]] = False
        kept, (a, b) = self.kept.copy(), self.nodes.T
        while True:
            ends = np.r_[a[kept], b[kept & (a != b)]]
            users = np.bincount(ends, minlength=len(self.node_xy))
            dead = kept & loose & (users[self.nodes] == 1).any(axis=1)
            if not dead.any():
                return kept
            kept &= ~dead


def _speed(road: Road) -> float:
    return round(float(np.clip(road.limit / BASE_LIMIT, *SPEEDS)), 3)


def _joined(lanes: Sequence[Lane], mouths: FloatArray) -> list[Lane]:
    """Join lanes of the same speed where two meet end to end, but for those nearest to mouths."""
    tree = shapely.STRtree(linestrings([lane.points for lane in lanes]))
    left = set(tree.query_nearest(shapely.points(mouths))[1].tolist())
    alike: dict[tuple[bool, float], list[FloatArray]] = {}
    for k, lane in enumerate(lanes):
        if k not in left:
            alike.setdefault((lane.oneway, lane.speed), []).append(lane.points)
    return [lanes[k] for k in sorted(left)] + [
        Lane(shapely.get_coordinates(line), *kind)
        for kind, parts in alike.items()
        for line in shapely.get_parts(
            shapely.line_merge(shapely.multilinestrings(linestrings(parts)), directed=kind[0])
        )
    ]


def read_streets(
    elements: Sequence[OsmElement], frame: LocalFrame, left_out: dict[str, list[str]], *, left_hand: bool
) -> Streets:
    roads = read_roads(elements, frame, left_out, town=True, left_hand=left_hand)
    blind = frame.to_xy([e.lines[0][0] for e in barriers_of(elements)])
    cut = frozenset(element.id for element in elements if element.cut)
    beyond = Streets(tuple(roads), cut, blind).ways_beyond()
    streets = Streets((*roads, *beyond), cut, blind)
    left_out["streets that are not connected to the others"] = streets.unconnected()
    return streets
