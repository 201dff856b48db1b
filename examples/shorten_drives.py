"""Time-optimal driving: shorten driven manoeuvres by optimal control in a corridor free of obstacles.

    pip install 'casadi>=3.6.5'
    python examples/shorten_drives.py

After Li, Acarman, Peng, Zhang, Bian and Kong, "Maneuver planning for automatic parking with safe travel corridors"
(European Control Conference, 2020): every pose has a box around the car that is free of obstacles, and its corners stay
inside. The corridor follows each solution, so that more time gives shorter drives; each is driven and judged again, and
a shorter one counts only if it passes the same check.
"""

import dataclasses
import math
import time
from typing import Any, NamedTuple

import casadi
import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.levels import level_scene
from parkenv.driving.scene import Scene
from parkenv.driving.vehicle import PHYSICS_S, SPEED, TPCAP, VehicleParameters, advance, placed
from planners.driving.manoeuvre import Manoeuvre, park

SCENES, DEADLINE_S = 10, 3.0  # wall time for each

_SPEED, _ACCELERATION, _INTERVAL_S = 1.5, 0.7, 0.25  # m/s, m/s², s, of the first reference
_LEAST_KNOTS = 6  # of a phase, from one change of direction to the next
_REACH_M = 1.5  # greatest growth of a box around the car, m, to each side
# Distance of the boxes from obstacles, m, and at most as a share of what the given drive has, tried in order.
_CLEAR = ((0.03, 0.4), (0.06, 0.7), (0.1, 0.95))
_SHARE = 0.92  # of the limits; the rest is for feedback
_WHEELS = 0.975  # likewise, of the steering angle
_GAIN = 1.2  # 1/m and 1/s
_BETTER_S = 0.1  # a solution that saves less is the last one
_LEAST_CLEAR_M = 0.015  # clearance, m, that a shorter drive keeps if the given one does
_SMOOTH = 2e-3  # weight of the squares of the controls


class Reference(NamedTuple):
    """A solution: phases between changes of direction, each with equal intervals."""

    states: list[FloatArray]  # (n + 1, 5) x, y, yaw, speed, steering at the knots of each phase
    interval: list[float]  # s, of each phase

    @property
    def time_s(self) -> float:
        """Time from start to stop, s."""
        return sum(dt * (len(states) - 1) for states, dt in zip(*self, strict=True))


def shorten(drive: Manoeuvre, deadline_s: float) -> Manoeuvre:
    """Return the shortest drive found until a deadline, s: one that touches nothing and arrives, or the given one.

    A drive among road users stays as it is: it has waited for them.
    """
    until = time.perf_counter() + deadline_s
    if drive.path is None or drive.others is not None or not drive.judged.driven:
        return drive
    room_m = drive.judged.clearance_m
    best, least_m = drive, min(room_m, _LEAST_CLEAR_M)
    for clear_m, share in _CLEAR:
        reference = _first(drive)
        while (left := until - time.perf_counter()) > 0.0:
            solution = _solve(drive.scene, reference, min(clear_m, share * room_m), left)
            if solution is None:
                break
            driven = dataclasses.replace(drive, states=follow(drive.scene.vehicle, solution, drive.states[0]))
            judged = driven.judged
            if judged.driven and judged.clearance_m >= least_m and driven.time_s < best.time_s:
                best = driven
            saved, reference = reference.time_s - solution.time_s, solution
            if saved < _BETTER_S:
                break
        if best is not drive:
            break
    return best


def _first(drive: Manoeuvre) -> Reference:
    """Return the planned path as a reference at a moderate speed."""
    path = drive.path
    assert path is not None
    poses, curvature, direction = path.sampled(0.02)
    cuts = np.flatnonzero(np.diff(direction)) + 1
    states, interval = [], []
    for part in np.split(np.arange(len(poses)), cuts):
        part = part if part[0] == 0 else np.r_[part[0] - 1, part]
        length = 0.02 * (len(part) - 1)
        # At most at this speed, faster and slower in between: a trapezium, or a triangle.
        ramp = min(_SPEED / _ACCELERATION, math.sqrt(length / _ACCELERATION))
        whole = ramp + length / (_ACCELERATION * ramp)
        n = max(_LEAST_KNOTS, math.ceil(whole / _INTERVAL_S))
        t = np.linspace(0.0, whole, n + 1)
        pace = _ACCELERATION * np.minimum(np.minimum(t, whole - t), ramp)
        way = np.r_[0.0, np.cumsum(0.5 * (pace[1:] + pace[:-1]))]
        at = part[np.round(way / way[-1] * (len(part) - 1)).astype(int)]
        wheels = np.arctan(curvature[at] * drive.scene.vehicle.wheelbase)
        states.append(np.column_stack([poses[at], direction[part[-1]] * pace, wheels]))
        interval.append(whole / n)
    return Reference(states, interval)


def _boxes(scene: Scene, poses: FloatArray, clear_m: float) -> FloatArray:
    """Return how far a box around the car at each pose may grow to the rear, right, front and left, (n, 4) m."""
    own = scene.vehicle.corners(np.zeros(3))
    tree, grown = shapely.STRtree(scene.shapes), np.zeros((len(poses), 4))
    for step in (0.4, 0.2, 0.1, 0.05, 0.02, 0.01):
        for side in (2, 0, 1, 3) * 2:
            tried = grown.copy()
            tried[:, side] += step
            # The clearance is kept on the side that grows; where the car is closer, it stays as close.
            wide = tried + clear_m * (np.arange(4) == side)
            # Rear right, front right, front left, rear left.
            by = np.stack(
                [wide[:, [0, 2, 2, 0]] * [-1, 1, 1, -1], wide[:, [1, 1, 3, 3]] * [-1, -1, 1, 1]], axis=2
            )
            boxes = shapely.polygons(placed(own + by, poses))
            good = tried[:, side] <= _REACH_M
            good[tree.query(boxes, predicate="intersects")[0]] = False
            grown[good, side] = tried[good, side]
    return grown


def _solve(scene: Scene, reference: Reference, clear_m: float, seconds: float) -> Reference | None:
    """Solve for the shortest time in the corridor around a reference; None if that fails or takes too long."""
    car = scene.vehicle
    corners = car.corners(np.zeros(3))
    (rear, right), (front, left) = corners.min(axis=0), corners.max(axis=0)
    hardest, quickest = _SHARE * min(car.max_acceleration, car.max_braking), _SHARE * car.steering_rate
    widest = _WHEELS * car.max_steering
    problem, phases = casadi.Opti(), list[tuple[Any, Any]]()
    cost, last = 0.0, reference.states[0][0] * [1, 1, 1, 0, 0]
    for states, guess in zip(*reference, strict=True):
        n, sign = len(states) - 1, math.copysign(1.0, states[:, 3].sum())
        x, u, dt = problem.variable(5, n + 1), problem.variable(2, n), problem.variable()
        problem.set_initial(x, states.T)
        problem.set_initial(dt, guess)
        # Corners relative to the poses of the reference, inside their boxes.
        room, away = _boxes(scene, states[:, :3], clear_m), x[:3, :] - states[:, :3].T
        cosine, sine = np.cos(states[:, 2])[None], np.sin(states[:, 2])[None]
        for px, py in corners.tolist():
            turned_x, turned_y = casadi.cos(away[2, :]), casadi.sin(away[2, :])
            along = cosine * away[0, :] + sine * away[1, :] + px * turned_x - py * turned_y
            across = cosine * away[1, :] - sine * away[0, :] + px * turned_y + py * turned_x
            for low, value, high in (
                (rear - room[:, 0], along, front + room[:, 2]), (right - room[:, 1], across, left + room[:, 3])
            ):  # fmt: skip
                problem.subject_to(problem.bounded(low[None], value, high[None]))
        for low, value, high in (
            (0.0, sign * x[3, :], car.max_speed if sign > 0.0 else car.max_reverse_speed),
            (-widest, x[4, :], widest), (-hardest, u[0, :], hardest), (-quickest, u[1, :], quickest), (0.01, dt, 2.0),
        ):  # fmt: skip
            problem.subject_to(problem.bounded(low, value, high))
        problem.subject_to(x[:, 0] == last)
        problem.subject_to(x[:, 1:] == _advanced(x[:, :-1], u, dt, car.wheelbase))
        problem.subject_to(x[3, n] == 0.0)
        last = x[:, n]
        cost += n * dt + _SMOOTH * dt * casadi.sumsqr(u)
        phases.append((x, dt))
    problem.subject_to(last[:3] == reference.states[-1][-1, :3])
    problem.minimize(cost)
    limits = {"max_cpu_time": max(seconds, 0.05), "tol": 1e-4, "max_iter": 300}
    problem.solver("ipopt", {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", **limits}})
    try:
        solution = problem.solve()
    except RuntimeError:  # CasADi's, where no solution was found
        return None
    return Reference(
        [np.array(solution.value(x)).T for x, _ in phases], [float(solution.value(dt)) for _, dt in phases]
    )


def _advanced(x: Any, u: Any, dt: Any, wheelbase: float) -> Any:
    """Return the states after an interval with constant controls (Runge-Kutta, fourth order)."""

    def rate(x: Any) -> Any:
        return casadi.vertcat(
            x[3, :] * casadi.cos(x[2, :]),
            x[3, :] * casadi.sin(x[2, :]),
            x[3, :] * casadi.tan(x[4, :]) / wheelbase,
            u,
        )

    first = rate(x)
    second = rate(x + 0.5 * dt * first)
    third = rate(x + 0.5 * dt * second)
    return x + dt / 6.0 * (first + 2.0 * second + 2.0 * third + rate(x + dt * third))


def follow(vehicle: VehicleParameters, reference: Reference, start: FloatArray) -> FloatArray:
    """Drive a reference with the vehicle's limits and rates; return the states, (n, 6), every `PHYSICS_S`."""
    ends = np.r_[0.0, np.cumsum([dt * (len(s) - 1) for s, dt in zip(*reference, strict=True)])]
    time_s = np.concatenate(
        [a + dt * np.arange(len(s)) for s, dt, a in zip(*reference, ends[:-1], strict=True)]
    )
    knots = np.concatenate(reference.states)
    state, states = start.copy(), [start.copy()]
    n = math.ceil(ends[-1] / PHYSICS_S)
    for i in range(n + 40):
        wanted = _at(time_s, knots, (i + 1) * PHYSICS_S)
        now = _at(time_s, knots, i * PHYSICS_S)
        dx, dy = now[:2] - state[:2]
        cosine, sine = math.cos(now[2]), math.sin(now[2])
        ahead, aside = cosine * dx + sine * dy, cosine * dy - sine * dx
        askew = math.remainder(float(now[2] - state[2]), 2.0 * math.pi)
        direction = math.copysign(1.0, wanted[3] + now[3])
        bend = math.tan(wanted[4]) / vehicle.wheelbase + _GAIN * (_GAIN * aside + 2.0 * direction * askew)
        wheels = math.atan(bend * vehicle.wheelbase) if abs(wanted[3]) > 0.05 else float(wanted[4])
        pull = (wanted[3] + _GAIN * ahead - state[SPEED]) / PHYSICS_S
        if i >= n:
            pull = -state[SPEED] / PHYSICS_S
        limit = vehicle.max_braking if pull * state[SPEED] < 0.0 else vehicle.max_acceleration
        advance(state, min(max(pull / limit, -1.0), 1.0), wheels / vehicle.max_steering, vehicle.limits)
        states.append(state.copy())
        if i >= n - 1 and state[SPEED] == 0.0:
            break
    return np.array(states)


def _at(time_s: FloatArray, knots: FloatArray, at: float) -> FloatArray:
    return np.array([np.interp(at, time_s, column) for column in knots.T])


if __name__ == "__main__":
    for seed in range(SCENES):
        drive = park(level_scene("perpendicular-normal", seed, TPCAP))
        shorter = shorten(drive, DEADLINE_S)
        print(f"{drive.scene.name}: {drive.time_s:.1f} s, shortened {shorter.time_s:.1f} s")
