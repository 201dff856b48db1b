"""Rows of parked cars: cars at the same offset from a street, and with the same heading."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.mapping.car_tracks import ParkedCars

LINK_M = (30.0, 1.0)  # along and across the street: cars no farther apart stand in one row
JOIN_M = (15.0, 1.6)  # the same of a car whose heading differs from the row's
_ALIKE, _PARALLEL, _ACROSS = (math.radians(angle) for angle in (25.0, 25.0, 65.0))
_KERNEL_M, _SPREAD_M = 10.0, 0.4  # reach of a row's local line, and deviation of parked cars from it
_HEADING_WEIGHT_M2 = 9.0  # scatter of a row's cars along it that counts as much as the track's heading


@dataclass(frozen=True, eq=False)
class CarRow:
    members: IntArray  # in their order along the row
    along: FloatArray  # (n, 2) unit vectors, the row's direction at each member
    angle: float  # rad, from `along` to the cars: 0 along the kerb, π/2 across it


def car_rows(cars: ParkedCars, path: shapely.MultiLineString) -> list[CarRow]:
    n = len(cars.xy)
    if not n:
        return []
    heading, _ = along_track(cars.xy, path)
    turn = _turn(heading[None] - heading[:, None])
    middle = heading[:, None] + 0.5 * turn
    step = cars.xy[None] - cars.xy[:, None]
    away = np.stack([(step * axis_of(middle + quarter)).sum(axis=2) for quarter in (0.0, math.pi / 2)])
    alike = np.abs(_turn((cars.yaw - heading)[None] - (cars.yaw - heading)[:, None])) < _ALIKE
    reach = alike & (np.abs(turn) < _ALIKE) & (np.abs(away[0]) <= LINK_M[0])
    linked = reach & (np.abs(away[1]) <= LINK_M[1])
    one, other = np.nonzero(np.triu(linked, 1))
    segments = np.asarray(shapely.linestrings(np.stack([cars.xy[one], cars.xy[other]], axis=1)))
    crossing = shapely.intersects(segments, path) if len(one) else np.zeros(0, np.bool_)
    linked[one[crossing], other[crossing]] = linked[other[crossing], one[crossing]] = False
    votes = linked.astype(np.int64) - (reach & (np.abs(away[1]) > JOIN_M[1]))
    label, order = np.arange(n), np.argsort(np.hypot(*(cars.xy[one] - cars.xy[other]).T), kind="stable")
    for a, b in np.stack([one, other], axis=1)[order[~crossing[order]]].tolist():
        # A car between two rows, such as one on its way, must not make them one.
        first, second = label == label[a], label == label[b]
        if label[a] != label[b] and votes[np.ix_(first, second)].sum() > 0:
            label[second] = label[a]
    size = np.bincount(label, minlength=n)
    # A car seen from the front or at an angle may have a wrong heading: its place tells which row it is of.
    near = (np.abs(away) <= np.array(JOIN_M)[:, None, None]).all(axis=0)
    least = np.where(np.abs(_turn(cars.yaw - heading)) < _ACROSS, 4.0, 2.0)
    for k in np.flatnonzero(size[label] == 1).tolist():
        for row in np.unique(label[near[k] & (size[label] > 1)]).tolist():
            members = np.flatnonzero(label == row)
            if (np.abs(away[0, k, members]) >= least[members]).all():
                label[k] = row
                break
    return [_row(cars, np.flatnonzero(label == row), heading) for row in np.unique(label)]


def _row(cars: ParkedCars, members: IntArray, heading: FloatArray) -> CarRow:
    """Order the cars of a row from one end to the other; find the row's direction, and the angle of its cars."""
    xy, weight = cars.xy[members], 1.0 / (cars.std[members] ** 2 + _SPREAD_M**2)
    step = xy[None] - xy[:, None]
    apart = np.hypot(step[..., 0], step[..., 1])
    order = [int(apart.max(axis=1).argmax())]
    while len(order) < len(members):
        left = np.setdiff1d(np.arange(len(members)), order)
        order.append(int(left[apart[order[-1], left].argmin()]))
    kernel = np.exp(-0.5 * (apart / _KERNEL_M) ** 2) * weight / weight.max()
    axis = axis_of(heading[members])
    scatter = np.einsum("ij,ijk,ijl->ikl", kernel, step, step)
    scatter += _HEADING_WEIGHT_M2 * axis[:, :, None] * axis[:, None, :]
    along = np.linalg.eigh(scatter)[1][:, :, 1]
    # The track may lead by in both directions; a row has one.
    forward = np.gradient(cars.xy[members][order], axis=0) if len(members) > 1 else axis
    along, members, weight = along[order], members[order], weight[order]
    along *= np.where((along * forward).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    twice = 2.0 * (cars.yaw[members] - np.arctan2(along[:, 1], along[:, 0]))
    angle = 0.5 * math.atan2(float(weight @ np.sin(twice)), float(weight @ np.cos(twice)))
    # Most cars decide, as one that is far off must not turn a row.
    off = np.abs(_turn(0.5 * twice - angle))
    if (off > _ALIKE).any() and (off <= _ALIKE).any():
        angle = 0.5 * math.atan2(*((weight * (off <= _ALIKE)) @ f(twice) for f in (np.sin, np.cos)))
    angle = 0.0 if abs(angle) < _PARALLEL else math.pi / 2 if abs(angle) > _ACROSS else angle
    return CarRow(members, along, angle)


def aligned(cars: ParkedCars, rows: Sequence[CarRow]) -> ParkedCars:
    """Give cars the heading of their row, and move them across it towards its line."""
    xy, yaw = cars.xy.copy(), cars.yaw.copy()
    for row in rows:
        # The place of a car is as wrong as its heading.
        direction = np.arctan2(row.along[:, 1], row.along[:, 0]) + row.angle
        is_off = np.abs(_turn(cars.yaw[row.members] - direction)) > _ALIKE
        variance = np.where(is_off, 100.0, cars.std[row.members] ** 2)
        step = steps_to_line(cars.xy[row.members], row.along, 1.0 / (variance + _SPREAD_M**2))
        # Slots across the kerb end at one line, however far into them the cars stand.
        share = variance / (variance + _SPREAD_M**2) if row.angle == 0.0 else np.ones(len(step))
        xy[row.members] += share[:, None] * step
        yaw[row.members] = direction % math.pi
    return replace(cars, xy=xy, yaw=yaw)


def steps_to_line(xy: FloatArray, along: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the steps across a row from its cars to the local mean of their offsets, (n, 2) m."""
    step, across = xy[None] - xy[:, None], np.stack([-along[:, 1], along[:, 0]], axis=1)
    kernel = np.exp(-0.5 * (np.hypot(step[..., 0], step[..., 1]) / _KERNEL_M) ** 2) * weight
    offset = np.einsum("ij,ijk,ik->i", kernel, step, across) / kernel.sum(axis=1)
    return np.asarray(offset[:, None] * across)


def _turn(angle: FloatArray) -> FloatArray:
    """Return the angle between two axes, which have no front, from -π/2 to π/2."""
    return np.asarray((angle + math.pi / 2) % math.pi - math.pi / 2)


def axis_of(angle: FloatArray | float) -> FloatArray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def along_track(xy: FloatArray, path: shapely.MultiLineString) -> tuple[FloatArray, FloatArray]:
    """Return the direction of the track beside points, rad, and the points of it nearest to them, (n, 2) m."""
    lines, points = np.array(path.geoms), np.asarray(shapely.points(xy))
    nearest = shapely.distance(lines[:, None], points[None]).argmin(axis=0)
    at = shapely.line_locate_point(lines[nearest], points)
    ends = [shapely.get_coordinates(shapely.line_interpolate_point(lines[nearest], np.maximum(at + d, 0.0)))
            for d in (-2.0, 2.0, 0.0)]  # fmt: skip
    step = ends[1] - ends[0]
    return np.arctan2(step[:, 1], step[:, 0]), ends[2]
