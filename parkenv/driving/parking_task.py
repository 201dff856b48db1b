"""Parking tasks: the slot, the start of the car, and the surrounding obstacles."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

import numpy as np
import shapely
from numpy.typing import ArrayLike
from pydantic import AfterValidator, Field

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.collision_world import CollisionWorld, ObstacleKind, Obstacles
from parkenv.driving.drivable_area import DrivableArea
from parkenv.driving.vehicle import STATE_SIZE, VehicleParameters, finite_pose, move_along, placed
from parkenv.errors import InputError
from parkenv.files.field_types import Number, Probability, Validated
from parkenv.world.drive_graph import LANE_OFFSET, linestrings
from parkenv.world.lot import Mouth, ParkingLot
from sim_sensors.slot_scenes import ParkingManners, SlotLot
from sim_sensors.surroundings import Surroundings

KINDS = ("perpendicular", "oblique", "parallel")  # orientation of a slot relative to its lane
# Orientation of a car in a perpendicular or oblique slot; in a parallel slot it faces the direction of traffic.
WAYS = ("nose-in", "back-in")
# Distance, m along both axes, from the slot's centre beyond which obstacles are not part of a task.
REACH = 30.0
# Distance, m along both axes, from the slot's centre beyond which the car has left the area of its task.
AREA = REACH - 3.0
FARTHEST = AREA - 7.0  # greatest `distance` of a start, m
UPRIGHT = math.radians(75.0)  # least angle between a perpendicular slot and its lane, rad

_ASIDE, _ASKEW = 0.2, math.radians(4.0)  # greatest offsets of a start on the lane
_TRIES = 64
_STEP = 0.1
_MOST_KNOWN = 1 << 15
_ARRIVALS = 16  # number of different cars and poses per slot


def _one_of(*known: str) -> AfterValidator:
    def checked(value: str) -> str:
        if value not in known:
            raise ValueError(", ".join(known))
        return value

    return AfterValidator(checked)


@dataclass(frozen=True, eq=False)
class ParkingTask:
    """A slot to park in, the obstacles around it, and the start of the car; public to agents."""

    vehicle: VehicleParameters  # the car
    lot: str  # the lot's name
    slot_id: str  # the slot's name
    kind: str  # one of `KINDS`
    way: str  # one of `WAYS`
    slot: FloatArray  # (3,) float64, x, y in m and yaw in rad of the slot, world frame
    size: tuple[float, float]  # length and width of the slot, m
    target: FloatArray  # (3,) goal of the car's centre, x and y in m, and its yaw, rad
    start: FloatArray  # (6,) state of the vehicle at the start
    obstacles: Obstacles  # parked cars, walls and kerbs within `REACH`

    def __post_init__(self) -> None:
        require_room(self.vehicle, self.size, f"slot {self.slot_id!r} of lot {self.lot!r}")

    @cached_property
    def room(self) -> FloatArray:
        """Free space, (2,) m, in front of and beside a car in the middle of the slot."""
        return 0.5 * np.array([self.size[0] - self.vehicle.length, self.size[1] - self.vehicle.width])

    def in_slot_frame(self, points: FloatArray) -> FloatArray:
        """Transform points, (..., 2) m, into the slot's frame: origin at its centre, x along its yaw."""
        x, y, yaw = self.slot.tolist()
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        local: FloatArray = (points - np.array([x, y])) @ turn
        return local


@dataclass(frozen=True, eq=False)
class ParkingTasks(Validated):
    """Draw parking tasks on one lot; a task is a pure function of a key.

    Args:
        lot: the lot.
        vehicle: the car.
        kinds: kinds of slots to draw from with equal probability; None for all kinds in the lot.
        ways: orientations in perpendicular and oblique slots to draw from with equal probability.
        slot: id of the only slot to park in; None draws one.
        occupancy: fraction of the other slots that are occupied, 0 to 1.
        slack: distance around the slot kept clear of parked cars, m. 0 keeps all neighbours, as misaligned as `manners`
            allows; 3 clears the adjacent slots.
        distance: smallest and largest distance of the start before the slot, m.
        starts: `lane`: on the lane, `distance` before the slot, in either direction of a two-way lane; `way-out`: the
            end of a random drive of `distance` out of the slot; short drives give easy tasks.
        manners: distribution of the poses of parked cars in their slots.

    Raises:
        InputError: a value out of its range; an unknown slot, or one that the car does not fit into; no slot of
            these kinds that it fits into.

    Examples:
        >>> from parkenv.lots import packaged_lot
        >>> task = ParkingTasks(packaged_lot("campus"), kinds=("oblique",)).draw(7)
        >>> task.kind, task.slot_id[0], task.size
        ('oblique', 'F', (5.0, 2.5))
    """

    lot: ParkingLot
    vehicle: VehicleParameters = field(default_factory=VehicleParameters)
    kinds: Annotated[tuple[Annotated[str, _one_of(*KINDS)], ...], Field(min_length=1)] | None = None
    ways: Annotated[tuple[Annotated[str, _one_of(*WAYS)], ...], Field(min_length=1)] = WAYS
    slot: str | None = None
    occupancy: Probability = 0.85
    slack: Annotated[Number, Field(ge=0.0, le=REACH)] = 0.0
    distance: tuple[float, float] = (4.0, 14.0)
    starts: Annotated[str, _one_of("lane", "way-out")] = "lane"
    manners: ParkingManners = field(default_factory=ParkingManners)

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.distance) != 2 or not 0.0 <= self.distance[0] <= self.distance[1] <= FARTHEST:
            raise InputError(f"distance is {self.distance!r}, want least and greatest, 0 to {FARTHEST:g} m")
        if self.slot is not None and self.slot not in self.lot.slot_ids:
            raise InputError(f"lot {self.lot.name!r} has no slot {self.slot!r}")
        if not any(map(len, self._slots_by_kind.values())):
            raise InputError(
                f"lot {self.lot.name!r} has no slot of the kinds {', '.join(self.kinds or KINDS)} that is at least "
                f"{self.vehicle.length:g} m × {self.vehicle.width:g} m, the size of the car"
            )

    @cached_property
    def slot_kinds(self) -> list[str]:
        """The kind of each slot."""
        lot = self.lot
        angle = np.abs(np.sin(lot.slot_yaw - lot.vertex_yaw[: lot.n_slots]))
        upright = np.where(angle >= math.sin(UPRIGHT), KINDS[0], KINDS[1])
        return [str(kind) for kind in np.where(lot.slot_mouth == Mouth.REAR, upright, KINDS[2])]

    @cached_property
    def _slots_by_kind(self) -> dict[str, list[int]]:
        lot, vehicle = self.lot, self.vehicle
        if self.slot is not None:
            i = lot.slot_ids.index(self.slot)
            size = (float(lot.slot_length[i]), float(lot.slot_width[i]))
            require_room(vehicle, size, f"slot {self.slot!r} of lot {lot.name!r}")
            chosen = [i]
        else:
            fits = (lot.slot_length >= vehicle.length) & (lot.slot_width >= vehicle.width)
            chosen = np.flatnonzero(fits).tolist()
        choice: dict[str, list[int]] = {}
        for i in chosen:
            if self.kinds is None or self.slot_kinds[i] in self.kinds:
                choice.setdefault(self.slot_kinds[i], []).append(i)
        return choice

    @cached_property
    def _area(self) -> DrivableArea:
        return DrivableArea(self.lot)

    @cached_property
    def slot_cars(self) -> SlotLot:
        """The cars that may park in the slots."""
        lot = self.lot
        return SlotLot(
            lot.slot_xy,
            lot.slot_yaw,
            lot.slot_length,
            lot.slot_width,
            kerbside=lot.slot_mouth != Mouth.REAR,
            surroundings=Surroundings(),
            manners=self.manners,
        )

    def draw(self, key: int, start: ArrayLike | None = None) -> ParkingTask:
        """Draw the task of a key.

        Args:
            key: at least 0.
            start: (3,) x, y in m and yaw in rad of the rear axle; None draws one.

        Raises:
            InputError: a start that is not three finite numbers, touches an obstacle, or lies outside the `AREA`; or
                no collision-free start was found.
        """
        rng = np.random.default_rng([int(key), 0])
        kinds = sorted(self._slots_by_kind)
        of_kind = self._slots_by_kind[kinds[rng.integers(len(kinds))]]
        i = of_kind[rng.integers(len(of_kind))]
        way = self.ways[rng.integers(len(self.ways))]
        kind, lot = self.slot_kinds[i], self.lot
        if kind == "parallel":
            way = WAYS[0]
        slot = np.array([*lot.slot_xy[i], lot.slot_yaw[i]])
        target = slot + np.array([0.0, 0.0, math.pi if way == WAYS[1] else 0.0])
        obstacles = self._obstacles_around(i, rng)
        space = CollisionWorld(self.vehicle, obstacles)
        if start is None:
            is_out = self.starts == "way-out"
            drawn = self._way_out(target, space, rng) if is_out else self._on_lane(i, space, rng)
            if drawn is None:
                raise InputError(
                    f"slot {lot.slot_ids[i]!r} of lot {lot.name!r}: no start without a contact was found"
                )
        else:
            drawn = self._checked_start(start, slot, space)
        return ParkingTask(
            vehicle=self.vehicle,
            lot=lot.name,
            slot_id=lot.slot_ids[i],
            kind=kind,
            way=way,
            slot=slot,
            size=(float(lot.slot_length[i]), float(lot.slot_width[i])),
            target=target,
            start=np.r_[drawn, np.zeros(STATE_SIZE - 3)],
            obstacles=obstacles,
        )

    @cached_property
    def _outlines(self) -> dict[tuple[int, int], FloatArray]:
        return {}

    def _outline(self, slot: int, arrival: int) -> FloatArray:
        if (slot, arrival) not in self._outlines:
            if len(self._outlines) >= _MOST_KNOWN:
                self._outlines.clear()
            pose, model = self.slot_cars.arrival(slot, arrival)
            self._outlines[slot, arrival] = placed(self.slot_cars.fleet.models[model].footprint(), pose)
        return self._outlines[slot, arrival]

    def _obstacles_around(self, i: int, rng: np.random.Generator) -> Obstacles:
        """The obstacles around slot i, nearest first within each kind."""
        lot = self.lot
        center = lot.slot_xy[i]
        offset = np.abs(lot.slot_xy - center).max(axis=1)
        near = np.flatnonzero((offset <= REACH) & (np.arange(lot.n_slots) != i))
        near = near[rng.random(len(near)) < self.occupancy]
        near = near[np.argsort(offset[near], kind="stable")]
        box = shapely.Polygon(lot.slot_corners()[i])
        outlines: list[tuple[ObstacleKind, FloatArray]] = []
        arrivals = rng.integers(_ARRIVALS, size=len(near))
        for j, arrival in zip(near.tolist(), arrivals.tolist(), strict=True):
            outline = self._outline(j, arrival)
            close = self.slack > 0.0 and offset[j] < self.slack + 12.0
            if not (close and shapely.distance(box, shapely.Polygon(outline)) < self.slack):
                outlines.append((ObstacleKind.PARKED_CAR, outline))
        for thing, lines in (
            (ObstacleKind.KERB, self._area.kerbs(center, REACH)),
            (ObstacleKind.WALL, self._area.walls(center, REACH)),
        ):
            away = shapely.distance(shapely.Point(center), shapely.linestrings(lines))
            outlines += [(thing, line) for line in lines[np.argsort(away, kind="stable")]]
        return Obstacles.of(outlines)

    def _on_lane(self, i: int, space: CollisionWorld, rng: np.random.Generator) -> FloatArray | None:
        """Draw a rear-axle pose on the lane before slot i; None without a free one."""
        lot = self.lot
        lanes = linestrings([lane.points for lane in lot.lanes])
        mouth = shapely.Point(lot.mouth_xy()[i])
        k = int(np.argmin(shapely.distance(lanes, mouth)))
        line, oneway = lanes[k], lot.lanes[k].oneway
        at = float(shapely.line_locate_point(line, mouth))
        heading = np.array([math.cos(lot.vertex_yaw[i]), math.sin(lot.vertex_yaw[i])])
        with_line = 1.0 if _tangent(line, at) @ heading >= 0.0 else -1.0
        for _ in range(_TRIES):
            direction = with_line
            if not oneway and lot.slot_mouth[i] == Mouth.REAR and rng.random() < 0.5:
                direction = -with_line
            station = np.clip(at - direction * rng.uniform(*self.distance), 0.0, line.length)
            ahead = direction * _tangent(line, station)
            right = np.array([ahead[1], -ahead[0]])
            aside = (0.0 if oneway else lot.side * LANE_OFFSET) + rng.uniform(-_ASIDE, _ASIDE)
            xy = shapely.get_coordinates(line.interpolate(station))[0] + aside * right
            yaw = math.atan2(ahead[1], ahead[0]) + rng.uniform(-_ASKEW, _ASKEW)
            pose = self.vehicle.at_rear_axle(np.array([*xy, yaw]))
            if not space.touched(*pose.tolist()):
                return pose
        return None

    def _way_out(
        self, target: FloatArray, space: CollisionWorld, rng: np.random.Generator
    ) -> FloatArray | None:
        """Draw the rear-axle pose at the end of a random drive out of the slot; None for a blocked slot."""
        x, y, yaw = self.vehicle.at_rear_axle(target).tolist()
        if space.touched(x, y, yaw):
            return None
        sharpest = 1.0 / self.vehicle.turning_radius
        left = rng.uniform(*self.distance)
        for _ in range(_TRIES):
            curvature, forward = sharpest * rng.uniform(-1.0, 1.0), rng.choice([-1.0, 1.0])
            for _ in range(int(rng.integers(5, 40))):
                ahead = move_along(x, y, yaw, curvature, forward * min(_STEP, left))
                if left <= 0.0 or space.touched(*ahead):
                    break
                (x, y, yaw), left = ahead, left - _STEP
        return np.array([x, y, yaw])

    def _checked_start(self, start: ArrayLike, slot: FloatArray, space: CollisionWorld) -> FloatArray:
        pose = finite_pose("start", start)
        if np.abs(self.vehicle.at_middle(pose)[:2] - slot[:2]).max() > AREA:
            raise InputError(f"start {pose.tolist()} is more than {AREA:g} m away from the slot")
        touched = ObstacleKind(space.touched(*pose.tolist()))
        if touched:
            raise InputError(
                f"start {pose.tolist()}: the car touches a {touched.label} there, want a free pose"
            )
        return pose


def require_room(vehicle: VehicleParameters, size: tuple[float, float], what: str) -> None:
    for name, own, needed in (("long", size[0], vehicle.length), ("wide", size[1], vehicle.width)):
        if not (math.isfinite(own) and own >= needed):
            raise InputError(f"{what} is {own:g} m {name}, want at least {needed:g} m, the size of the car")


def _tangent(line: shapely.LineString, station: float) -> FloatArray:
    step = 0.05
    low = min(max(station - step, 0.0), line.length - 2 * step)
    ends = [shapely.get_coordinates(line.interpolate(s))[0] for s in (low, low + 2 * step)]
    along = ends[1] - ends[0]
    return np.asarray(along / np.hypot(*along))


@dataclass
class DriveState:
    """Everything that changes during an episode of `parkenv/Drive-v1`."""

    key: np.uint64
    task: ParkingTask  # the parking task; never changes
    vehicle: FloatArray  # (6,) state of the car, see `parkenv.driving.vehicle`
    rng: np.random.Generator  # random generator of the laser's noise
    time: float = 0.0  # time since the start, s
    driven_m: float = 0.0  # distance driven, m
    direction: int = 0  # direction of the last motion: 1 forward, -1 backward, 0 before the first
    direction_changes: int = 0  # number of changes between forward and backward
    contact: str = ""  # name of the obstacle touched, empty without one
    parked: bool = False  # whether the car has parked
    over: bool = False  # whether the episode has ended
    clocks: FloatArray = field(default_factory=lambda: np.empty(0))  # (n,) s, time of each moving road user
    # (n, 3) x, y in m and yaw in rad, poses of the moving road users
    movers: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    # x, y in m and yaw in rad of the rear axle after each step
    trail: list[tuple[float, float, float]] = field(default_factory=list)

    def count(self, way: float, seconds: float) -> None:
        """Count a motion of `way`, m, negative backward, that took `seconds`."""
        self.time += seconds
        if way != 0.0:
            direction = 1 if way > 0.0 else -1
            self.driven_m += abs(way)
            self.direction_changes += direction == -self.direction
            self.direction = direction
