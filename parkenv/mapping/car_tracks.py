"""Parked cars of a drive: sightings in several captures joined to one car, with one place and its error.

A laser or a stereo camera sees a flank and an end of most cars while it passes them, each from other captures: the
rectangle is fitted to all end points of a car. From pictures alone, a place is the mean of the sightings, weighted by
their covariances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.perception.box_fit import CAR_WIDTH, LONG_SIDE, direction_of, fit_box
from parkenv.perception.pipeline import CameraView
from parkenv.perception.ranging import LONGEST, LocatedCars

CAR_LENGTH = 4.1  # m, of cars whose ends have not both been seen: between KITTI's mean of 3.9 and today's 4.3
LEAST_PROBABILITY = 0.5  # of a car that is listed
_GATE = (2.6, 1.3)  # m along and across a car within which a sighting is of it
_SPREADS = 3.0  # standard deviations of a sighting from one picture, within which it is of a car
_OVERLAP = (2.8, 1.3)  # m along and across, between the middles of two cars that cannot both be there
_SHARE = 0.6  # weight of a sighting as evidence that there is a car: boxes of one thing resemble
_WHOLE_RATIO = 4.0  # likelihood ratio of a car's length in end points: walls and hedges seldom have it
_UNPLACED_M = 1.5  # m; sightings from pictures with a larger standard deviation say too little
_MOVED_M = 2.2  # m between the first and the last third of a car's sightings, beyond which it was on its way
_WHOLE_LENGTH, _WHOLE_WIDTH = 3.3, 1.5  # m, sides seen so far are seen from end to end
_EDGES = (3.0, 97.0)  # percentiles of the end points where a car's sides are
_CELL_M = 0.05  # one end point in so large a cell counts
_ROW_M, _ROW_CARS, _ROW_AGREES = 25.0, 3, 0.5  # m around a car in which so many others agree in heading
_ASKEW = math.radians(10.0)
_FLANK_STD, _PART_STD = (0.25, 0.25), (0.6, 0.35)  # m along and across, of a sighting of a flank, and of less
_SEEN_STD, _ASSUMED_STD = 0.14, 0.4  # m, of a centre between two seen ends, and half a usual car from one
_COMMON_STD = 0.12  # m, of errors that all sightings share, as that of poses
_COMMON_SHARE = 0.8  # the same of sightings from pictures, as a fraction of the mean one


@dataclass(frozen=True, eq=False)
class ParkedCars:
    """The cars that a drive has passed, each once."""

    xy: FloatArray  # (n, 2) m, centres, world frame
    yaw: FloatArray  # (n,) rad, along the car, in [0, π)
    size: FloatArray  # (n, 2) m, length and width
    std: FloatArray  # (n,) m, standard deviation of the centre in each direction
    probability: FloatArray  # (n,) P(there is a car)
    sightings: IntArray  # (n,) captures in which it was located
    distance: FloatArray  # (n,) m, how near the vehicle came to its nearest side
    time: FloatArray  # (n,) s, when it was located from nearest

    @property
    def located(self) -> LocatedCars:
        probability, cars = self.probability.astype(np.float32), np.arange(len(self.yaw), dtype=np.int64)
        return LocatedCars(self.xy, self.yaw, self.size, self.distance, probability, cars)


class _Place(NamedTuple):
    """A car's rectangle, m and rad, and the standard deviation of its centre in each direction."""

    x: float
    y: float
    yaw: float
    length: float
    width: float
    std: float

    def distances(self, points: FloatArray) -> FloatArray:
        """Return how far points are from the nearest side, (k,) m."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        local = (points - [self.x, self.y]) @ np.array([[c, -s], [s, c]])
        return np.asarray(np.hypot(*np.maximum(np.abs(local) - [0.5 * self.length, 0.5 * self.width], 0.0).T))


@dataclass(eq=False)
class _Track:
    """The sightings of one car."""

    times: list[float] = field(default_factory=list)
    xy: list[FloatArray] = field(default_factory=list)
    covariance: list[FloatArray] = field(default_factory=list)
    yaw: list[tuple[float, float]] = field(default_factory=list)  # rad, and its weight
    probability: list[float] = field(default_factory=list)
    points: list[FloatArray] = field(default_factory=list)
    eyes: list[FloatArray] = field(default_factory=list)  # where the sensor was, (2,) m

    @property
    def middle(self) -> FloatArray:
        weight = np.linalg.inv(np.array(self.covariance))
        return np.asarray(self.own @ (weight @ np.array(self.xy)[:, :, None]).sum(axis=0)[:, 0])

    @property
    def own(self) -> FloatArray:
        """Covariance of `middle`, (2, 2) m², if errors of sightings had nothing in common."""
        return np.asarray(np.linalg.inv(np.linalg.inv(np.array(self.covariance)).sum(axis=0)), np.float64)

    @property
    def heading(self) -> float:
        turn = np.array([(2.0 * yaw, weight) for yaw, weight in self.yaw])
        c, s = (turn[:, 1] * np.cos(turn[:, 0])).sum(), (turn[:, 1] * np.sin(turn[:, 0])).sum()
        return 0.5 * math.atan2(s, c) % math.pi

    @property
    def chance(self) -> float:
        """P(there is a car), from boxes that tell less together than if they were independent, and from its length."""
        none = float(np.prod((1.0 - np.clip(self.probability, 0.0, 0.999)) ** _SHARE))
        axis = np.array([math.cos(self.heading), math.sin(self.heading)])
        lengths = [np.ptp(points @ axis) for points in self.points if len(points)]
        ratio = _WHOLE_RATIO if any(_WHOLE_LENGTH <= length <= LONGEST for length in lengths) else 1.0
        return ratio * (1.0 - none) / (ratio * (1.0 - none) + none)

    @property
    def has_moved(self) -> bool:
        third, xy = max(len(self.xy) // 3, 1), np.array(self.xy)[np.argsort(self.times, kind="stable")]
        first, last = np.median(xy[:third], axis=0), np.median(xy[-third:], axis=0)
        return len(self.xy) >= 3 and math.dist(first, last) > _MOVED_M

    def take(self, other: _Track) -> None:
        for name, values in vars(self).items():
            values += getattr(other, name)

    def off(self, xy: FloatArray, unit: tuple[float, float]) -> float:
        """Return how far a point is from the middle, in units along and across the car."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        x, y = (xy - self.middle).tolist()
        return math.hypot((c * x + s * y) / unit[0], (c * y - s * x) / unit[1])


class CarTracks:
    """Joins the located cars of captures, in order of time."""

    def __init__(self) -> None:
        self._tracks: list[_Track] = []

    def add(self, time: float, view: CameraView) -> None:
        """Add the cars of one view; each is of a car that is there already, or a new one."""
        cars, open_tracks = view.cars, list(self._tracks)
        eye = np.array([view.scan.x, view.scan.y])
        for k in np.argsort(-cars.probability, kind="stable").tolist():
            xy, yaw = cars.xy[k], float(cars.yaw[k])
            if cars.covariance is None:
                points, gate = cars.points[k], _GATE
                fitted = _Place(xy[0], xy[1], yaw, cars.size[k, 0], cars.size[k, 1], 0.0)
                if (fitted.distances(points) > _CELL_M).any():
                    car = fit_box(points, eye, end_on=False)  # the box was too small
                    xy, yaw = np.array([car.x, car.y]), car.yaw
                is_flank = bool(np.ptp(points @ [math.cos(yaw), math.sin(yaw)]) > LONG_SIDE)
                covariance = _turned(yaw, _FLANK_STD if is_flank else _PART_STD)
            else:
                points, is_flank, covariance = np.empty((0, 2)), True, cars.covariance[k]
                std = math.sqrt(float(np.linalg.eigvalsh(covariance).max()))
                if std > _UNPLACED_M:
                    continue
                spread = _SPREADS * std
                gate = (min(_GATE[0], spread), min(_GATE[1], spread))
            off = [track.off(xy, gate) for track in open_tracks]
            if min(off, default=math.inf) < 1.0:
                track = open_tracks.pop(int(np.argmin(off)))
            else:
                self._tracks.append(track := _Track())
            track.times.append(time)
            track.xy.append(xy)
            track.covariance.append(covariance)
            track.yaw.append((yaw, 1.0 if is_flank else 0.1))
            track.probability.append(float(cars.probability[k]))
            track.points.append(points)
            track.eyes.append(eye)

    def cars(self, way: FloatArray, least: float = LEAST_PROBABILITY) -> ParkedCars:
        """Return the cars that are there with a probability of at least `least`, and that stood still.

        `way`, (k, 2) m, is where the vehicle has been.
        """
        tracks = [t for t in _joined(self._tracks) if t.chance >= least and not t.has_moved]
        places = [_placed(track) for track in tracks]
        places = [
            place if heading is None else _placed(track, heading)
            for track, place, heading in zip(tracks, places, _headings_of_rows(places), strict=True)
        ]
        tracks = [track for track, place in zip(tracks, places, strict=True) if place.length <= LONGEST]
        table = np.array([place for place in places if place.length <= LONGEST]).reshape(-1, 6)
        away = [_Place(*row).distances(np.array(t.eyes)) for t, row in zip(tracks, table, strict=True)]
        return ParkedCars(
            table[:, :2],
            table[:, 2],
            table[:, 3:5],
            table[:, 5],
            np.array([track.chance for track in tracks]),
            np.array([len(track.times) for track in tracks], dtype=np.int64),
            np.array([_Place(*row).distances(way).min() for row in table]),
            np.array([track.times[d.argmin()] for track, d in zip(tracks, away, strict=True)]),
        )


def _turned(yaw: float, std: tuple[float, float]) -> FloatArray:
    axes = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]) * std
    return np.asarray(axes @ axes.T)


def _joined(tracks: Sequence[_Track]) -> list[_Track]:
    """Join tracks whose cars would overlap: cars cannot."""
    kept: list[_Track] = []
    for track in sorted(tracks, key=lambda track: -track.chance * len(track.times)):
        for other in kept:
            if other.off(track.middle, (_OVERLAP[0], math.inf)) < 1.0 and (
                other.off(track.middle, (math.inf, _OVERLAP[1])) < 1.0
            ):
                other.take(track)
                break
        else:
            kept.append(_Track(**{name: list(values) for name, values in vars(track).items()}))
    return kept


def _headings_of_rows(places: Sequence[_Place]) -> list[float | None]:
    """Return the heading that the cars around have for those that stand askew among them; None for the others.

    A wrong fit explains best why one car should, of which no whole flank was seen.
    """
    headings: list[float | None] = []
    table = np.array(places).reshape(-1, 6)
    for k, (x, y, yaw, length, *_) in enumerate(places):
        around = (np.hypot(*(table[:, :2] - [x, y]).T) < _ROW_M) & (np.arange(len(places)) != k)
        mean = np.exp(2j * table[around, 2]).mean() if around.sum() >= _ROW_CARS else 0.0
        turn = (np.angle(mean) / 2.0 - yaw + math.pi / 2) % math.pi - math.pi / 2
        askew = length == CAR_LENGTH and abs(mean) > _ROW_AGREES and abs(turn) > _ASKEW
        headings.append(float(yaw + turn) if askew else None)
    return headings


def _placed(track: _Track, heading: float | None = None) -> _Place:
    """Return the rectangle of a car, in a given heading or in that which fits best."""
    if not any(len(points) for points in track.points):
        mean = math.sqrt(np.trace(np.mean(track.covariance, axis=0)) / 2.0)
        std = math.hypot(math.sqrt(np.trace(track.own) / 2.0), _COMMON_SHARE * mean)
        x, y = track.middle.tolist()
        return _Place(x, y, track.heading if heading is None else heading, CAR_LENGTH, CAR_WIDTH, std)
    return _fitted(np.concatenate(track.points), np.array(track.eyes), track.heading, heading)


def _fitted(points: FloatArray, eyes: FloatArray, heading: float, given: float | None) -> _Place:
    cells: FloatArray = np.unique(np.round(points / _CELL_M), axis=0) * _CELL_M
    if given is None:
        yaws = direction_of(cells) + np.array([0.0, 0.5 * math.pi])
        sides = [float(np.ptp(np.percentile(cells @ [math.cos(a), math.sin(a)], _EDGES))) for a in yaws]
        turns = np.abs((yaws - heading + math.pi / 2) % math.pi - math.pi / 2)
        # A side longer than any car is wide is a flank; else the sightings tell an end from a flank.
        given = float(yaws[int(np.argmax(sides) if max(sides) > LONG_SIDE else np.argmin(turns))])
    yaw = given
    axes = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    local, eyes = cells @ axes.T, eyes @ axes.T
    low, high = np.percentile(local, _EDGES, axis=0)
    centre, size, std = 0.5 * (low + high), np.zeros(2), np.zeros(2)
    for i, (usual, whole) in enumerate(((CAR_LENGTH, _WHOLE_LENGTH), (CAR_WIDTH, _WHOLE_WIDTH))):
        extent = float(high[i] - low[i])
        below, above = bool((eyes[:, i] < low[i]).any()), bool((eyes[:, i] > high[i]).any())
        if (below and above and extent > whole) or extent > usual or below == above:
            size[i], std[i] = max(extent, whole), _SEEN_STD if extent > whole else _ASSUMED_STD
        else:  # the end that the sensor has seen is one; the other is where that of a usual car is
            size[i], std[i] = usual, _ASSUMED_STD if i == 0 else _SEEN_STD
            centre[i] = low[i] + 0.5 * usual if below else high[i] - 0.5 * usual
    (x, y), (length, width) = (axes.T @ centre).tolist(), size.tolist()
    return _Place(x, y, yaw % math.pi, length, width, math.hypot(_COMMON_STD, math.sqrt((std**2).mean())))
