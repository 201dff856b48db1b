"""Survey a lot as a driver would: every slot reached, entered and left again, lanes clear, one-way loops closed.

A slot's manoeuvre is planned in a scene of its kind: cars parked in the slots beside it, an obstacle across the aisle.
The planner is the one that drives the car of `parkenv/Drive-v1`. Its path can be driven in both directions, so a car
that gets in also gets out. Slots of one kind (angle, size, width of the aisle) share a plan.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from parkenv.compiled.arrays import IntArray
from parkenv.driving.vehicle import VehicleParameters
from parkenv.lots.draft import QualityIssue, combined_error_probability
from parkenv.lots.formats.contents import LotProblem
from parkenv.lots.slot_polygons import nearest_on_lanes
from parkenv.world.drive_graph import linestrings
from parkenv.world.lot import Mouth, ParkingLot, corner_points, is_building, mouth_heading

CAR_ROOM = 1.0  # half the width, m, that a car needs on a lane: 1.8 m and the mirrors
WIDEST = 8.0  # width of an aisle, m, from which more makes no difference
TWO_WAY_WIDTH = 4.5
"""Least distance, m, between the obstacles on both sides of a two-way lane with slots."""
APPROACH = 9.0  # distance, m, before the slot at which a manoeuvre starts
MOST_CHANGES = 4  # largest number of changes of direction of a manoeuvre
PARKED = 4  # number of cars parked on either side of the slot
FAR, KERB_GAP = 30.0, 0.3  # half the length of the scene, and the room to its kerbs, m
NAMED = 3  # number of slots named in a message


@dataclass(frozen=True, order=True)
class ManoeuvreKind:
    """What decides whether a car gets into a slot; sizes are rounded down, in cm and degrees."""

    slant: int  # degrees between the lane's direction and the parked car: 0 kerbside, 90 perpendicular
    aisle: int  # cm, free width before the mouth
    width: int  # cm, of the slot
    length: int  # cm, of the slot

    def __str__(self) -> str:
        return (
            f"slots of {self.length / 100:g} × {self.width / 100:g} m at {self.slant}° to an aisle "
            f"{self.aisle / 100:g} m wide"
        )

    def is_easier_than(self, other: ManoeuvreKind) -> bool:
        """Whether a car that gets into the other kind gets into this one."""
        return self.slant == other.slant and all(
            getattr(self, name) >= getattr(other, name) for name in ("aisle", "width", "length")
        )


@dataclass(frozen=True)
class Drivability:
    """The result of a survey."""

    problems: tuple[LotProblem, ...]  # warnings; none for a lot that can be driven throughout
    issues: tuple[QualityIssue, ...]  # what may be wrong with it, also of the import
    kinds: int  # number of kinds of manoeuvres
    planned: int  # number of them that were planned within the time

    @property
    def error_probability(self) -> float:
        """Probability, 0 to 1, that the lot is wrong."""
        return combined_error_probability(self.issues)


def check_drivability(
    lot: ParkingLot,
    issues: tuple[QualityIssue, ...] = (),
    vehicle: VehicleParameters | None = None,
    seconds: float = 20.0,
    *,
    drive: bool = True,
) -> Drivability:
    """Survey a lot; with `drive`, for so many seconds plan the manoeuvres of the car that parks.

    `issues` are what may be wrong with the lot, as its import knows.
    """
    kinds, member = manoeuvre_kinds(lot) if drive else ([], np.zeros(lot.n_slots, dtype=np.int64))
    problems = [*_open_loops(lot), *_blocked_lanes(lot)]
    car = vehicle or VehicleParameters()
    count = np.bincount(member, minlength=len(kinds))
    deadline = time.perf_counter() + seconds
    known: dict[ManoeuvreKind, bool] = {}
    planned = 0
    # The hardest kinds first: they settle the easier ones.
    for kind in sorted(kinds, key=lambda k: (k.slant, k.aisle, k.width, k.length)):
        if any(ok and kind.is_easier_than(other) for other, ok in known.items()):
            known[kind] = True
        elif any(not ok and other.is_easier_than(kind) for other, ok in known.items()):
            known[kind] = False
        elif time.perf_counter() < deadline:
            known[kind] = can_park(kind, car)
        planned += kind in known
    stuck = 0
    for k, kind in enumerate(kinds):
        if known.get(kind, True):
            continue
        slots = np.flatnonzero(member == k)
        stuck += len(slots)
        problems.append(LotProblem("warning", None, f"the car gets into no {kind}: {_named(lot, slots)}"))
    reasons = list(issues)
    if stuck:
        reasons.append(
            QualityIssue("slots that the car does not get into", min(0.9, 0.1 + stuck / lot.n_slots))
        )
    if len(problems) > sum("gets into no" in p.message for p in problems):
        reasons.append(QualityIssue("lanes that are blocked or lead nowhere", 0.5))
    unplanned = int(sum(count[k] for k, kind in enumerate(kinds) if kind not in known))
    if unplanned:
        reasons.append(
            QualityIssue("manoeuvres that were not planned in time", 0.3 * unplanned / lot.n_slots)
        )
    return Drivability(tuple(problems), tuple(reasons), len(kinds), planned)


def manoeuvre_kinds(lot: ParkingLot) -> tuple[list[ManoeuvreKind], IntArray]:
    """Return the kinds of manoeuvres of a lot, and the kind of each slot, (n_slots,)."""
    mouth = lot.mouth_xy()
    nearest, tangent, _ = nearest_on_lanes(lot.lanes, mouth)
    heading = mouth_heading(lot.slot_yaw, lot.slot_mouth)
    outward = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    left = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    across = left * np.where((left * outward).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    # A lane may end before a slot, or bend around it.
    to_lane = nearest - mouth
    distance = np.hypot(to_lane[:, 0], to_lane[:, 1])
    is_apart = (distance > 0.3)[:, None]
    across = np.where(is_apart, to_lane / np.maximum(distance, 0.3)[:, None], across)
    sine = np.clip(np.abs((across * outward).sum(axis=1)), 0.0, 1.0)
    slant = np.where(lot.slot_mouth == Mouth.REAR, np.degrees(np.arcsin(sine)), 0.0)
    along = np.stack([-outward[:, 1], outward[:, 0]], axis=1)
    boxes = shapely.polygons(
        corner_points(lot.slot_xy, lot.slot_yaw, lot.slot_length - 0.1, lot.slot_width - 0.1)
    )
    scene = np.concatenate([np.atleast_1d(np.asarray(boxes)), _walls(lot)])
    tree = shapely.STRtree(scene)
    mouth_side = np.where(lot.slot_mouth == Mouth.REAR, lot.slot_width, lot.slot_length)
    clear = np.full((3, lot.n_slots), WIDEST)
    for j, share in enumerate((-0.35, 0.0, 0.35)):
        start = mouth + share * mouth_side[:, None] * along + 0.1 * across
        rays = np.asarray(shapely.linestrings(np.stack([start, start + WIDEST * across], axis=1)))
        ray, thing = tree.query(rays, predicate="intersects")
        # Neighbours at an oblique row reach before the mouth beside them.
        hit = shapely.distance(
            np.asarray(shapely.points(start))[ray], shapely.intersection(rays[ray], scene[thing])
        )
        ahead = (thing != ray) & (hit > 0.5)
        np.minimum.at(clear[j], ray[ahead], hit[ahead] + 0.1)
    aisle = np.minimum(clear[1], np.median(clear, axis=0))
    columns = np.stack(
        [
            np.round(slant / 5.0) * 5.0,
            np.floor(np.clip(aisle, 0.0, WIDEST) * 4.0 + 0.2) * 25.0,
            np.floor(np.minimum(lot.slot_width, 2.6) * 20.0 + 0.2) * 5.0,
            np.floor(np.clip(lot.slot_length, 4.4, 6.6) * 5.0 + 0.1) * 20.0,
        ],
        axis=1,
    ).astype(int)
    unique, member = np.unique(columns, axis=0, return_inverse=True)
    return [ManoeuvreKind(*map(int, row)) for row in unique], np.asarray(member, dtype=np.int64).reshape(-1)


@lru_cache(maxsize=4096)
def can_park(kind: ManoeuvreKind, vehicle: VehicleParameters) -> bool:
    """Whether the planner gets a car into a slot of a kind, nose or tail first, with cars in the slots beside it."""
    from planners.driving.hybrid_astar import SearchSettings, plan_path

    angle, aisle, width, length = (
        np.radians(kind.slant),
        kind.aisle / 100,
        kind.width / 100,
        kind.length / 100,
    )
    if kind.slant < 10:
        center, step = np.array([0.0, width / 2]), np.array([length, 0.0])
    else:
        nose = np.array([np.cos(angle), np.sin(angle)])
        center, step = nose * length / 2, np.array([width / np.sin(angle), 0.0])
    yaw = angle if kind.slant >= 10 else 0.0
    # Neighbours as far as the car can swing.
    beside = center + np.array([k for k in range(-PARKED, PARKED + 1) if k])[:, None] * step
    cars = corner_points(
        np.concatenate([beside, center[None]]),
        np.full(len(beside) + 1, yaw),
        np.full(len(beside) + 1, vehicle.length),
        np.full(len(beside) + 1, vehicle.width),
    )
    # An obstacle across the aisle, kerbs behind the slots and along the aisle beyond the parked cars.
    behind = max(float(cars[-1, :, 1].max()), length * np.sin(angle)) + KERB_GAP
    row = (PARKED + 0.5) * float(step[0])
    kerbs = [
        [[-FAR, -aisle], [FAR, -aisle]],
        [[-FAR, behind], [FAR, behind]],
        [[-FAR, KERB_GAP], [-row, KERB_GAP]],
        [[row, KERB_GAP], [FAR, KERB_GAP]],
    ]
    outlines = np.zeros((len(beside) + len(kerbs), 4, 2))
    outlines[: len(beside)], outlines[len(beside) :, :2] = cars[:-1], kerbs
    corners = np.r_[np.full(len(beside), 4), np.full(len(kerbs), 2)]
    lane = -float(np.clip(aisle / 2, vehicle.width / 2 + 0.15, 2.0))
    start = vehicle.at_rear_axle(np.array([-APPROACH, lane, 0.0]))
    settings = SearchSettings(
        attempts=((0.10, 0.5), (0.05, 0.5), (0.02, 0.25)), most_expansions=8000, patience=0.0
    )
    ways = (0.0, np.pi) if kind.slant >= 10 else (0.0,)
    for way in ways:
        target = vehicle.at_rear_axle(np.array([*center, yaw + way]))
        path = plan_path(vehicle, outlines, corners, start, target, settings)
        if path is not None and path.direction_changes <= MOST_CHANGES:
            return True
    return False


def _named(lot: ParkingLot, slots: IntArray) -> str:
    listed = ", ".join(repr(lot.slot_ids[i])[:42] for i in slots[:NAMED].tolist())
    return f"{len(slots)} slots ({listed}{', ...' if len(slots) > NAMED else ''})"


def _walls(lot: ParkingLot) -> NDArray[np.object_]:
    shapes = [
        shapely.make_valid(shapely.Polygon(wall)) if is_building(wall) else shapely.LineString(wall)
        for wall in lot.walls
    ]
    return np.array(shapes, dtype=object)


def _open_loops(lot: ParkingLot) -> list[LotProblem]:
    """Return a warning if some slots cannot be reached again after others."""
    n = lot.n_slots
    _, part = connected_components(lot.drive_matrix(), connection="strong")
    size = np.bincount(part[:n])
    main = int(np.argmax(size))
    apart = np.flatnonzero(part[:n] != main)
    if not len(apart):
        return []
    return [
        LotProblem(
            "warning",
            None,
            f"one-way lanes form no loop: a car that passed {_named(lot, apart)} does not get back to the others",
        )
    ]


def _blocked_lanes(lot: ParkingLot) -> list[LotProblem]:
    """Return warnings about lanes that lead over slots or walls."""
    boxes = np.asarray(
        shapely.polygons(
            corner_points(lot.slot_xy, lot.slot_yaw, lot.slot_length - 0.2, lot.slot_width - 0.2)
        )
    )
    things = np.concatenate([np.atleast_1d(boxes), _walls(lot)])
    lanes = linestrings([lane.points for lane in lot.lanes])
    lane, thing = shapely.STRtree(things).query(lanes, predicate="dwithin", distance=CAR_ROOM)
    problems = []
    for k in np.unique(lane).tolist():
        slots = thing[(lane == k) & (thing < lot.n_slots)]
        x, y = lot.lanes[k].points.mean(axis=0)
        what = f"the slot {lot.slot_ids[int(slots[0])]!r:.40}" if len(slots) else "a wall"
        problems.append(
            LotProblem(
                "warning", None, f"the lane at ({x:.1f}, {y:.1f}) m leaves less than {CAR_ROOM:g} m to {what}"
            )
        )
    return problems
