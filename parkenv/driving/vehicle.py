"""The car that drives: its size, its limits, and how it moves in a step of time."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from sim_sensors.compilation import compiled

FloatArray = NDArray[np.float64]

PHYSICS_S = 0.05
"""s, one step of the physics."""
X, Y, YAW, SPEED, STEERING, ACCELERATION = range(6)
"""Columns of a vehicle's state: m, m, rad, m/s, rad, m/s²; x and y are the middle of the rear axle."""
STATE_SIZE = 6
STRAIGHT = 1e-6
"""rad turned in a step, below which an arc is its chord."""


@dataclass(frozen=True)
class VehicleParameters:
    """A car: by default a Volkswagen Golf of 2012, whose turning circle is 10.9 m from kerb to kerb.

    Args:
        length, width: m, of the footprint, a rectangle without mirrors.
        wheelbase: m, from axle to axle.
        rear_overhang: m, from the rear axle to the rear end.
        max_steering: rad, of the wheel in the middle of the front axle, to either side.
        steering_rate: rad/s.
        max_speed, max_reverse_speed: m/s, both above 0.
        max_acceleration: m/s², of getting faster in either direction.
        max_braking: m/s², of getting slower.
        acceleration_rate: m/s³, how fast the acceleration changes.

    Raises:
        InputError: a value that is not a finite number above 0, axles outside the car, steering of a right angle
            or more, or a speed that carries the car over more than half its length in a step of the physics.

    Examples:
        >>> round(VehicleParameters().turning_radius, 2)
        4.0
    """

    length: float = 4.26
    width: float = 1.80
    wheelbase: float = 2.64
    rear_overhang: float = 0.78
    max_steering: float = 0.583
    steering_rate: float = 0.6
    max_speed: float = 8.0
    max_reverse_speed: float = 3.0
    max_acceleration: float = 2.0
    max_braking: float = 6.0
    acceleration_rate: float = 15.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
            if not (number and math.isfinite(value) and value > 0.0):
                raise InputError(f"vehicle {field.name} is {value!r}, want a finite number above 0")
        if self.rear_overhang + self.wheelbase > self.length:
            raise InputError(
                f"vehicle wheelbase {self.wheelbase:g} m and rear_overhang {self.rear_overhang:g} m: want both within "
                f"the length, {self.length:g} m"
            )
        if self.max_steering >= math.pi / 2:
            raise InputError(f"vehicle max_steering is {self.max_steering:g} rad, want below a right angle")
        fastest = 0.5 * self.length / PHYSICS_S
        for name in ("max_speed", "max_reverse_speed"):
            if getattr(self, name) > fastest:
                raise InputError(
                    f"vehicle {name} is {getattr(self, name):g} m/s, want at most {fastest:g}: half a length in a step "
                    "of the physics, or the car could pass through things"
                )

    @cached_property
    def turning_radius(self) -> float:
        """m, of the smallest circle of the rear axle's middle: wheelbase / tan(steering)."""
        return self.wheelbase / math.tan(self.max_steering)

    @cached_property
    def middle(self) -> float:
        """m, from the rear axle forward to the middle of the footprint."""
        return 0.5 * self.length - self.rear_overhang

    @cached_property
    def limits(self) -> FloatArray:
        """(8,) float64: what `advance` takes."""
        limits = np.array(
            [
                self.wheelbase,
                self.max_steering,
                self.steering_rate,
                self.max_speed,
                self.max_reverse_speed,
                self.max_acceleration,
                self.max_braking,
                self.acceleration_rate,
            ]
        )
        limits.flags.writeable = False
        return limits

    def corners(self, pose: FloatArray) -> FloatArray:
        """Footprints, (..., 4, 2) m, counter-clockwise from the rear right, of rear-axle poses, (..., 3)."""
        back, front, half = -self.rear_overhang, self.length - self.rear_overhang, 0.5 * self.width
        own = np.array([[back, -half], [front, -half], [front, half], [back, half]])
        return placed(own, pose)

    def at_middle(self, pose: FloatArray) -> FloatArray:
        """Poses, (..., 3), of the footprint's middle, of a car whose rear axle is at `pose`, (..., 3)."""
        return _shifted(pose, self.middle)

    def at_rear_axle(self, pose: FloatArray) -> FloatArray:
        """Poses, (..., 3), of the rear axle, of a car whose footprint has its middle at `pose`, (..., 3)."""
        return _shifted(pose, -self.middle)


def placed(points: FloatArray, pose: FloatArray) -> FloatArray:
    """Points, (k, 2) m, of a body at poses, (..., 3): (..., k, 2) m."""
    pose = np.asarray(pose, dtype=np.float64)
    cosine, sine = np.cos(pose[..., 2, None]), np.sin(pose[..., 2, None])
    x = pose[..., 0, None] + cosine * points[:, 0] - sine * points[:, 1]
    y = pose[..., 1, None] + sine * points[:, 0] + cosine * points[:, 1]
    return np.stack([x, y], axis=-1)


def _shifted(pose: FloatArray, ahead: float) -> FloatArray:
    pose = np.asarray(pose, dtype=np.float64)
    step = np.stack([np.cos(pose[..., 2]), np.sin(pose[..., 2]), np.zeros(pose.shape[:-1])], axis=-1)
    moved: FloatArray = pose + ahead * step
    return moved


@compiled(error_model="numpy")
def move_along(x: float, y: float, yaw: float, curvature: float, way: float) -> tuple[float, float, float]:
    """The pose at the end of an arc: `way` m forward, or backward where it is negative; exact."""
    turned = curvature * way
    half = 0.5 * turned
    chord = way if abs(turned) < STRAIGHT else way * math.sin(half) / half
    return x + chord * math.cos(yaw + half), y + chord * math.sin(yaw + half), yaw + turned


@compiled(error_model="numpy")
def advance(state: FloatArray, acceleration: float, steering: float, limits: FloatArray) -> float:
    """Move a car by one step of the physics, `PHYSICS_S`.

    The kinematic bicycle: no wheel slips, and the rear axle's middle runs on a circle of wheelbase / tan(steering).
    Steering angle and acceleration go toward what is asked for as fast as their rates let them, and are then held
    for the step, so that the motion is an arc and exact. A car that brakes comes to rest and stays so for the rest
    of the step.

    Args:
        state: (6,) float64, changed in place; see `X`.
        acceleration: -1 to 1, of the limit: the one for braking where it is against the motion.
        steering: -1 to 1, of the greatest angle, left above 0.
        limits: `VehicleParameters.limits`.

    Returns:
        The way driven, m, below 0 backward.
    """
    wheelbase, max_steering, steering_rate, max_speed, max_reverse, max_faster, max_slower, rate = limits
    dt = PHYSICS_S
    turn = steering_rate * dt
    state[STEERING] += min(max(steering * max_steering - state[STEERING], -turn), turn)
    before = state[SPEED]
    wanted = acceleration * (max_slower if acceleration * before < 0.0 else max_faster)
    jolt = rate * dt
    held = state[ACCELERATION] + min(max(wanted - state[ACCELERATION], -jolt), jolt)
    after = before + held * dt
    if before * after < 0.0 or (before != 0.0 and after == 0.0):
        way = -0.5 * before * before / held
        after = held = 0.0
    elif after > max_speed or after < -max_reverse:
        most = max_speed if after > 0.0 else -max_reverse
        until = (most - before) / held
        way = 0.5 * (before + most) * until + most * (dt - until)
        after = most
        held = 0.0
    else:
        way = 0.5 * (before + after) * dt
    state[SPEED], state[ACCELERATION] = after, held
    curvature = math.tan(state[STEERING]) / wheelbase
    state[X], state[Y], state[YAW] = move_along(state[X], state[Y], state[YAW], curvature, way)
    return float(way)


def drive(
    vehicle: VehicleParameters, state: FloatArray, acceleration: float, steering: float, steps: int = 1
) -> FloatArray:
    """The states, (steps + 1, 6) float64, that a car goes through under one command; see `advance`.

    Args:
        vehicle: the car.
        state: (6,) float64, where it starts; stays as it is.
        acceleration: -1 to 1, of the limit.
        steering: -1 to 1, of the greatest angle.
        steps: of the physics.

    Examples:
        >>> path = drive(VehicleParameters(), np.zeros(6), 1.0, 0.0, steps=40)
        >>> round(float(path[-1, X]), 1), round(float(path[-1, SPEED]), 1)
        (3.8, 3.9)
    """
    states = np.empty((steps + 1, STATE_SIZE))
    states[0] = state
    for k in range(steps):
        states[k + 1] = states[k]
        advance(states[k + 1], acceleration, steering, vehicle.limits)
    return states
