"""Bays of a register as slots at the kerbs of streets.

A bay stands at the nearest street: of streets about as near, one of its name wins, for outlines and kerb lines one of
its bearing; service roads come last. Its slot is on its side of the street, where the register says, or up to `SHIFT`
from there, so that it is off the carriageway and within reach of its lane:

- Points are meters at the kerb's edge: slots lie between kerb and street, along it, or across it where at least `ROW`
  neighbours are 2.2 to 3.3 m apart on average. Along a kerb they are spread, by least squares, until none overlaps:
  several spaces of one meter get places side by side.
- Outlines are slots as drawn, along the street where their longer sides are within 30° of it, else across it.
- A kerb line has as many slots as its capacity, evenly spaced.
"""

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.lots.bays.register import Register
from parkenv.lots.draft import LeftOut
from parkenv.lots.generators import BAY_SIZE, KERB_SIZE, Slots
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.parking import without_overlaps
from parkenv.lots.osm.roads import Rank, Road
from parkenv.world.drive_graph import SLOT_REACH
from parkenv.world.lot import Mouth

REACH = 20.0  # m, from a bay within which its street is looked for
SHIFT = 4.9  # m, most between a slot's centre and its bay
NAME_BONUS, SERVICE_MALUS, BEARING_MALUS = 3.0, 8.0, 4.0  # m, of the distance to a street
ALONG = np.radians(30.0)  # largest angle between a street and the longer sides of a slot along it
NEAREST, FARTHEST = (
    (1.5, 2.0),
    SLOT_REACH - 0.2,
)  # m, from the centre line, of a one-way or a two-way street, to a slot
# Bays of a row at least, m between neighbours in a row, and mean spacing, m, of a row of slots across the street.
ROW, APART, ANGLED = 4, 12.0, (2.2, 3.3)
SHORTEST = 4.5  # m, shortest slot along a street
LARGEST = 60.0  # m², largest outline of a bay
OVERLAP = 0.5  # m, slots that overlap by less are drawn so
ON_IT = 0.8  # m, from the centre line of a street, which is free of slots


class KerbSlots(NamedTuple):
    """n slots of a register, in its order."""

    slots: Slots
    ids: list[str]  # the bays'; of a kerb line with a number
    bay: IntArray  # (n,) index of the bay or kerb line in the register
    road: IntArray  # (n,) index of the road
    is_left: BoolArray  # (n,) whether they are on its left, in the order of its points
    left_out: tuple[LeftOut, ...]


class _Places(NamedTuple):
    """n places that a register names, in the lot's frame."""

    ids: NDArray[np.object_]
    bay: IntArray  # (n,) index in the register
    xy: FloatArray  # (n, 2) m, centres of outlines, else places at the kerb
    axis: FloatArray  # (n, 2) unit vectors along kerb lines and the longer sides of outlines; zeros of points
    size: FloatArray  # (n, 2) m, length and width of outlines; infinite for others
    spacing: FloatArray  # (n,) m, between the places of a kerb line; infinite for others


def _places(register: Register, frame: LocalFrame) -> _Places:
    shapes, count = shapely.transform(register.shapes, frame.to_xy), register.capacity
    bay = np.repeat(np.arange(len(shapes)), count)
    rank = np.arange(len(bay)) - np.repeat(np.cumsum(count) - count, count)
    kind = shapely.get_type_id(shapes)
    is_line, is_outline = kind == shapely.GeometryType.LINESTRING, kind == shapely.GeometryType.POLYGON
    xy = shapely.get_coordinates(shapely.centroid(shapes))[bay]
    axis, size = np.zeros_like(xy), np.full_like(xy, np.inf)
    own, lines = is_line[bay], shapes[bay[is_line[bay]]]
    share = (rank[own] + 0.5) / count[bay[own]]
    xy[own] = shapely.get_coordinates(shapely.line_interpolate_point(lines, share, normalized=True))
    first, last = (shapely.get_coordinates(shapely.get_point(lines, end)) for end in (0, -1))
    axis[own] = last - first
    corners = shapely.get_coordinates(shapely.oriented_envelope(shapes[is_outline])).reshape(-1, 5, 2)
    sides = np.diff(corners, axis=1)[:, :2]
    length = np.hypot(sides[..., 0], sides[..., 1])
    own = is_outline[bay]
    axis[own] = sides[np.arange(len(sides)), length.argmax(axis=1)]
    size[own] = np.sort(length, axis=1)[:, ::-1]
    axis /= np.maximum(np.hypot(axis[:, 0], axis[:, 1]), 1e-9)[:, None]
    ids = register.ids[bay]
    ids[is_line[bay]] += np.char.add("-", (rank[is_line[bay]] + 1).astype(str)).astype(object)
    return _Places(ids, bay, xy, axis, size, np.where(is_line, shapely.length(shapes) / count, np.inf)[bay])


def kerb_slots_of(register: Register, roads: Sequence[Road], frame: LocalFrame) -> KerbSlots:
    """Return the slots of a register at the kerbs of roads, on the side of its bays."""
    places, legs = _places(register, frame), _Legs(roads)
    is_drawn = np.isfinite(places.size[:, 0])
    reasons = np.zeros(len(places.xy), object)  # why places are left out; 0: they are not

    def leave_out(which: BoolArray, reason: str) -> None:
        reasons[which & (reasons == 0)] = reason

    leave_out(is_drawn & (places.size.prod(axis=1) > LARGEST), f"outlines larger than {LARGEST:g} m²")
    leg = legs.serving(places, register.streets)
    leave_out(leg < 0, f"bays without a street within {REACH:g} m")
    run, beyond, across = legs.at(leg, places.xy)
    leave_out(np.abs(across) < 0.1, "bays on the centre line of their street")

    road, along, is_left = legs.road[leg], legs.along[leg], across > 0.0
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    outward = np.where(is_left, 1.0, -1.0)[:, None] * left
    station = legs.station[leg] + run
    kerb = np.where(reasons == 0, 2 * road + is_left, -1 - np.arange(len(road)))
    gap, mean = (np.minimum(values, places.spacing) for values in _spacing(kerb, station))
    sine = np.where(is_drawn, np.abs((places.axis * outward).sum(axis=1)), 1.0)
    is_angled = np.where(is_drawn, sine > np.sin(ALONG), (mean >= ANGLED[0]) & (mean < ANGLED[1]))
    length = np.where(is_angled, BAY_SIZE[0], np.clip(gap, SHORTEST, KERB_SIZE[0]))
    width = np.where(is_angled, np.clip(gap, ANGLED[0], BAY_SIZE[1]), KERB_SIZE[1])
    length, width = np.where(is_drawn, places.size.T, [length, width])
    # Along the street: to where it ends, and away from neighbours.
    slide = np.clip(beyond, -1.5, 1.5) - beyond
    slide += np.where(is_drawn, 0.0, _spread(kerb, station, np.where(is_angled, width, length)) - station)

    # Cars along a two-way street head the way of the traffic on their side.
    oneway, near_left = np.array([(r.oneway, r.near_side == "left") for r in roads])[road].T
    heading = np.where(oneway | (is_left == near_left), 1.0, -1.0)[:, None] * along
    front = np.where(is_angled[:, None], outward, heading)
    nose = np.where(is_drawn[:, None], places.axis, front)
    nose = nose * np.where((nose * front).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    is_left_of_car = heading[:, 0] * outward[:, 1] - heading[:, 1] * outward[:, 0] > 0.0
    mouth = np.where(is_angled, Mouth.REAR, np.where(is_left_of_car, Mouth.RIGHT, Mouth.LEFT)).astype(np.int8)
    # Distances across the street, from a slot's centre to its mouth, and from there to the centre line.
    depth = np.where(is_angled, length / 2 * sine, width / 2)
    to_line = np.abs(across) - depth * np.where(is_drawn, 1.0, 2.0)

    def placed(to_line: FloatArray) -> tuple[Slots, FloatArray]:
        shift = np.clip(to_line, np.where(oneway, *NEAREST), FARTHEST) + depth - np.abs(across)
        xy = places.xy + slide[:, None] * along + shift[:, None] * outward
        return Slots(xy, np.arctan2(nose[:, 1], nose[:, 0]), length, width, mouth), np.hypot(slide, shift)

    # A car gets to a slot by the lane nearest to its mouth: at a corner, it is moved nearer to its own street.
    crossing = legs.nearest_crossing(placed(to_line)[0].mouths(), leg)
    slots, off = placed(np.minimum(to_line, crossing - 0.3))
    own = np.hypot(*legs.at(leg, slots.mouths())[1:])
    leave_out(np.abs(slide) > SHIFT, f"bays without room at the kerb within {SHIFT:g} m, beside others")
    leave_out(off > SHIFT, f"bays whose slot would be more than {SHIFT:g} m off")
    leave_out(
        legs.nearest_crossing(slots.mouths(), leg) <= own, "bays nearer to a street that crosses theirs"
    )
    on_it = legs.tree.query(slots.boxes(), predicate="dwithin", distance=ON_IT)[0]
    leave_out(np.isin(np.arange(len(slots)), on_it), "bays on a street")
    index = np.flatnonzero(reasons == 0)
    reasons[index[~without_overlaps(slots.boxes(OVERLAP)[index])]] = "bays at the place of another one"
    index = np.flatnonzero(reasons == 0)
    named = dict.fromkeys(filter(None, reasons.tolist()))
    left_out = LeftOut.by_reason({reason: places.ids[reasons == reason].tolist() for reason in named})
    ids = places.ids[index].tolist()
    return KerbSlots(slots[index], ids, places.bay[index], road[index], is_left[index], left_out)


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
    extent = np.bincount(row[1:], np.where(step > APART, 0.0, step), minlength=len(count))
    mean[order] = np.where(count >= ROW, extent / np.maximum(count - 1, 1), np.inf)[row]
    return gap, mean


def _spread(kerb: IntArray, station: FloatArray, length: FloatArray) -> FloatArray:
    """Return stations, (n,) m, as near as possible to those given (least squares) at which no two bays overlap."""
    order = np.lexsort((station, kerb))
    room = np.cumsum(np.r_[0.0, (length[order][1:] + length[order][:-1]) / 2])
    # Kerbs are laid out one after the other, with gaps that no bay crosses.
    start = 1e5 * np.cumsum(np.r_[0, np.diff(kerb[order]) != 0]) - room
    result = np.empty(len(station))
    result[order] = isotonic_regression(station[order] + start).x - start
    return result


class _Legs:
    """The n straight legs of roads."""

    def __init__(self, roads: Sequence[Road]) -> None:
        steps = [np.diff(road.points, axis=0) for road in roads]
        lengths = [np.hypot(step[:, 0], step[:, 1]) for step in steps]
        self.length = np.concatenate(lengths)
        self.start = np.concatenate([road.points[:-1] for road in roads])
        self.along = np.concatenate(steps) / self.length[:, None]
        self.station = np.concatenate([np.cumsum(own) - own for own in lengths])  # m from the road's start
        self.road = np.repeat(np.arange(len(roads)), [len(own) for own in lengths])
        self.is_service = np.array([road.rank is not Rank.STREET for road in roads])[self.road]
        self.names = np.array([road.tags.get("name", "") for road in roads], np.str_)
        ends = np.stack([self.start, self.start + self.length[:, None] * self.along], axis=1)
        self.tree = shapely.STRtree(np.asarray(shapely.linestrings(ends)))

    def at(self, leg: IntArray, xy: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return where points, (n, 2) m, are beside legs, m: along it, beyond its ends, and to its left, (n,) each."""
        to, along = xy - self.start[leg], self.along[leg]
        ahead = (to * along).sum(axis=1)
        run = np.clip(ahead, 0.0, self.length[leg])
        return run, ahead - run, along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0]

    def serving(self, places: _Places, streets: NDArray[np.object_]) -> IntArray:
        """Return the leg at which each place is, (n,); -1: none."""
        place, leg = self.tree.query(shapely.points(places.xy), predicate="dwithin", distance=REACH)
        cost = np.hypot(*self.at(leg, places.xy[place])[1:]) + SERVICE_MALUS * self.is_service[leg]
        axis = places.axis[place]
        sine = np.abs(axis[:, 0] * self.along[leg, 1] - axis[:, 1] * self.along[leg, 0])
        turn = np.arcsin(np.clip(sine, 0.0, 1.0))
        # Outlines may be along their street or across it.
        is_drawn = np.isfinite(places.size[place, 0])
        cost += BEARING_MALUS / (np.pi / 4) * np.where(is_drawn, np.minimum(turn, np.pi / 2 - turn), turn)
        names, of_bay = np.unique(streets.astype(str), return_inverse=True)
        both = np.stack([of_bay[places.bay[place]], self.road[leg]])
        pairs, which = np.unique(both, axis=1, return_inverse=True)
        alike = [bool(_words(str(names[i])) & _words(str(self.names[k]))) for i, k in pairs.T.tolist()]
        cost -= NAME_BONUS * np.array(alike, np.float64)[which]
        order = np.lexsort((leg, cost, place))
        own, first = np.unique(place[order], return_index=True)
        result = np.full(len(places.xy), -1)
        result[own] = leg[order[first]]
        return result

    def nearest_crossing(self, xy: FloatArray, own: IntArray) -> FloatArray:
        """Return the distances of points to the nearest leg of another road and bearing than their own, (n,) m."""
        point, leg = self.tree.query(shapely.points(xy), predicate="dwithin", distance=SLOT_REACH + 1.0)
        turned = np.abs((self.along[leg] * self.along[own[point]]).sum(axis=1)) < np.cos(ALONG)
        point, leg = (values[turned & (self.road[leg] != self.road[own[point]])] for values in (point, leg))
        distance = np.full(len(xy), np.inf)
        np.minimum.at(distance, point, np.hypot(*self.at(leg, xy[point])[1:]))
        return distance


_COMMON = frozenset(
    ("street", "st", "avenue", "ave", "av", "road", "rd", "boulevard", "blvd", "bl", "north", "south")
)


@lru_cache(maxsize=65536)
def _words(name: str) -> frozenset[str]:
    """Return the words by which a street is told from others."""
    street = re.split(r"\b(?:between|from)\b", name.casefold())[0]
    return frozenset(word for word in re.findall(r"\w+", street) if len(word) > 1) - _COMMON
