"""The car: dimensions, limits, and the kinematic bicycle model."""

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError, naming
from parkenv.files.field_types import Positive, Validated

PHYSICS_S = 0.05  # physics time step, s
# Columns of a vehicle's state: m, m, rad, m/s, rad, m/s²; x and y are the middle of the rear axle.
X, Y, YAW, SPEED, STEERING, ACCELERATION = range(6)
STATE_SIZE = 6
STRAIGHT = 1e-6  # turn per step, rad, below which an arc is approximated by its chord


@dataclass(frozen=True)
class VehicleParameters(Validated):
    """Dimensions and limits of a car; by default a 2012 Volkswagen Golf with a kerb-to-kerb turning circle of 10.9 m.

    Args:
        length, width: size of the footprint, a rectangle without mirrors, m.
        wheelbase: distance between the axles, m.
        rear_overhang: distance from the rear axle to the rear end, m.
        max_steering: largest angle, to either side, of a wheel in the middle of the front axle, rad.
        steering_rate: largest rate of change of that angle, rad/s.
        max_speed, max_reverse_speed: largest speeds, m/s, both above 0.
        max_acceleration: largest acceleration in either direction, m/s².
        max_braking: largest deceleration, m/s².
        acceleration_rate: largest rate of change of the acceleration, m/s³.

    Raises:
        InputError: a value that is not a finite number above 0, axles outside the car, a steering angle of 90° or
            more, or a speed above half a car length per physics step.

    Examples:
        >>> round(VehicleParameters().turning_radius, 2)
        4.0
    """

    length: Positive = 4.26
    width: Positive = 1.80
    wheelbase: Positive = 2.64
    rear_overhang: Positive = 0.78
    max_steering: Positive = 0.583
    steering_rate: Positive = 0.6
    max_speed: Positive = 8.0
    max_reverse_speed: Positive = 3.0
    max_acceleration: Positive = 2.0
    max_braking: Positive = 6.0
    acceleration_rate: Positive = 15.0

    def __post_init__(self) -> None:
        with naming("vehicle"):
            super().__post_init__()
        if self.rear_overhang + self.wheelbase > self.length:
            raise InputError(
                f"vehicle wheelbase and rear_overhang: want both within the length, {self.length:g} m"
            )
        if self.max_steering >= math.pi / 2:
            raise InputError(f"vehicle max_steering is {self.max_steering:g} rad, want below a right angle")
        fastest = 0.5 * self.length / PHYSICS_S
        if max(self.max_speed, self.max_reverse_speed) > fastest:
            # Faster, it could pass through things.
            raise InputError(
                f"vehicle speeds: want at most {fastest:g} m/s, half a length in a step of the physics"
            )

    @cached_property
    def turning_radius(self) -> float:
        """Smallest turning radius of the middle of the rear axle, m: wheelbase / tan(steering)."""
        return self.wheelbase / math.tan(self.max_steering)

    @cached_property
    def middle(self) -> float:
        """Distance from the rear axle to the centre of the footprint, m."""
        return 0.5 * self.length - self.rear_overhang

    @cached_property
    def limits(self) -> FloatArray:
        """The limits as `advance` takes them, (8,) float64."""
        # All fields but those of the footprint: length, width and rear overhang.
        limits = np.delete(np.array(dataclasses.astuple(self), dtype=np.float64), [0, 1, 3])
        limits.flags.writeable = False
        return limits

    @cached_property
    def numbers(self) -> NDArray[np.float32]:
        """All parameters in the order of the fields, (11,) float32, as observations show them."""
        numbers = np.array(dataclasses.astuple(self), dtype=np.float32)
        numbers.flags.writeable = False
        return numbers

    def require_same(self, numbers: ArrayLike, what: str) -> None:
        """Raise an `InputError` unless `numbers`, (11,) or (n, 11), are this vehicle's, for which `what` is made."""
        others = np.atleast_2d(np.asarray(numbers, dtype=np.float32))
        for other, k in np.argwhere(others != self.numbers).tolist():
            name = dataclasses.fields(self)[k].name
            raise InputError(
                f"{what} is made for a vehicle with {name} {self.numbers[k]:g}, this one has {others[other, k]:g}"
            )

    def corners(self, pose: FloatArray) -> FloatArray:
        """Footprints, (..., 4, 2) m, counter-clockwise from the rear right, of rear-axle poses, (..., 3)."""
        back, front, half = -self.rear_overhang, self.length - self.rear_overhang, 0.5 * self.width
        own = np.array([[back, -half], [front, -half], [front, half], [back, half]])
        return placed(own, pose)

    def at_middle(self, pose: FloatArray) -> FloatArray:
        """Convert poses of the rear axle, (..., 3), to poses of the footprint's centre."""
        return _shifted(pose, self.middle)

    def at_rear_axle(self, pose: FloatArray) -> FloatArray:
        """Convert poses of the footprint's centre, (..., 3), to poses of the rear axle."""
        return _shifted(pose, -self.middle)


TPCAP = VehicleParameters(
    length=4.689, width=1.942, wheelbase=2.8, rear_overhang=0.929, max_steering=0.75, steering_rate=0.5,
    max_speed=2.5, max_reverse_speed=2.5, max_acceleration=1.0, max_braking=1.0,
)  # fmt: skip
# Cars by name: the default; that of the Trajectory Planning Competition for Automated Parking (2022); and that of the
# paper on ParkBench (2026, appendix B), without its cut corners and with the speeds and rates of the second.
VEHICLES = {
    "golf": VehicleParameters(),
    "tpcap": TPCAP,
    "parkbench": dataclasses.replace(
        TPCAP, length=4.95, width=2.0, wheelbase=3.0, rear_overhang=1.025, max_steering=math.radians(32.0)
    ),
}


def finite_pose(name: str, given: object) -> FloatArray:
    """Return x, y in m and yaw in rad, (3,), read-only; `name` is for the message."""
    try:
        pose = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise InputError(f"{name} is {given!r:.60}, want three finite numbers: x, y in m and yaw in rad")
    pose.flags.writeable = False
    return pose


def placed(points: FloatArray, pose: FloatArray) -> FloatArray:
    """Transform points of one body, (k, 2) m, or of each, (..., k, 2) m, to poses, (..., 3); returns (..., k, 2) m."""
    pose = np.asarray(pose, dtype=np.float64)
    cosine, sine = np.cos(pose[..., 2, None]), np.sin(pose[..., 2, None])
    x = pose[..., 0, None] + cosine * points[..., 0] - sine * points[..., 1]
    y = pose[..., 1, None] + sine * points[..., 0] + cosine * points[..., 1]
    return np.stack([x, y], axis=-1)


def _shifted(pose: FloatArray, ahead: float) -> FloatArray:
    pose = np.asarray(pose, dtype=np.float64)
    step = np.stack([np.cos(pose[..., 2]), np.sin(pose[..., 2]), np.zeros(pose.shape[:-1])], axis=-1)
    moved: FloatArray = pose + ahead * step
    return moved


@compiled(error_model="numpy")
def move_along(x: float, y: float, yaw: float, curvature: float, way: float) -> tuple[float, float, float]:
    """Return the exact pose at the end of an arc of length `way`, m, negative backward."""
    turned = curvature * way
    half = 0.5 * turned
    chord = way if abs(turned) < STRAIGHT else way * math.sin(half) / half
    return x + chord * math.cos(yaw + half), y + chord * math.sin(yaw + half), yaw + turned


@compiled(error_model="numpy")
def advance(state: FloatArray, acceleration: float, steering: float, limits: FloatArray) -> float:
    """Move a car by one physics step, `PHYSICS_S`.

    Kinematic bicycle model: no wheel slips, and the rear axle's middle moves on a circle of wheelbase / tan(steering).
    Steering angle and acceleration approach the command as fast as their rates allow, and are then constant for the
    step, so that the motion is an exact arc. A braking car comes to rest and stays at rest for the rest of the step.

    `state`, (6,) with the columns of `X`, changes in place. Commands are fractions, -1 to 1, of the limits: of braking
    against the direction of motion; of steering, positive to the left. Return the way, m, negative backward.
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
