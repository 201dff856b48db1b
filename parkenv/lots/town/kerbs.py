"""The kerbs of a town: parking along streets as tagged, else as many places as streets of their class have.

Both tagging schemes are read, see `parkenv.lots.osm.rows`. A tagged kerb without a capacity has a place for every
`METRES_PER_PLACE`; one whose tags say nothing of parking has `PLACES_PER_METRE` of its class, where houses stand beside
it, and none on bridges, in tunnels and at roundabouts. Of main roads, one-way ones are one half of a dual carriageway:
all places are on the right. Kerbs that are drawn as areas (`parking=street_side` and the like) are places along the
nearest street.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.osm.areas import Area
from parkenv.lots.osm.roads import Rank, Road, whole_number
from parkenv.lots.osm.rows import (
    ARRANGEMENTS,
    SHORTEST_KERB_SLOT,
    Junctions,
    Kerb,
    Side,
    free_intervals,
    kerb_of,
    kerb_slots,
)
from parkenv.lots.town.supply import RESERVED, FacilityRow, kerb_rules, rules_of
from parkenv.world.drive_graph import linestrings

PLACES_PER_METRE = {
    "residential": 0.1659,
    "unclassified": 0.1539,
    "living_street": 0.1499,
    "tertiary": 0.0956,
    "secondary": 0.0649,
    "primary": 0.0153,
}
"""Places per metre of kerb, both sides, 5 m off the corners at junctions, by class of street.

Fitted to the 43,863 places of Berlin-Neukölln by `python tests/parking_rules.py`, which says how well.
"""
METRES_PER_PLACE = {"parallel": 5.4, "diagonal": 3.1, "perpendicular": 2.6}
"""Kerb taken by a place, m, by orientation; from the same kerbs."""
STRIPS = ("street_side", "lane", "on_kerb", "half_on_kerb", "shoulder")
"""Values of `parking` of areas that are kerbs."""
CLASS_RULE = "class of street"  # name of the rule of kerbs that the map says nothing of
HOUSES_WITHIN = 40.0  # m; where no building is this near, an untagged street has no places
STATION = 20.0  # m, between the points of a street at which buildings are looked for
STRIP_REACH = 20.0  # largest distance, m, of a drawn kerb from its street


def kerb_sides(
    roads: Sequence[Road],
    crossings: FloatArray,
    buildings: Sequence[Area],
    left_out: Mapping[str, list[str]],
    untagged: float = 1.0,
) -> Iterator[FacilityRow]:
    """Yield the kerbs of roads that have places, under the names of their streets; of a way there may be several.

    Kerbs that nobody may use are listed in `left_out`, by reason. Without any buildings, all streets have houses.
    `untagged` are the places of untagged kerbs, as a multiple of the rule's.
    """
    street = {k: i for i, k in enumerate(k for k, road in enumerate(roads) if road.rank is Rank.STREET)}
    corners = Junctions([roads[k] for k in street], np.empty((0, 2)))
    everything = Junctions(roads, crossings)
    lonely = _without_houses(roads, buildings)
    rest: dict[str, float] = defaultdict(float)  # fractions of places, by class, so that totals are kept
    for k, road in enumerate(roads):
        kind = road.tags["highway"]
        total = float(np.hypot(*np.diff(road.points, axis=0).T).sum())
        for side in ("left", "right"):
            tagged: Side = side if not road.turned else ("left" if side == "right" else "right")
            by_tag = any(
                f"{key}:{at}" in road.tags for key in ("parking", "parking:lane") for at in (tagged, "both")
            )
            closed = everything.closed_intervals(k, side)
            source, rule, said = "rule", CLASS_RULE, None
            if by_tag:
                usable = {key: value for key, value in road.tags.items() if value not in RESERVED}
                kerb = kerb_of(usable, tagged)
                if isinstance(kerb, str):
                    left_out[kerb].append(f"{road.id}-{tagged}")
                if kerb is None or isinstance(kerb, str):
                    continue
                said, source, rule = kerb.capacity, "tag", ""
                if said is None:
                    free = sum(end - start for start, end in free_intervals(total, closed))
                    kerb = replace(kerb, capacity=int(free / METRES_PER_PLACE[kerb.orientation]))
                    source, rule = "rule", "length of kerb"
            else:
                if (
                    k not in street
                    or any(road.tags.get(key, "no") != "no" for key in ("bridge", "tunnel", "junction"))
                    or (side == "left" and _is_half(road))
                ):
                    continue
                closed = closed + lonely[k]
                off_corners = corners.closed_intervals(street[k], side) + lonely[k]
                free = sum(end - start for start, end in free_intervals(total, off_corners))
                free *= untagged * (2 if _is_half(road) else 1)
                expected = PLACES_PER_METRE.get(kind, 0.0) * free + rest[kind]
                rest[kind] = expected % 1.0
                kerb = Kerb("parallel", int(expected), False)
            slots = kerb_slots(road, side, kerb, closed)
            if len(slots):
                rules, name = kerb_rules(road.tags, tagged), road.tags.get("name", "")
                yield FacilityRow(name, "kerb", rules, source, rule, f"{road.id} {tagged}", said, slots)


def strip_side(area: Area, roads: Sequence[Road], tree: shapely.STRtree) -> FacilityRow | None:
    """Return the kerb that is drawn as an area, under its name; None if it is not along a road of the tree."""
    tags = area.element.tags
    (index, distance) = tree.query_nearest(area.polygon, return_distance=True, all_matches=False)
    if not len(index) or distance[0] > STRIP_REACH:
        return None
    road = roads[int(index[0])]
    line = linestrings([road.points])[0]
    outline = shapely.points(shapely.get_coordinates(area.polygon))
    stations = shapely.line_locate_point(line, outline)
    start, end, total = float(stations.min()), float(stations.max()), float(shapely.length(line))
    if end - start < SHORTEST_KERB_SLOT:
        return None
    orientation = tags.get("orientation", tags.get("parking:orientation", "parallel"))
    orientation = orientation if orientation in ARRANGEMENTS else "parallel"
    said = whole_number(tags.get("capacity"))
    capacity = said if said is not None else max(round((end - start) / METRES_PER_PLACE[orientation]), 1)
    middle = shapely.get_coordinates(shapely.centroid(area.polygon))[0]
    here, ahead = shapely.get_coordinates(
        shapely.line_interpolate_point(line, [(start + end) / 2 - 1.0, (start + end) / 2 + 1.0])
    )
    along, away = ahead - here, middle - here
    side: Side = "left" if along[0] * away[1] - along[1] * away[0] > 0.0 else "right"
    slots = kerb_slots(road, side, Kerb(orientation, capacity, False), [(-1.0, start), (end, total + 1.0)])
    if not len(slots):
        return None
    source, rule = ("tag", "") if said is not None else ("rule", "length of kerb")
    name = tags.get("name", road.tags.get("name", ""))
    return FacilityRow(name, "kerb", rules_of(tags), source, rule, area.element.id, said, slots)


def _is_half(road: Road) -> bool:
    return road.oneway and road.tags["highway"] in ("primary", "secondary", "tertiary")


def _without_houses(roads: Sequence[Road], buildings: Sequence[Area]) -> list[list[tuple[float, float]]]:
    """Return the intervals of each road, m from its start, without a building beside it."""
    if not buildings:
        return [[] for _ in roads]
    tree = shapely.STRtree([a.polygon for a in buildings])
    lines = linestrings([road.points for road in roads])
    total = shapely.length(lines)
    count = np.maximum(np.ceil(total / STATION).astype(np.int64), 1)
    of = np.repeat(np.arange(len(roads)), count)
    rank = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    step = (total / count)[of]
    at = shapely.line_interpolate_point(lines[of], (rank + 0.5) * step)
    beside = np.zeros(len(of), bool)
    beside[tree.query(at, predicate="dwithin", distance=HOUSES_WITHIN)[0]] = True
    result: list[list[tuple[float, float]]] = [[] for _ in roads]
    for i in np.flatnonzero(~beside).tolist():
        result[of[i]].append((float(rank[i] * step[i]), float((rank[i] + 1) * step[i])))
    return result
