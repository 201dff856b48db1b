"""Slots of an unknown street, from the parked cars that drives have passed: rows of cars, and gaps in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError
from parkenv.lots.generators import NO_SLOTS, Slots
from parkenv.mapping.car_rows import CarRow, aligned, along_track, axis_of, car_rows, steps_to_line
from parkenv.mapping.car_tracks import ParkedCars
from parkenv.mapping.discovery import discover
from parkenv.perception.box_fit import CAR_LENGTH
from parkenv.world.lot import Mouth

# What a slot is known from: a car of a row. Guesses are those from cars that are seen once or alone, and from gaps.
CAR, ONCE, LONE_CAR, GAP = "car", "car seen once", "lone car", "gap"
SIDE = (5.2, 2.0)  # length and width, m, of a slot along the kerb
END = (5.0, 2.5)  # the same of one across or at an angle
GAP_M = 5.4  # m, room between two cars along the kerb that one more needs
PITCH_M = (2.2, 2.5, 3.4)  # least, usual and largest distance of slots across the kerb
MOST_GAPS_M = 17.0  # m, room that is filled with guessed slots without evidence: more may be a side street
MOST_STD_M = 1.0  # of cars that stay where they are
_CORRIDOR_M = 0.8  # half the width of what the car has driven over
_TOUCH_M = 0.1  # m, by which slots may overlap in the end
_OVERLAP_M = 0.5  # m, by which slots may overlap before the one with less evidence is left out, else narrowed


@dataclass(frozen=True, eq=False)
class StreetSlots:
    """Slots that were discovered, and their rows."""

    slots: Slots
    source: NDArray[np.str_]  # (n,) CAR, ONCE, LONE_CAR or GAP
    sightings: IntArray  # (n,) captures in which a car was located there; 0 of a gap
    std: FloatArray  # (n,) m, standard deviation of the centre along each axis; NaN of a gap
    kerbs: tuple[FloatArray, ...] = ()  # (k, 2) m each, the outer edges of rows

    def __len__(self) -> int:
        return len(self.slots)

    def select(self, which: IntArray | BoolArray) -> StreetSlots:
        return replace(self, **{n: getattr(self, n)[which] for n in ("slots", "source", "sightings", "std")})


def discover_street(
    drives: Sequence[ParkedCars],
    tracks: Sequence[FloatArray],
    is_free: Callable[[Slots], BoolArray] = lambda slots: np.zeros(len(slots), np.bool_),
) -> StreetSlots:
    """Find the slots of a street in the parked cars of one or more drives.

    Cars at the same offset from the street and with the same heading are a row. A car's heading becomes that of its
    row, and its offset moves towards the row's line as far as it is uncertain. Sightings of one car in several drives
    are joined. Each car makes a slot; so does each part of a gap between two cars of a row that holds one.

    Args:
        drives: the cars of each drive.
        tracks: (k, 2) m each, where the drives went.
        is_free: whether the scans show slots without anything in them, (n,) bool, to fill gaps longer than
            `MOST_GAPS_M`.

    Raises:
        InputError: no track has two different points.
    """
    paths = [shapely.LineString(track) for track in tracks if len(track) > 1]
    path = shapely.MultiLineString([line for line in paths if line.length > 0.0])
    if path.is_empty:
        raise InputError("the drives have no track, want poses at two places at least")
    cars = joined(drives)
    is_beside = np.asarray(shapely.distance(shapely.points(cars.xy), path)) > _CORRIDOR_M
    cars = _chosen(cars, (cars.std <= MOST_STD_M) & (cars.probability >= 0.5) & is_beside)
    cars = _chosen(cars, np.argsort(cars.std, kind="stable"))
    if len(cars.xy):
        cars = _same_cars_joined(aligned(cars, car_rows(cars, path)))
    rows = car_rows(cars, path)
    # What is seen once may have moved, unless it is in line with others; a car alone at an angle is hardly parked.
    rows = [row for row in rows if len(row.members) > 2 or (cars.sightings[row.members] > 1).any()]
    rows = [row for row in rows if len(row.members) > 1 or row.angle in (0.0, math.pi / 2)]
    found = [_slots_of(cars, row, path, is_free) for row in rows]
    none = StreetSlots(NO_SLOTS, np.empty(0, np.str_), np.empty(0, np.int64), np.empty(0))
    parts = [*found, none]
    slots = StreetSlots(
        Slots.joined([part.slots for part in parts]),
        np.concatenate([part.source for part in parts]),
        np.concatenate([part.sightings for part in parts]),
        np.concatenate([part.std for part in parts]),
        tuple(kerb for part in parts for kerb in part.kerbs),
    )
    slots = slots.select(_apart(slots, path.buffer(_CORRIDOR_M)))
    return replace(slots, slots=_within_touch(slots.slots))


def joined(drives: Sequence[ParkedCars]) -> ParkedCars:
    columns = {f.name: np.concatenate([getattr(d, f.name) for d in drives]) for f in fields(ParkedCars)}
    return ParkedCars(**columns)


def _chosen(cars: ParkedCars, which: IntArray | BoolArray) -> ParkedCars:
    return ParkedCars(*(getattr(cars, f.name)[which] for f in fields(cars)))


def _same_cars_joined(cars: ParkedCars) -> ParkedCars:
    """Join what was seen at one place in several drives: the mean, weighted by the errors."""
    places = discover(np.column_stack([cars.xy, cars.yaw]), least=1)
    away = np.hypot(*(cars.xy[:, None] - places.xy[None]).transpose(2, 0, 1))
    nearest, k = away.argmin(axis=1), np.arange(len(places.xy))
    nearest[away.min(axis=1) > 1.0] = -1  # beside a car with more evidence, and overlapping it
    first = np.array([np.flatnonzero(nearest == i)[0] for i in k])
    is_at = (nearest == k[:, None]).astype(np.float64)
    weight = is_at / np.maximum(cars.std, 0.05) ** 2
    return replace(
        _chosen(cars, first),
        xy=weight @ cars.xy / weight.sum(axis=1)[:, None],
        yaw=places.yaw,
        std=weight.sum(axis=1) ** -0.5,
        sightings=(is_at @ cars.sightings).astype(np.int64),
    )


def _slots_of(
    cars: ParkedCars, row: CarRow, path: shapely.MultiLineString, is_free: Callable[[Slots], BoolArray]
) -> StreetSlots:
    """Make the slots of a row: one for each car, and those of its gaps."""
    at, along = cars.xy[row.members], row.along
    kerbside = row.angle == 0.0
    apart = np.hypot(*np.diff(at, axis=0).T)
    usual = apart[(apart > PITCH_M[0] - 0.2) & (apart < PITCH_M[2])]
    pitch = float(np.median(usual)) if len(usual) else PITCH_M[1] / abs(math.sin(row.angle or 1.0))
    centres, ways, sources = [at[:1]], [along[:1]], [CAR if len(at) > 1 else LONE_CAR]
    ends: list[bool] = []  # whether what is beside each slot is unknown
    for (a, b), (u, v), distance in zip(pairwise(at), pairwise(along), apart.tolist(), strict=True):
        room = distance - CAR_LENGTH if kerbside else distance - pitch
        n = math.floor(room / GAP_M + 1e-9) if kerbside else max(round(room / pitch), 0)
        n -= not kerbside and distance / (n + 1) < PITCH_M[0] and n > 0
        first = (0.5 * CAR_LENGTH + 0.5 * room / max(n, 1)) / distance if kerbside else 1.0 / (n + 1)
        share = first + np.arange(n) * (room / max(n, 1) / distance if kerbside else first)
        xy, way = _between(a, b, u, v, share)
        if n * (GAP_M if kerbside else pitch) > MOST_GAPS_M:
            size = SIDE if kerbside else END
            tried = _posed(xy, way, row.angle, np.full(n, size[0]), np.full(n, size[1]), path)
            if not is_free(tried).all():
                xy, way = xy[:0], way[:0]
        ends += [n > 0 and not len(xy), *[False] * len(xy)]
        centres += [xy, b[None]]
        ways += [way, v[None]]
        sources += [GAP] * len(xy) + [CAR]
    xy, way, source = np.concatenate(centres), np.concatenate(ways), np.array(sources)
    from_car = source != GAP
    step = np.diff(xy, axis=0)
    nearer = np.abs([(step * way[1:]).sum(axis=1), (step * way[:-1]).sum(axis=1)]).min(axis=0) - _TOUCH_M
    room = np.minimum(np.r_[np.inf, nearer], np.r_[nearer, np.inf])
    slant = abs(math.sin(row.angle))
    length = np.minimum(room, SIDE[0]) if kerbside else np.full(len(xy), END[0])
    width = np.full(len(xy), SIDE[1]) if kerbside else np.minimum(room, max(pitch, PITCH_M[0])) * slant
    slots = _posed(xy, way, row.angle, length, width, path)
    sightings, std = np.zeros(len(xy), np.int64), np.full(len(xy), np.nan)
    sightings[from_car], std[from_car] = cars.sightings[row.members], cars.std[row.members]
    source = np.where((source == CAR) & (sightings < 2), ONCE, source)
    depth = 0.5 * (width if kerbside else length * slant)
    edge = xy + steps_to_line(xy, way, np.ones(len(xy))) + depth[:, None] * _outward(xy, way, path)
    half = 0.5 * (length if kerbside else width)[:, None] * way
    pieces = np.split(np.arange(len(xy)), np.flatnonzero(ends) + 1)
    kerbs = [np.concatenate([(edge - half)[p[:1]], edge[p], (edge + half)[p[-1:]]]) for p in pieces]
    return StreetSlots(slots, source, sightings, std, tuple(kerbs))


def _between(
    a: FloatArray, b: FloatArray, u: FloatArray, v: FloatArray, share: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return points of the cubic curve from a to b with directions u and v at its ends, and its directions there."""
    curve = CubicHermiteSpline([0.0, 1.0], [a, b], math.hypot(*(b - a)) * np.array([u, v]))
    way = curve(share, 1)
    return curve(share), way / np.hypot(way[:, :1], way[:, 1:])


def _outward(xy: FloatArray, way: FloatArray, path: shapely.MultiLineString) -> FloatArray:
    """Return the directions across a row that point away from the track, (n, 2) unit vectors."""
    if not len(xy):
        return np.empty((0, 2))
    left = np.stack([-way[:, 1], way[:, 0]], axis=1)
    side = np.sign(((xy - along_track(xy, path)[1]) * left).sum(axis=1))
    return np.where(side == 0.0, 1.0, side)[:, None] * left


def _posed(
    xy: FloatArray,
    way: FloatArray,
    angle: float,
    length: FloatArray,
    width: FloatArray,
    path: shapely.MultiLineString,
) -> Slots:
    outward = _outward(xy, way, path)
    if angle == 0.0:
        # The lane is on the left of a car that parks at a kerb, in right-hand traffic.
        yaw = np.arctan2(outward[:, 0], -outward[:, 1])
        return Slots(xy, yaw, length, width, np.full(len(xy), Mouth.LEFT, np.int8))
    yaw = np.arctan2(way[:, 1], way[:, 0]) + angle
    nose = axis_of(yaw) * np.where((axis_of(yaw) * outward).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    yaw = np.arctan2(nose[:, 1], nose[:, 0])
    return Slots(xy, yaw, length, width, np.full(len(xy), Mouth.REAR, np.int8))


def _apart(found: StreetSlots, driven: shapely.Geometry) -> IntArray:
    """Return the slots that overlap neither a driven place nor a slot with more evidence, in their order."""
    boxes = found.slots.boxes(shrink=_OVERLAP_M)
    is_clear = ~shapely.intersects(boxes, driven)
    rank = np.array([(CAR, ONCE, LONE_CAR, GAP).index(source) for source in found.source.tolist()])
    order = np.lexsort([np.nan_to_num(found.std, nan=np.inf), rank])
    place = np.argsort(order)
    tree = shapely.STRtree(boxes)
    for k in order[is_clear[order]].tolist():
        near = tree.query(boxes[k], predicate="intersects")
        is_clear[k] = not (is_clear[near] & (place[near] < place[k])).any()
    return np.flatnonzero(is_clear)


def _within_touch(slots: Slots) -> Slots:
    """Shrink slots that overlap others by more than can be drawn."""
    for _ in range(math.ceil(_OVERLAP_M / _TOUCH_M)):
        boxes = slots.boxes(shrink=_TOUCH_M)
        one, other = shapely.STRtree(boxes).query(boxes, predicate="intersects")
        by = _TOUCH_M * np.isin(np.arange(len(slots)), one[one != other])
        slots = replace(slots, length=slots.length - by, width=slots.width - by)
    return slots
