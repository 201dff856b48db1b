"""A simulated car among parked cars, walls and road users: its state, its surroundings, and braking for others."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
from pydantic import Field

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.collision_world import CollisionWorld, ObstacleKind, Obstacles
from parkenv.driving.drivable_area import REACH_M, LotObstacles
from parkenv.driving.road_users import RoadUsers, YieldingTraffic
from parkenv.driving.vehicle import PHYSICS_S, SPEED, STATE_SIZE, STEERING, VehicleParameters, advance
from parkenv.envs.drive import CONTROL_S, SUBSTEPS
from parkenv.files.field_types import Number, Positive, Validated
from parkenv.world.occupancy.process import World
from parkenv.world.scenario import Scenario
from planners.driving.parking import STRAYED_M, STRAYED_RAD
from planners.driving.path_tracking import PathTracker

if TYPE_CHECKING:
    from sim_sensors.movers import Movers

ALONG, TURN, ROUND, ACROSS = "along", "turn", "round", "across"
# Kinds of edges: straight on; with a turn into another lane; with a U-turn; across a two-way lane, where the car
# turns round only if it drives on afterwards, not if it parks.
EDGE_KINDS = (ALONG, TURN, ROUND, ACROSS)
TAKEN, NO_ROOM, NO_WAY = "taken", "too narrow", "no way in"  # reasons of failed attempts


RESCUE_S = 60.0  # time until a stuck car is back on the lane, s
PATIENCE_S = 3.0  # time for which the car and a waiting road user both stand until the other gives way, s

_WAITS_M = 7.0
_SOON_S = 0.8  # brake hard for encounters within this time
_NO_CLOCKS = np.empty(0)


class Leg(NamedTuple):
    """A driven edge: its kind, its length in the graph, m, and its duration, s."""

    kind: str
    graph_m: float
    seconds: float


class ParkingAttempt(NamedTuple):
    slot: str
    kind: str  # orientation of the slot to its lane
    way: str  # nose-in or back-in; empty for parallel slots and if no path was found
    seconds: float  # from the decision until the car stands in the slot, or is back on the lane
    reason: str  # reason of the failure; empty if the car parked
    # distance of the car on the lane beyond the slot's vertex after a failed attempt, m; this part of the next edges
    # is already driven
    onward_m: float = 0.0


class TrackPoint(NamedTuple):
    time: float  # s since Monday 00:00
    driven_m: float  # distance driven so far, m
    pose: FloatArray  # (3,) x, y in m, yaw in rad, of the middle of the car's footprint
    clocks: FloatArray  # (n,) s, clocks of the moving road users, see `RoadUsers`


@dataclass(frozen=True)
class DrivingStyle(Validated):
    speed: Positive | None = None  # maximum on the lanes, m/s; None for the scenario's `v_drive`
    acceleration: Positive = 1.2  # acceleration, and deceleration before turns, m/s²
    braking: Positive = 2.0  # deceleration before parking, m/s²
    # distance along the path, m, at which the car notices at the latest that a slot is taken; it must be able to stop
    notice_m: Annotated[Number, Field(ge=0.8)] = 2.0


@dataclass
class DriveLog:
    legs: list[Leg] = field(default_factory=list)  # driven edges
    attempts: list[ParkingAttempt] = field(default_factory=list)  # parking attempts
    driven_m: float = 0.0  # distance driven, forward and backward, m
    contacts: list[str] = field(default_factory=list)  # kinds of obstacles touched, one per collision
    strays: int = 0  # how often the car left its path and planned another
    rescues: int = 0  # how often no path was found and the car was put back on the lane
    waited_s: float = 0.0  # time spent braking and standing for other road users, s


class DrivenCar:
    """A kinematic bicycle model among pymunk bodies.

    Cars that park while this one manoeuvres wait until it is farther away. The scenario's traffic moves meanwhile: the
    car brakes for road users that are in its way now or soon, and they brake for the car; if both have stood for
    `PATIENCE_S`, the others give way, see `RoadUsers`.

    Attributes:
        log: record of the drive since `begin`.
        state: (6,) state of the vehicle, see `parkenv.driving.vehicle`.
        time: current time, s.
        track: positions of the car since the last decision, every 0.1 s.
        others: moving road users; None without traffic.
        path: what the car follows, and brakes along; None while it has no path.
    """

    def __init__(self, scenario: Scenario, vehicle: VehicleParameters, style: DrivingStyle) -> None:
        self.scenario, self.vehicle, self.style = scenario, vehicle, style
        self._around = LotObstacles(scenario)
        self.log = DriveLog()
        self.track: list[TrackPoint] = []
        self.others: RoadUsers | None = None
        self.state = np.zeros(STATE_SIZE)
        self.time = 0.0

    def begin(self, key: np.uint64, world: World, vertex: int, time: float) -> None:
        self._around.begin(key, world)
        self.log = DriveLog()
        self.track = []
        self.state = np.zeros(STATE_SIZE)
        self.time = time
        self.path: PathTracker | None = None
        self._touches = False
        self._knew: set[int] | None = None
        self._stood_s = 0.0
        self.others = None
        traffic = self.scenario.traffic
        if traffic.cars or traffic.pedestrians:
            rounds = YieldingTraffic(self.scenario.lot, traffic, key, self._around.slots)
            self.others = RoadUsers(rounds, self.vehicle)
        self.enter(self.standing(self.scenario.lot.vertex_xy[vertex]))

    @property
    def pose(self) -> FloatArray:
        """Pose of the rear axle, (3,) m and rad."""
        return self.state[:3]

    @property
    def middle(self) -> FloatArray:
        """Pose of the middle of the footprint, (3,) m and rad."""
        return self.vehicle.at_middle(self.state[:3])

    def place(self, pose: FloatArray, speed: float) -> None:
        """Put the car on a pose of the rear axle; road users that stand there are hidden."""
        self.state = np.r_[pose, np.zeros(STATE_SIZE - 3)]
        self.state[SPEED] = speed
        if self.others is not None:
            self.others.clear_area(self.vehicle.corners(self.state[:3]))

    def rescue(self, pose: FloatArray) -> None:
        self.log.rescues += 1
        self.time += RESCUE_S
        self.place(pose, 0.0)

    def parked_outline(self, slot: int) -> FloatArray | None:
        return self._around.footprint(slot, self.time)

    def all_slots_taken(self, center: FloatArray) -> Obstacles:
        """Return the obstacles around a point, (2,) m, if all slots were taken."""
        return self._around.worst_case(center)

    def movers_at(self, point: TrackPoint) -> Movers | None:
        return None if self.others is None else self.others.movers(point.clocks)

    def follow(self, tracker: PathTracker, notices: Callable[[], bool] | None = None) -> bool:
        """Follow a path to its end, or stop if the car leaves it; return False if `notices` stopped the car."""
        while True:
            pose, speed, steering = self.state[:3], float(self.state[SPEED]), float(self.state[STEERING])
            command = tracker.command(pose, speed, steering)
            if tracker.done:
                return True
            if notices is not None and notices():
                self.halt(max(self.style.braking, 0.5 * speed * speed / (self.style.notice_m - 0.4)), tracker)
                return False
            if abs(tracker.offset) > STRAYED_M or abs(tracker.askew) > STRAYED_RAD:
                self.halt(self.style.braking, tracker)
                return True
            if not self.yields(tracker):
                self.step(*command)

    def yields(self, tracker: PathTracker) -> bool:
        if self.others is None:
            return False
        speed = abs(float(self.state[SPEED]))
        when = self.others.encounter_times(tracker.middle_ahead(speed))
        if np.isinf(when).all():
            self._stood_s = 0.0
            return False
        if speed == 0.0:
            self._stood_s += CONTROL_S
            if self._stood_s >= PATIENCE_S:
                self.others.hide_standing(np.isfinite(when))
                self._stood_s = 0.0
        self.log.waited_s += CONTROL_S
        self.brake(self.vehicle.max_braking if when.min() < _SOON_S else self.style.braking, tracker)
        return True

    def halt(self, braking: float, tracker: PathTracker | None = None) -> None:
        self.refresh()
        while self.state[SPEED] != 0.0:
            self.brake(braking, tracker)

    def brake(self, braking: float, tracker: PathTracker | None = None) -> None:
        speed, steering = float(self.state[SPEED]), float(self.state[STEERING])
        tracker = tracker or self.path
        wheels = steering / self.vehicle.max_steering
        if tracker is not None and speed != 0.0:
            _, wheels = tracker.command(self.state[:3], speed, steering)
        share = min(braking, abs(speed) / CONTROL_S) / self.vehicle.max_braking
        self.step(-math.copysign(min(share, 1.0), speed) if speed else 0.0, wheels)

    def step(self, acceleration: float, steering: float) -> None:
        others = self.others
        if others is not None:
            others.advance(CONTROL_S, self.vehicle.corners(self.state[:3]))
        for step in range(SUBSTEPS):
            if others is not None:
                self._space.move(others.interpolate((step + 1) / SUBSTEPS))
            way = advance(self.state, acceleration, steering, self.vehicle.limits)
            self.log.driven_m += abs(way)
            touched = self._space.touched(*self.state[:3].tolist())
            if touched and not self._touches:
                self.log.contacts.append(ObstacleKind(touched).label)
            self._touches = bool(touched)
            self.time += PHYSICS_S
        clocks = _NO_CLOCKS if others is None else others.clocks
        self.track.append(
            TrackPoint(self.time, self.log.driven_m, self.vehicle.at_middle(self.state[:3]), clocks)
        )
        if np.abs(self.state[:2] - self._space_at).max() > REACH_M - 10.0:
            self.refresh()

    def refresh(self) -> Obstacles:
        """Build the collision world of the obstacles around the car, and return them."""
        there = self.standing(self.state[:2])
        self.enter(there)
        return there

    def standing(self, center: FloatArray, looks_free: int | None = None) -> Obstacles:
        """Return the obstacles around a point, (2,) m, without waiting cars and any car in slot `looks_free`."""
        taken = set(self._around.taken(center, self.time))
        if self._knew is not None:
            new = np.array(sorted(taken - self._knew), dtype=np.int64)
            close = np.hypot(*(self.scenario.lot.slot_xy[new] - self.state[:2]).T) < _WAITS_M
            taken -= set(new[close].tolist())
        self._knew = taken
        return self._around.at_time(center, self.time, sorted(taken - {looks_free}))

    def enter(self, there: Obstacles) -> None:
        if self.others is None:
            self._space = CollisionWorld(self.vehicle, there)
        else:
            self._space = CollisionWorld(self.vehicle, there, self.others.outlines)
            self._space.move(self.others.poses)
        self._space_at = self.state[:2].copy()
