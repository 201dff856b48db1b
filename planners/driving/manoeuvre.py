"""Manoeuvres: plan a path in a scene, and drive it with the vehicle's limits and rates."""

import dataclasses
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.road_users import CrossingTraffic, caused_contact, is_blocked
from parkenv.driving.scene import ANGLE_TOLERANCE_RAD, POSITION_TOLERANCE_M, FootprintCheck, Scene
from parkenv.driving.vehicle import PHYSICS_S, SPEED, STATE_SIZE, STEERING, advance
from planners.driving.car_path import CarPath, count_changes
from planners.driving.clearance import Clearance, clearance, free_length, room_at
from planners.driving.hybrid_astar import WINDOW_M, SearchSettings, plan_path
from planners.driving.path_tracking import PathTracker, TrackingSettings

# Settings of the search in scenes: long moves first, and a path soon rather than the shortest.
SEARCH = SearchSettings(
    greed=2.0, patience=0.3, most_expansions=8_000, attempts=((0.2, 1.0), (0.1, 1.0), (0.1, 0.5), (0.04, 0.5))
)
# Settings of the search out of the tightest slots.
TIGHT = dataclasses.replace(SEARCH, most_expansions=6_000, attempts=((0.04, 0.0), (0.02, 0.0), (0.01, 0.0)))
# Settings of the last search, out of slots hardly longer than the car.
FINEST = dataclasses.replace(SEARCH, most_expansions=12_000, attempts=((0.008, 0.0), (0.004, 0.0)))
WIDE_M = 25.0  # margin, m, around start and target of the search for ways around
# Settings of the tracking where a fluent drive would touch something.
EXACT = TrackingSettings(
    speed=0.8, reverse_speed=0.8, acceleration=0.6, firmness=2.5, control_s=PHYSICS_S, stops=True
)
# Largest distance, m, and angle, rad, of the pose aimed at from the target, within what a scene tolerates.
AIM_M, AIM_RAD = 0.03, 0.004
_ROOMY_M = 0.1  # room at the target, m, from which on the car aims at it exactly
# Clearance, m, and share of the tolerance, from which on a fluent drive is enough.
_CLOSE_M, _SURE = 0.015, 0.8
_LONGEST_S = 600.0
# Length of six ways, their clearance, and their sum in a tight slot, m.
_WAY_M, _WAY_CLEAR_M, _TIGHT_WAY_M = 2.0, 0.02, 3.2
_BRAKING = 2.0  # m/s², for road users


class Judgement(NamedTuple):
    """Whether a manoeuvre ended at its target without a contact; clearance, m, and errors at the end, m and rad."""

    driven: bool
    contact: bool
    clearance_m: float
    error_m: float
    error_rad: float

    @property
    def score(self) -> tuple[bool, bool, float]:
        """Whether it was driven, and exactly enough, and the clearance up to the one that is enough."""
        far = max(self.error_m / POSITION_TOLERANCE_M, self.error_rad / ANGLE_TOLERANCE_RAD)
        return self.driven, self.driven and far <= _SURE, min(self.clearance_m, _CLOSE_M)


@dataclass(frozen=True, eq=False)
class Manoeuvre:
    scene: Scene
    path: CarPath | None  # the path that was driven; None if none was found
    # (n, 6) states of the vehicle every `PHYSICS_S` from the start on; see `parkenv.driving.vehicle`
    states: FloatArray
    planning_s: float  # wall time of planning
    others: FloatArray | None = None  # (n, m, 3) poses of the scene's road users at the same times

    @property
    def time_s(self) -> float:
        """Time from the start until the car stands for good, s."""
        return PHYSICS_S * (len(self.states) - 1)

    @property
    def length_m(self) -> float:
        return float(np.hypot(*np.diff(self.states[:, :2], axis=0).T).sum())

    @property
    def direction_changes(self) -> int:
        return count_changes(self.states[self.states[:, SPEED] != 0.0, SPEED])

    @cached_property
    def judged(self) -> Judgement:
        """The judgement of what was driven, by its footprints alone; the clearance is that to what stands."""
        check = self.scene.check(self.states[:, :3])
        crossings = self.scene.crossings
        if self.others is not None and caused_contact(
            self.scene.vehicle, self.states[:, :3], crossings, self.others
        ):
            check = FootprintCheck(True, 0.0)
        away, turned = self.scene.error(self.states[-1])
        arrived = away <= POSITION_TOLERANCE_M and turned <= ANGLE_TOLERANCE_RAD
        stands = self.states[-1, SPEED] == 0.0
        return Judgement(
            bool(arrived and stands and not check.contact), check.contact, check.clearance, away, turned
        )


def park(scene: Scene) -> Manoeuvre:
    """Plan a path from a scene's start to its target, and drive it; one that starts at its target stays there.

    The car is driven fluently; where that would touch something or end too far from the target, it is driven anew
    and stops to turn its wheels, or on another path. The planner knows the vehicle's model, so it finds that out first.
    """
    start = np.concatenate([scene.start, np.zeros(STATE_SIZE - 3)])[None]
    there = Manoeuvre(scene, CarPath(scene.start, np.zeros(0), np.zeros(0)), start, 0.0)
    if there.judged.driven:
        return there
    paths, planning_s, tried = paths_in_scene(scene), 0.0, list[Manoeuvre]()
    while not any(manoeuvre.judged.driven for manoeuvre in tried):
        began = time.perf_counter()
        path = next(paths, None)
        planning_s += time.perf_counter() - began
        if path is None:
            break
        for tracking in (TrackingSettings(), EXACT):
            states, others = drive(scene, path, tracking)
            manoeuvre = Manoeuvre(scene, path, states, planning_s, others)
            if manoeuvre.judged.score == (True, True, _CLOSE_M):
                return manoeuvre
            tried.append(manoeuvre)
    if not tried:
        return Manoeuvre(scene, None, start, planning_s)
    return max(tried, key=lambda manoeuvre: manoeuvre.judged.score)


def paths_in_scene(scene: Scene) -> Iterator[CarPath]:
    """Yield paths from a scene's start to its target: a search is short that begins where there is the least room."""
    start, end = scene.start, aim(scene)
    ways = _free_way(scene, start), _free_way(scene, end)
    forward = ways[1] <= ways[0]
    # What does not lead out of a tight slot is soon over; ways around take longer.
    second = [(TIGHT, True, WINDOW_M), (SEARCH, True, WIDE_M)]
    for settings, from_tighter, window_m in (
        (SEARCH, True, WINDOW_M), *(second if min(ways) < _TIGHT_WAY_M else second[::-1]), (SEARCH, False, WINDOW_M),
        (TIGHT, False, WINDOW_M), (FINEST, True, WINDOW_M),
    ):  # fmt: skip
        obstacles = scene.obstacles.corners, scene.obstacles.n_corners
        # The search begins at the last pose.
        ends = (start, end) if from_tighter == forward else (end, start)
        path = plan_path(scene.vehicle, *obstacles, *ends, settings, window_m)
        if path is not None:
            yield path if ends[0] is start else path.reversed(start)


def _free_way(scene: Scene, pose: FloatArray) -> float:
    """Return how far, m, the car may drive from a pose, all ways together."""
    space = _space_around(scene, pose)
    bends = np.array([-1.0, 0.0, 1.0]) / scene.vehicle.turning_radius
    ways = [(bend, way) for bend in bends.tolist() for way in (-_WAY_M, _WAY_M)]
    return float(sum(abs(free_length(space, *pose.tolist(), *way, _WAY_CLEAR_M)) for way in ways))


def _space_around(scene: Scene, pose: FloatArray) -> Clearance:
    low, high = pose[:2] - WINDOW_M, pose[:2] + WINDOW_M
    return clearance(scene.vehicle, scene.obstacles.corners, scene.obstacles.n_corners, low, high)


def aim(scene: Scene) -> FloatArray:
    """Return the pose to park at, (3,): the target, or where it is narrow a pose nearby with the most room."""
    space = _space_around(scene, scene.target)
    x, y, yaw = scene.target.tolist()
    best, most = scene.target, room_at(space, x, y, yaw, _ROOMY_M)
    if most >= 0.99 * _ROOMY_M:
        return best
    steps = np.linspace(-1.0, 1.0, 5)
    for turn in (0.0, -AIM_RAD, AIM_RAD):
        for along in AIM_M * steps:
            for across in AIM_M * steps:
                if math.hypot(along, across) > AIM_M:
                    continue
                cosine, sine = math.cos(yaw), math.sin(yaw)
                pose = (x + along * cosine - across * sine, y + along * sine + across * cosine, yaw + turn)
                room = room_at(space, *pose, _ROOMY_M)
                if room > most + 1e-4:
                    best, most = np.array(pose), room
    return best


def drive(scene: Scene, path: CarPath, tracking: TrackingSettings) -> tuple[FloatArray, FloatArray | None]:
    """Track a path from a standstill to a stop at its end, and wait for road users in the way.

    Return the states, (n, 6), every `PHYSICS_S`, and the poses of the scene's road users, (n, m, 3); None without any.
    """
    vehicle = scene.vehicle
    tracker = PathTracker(vehicle, path, tracking)
    traffic = CrossingTraffic(scene.crossings) if scene.crossings else None
    state = np.concatenate([scene.start, np.zeros(STATE_SIZE - 3)])
    states, others = [state.copy()], [] if traffic is None else [traffic.poses]

    def move(pedal: float, wheels: float) -> None:
        if traffic is not None:
            traffic.advance(PHYSICS_S, vehicle.corners(state[:3]), stands=state[SPEED] == 0.0)
            others.append(traffic.poses)
        advance(state, pedal, wheels, vehicle.limits)
        states.append(state.copy())

    while len(states) < _LONGEST_S / PHYSICS_S:
        pedal, wheels = tracker.command(state[:3], float(state[SPEED]), float(state[STEERING]))
        if tracker.done:
            break
        if traffic is not None and is_blocked(
            vehicle, tracker.middle_ahead(float(state[SPEED])), traffic.outlines, traffic.velocity
        ):
            slower = min(_BRAKING, abs(state[SPEED]) / tracking.control_s) / vehicle.max_braking
            pedal = -math.copysign(min(slower, 1.0), state[SPEED]) if state[SPEED] else 0.0
        for _ in range(round(tracking.control_s / PHYSICS_S)):
            move(pedal, wheels)
    while state[SPEED] != 0.0:
        # The last millimetres a second.
        brake = min(1.01 * abs(state[SPEED]) / (vehicle.max_braking * PHYSICS_S), 1.0)
        move(-math.copysign(brake, state[SPEED]), state[STEERING] / vehicle.max_steering)
    return np.array(states), np.array(others) if others else None
