"""Drive a car through a lot: along the lanes, into slots, and back out of slots that turn out to be taken."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.collision_world import ObstacleKind, Obstacles
from parkenv.driving.driven_lines import DrivenEdge, DrivenLine, DrivenLines
from parkenv.driving.parking_task import KINDS, ParkingTasks
from parkenv.driving.vehicle import SPEED, STEERING, VehicleParameters
from parkenv.envs.drive_observation import ANGLE_TOLERANCE, POSITION_TOLERANCE
from parkenv.errors import require
from parkenv.studies.trips.driven_car import (
    ACROSS,
    ALONG,
    NO_ROOM,
    NO_WAY,
    ROUND,
    TAKEN,
    TURN,
    DrivenCar,
    DrivingStyle,
    Leg,
    ParkingAttempt,
)
from parkenv.world.occupancy.process import World
from parkenv.world.scenario import Scenario
from planners.driving.car_path import CarPath, joined, rounded
from planners.driving.hybrid_astar import SearchSettings, plan_path
from planners.driving.path_tracking import LaneKeeper, PathTracker, TrackingSettings

MOST_ROAD_USERS = 200  # maximum number of other cars and pedestrians
TURN_IN_M = 9.0  # distance from the rear axle to the middle of a junction at which the turn begins, m

_LEAD_M = 1.5
_LANE = SearchSettings(change_m=8.0, attempts=((0.25, 0.5), (0.15, 0.5), (0.08, 0.5), (0.03, 0.25)))
TURN_MARGINS = (0.6, 0.3, 0.06)  # margins by which turns are widened if there is room
MERGE_DISTANCES_M = (4.0, 6.5, 9.0, 12.0)  # m after a junction at which a turn into the lane may end
RETURN_DISTANCES_M = (0.0, 3.0, 6.0, 9.0)  # m after a slot or the place where the car turns round
_CHANGE_S = 3.0  # s, approximate time of a change of direction
TYPICAL_SPEED = 1.5  # m/s, approximate speed between changes of direction
_NEAR_M, _ALIGNED = 0.4, math.radians(10.0)
U_TURN_ANGLE = math.radians(150.0)
_STRAYED_M = 1.0
_MOST_PLANS = 6
_NOTICE_STEP = 0.2
_BEND_M = 8.0
_LONGEST_S = 240.0


class VehicleController:
    """Drives a kinematic bicycle model among pymunk bodies, by lane keeping and planned manoeuvres.

    Paths along lanes are straights and arcs. Paths between lanes are planned as if all slots were taken, so they can be
    driven at any time. Parking, turning round and leaving a slot are planned among the cars that are parked there. Cars
    that arrive during a manoeuvre wait until it is over. `car` has the state, log and track of what is driven.
    """

    def __init__(
        self, scenario: Scenario, vehicle: VehicleParameters | None = None, style: DrivingStyle | None = None
    ) -> None:
        self.scenario = scenario
        self.vehicle = vehicle or VehicleParameters()
        self.style = style or DrivingStyle()
        self.car = DrivenCar(scenario, self.vehicle, self.style)
        speed = scenario.v_drive if self.style.speed is None else self.style.speed
        require(
            speed <= self.vehicle.max_speed,
            f"the speed on lanes is {speed:g} m/s, want at most {self.vehicle.max_speed:g}, the car's own",
        )
        others = scenario.traffic.cars + scenario.traffic.pedestrians
        require(
            others <= MOST_ROAD_USERS,
            f"traffic has {others} cars and pedestrians; a driven trip takes at most {MOST_ROAD_USERS}",
        )
        lot = scenario.lot
        self._lines = DrivenLines(lot)
        self._kinds = ParkingTasks(lot).slot_kinds
        self._on_lane = TrackingSettings(
            speed=speed, acceleration=self.style.acceleration, blend_m=2.0, firmness=0.5
        )
        self._turns: dict[tuple[int, int, int, int], CarPath | None] = {}

    def begin(self, key: np.uint64, world: World, vertex: int, time: float) -> None:
        self.car.begin(key, world, vertex, time)
        self._line: int | None = None
        self._placed = False

    def drive(self, source: int, column: int) -> float:
        lot = self.scenario.lot
        target, length = int(lot.neighbors[source, column]), float(lot.edge_length[source, column])
        edge = self._lines.edge(source, target, length)
        began, self.car.track = self.car.time, []
        if not self._placed:
            pose = self._lines.lines[edge.line].pose(edge.start - self.vehicle.middle)
            self.car.place(pose, self._on_lane.speed)
            self._placed = True
        kind = ACROSS
        if not edge.across:
            kind = self._plan_edge(edge)
            self.car.refresh()
            while not self._arrived(edge, target) and self.car.time - began < _LONGEST_S:
                if not self._keep_lane():
                    break
        leg = Leg(kind, length, self.car.time - began)
        self.car.log.legs.append(leg)
        return leg.seconds

    def park(self, slot: int, taken: bool) -> ParkingAttempt:
        """Stop, plan a manoeuvre into a slot and drive it; if it is taken or too narrow, return to the lane.

        The car notices that the slot is `taken` when it is about to drive in.
        """
        lot, vehicle, began = self.scenario.lot, self.vehicle, self.car.time
        self.car.track = []
        self.car.halt(self.style.braking)
        center = 0.5 * (lot.slot_xy[slot] + self.car.state[:2])
        there = self.car.standing(center, slot)
        inside = self.car.parked_outline(slot) if taken else None
        self.car.enter(there if inside is None else _with(there, inside))
        kind = self._kinds[slot]
        pose = np.array([*lot.slot_xy[slot], lot.slot_yaw[slot]])
        targets = {"nose-in": pose, "back-in": pose + np.array([0.0, 0.0, math.pi])}
        if kind == KINDS[2]:
            targets = {"": pose}
        way, reason, onward = "", NO_ROOM, 0.0
        if lot.slot_length[slot] >= vehicle.length and lot.slot_width[slot] >= vehicle.width:
            way, reason = self._drive_in(targets, there, inside)
        if reason:
            onward = self._back(slot)
        result = ParkingAttempt(lot.slot_ids[slot], kind, way, self.car.time - began, reason, onward)
        self.car.log.attempts.append(result)
        return result

    def wait(self, seconds: float) -> float:
        until, self.car.track = self.car.time + seconds, []
        self.car.refresh()
        while self.car.time < until - 1e-9:
            self.car.brake(self.style.braking)
        return seconds

    # --- Lanes

    def _plan_edge(self, edge: DrivenEdge) -> str:
        if self._line == edge.line and self.car.path is not None and not self.car.path.done:
            return ALONG
        line = self._lines.lines[edge.line]
        here = self._lines.lines[self._line] if self._line is not None else None
        before, self._line = self._line, edge.line
        if self._is_on(line):
            self._follow_line(line)
            return ALONG
        if here is not None and self._is_on(here):
            joint = line.pose(edge.start)
            at = here.station_of(joint[:2])
            if _away(here.pose(at), joint) < _NEAR_M / 2 and _askew(here.pose(at), joint) < _ALIGNED:
                now = here.station_of(self.car.state[:2])
                first = here.between(now, at) if at > now + 0.1 else self.car.state[None, :2]
                points = np.concatenate([first, line.between(max(edge.start, 0.1), line.length)])
                self.car.path = LaneKeeper(self.vehicle, rounded(points, _BEND_M), self._on_lane)
                return ALONG
            if _askew(here.pose(at), joint) < U_TURN_ANGLE:
                turn = self._turn(before or 0, edge, at)
                if turn is not None:
                    self.car.path = LaneKeeper(self.vehicle, turn, self._on_lane)
                    return TURN
        return self._turn_onto(line)

    def _follow_line(self, line: DrivenLine) -> None:
        now = line.station_of(self.car.state[:2])
        points = line.between(now, max(line.length, now + 1.0))
        self.car.path = LaneKeeper(self.vehicle, rounded(points, _BEND_M), self._on_lane)

    def _turn(self, before: int, edge: DrivenEdge, at: float) -> CarPath | None:
        """Plan the turn from the car's line to one that crosses it at station `at`; return None if there is none."""
        here, line = self._lines.lines[before], self._lines.lines[edge.line]
        # Measured to the middle of the junction, not to the near side of the other lane.
        now = here.station_of(self.car.state[:2])
        leave = at - TURN_IN_M + _LEAD_M
        if now > leave:
            leave = math.ceil(2.0 * (now + 0.2)) / 2.0
        key = before, edge.line, round(10 * leave), round(10 * edge.start)
        if key not in self._turns:
            there = self.car.all_slots_taken(here.pose(at)[:2])
            path = _path_onto(
                self.vehicle, here.pose(leave), line, edge.start, MERGE_DISTANCES_M, there, TURN_MARGINS
            )
            if path is not None:
                ends = line.station_of(path.sampled()[0][-1, :2])
                if line.length - ends > 0.5:
                    path = joined(path, rounded(line.between(ends, line.length), _BEND_M))
            self._turns[key] = path
        path = self._turns[key]
        if path is None:
            return None
        return joined(rounded(here.between(now, leave), _BEND_M), path)

    def _turn_onto(self, line: DrivenLine) -> str:
        self.car.halt(self.style.braking)
        askew = 0.0
        for _ in range(_MOST_PLANS):
            now = line.station_of(self.car.middle[:2])
            askew = max(askew, _askew(line.pose(now), self.car.pose))
            there = self.car.refresh()
            onward = MERGE_DISTANCES_M if askew < U_TURN_ANGLE else RETURN_DISTANCES_M
            path = _path_onto(self.vehicle, self.car.pose, line, now, onward, there, TURN_MARGINS[-1:])
            if path is None:
                break
            tracker = PathTracker(self.vehicle, path)
            self.car.follow(tracker)
            if tracker.done:
                break
            self.car.log.strays += 1
        if not self._is_on(line):
            self._rescue(line)
        self._follow_line(line)
        return TURN if askew < U_TURN_ANGLE else ROUND

    def _keep_lane(self) -> bool:
        assert self.car.path is not None
        pose, speed, steering = self.car.pose, float(self.car.state[SPEED]), float(self.car.state[STEERING])
        command = self.car.path.command(pose, speed, steering)
        if self.car.path.done:
            return False
        if abs(self.car.path.offset) > _STRAYED_M:
            self.car.log.strays += 1
            assert self._line is not None
            self._turn_onto(self._lines.lines[self._line])
            return True
        if not self.car.yields(self.car.path):
            self.car.step(*command)
        return True

    def _arrived(self, edge: DrivenEdge, target: int) -> bool:
        goal = self._lines.lines[edge.line].pose(edge.end)
        slot = target < self.scenario.lot.n_slots
        own = self.car.middle if slot else self.car.pose
        c, s = math.cos(goal[2]), math.sin(goal[2])
        dx, dy = own[0] - goal[0], own[1] - goal[1]
        ahead, aside = c * dx + s * dy, c * dy - s * dx
        if _askew(goal, own) > math.radians(60.0) or abs(aside) > 3.0:
            return False
        return bool(ahead >= (0.0 if slot else -TURN_IN_M))

    def _is_on(self, line: DrivenLine) -> bool:
        pose = line.pose(line.station_of(self.car.state[:2]))
        return _away(pose, self.car.pose) < _NEAR_M and _askew(pose, self.car.pose) < _ALIGNED

    # --- Manoeuvres

    def _drive_in(
        self, targets: dict[str, FloatArray], there: Obstacles, inside: FloatArray | None
    ) -> tuple[str, str]:
        """Drive to the target with the fastest path; return its name, and the reason of a failure."""
        ways = list(targets)
        for _ in range(_MOST_PLANS):
            obstacles = there.corners, there.n_corners, self.car.pose
            goals = {way: self.vehicle.at_rear_axle(targets[way]) for way in ways}
            planned = {way: plan_path(self.vehicle, *obstacles, goal) for way, goal in goals.items()}
            paths = {way: path for way, path in planned.items() if path is not None}
            if not paths:
                return ways[0] if len(ways) == 1 else "", NO_WAY
            way = min(paths, key=lambda w: _seconds_of(paths[w]))
            ways = [way]
            tracker = PathTracker(self.vehicle, paths[way])
            notices = None if inside is None else self._noticing(tracker, inside)
            if not self.car.follow(tracker, notices):
                return way, TAKEN
            own = self.car.middle
            if (
                tracker.done
                and _away(targets[way], own) <= POSITION_TOLERANCE
                and _askew(targets[way], own) <= ANGLE_TOLERANCE
            ):
                return way, ""
            self.car.log.strays += 1
        return way, NO_WAY

    def _noticing(self, tracker: PathTracker, inside: FloatArray) -> Callable[[], bool]:
        body = shapely.Polygon(inside)
        ahead = np.arange(0.0, self.style.notice_m + _NOTICE_STEP, _NOTICE_STEP)

        def notices() -> bool:
            corners = self.vehicle.corners(tracker.poses_ahead(ahead))
            return bool(shapely.intersects(shapely.polygons(corners), body).any())

        return notices

    def _back(self, slot: int) -> float:
        """Drive back onto the slot's lane or the previous one, whichever is faster; return `onward_m`."""
        ways = [self._lines.at(slot)]
        if self._line is not None and self._line != ways[0][0]:
            line = self._lines.lines[self._line]
            ways.append((self._line, line.station_of(self.scenario.lot.vertex_xy[slot])))
        there = self.car.refresh()
        self.car.path = None
        for _ in range(_MOST_PLANS):
            if any(self._is_on(self._lines.lines[index]) for index, _ in ways):
                break
            best: tuple[float, CarPath, int] | None = None
            for index, station in ways:
                line = self._lines.lines[index]
                for onward in RETURN_DISTANCES_M:
                    pose = line.pose(min(station + onward, line.length) - self.vehicle.middle)
                    path = plan_path(self.vehicle, there.corners, there.n_corners, self.car.pose, pose)
                    if path is not None and (best is None or _seconds_of(path) < best[0]):
                        best = _seconds_of(path), path, index
            if best is None:
                self._rescue(self._lines.lines[ways[0][0]])
                break
            _, path, self._line = best
            tracker = PathTracker(self.vehicle, path)
            self.car.follow(tracker)
            if tracker.done:
                break
            self.car.log.strays += 1
        index, station = next((way for way in ways if way[0] == self._line), ways[0])
        own = self._lines.lines[index].station_of(self.car.middle[:2])
        return own - station

    def _rescue(self, line: DrivenLine) -> None:
        self.car.rescue(line.pose(line.station_of(self.car.state[:2])))


def _path_onto(
    vehicle: VehicleParameters,
    start: FloatArray,
    line: DrivenLine,
    at: float,
    onward: Sequence[float],
    there: Obstacles,
    reserves: Sequence[float],
) -> CarPath | None:
    """Plan the fastest path from a pose onto a line, with the widest turn possible without reversing."""
    best: tuple[float, CarPath] | None = None
    for reserve in reserves:
        settings = SearchSettings(
            change_m=_LANE.change_m,
            reserve=reserve,
            attempts=_LANE.attempts,
            most_expansions=4000 if reserve > TURN_MARGINS[-1] else _LANE.most_expansions,
        )
        for ahead in onward:
            station = min(at + ahead, line.length - 0.3)
            path = plan_path(vehicle, there.corners, there.n_corners, start, line.pose(station), settings)
            if path is None:
                continue
            cost = _seconds_of(path) - ahead / TYPICAL_SPEED
            if best is None or cost < best[0]:
                best = cost, path
            if path.length.min() > 0.0:
                break
        if best is not None and best[1].length.min() > 0.0:
            break
    return None if best is None else best[1]


def _with(there: Obstacles, outline: FloatArray) -> Obstacles:
    things = [(ObstacleKind(t), o) for t, o in zip(there.kind.tolist(), there.outlines(), strict=True)]
    return Obstacles.of([*things, (ObstacleKind.PARKED_CAR, outline)])


def _seconds_of(path: CarPath) -> float:
    changes = path.direction_changes + (len(path.length) > 0 and path.length[0] < 0.0)
    return path.driven_m / TYPICAL_SPEED + _CHANGE_S * changes


def _away(a: FloatArray, b: FloatArray) -> float:
    return math.hypot(a[0] - b[0], a[1] - b[1])


def _askew(a: FloatArray, b: FloatArray) -> float:
    return abs(math.remainder(float(a[2] - b[2]), 2.0 * math.pi))
