"""Path tracking: steering and speed along a path, forward and backward.

Steering is feedback control of the rear axle (Samson 1992; Paden et al., "A survey of motion planning and control
techniques for self-driving urban vehicles", 2016, §V): like the Stanley controller it corrects the heading error and
the lateral offset, but it is also stable in reverse, where feedback control of the front axle diverges.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.driving.road_users import PREDICTION_TIMES_S, START_SPEED
from parkenv.driving.vehicle import VehicleParameters, move_along
from parkenv.files.field_types import Positive, Validated
from planners.driving.car_path import CarPath

SAMPLE_M = 0.05
"""Distance between samples of a path, m."""


@dataclass(frozen=True)
class TrackingSettings(Validated):
    """Speeds and gains of path tracking.

    Args:
        speed, reverse_speed: maximum speeds, m/s.
        acceleration: acceleration and deceleration, m/s².
        firmness: gain, 1/m; an offset from the path decays over about 2/firmness metres.
        blend_m: distance over which the steering changes between two arcs, m.
        control_s: control period, s.
        stops: stop wherever the curvature changes and turn the wheels at rest: slow, but exact.

    Raises:
        InputError: a value that is not a finite number above 0.
    """

    speed: Positive = 2.2
    reverse_speed: Positive = 1.5
    acceleration: Positive = 1.2
    firmness: Positive = 1.3
    blend_m: Positive = 0.6
    control_s: Positive = 0.1
    stops: bool = False

    def within(self, vehicle: VehicleParameters) -> Self:
        """Return the same within the limits of a vehicle, with some acceleration left for feedback."""
        return dataclasses.replace(
            self,
            speed=min(self.speed, vehicle.max_speed),
            reverse_speed=min(self.reverse_speed, vehicle.max_reverse_speed),
            acceleration=min(self.acceleration, 0.7 * min(vehicle.max_acceleration, vehicle.max_braking)),
        )


_CRAWL = 0.1  # m/s, lowest commanded speed before the end of the path
# m, from the end of a segment; the second where the car stops to turn its wheels
_ARRIVED, _EXACTLY = 0.01, 0.001
_BRAKE_FROM = 0.85  # of the acceleration
_LAG = 0.8  # steps
_CLOSE, _CLOSER = 0.06, 0.005  # m, likewise, of where the car may stand
_AIMED = 0.02  # rad, of the wheels, before the car sets off
_STANDS = 0.01  # m/s
_RATE_SHARE = 0.8  # share of the steering rate available to the path; the rest is for corrections
_REACTION_S = 0.2
_ASIDE = 1.8  # m/s², greatest acceleration to the side on a lane


@dataclass(frozen=True, eq=False)
class _Segment:
    """A sampled path between two changes of direction."""

    direction: float  # 1 forward, -1 backward
    station: FloatArray  # (n,) m, distance from its start
    poses: FloatArray  # (n, 3)
    curvature: FloatArray  # (n,) 1/m
    pace: FloatArray  # (n,) m/s, speed limit


class PathTracker:
    """Tracks one path and its progress along it.

    Args:
        vehicle: the car.
        path: the path.
        settings: settings of the tracking.

    Raises:
        InputError: the path was planned for another vehicle.

    Attributes:
        done: whether the car has reached the end of the path.
        offset: latest lateral offset from the path, m, positive to the left.
        askew: latest heading error, rad.
    """

    def __init__(
        self, vehicle: VehicleParameters, path: CarPath, settings: TrackingSettings | None = None
    ) -> None:
        if path.vehicle is not None:
            path.vehicle.require_same(vehicle.numbers, "path")
        self._vehicle = vehicle
        self._settings = settings = (settings or TrackingSettings()).within(vehicle)
        self._segments = _segments(vehicle, path, settings)
        self._segment = self._at = 0
        self._set_off = self.done = False
        self.offset = self.askew = 0.0

    def command(self, pose: FloatArray, speed: float, steering: float) -> tuple[float, float]:
        """Return the acceleration and steering commands, -1 to 1 each, for `parkenv.driving.vehicle.advance`.

        Args:
            pose: (3,) x, y in m and yaw in rad of the rear axle.
            speed: m/s, negative backward.
            steering: rad, angle of the wheels.
        """
        while True:
            segment = self._segments[self._segment]
            first = max(self._at - 4, 0)
            near = segment.poses[first : self._at + 31]
            self._at = first + int(np.hypot(near[:, 0] - pose[0], near[:, 1] - pose[1]).argmin())
            x, y, yaw = segment.poses[self._at].tolist()
            along = math.cos(yaw) * (float(pose[0]) - x) + math.sin(yaw) * (float(pose[1]) - y)
            # Move to the closest point of the path: between two samples the path is approximately an arc.
            x, y, yaw = move_along(x, y, yaw, float(segment.curvature[self._at]), along)
            dx, dy = float(pose[0]) - x, float(pose[1]) - y
            station = float(segment.station[self._at]) + segment.direction * along
            self.offset = math.cos(yaw) * dy - math.sin(yaw) * dx
            self.askew = math.remainder(float(pose[2]) - yaw, 2.0 * math.pi)
            left = float(segment.station[-1]) - station
            close = _CLOSER if self._settings.stops else _CLOSE
            if not (left < close and abs(speed) < _STANDS and self._set_off):
                return self._drive(segment, station, left, speed, steering)
            if self._segment + 1 == len(self._segments):
                self.done = True
                return 0.0, 0.0
            self._segment += 1
            self._at, self._set_off = 0, False

    def poses_ahead(self, distances: FloatArray) -> FloatArray:
        """Return the poses, (n, 3), on the path at `distances`, (n,) m, ahead of the car; at most to the next stop."""
        segment = self._segments[self._segment]
        station = np.minimum(segment.station[self._at] + distances, segment.station[-1])
        at = np.searchsorted(segment.station, station - 1e-9)
        return np.asarray(segment.poses[np.minimum(at, len(segment.poses) - 1)])

    def middle_ahead(self, speed: float) -> FloatArray:
        """Return where the car's middle will be on its path after `PREDICTION_TIMES_S`, (6, 3), at a speed, m/s."""
        distances = PREDICTION_TIMES_S * max(abs(speed), START_SPEED)
        return self._vehicle.at_middle(self.poses_ahead(distances))

    def _drive(
        self, segment: _Segment, station: float, left: float, speed: float, steering: float
    ) -> tuple[float, float]:
        settings, vehicle = self._settings, self._vehicle
        reach = abs(speed) * settings.control_s
        # A command takes effect half a step late on average, and the wheels take another half step to get there.
        bend = float(np.interp(station + 1.5 * reach, segment.station, segment.curvature))
        if not self._set_off:
            wheels = math.atan(bend * vehicle.wheelbase)
            aimed = _EXACTLY if settings.stops else _AIMED
            if abs(speed) >= _STANDS or abs(steering - wheels) > aimed:
                return self._pedal(0.0, speed), self._turn(wheels)
            self._set_off = True
        w = settings.firmness
        bend -= w * w * self.offset + 2.0 * w * segment.direction * self.askew
        turn = self._turn(math.atan(bend * vehicle.wheelbase))
        if left < (_EXACTLY if settings.stops else _ARRIVED):
            return self._pedal(0.0, speed), turn
        # Brake to stop at the end of the segment; braking takes most of a step to build up.
        braking = 0.5 * speed * speed / max(left - _LAG * reach, 1e-3)
        if speed * segment.direction > 0.0 and braking > _BRAKE_FROM * settings.acceleration:
            return -segment.direction * min(braking / vehicle.max_braking, 1.0), turn
        pace = float(np.interp(station + reach, segment.station, segment.pace))
        return self._pedal(segment.direction * max(pace, _CRAWL), speed), turn

    def _turn(self, wheels: float) -> float:
        return min(max(wheels / self._vehicle.max_steering, -1.0), 1.0)

    def _pedal(self, goal: float, speed: float) -> float:
        """Return the fraction of the maximum acceleration that reaches a speed within the reaction time."""
        most = 1.5 * self._settings.acceleration
        needed = min(max((goal - speed) / _REACTION_S, -most), most)
        limit = self._vehicle.max_braking if needed * speed < 0.0 else self._vehicle.max_acceleration
        return min(max(needed / limit, -1.0), 1.0)


class LaneKeeper(PathTracker):
    """Follow a path on a lane, starting at the current speed, and slow down in turns."""

    def __init__(
        self, vehicle: VehicleParameters, path: CarPath, settings: TrackingSettings | None = None
    ) -> None:
        super().__init__(vehicle, path, settings)
        self._set_off = True
        most = 1.5 * self._settings.acceleration
        for segment in self._segments:
            bend = np.maximum(np.abs(segment.curvature), 1e-6)
            np.minimum(segment.pace, np.sqrt(_ASIDE / bend), out=segment.pace)
            _brake_ahead(segment.pace, segment.station, most)


def _segments(vehicle: VehicleParameters, path: CarPath, settings: TrackingSettings) -> list[_Segment]:
    """Split a path at changes of direction, and smooth its curvature for a finite steering rate.

    Between two arcs the curvature changes linearly around their joint. The heading change of each arc stays the same,
    so the deviation from the path is a few millimetres. Each segment starts on the planned path.
    """
    driven = np.abs(path.length) > 1e-9
    length, curvature = path.length[driven], path.curvature[driven]
    cuts = np.arange(1, len(length)) if settings.stops else np.flatnonzero(np.diff(np.sign(length))) + 1
    start = tuple(path.start.tolist())
    segments = []
    for arcs in np.split(np.arange(len(length)), cuts):
        direction = math.copysign(1.0, length[arcs[0]])
        ends = np.r_[0.0, np.cumsum(np.abs(length[arcs]))]
        ramp = np.minimum(0.5 * settings.blend_m, 0.5 * np.minimum(np.diff(ends)[1:], np.diff(ends)[:-1]))
        knots = np.r_[0.0, np.stack([ends[1:-1] - ramp, ends[1:-1] + ramp], axis=1).ravel(), ends[-1]]
        bends = np.repeat(curvature[arcs], 2)
        station = np.linspace(0.0, ends[-1], max(2, math.ceil(ends[-1] / SAMPLE_M) + 1))
        # Include the knots as samples: the curvature is linear between them, so its mean gives the exact turn.
        station = np.unique(np.r_[station, knots])
        bend = np.interp(station, knots, bends)
        poses = [start]
        turns = (0.5 * (bend[1:] + bend[:-1])).tolist()
        for step, turn in zip(np.diff(station).tolist(), turns, strict=True):
            poses.append(move_along(*poses[-1], turn, direction * step))
        fastest = settings.speed if direction > 0.0 else settings.reverse_speed
        rate = _RATE_SHARE * vehicle.steering_rate
        pace = _pace(station, np.arctan(bend * vehicle.wheelbase), fastest, rate, settings.acceleration)
        segments.append(_Segment(direction, station, np.array(poses), bend, pace))
        for i in arcs.tolist():
            start = move_along(*start, float(curvature[i]), float(length[i]))
    return segments


@compiled(error_model="numpy")
def _pace(
    station: FloatArray, wheels: FloatArray, fastest: float, rate: float, acceleration: float
) -> FloatArray:
    """Return speed limits, (n,) m/s, for a steering rate of `rate`, rad/s, that let the car stop at the end."""
    n = len(station)
    pace = np.empty(n)
    for i in range(n):
        steep = 0.0
        for j in range(max(i - 1, 0), min(i + 1, n - 1)):
            steep = max(steep, abs(wheels[j + 1] - wheels[j]) / max(station[j + 1] - station[j], 1e-6))
        pace[i] = min(fastest, rate / max(steep, 1e-9))
    pace[n - 1] = 0.0
    _brake_ahead(pace, station, acceleration)
    return pace


@compiled(error_model="numpy")
def _brake_ahead(pace: FloatArray, station: FloatArray, acceleration: float) -> None:
    """Lower speed limits, (n,) m/s, so that the car may brake to each of them in time."""
    for i in range(len(pace) - 2, -1, -1):
        pace[i] = min(
            pace[i], math.sqrt(pace[i + 1] ** 2 + 2.0 * acceleration * (station[i + 1] - station[i]))
        )
