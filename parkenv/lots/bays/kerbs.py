"""Bays of a register as slots at the kerbs of streets.

A bay stands at the nearest street: of streets about as near, one of its name wins, of outlines also one along or across
the bay; service roads come last. Its slot is where the register says, on the same side of the street, up to `SHIFT` off:

- Points are meters at the kerb's edge: slots lie between kerb and street, along it, or across it where at least
  `ROW` neighbours are 2.2 to 3.3 m apart on average. Along a kerb they are spread, by least squares, until none overlaps:
  several spaces of one meter get places side by side.
- Outlines are slots as drawn, along the street where their longer sides are within 30° of it, else across it.
- A kerb line has as many slots as its capacity, evenly spaced.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.lots.bays.register import Register
from parkenv.lots.generators import BAY_SIZE, KERB_SIZE, Slots
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.elements import OsmElement
from parkenv.lots.osm.parking import without_overlaps
from parkenv.lots.osm.roads import Rank, Road
from parkenv.world.drive_graph import SLOT_REACH
from parkenv.world.lot import Mouth

REACH = 20.0  # m, from a bay within which streets are looked for
SERVICE_BEYOND = 12.0  # m, from the nearest street beyond which a bay may be at a service road
SHIFT = 4.9  # m, most between a slot's centre and its bay
NAME_BONUS, SERVICE_MALUS, BEARING_MALUS = 3.0, 8.0, 4.0  # m, of the distance to a street
ALONG = np.radians(30.0)  # largest angle between a street and the longer sides of a slot along it
NEAREST = (1.5, 2.0)  # m, least distance of a slot from the centre line of a one-way and of a two-way street
FARTHEST = SLOT_REACH - 0.2  # m, most
ROW, APART, ANGLED = 4, 12.0, (2.2, 3.3)
"""Bays of a row at least, m between neighbours in a row, and mean spacing, m, of a row of slots across the street."""
SHORTEST = 4.5  # m, shortest slot along a street
LARGEST = 60.0  # m², largest outline of a bay
OVERLAP = 0.5  # m, two slots that overlap by less are drawn so

NO_STREET = f"bays without a street within {REACH:g} m"
TOO_FAR = f"bays whose slot would be more than {SHIFT:g} m off"
NO_SIDE = "bays on the centre line of their street"
NO_ROOM = f"bays without room at the kerb within {SHIFT:g} m, beside others"
SAME_PLACE = "bays at the place of another one"
TOO_LARGE = f"outlines larger than {LARGEST:g} m²"
OTHER_STREET = "bays nearer to a street that crosses theirs"


@dataclass(frozen=True, eq=False)
class KerbSlots:
    """n slots of a register, in its order."""

    slots: Slots
    ids: tuple[str, ...]  # the bays'; of a kerb line with a number
    bay: IntArray  # (n,) index of the bay or kerb line in the register
    road: IntArray  # (n,) index of the road
    is_left: BoolArray  # (n,) whether they are on its left, in the order of its points
    left_out: dict[str, list[str]]  # ids by reason
    nearest: float  # m, least distance of a bay to a road; infinite if there is none


@dataclass(eq=False)
class _Bays:
    """n places that a register names, in the lot's frame."""

    ids: NDArray[np.str_]
    bay: IntArray  # (n,) index in the register
    xy: FloatArray  # (n, 2) m, centres of outlines, else places at the kerb
    axis: FloatArray  # (n, 2) unit vectors along kerb lines and the longer sides of outlines; zeros of points
    size: FloatArray  # (n, 2) m, length and width of outlines; infinite for others
    spacing: FloatArray  # (n,) m, between the places of a kerb line; infinite for others

    def __getitem__(self, index: IntArray | BoolArray) -> "_Bays":
        return _Bays(*(getattr(self, f.name)[index] for f in fields(self)))

    @property
    def is_drawn(self) -> BoolArray:
        return np.isfinite(self.size[:, 0])


def _bays_of(register: Register, frame: LocalFrame) -> _Bays:
    """Return the places of a register: one of a bay, as many of a kerb line as it has spaces."""
    shapes = shapely.transform(register.shapes, frame.to_xy)
    count, kind = register.capacity, shapely.get_type_id(shapes)
    bay = np.repeat(np.arange(len(shapes)), count)
    rank = np.arange(len(bay)) - np.repeat(np.cumsum(count) - count, count)
    is_line, is_outline = (kind == shapely.GeometryType[name] for name in ("LINESTRING", "POLYGON"))
    length = np.where(is_line, shapely.length(shapes), np.inf)
    axis, size, xy = np.zeros((len(bay), 2)), np.full((len(bay), 2), np.inf), np.empty((len(bay), 2))
    own = is_line[bay]
    share = (rank[own] + 0.5) / count[bay[own]]
    xy[own] = shapely.get_coordinates(shapely.line_interpolate_point(shapes[bay[own]], share, normalized=True))
    ends = [shapely.get_coordinates(shapely.get_point(shapes[bay[own]], k)) for k in (0, -1)]
    axis[own] = _unit(ends[1] - ends[0])
    own = is_outline[bay]
    sides = np.diff(shapely.get_coordinates(shapely.oriented_envelope(shapes[bay[own]])).reshape(-1, 5, 2), axis=1)
    one, other = np.hypot(*sides[:, 0].T), np.hypot(*sides[:, 1].T)
    axis[own] = _unit(np.where((one >= other)[:, None], sides[:, 0], sides[:, 1]))
    size[own] = np.stack([np.maximum(one, other), np.minimum(one, other)], axis=1)
    xy[~is_line[bay]] = shapely.get_coordinates(shapely.centroid(shapes[~is_line]))
    ids = np.array(register.ids, np.str_)[bay]
    numbered = np.flatnonzero(is_line[bay])
    names = ids.astype(object)
    names[numbered] = [f"{ids[i]}-{rank[i] + 1}" for i in numbered.tolist()]
    return _Bays(names, bay, xy, axis, size, length[bay] / count[bay])


def has_kerbs(road: Road) -> bool:
    """Whether bays may stand at a road: not on motorways, in tunnels, and beyond the map."""
    of_map = road.tags["highway"] not in ("motorway", "motorway_link", "trunk_link")
    return of_map and road.tags.get("tunnel", "no") == "no" and not road.id.startswith("beyond")


def with_streets_of(register: Register, elements: Sequence[OsmElement]) -> list[OsmElement]:
    """Return the elements of a map without parking, and with those service roads alone that serve bays far from streets."""
    ways = [e for e in elements if "highway" in e.tags and not e.is_node and e.lines]
    is_service = np.array([e.tags["highway"] == "service" for e in ways], bool)
    xy = shapely.get_coordinates(shapely.centroid(register.shapes))
    frame = LocalFrame.around(xy)
    points = shapely.points(frame.to_xy(xy))
    lines = np.array([shapely.MultiLineString([frame.to_xy(line) for line in e.lines]) for e in ways], np.object_)
    near = shapely.STRtree(lines[~is_service]).query(points, predicate="dwithin", distance=SERVICE_BEYOND)[0]
    points = np.delete(points, np.unique(near))
    serving = shapely.STRtree(lines[is_service]).query_nearest(points, max_distance=REACH)[1]
    used = {ways[i].id for i in np.flatnonzero(is_service)[serving].tolist()}
    return [
        e
        for e in elements
        if not e.tags.get("amenity", "").startswith("parking")
        and (e.is_node or e.tags.get("highway") != "service" or e.id in used)
    ]


def kerb_slots_of(register: Register, roads: Sequence[Road], frame: LocalFrame) -> KerbSlots:
    """Return the slots of a register at the kerbs of roads, on the side of its bays."""
    left_out: dict[str, list[str]] = {}

    def fitting(fits: BoolArray, reason: str) -> IntArray:
        left_out.setdefault(reason, []).extend(bays.ids[~fits].tolist())
        return np.flatnonzero(fits)

    bays, legs = _bays_of(register, frame), _Legs(roads)
    away = legs.tree.query_nearest(shapely.points(bays.xy), all_matches=False, return_distance=True)[1]
    bays = bays[fitting(~bays.is_drawn | (bays.size.prod(axis=1) <= LARGEST), TOO_LARGE)]
    leg = legs.serving(bays, register.streets)
    index = fitting(leg >= 0, NO_STREET)
    bays, leg = bays[index], leg[index]
    foot, across = legs.foot(leg, bays.xy)
    index = fitting(np.abs(across) > 0.1, NO_SIDE)
    bays, leg, foot, across = bays[index], leg[index], foot[index], across[index]

    road, along, is_left, is_drawn = legs.road[leg], legs.along[leg], across > 0.0, bays.is_drawn
    outward = np.where(is_left, 1.0, -1.0)[:, None] * np.stack([-along[:, 1], along[:, 0]], axis=1)
    station = legs.station[leg] + ((foot - legs.start[leg]) * along).sum(axis=1)
    kerb = 2 * road + is_left
    gap, mean = _spacing(kerb, station)
    gap, mean = np.minimum(gap, bays.spacing), np.minimum(mean, bays.spacing)
    sine = np.where(is_drawn, np.abs((bays.axis * outward).sum(axis=1)), 1.0)
    in_row = (mean >= ANGLED[0]) & (mean < ANGLED[1])
    is_angled = np.where(is_drawn, sine > np.sin(ALONG), in_row)
    length = np.where(is_angled, BAY_SIZE[0], np.clip(gap, SHORTEST, KERB_SIZE[0]))
    width = np.where(is_angled, np.clip(gap, ANGLED[0], BAY_SIZE[1]), KERB_SIZE[1])
    length, width = np.where(is_drawn, bays.size.T, [length, width])
    slide = np.where(is_drawn, 0.0, _spread(kerb, station, np.where(is_angled, width, length)) - station)

    oneway = np.array([r.oneway for r in roads])[road]
    # Cars along a two-way street head the way of the traffic on their side.
    near_left = np.array([r.near_side == "left" for r in roads])[road]
    heading = np.where(oneway | (is_left == near_left), 1.0, -1.0)[:, None] * along
    front = np.where(is_angled[:, None], outward, heading)
    nose = np.where(is_drawn[:, None], bays.axis, front)
    nose = nose * np.where((nose * front).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    # Distance across the street from the slot's centre to its mouth, and from the mouth to the centre line.
    depth = np.where(is_angled, length / 2 * sine, width / 2)
    to_line = np.abs(across) - depth * np.where(is_drawn, 1.0, 2.0)
    is_right_of_car = (heading[:, 0] * outward[:, 1] - heading[:, 1] * outward[:, 0]) < 0.0
    mouth = np.where(is_angled, Mouth.REAR, np.where(is_right_of_car, Mouth.LEFT, Mouth.RIGHT)).astype(np.int8)

    def placed(gap: FloatArray) -> tuple[Slots, FloatArray]:
        shift = np.clip(gap, np.where(oneway, *NEAREST), FARTHEST) + depth - np.abs(across)
        xy = bays.xy + slide[:, None] * along + shift[:, None] * outward
        return Slots(xy, np.arctan2(nose[:, 1], nose[:, 0]), length, width, mouth), np.hypot(slide, shift)

    # The drive graph takes the nearest street: at a corner, a mouth is moved nearer to its own.
    slots, off = placed(to_line)
    slots, off = placed(np.minimum(to_line, legs.nearest_crossing(slots.mouths(), leg) - 0.3))
    own = np.abs(legs.foot(leg, slots.mouths())[1])
    checks = (
        (np.abs(slide) <= SHIFT, NO_ROOM),
        (off <= SHIFT, TOO_FAR),
        (legs.nearest_crossing(slots.mouths(), leg) > own, OTHER_STREET),
        (without_overlaps(slots.boxes(OVERLAP)), SAME_PLACE),
    )
    good = np.ones(len(leg), bool)
    for fits, reason in checks:
        fitting(fits | ~good, reason)
        good &= fits
    index = np.flatnonzero(good)
    return KerbSlots(
        slots[index],
        tuple(bays.ids[index].tolist()),
        bays.bay[index],
        road[index],
        is_left[index],
        {reason: ids for reason, ids in left_out.items() if ids},
        float(away.min(initial=np.inf)),
    )


def _unit(vectors: FloatArray) -> FloatArray:
    return vectors / np.maximum(np.hypot(vectors[:, 0], vectors[:, 1]), 1e-9)[:, None]


def _spacing(kerb: IntArray, station: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distance of bays to the nearer neighbour at their kerb, and the mean one of their row, (n,) m.

    It is infinite without a neighbour, or for fewer than `ROW` bays in a row.
    """
    order = np.lexsort((station, kerb))
    step = np.where(np.diff(kerb[order]) == 0, np.diff(station[order]), np.inf)
    gap, mean = np.full((2, len(kerb)), np.inf)
    gap[order] = np.minimum(np.r_[np.inf, step], np.r_[step, np.inf])
    row = np.cumsum(np.r_[0, step > APART])
    count = np.bincount(row)
    extent = np.bincount(row[1:], np.where(step <= APART, step, 0.0), minlength=len(count)) if len(row) else count
    mean[order] = np.where(count >= ROW, extent / np.maximum(count - 1, 1), np.inf)[row]
    return gap, mean


def _spread(kerb: IntArray, station: FloatArray, length: FloatArray) -> FloatArray:
    """Return stations, (n,) m, as near as possible to those given (least squares) at which no two bays overlap."""
    order = np.lexsort((station, kerb))
    room = np.cumsum(np.r_[0.0, (length[order][1:] + length[order][:-1]) / 2])
    # Kerbs are laid out one after the other, with gaps that no bay crosses.
    start = 1e5 * np.cumsum(np.r_[0, np.diff(kerb[order]) != 0]) if len(order) else np.zeros(0)
    result = np.empty(len(station))
    result[order] = isotonic_regression(station[order] + start - room).x + room - start if len(order) else 0.0
    return result


class _Legs:
    """The straight legs of roads, as arrays of n."""

    def __init__(self, roads: Sequence[Road]) -> None:
        steps = [np.diff(road.points, axis=0) for road in roads]
        length = [np.hypot(step[:, 0], step[:, 1]) for step in steps]
        self.start = np.concatenate([road.points[:-1] for road in roads])
        self.length = np.concatenate(length)
        self.along = np.concatenate(steps) / self.length[:, None]
        self.station = np.concatenate([np.cumsum(own) - own for own in length])  # m from the road's start
        self.road = np.repeat(np.arange(len(roads)), [len(own) for own in length])
        self.is_service = np.array([road.rank is not Rank.STREET for road in roads])[self.road]
        self.names = np.array([road.tags.get("name", "") for road in roads])
        ends = self.start + self.length[:, None] * self.along
        self.tree = shapely.STRtree(np.asarray(shapely.linestrings(np.stack([self.start, ends], axis=1))))

    def foot(self, leg: IntArray, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the points of legs nearest to points, (n, 2) m, and the distances, (n,) m, positive on the left."""
        to = xy - self.start[leg]
        run = np.clip((to * self.along[leg]).sum(axis=1), 0.0, self.length[leg])
        foot = self.start[leg] + run[:, None] * self.along[leg]
        is_left = self.along[leg, 0] * to[:, 1] - self.along[leg, 1] * to[:, 0] > 0.0
        return foot, np.hypot(*(xy - foot).T) * np.where(is_left, 1.0, -1.0)

    def serving(self, bays: _Bays, streets: Sequence[str]) -> IntArray:
        """Return the leg at which each bay stands, (n,); -1: none."""
        bay, leg = self.tree.query(shapely.points(bays.xy), predicate="dwithin", distance=REACH)
        cost = np.abs(self.foot(leg, bays.xy[bay])[1]) + SERVICE_MALUS * self.is_service[leg]
        sine = np.abs(bays.axis[bay, 0] * self.along[leg, 1] - bays.axis[bay, 1] * self.along[leg, 0])
        turn = np.arcsin(np.clip(sine, 0.0, 1.0))
        # Outlines may be along their street or across it.
        turn = np.where(bays.is_drawn[bay], np.minimum(turn, np.pi / 2 - turn), turn)
        cost += BEARING_MALUS * turn / (np.pi / 4)
        names, of_bay = np.unique(np.array(streets, np.str_), return_inverse=True)
        pairs, which = np.unique(np.stack([of_bay[bays.bay[bay]], self.road[leg]]), axis=1, return_inverse=True)
        alike = [bool(_words(str(names[i])) & _words(str(self.names[k]))) for i, k in pairs.T.tolist()]
        cost -= NAME_BONUS * np.array(alike, np.float64)[which]
        order = np.lexsort((leg, cost, bay))
        own, first = np.unique(bay[order], return_index=True)
        result = np.full(len(bays.xy), -1)
        result[own] = leg[order[first]]
        return result

    def nearest_crossing(self, xy: FloatArray, own: IntArray) -> FloatArray:
        """Return the distances of points to the nearest leg of another road and bearing than their own, (n,) m."""
        point, leg = self.tree.query(shapely.points(xy), predicate="dwithin", distance=SLOT_REACH + 1.0)
        turned = np.abs((self.along[leg] * self.along[own[point]]).sum(axis=1)) < np.cos(ALONG)
        other = turned & (self.road[leg] != self.road[own[point]])
        distance = np.full(len(xy), np.inf)
        away = np.abs(self.foot(leg[other], xy[point[other]])[1])
        np.minimum.at(distance, point[other], away)
        return distance


_GENERIC = frozenset("street st avenue ave av road rd boulevard blvd bl drive dr lane place pl way the north south east west".split())


@lru_cache(maxsize=65536)
def _words(name: str) -> frozenset[str]:
    """Return the words by which a street is told from others."""
    street = re.split(r"\b(?:between|from)\b", name.casefold())[0]
    return frozenset(word for word in re.findall(r"\w+", street) if len(word) > 1) - _GENERIC
