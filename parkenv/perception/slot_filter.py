"""Slot occupancy from range scans and located cars: one static-state binary Bayes filter per slot (T §3.3.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import erf
from shapely import LineString, STRtree

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.perception.monocular import GroundView, RangingErrors, corners_of_cars
from parkenv.perception.range_scan import RangeScan
from parkenv.perception.ranging import LocatedCars
from parkenv.world.lot import Mouth, ParkingLot

P_FREE, P_OCCUPIED, P_PRIOR = 0.45, 0.95, 0.5  # the observation model of eq. 3.9.
CORE = (0.8, 0.45)  # half the length and width, m, of the core of a slot, which every parked car covers
MARGIN = 0.35  # m; a parked car may extend out of its slot towards the lane by this much
INSET = 0.1  # m; beams must end this far inside the lines to the neighbours, whose cars may be close
SCAN_LOG_ODDS = 1.2  # of a scan whose beams cross a slot's core (negative) or end within it (positive)
MOST_LOG_ODDS = 4.0  # bound of a slot's log-odds: a car that arrives or leaves during the drive is noticed
PARKING_SPREAD_M = (0.35, 0.2)  # standard deviation of a parked car's place along and across its slot, m
CLUTTER_DENSITY = 0.01  # cars outside slots, 1/m²: traffic, and boxes without a car
LEAST_ASSIGNMENT = 0.5  # probability that an observation is of a slot, from which it counts
MOST_MISSED = 0.4  # of cars, by a detector whose silence says nothing: misses of one car resemble one another
VIEW_REACH_M = 12.0  # m, up to which a slot without a car in the picture is held to be free
_CANDIDATES = 8  # slots that a car may stand in
_FREE_LOG_ODDS = 0.5  # against taken, from which a slot is known to be free
_SHOWN_HEIGHT = 0.85  # fraction of a car's height that a picture must show
OCCLUDED = 0.15  # fraction of a slot's place in the picture from which a box hides it
_LEAST_BEAMS, _BEAM_MAJORITY = 4, 0.6


@dataclass(frozen=True, eq=False)
class SlotStates:
    p_occupied: FloatArray  # (n_slots,) float64; 0.5 where nothing was observed
    in_view: NDArray[np.bool_]  # (n_slots,) bool, whether there was any evidence about the slot

    @property
    def occupied(self) -> NDArray[np.bool_]:
        return self.p_occupied > 0.5


class SlotObservation(NamedTuple):
    slots: IntArray  # (k,) int64, ascending
    taken: NDArray[np.bool_]  # (k,) bool

    @classmethod
    def none(cls) -> SlotObservation:
        return cls(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.bool_))


class SlotFilter:
    """Log-odds that each slot is taken, from located cars and from the beams of range scans.

    The thesis uses only detections: a car is assigned to the nearest slot, and slots without a car at the end of a
    session are free. Here a slot that was never in view stays unknown. A car counts only inside a
    slot, so traffic and pedestrians are not mistaken for parked cars. Beams that end within a slot are evidence that
    it is taken; beams that cross its core are evidence that it is free.

    Args:
        lot: the lot with the slots.

    Attributes:
        log_odds: (n_slots,) float64, taken against free.
        in_view: (n_slots,) bool, slots with any evidence.
        updated: (n_slots,) bool, slots with evidence since the caller last cleared this array.
    """

    def __init__(self, lot: ParkingLot) -> None:
        self.lot = lot
        self._tree = cKDTree(lot.slot_xy)
        self._size = 0.5 * np.stack([lot.slot_length, lot.slot_width], axis=1)
        open_ended = (lot.slot_mouth == Mouth.REAR)[:, None]
        self._inner = self._size + np.where(open_ended, [MARGIN, -INSET], [-INSET, MARGIN])
        self.log_odds = np.zeros(lot.n_slots)
        self.in_view = np.zeros(lot.n_slots, dtype=np.bool_)
        self.updated = np.zeros(lot.n_slots, dtype=np.bool_)

    def slots_of(self, cars: LocatedCars) -> IntArray:
        """Return the slot of each car, (n,) int64; -1 for cars outside all slots, or likely so."""
        return self._attributed(cars)[0]

    def headings_near(self, xy: FloatArray) -> FloatArray:
        """Return the heading of cars parked near points, (n,) rad; NaN farther than a slot's length from all slots."""
        away, nearest = self._tree.query(xy)
        return np.where(away <= 2.0 * self._size[nearest, 0], self.lot.slot_yaw[nearest], np.nan)

    def _attributed(self, cars: LocatedCars) -> tuple[IntArray, FloatArray]:
        if not len(cars):
            return np.empty(0, dtype=np.int64), np.empty(0)
        if cars.covariance is None:
            nearest = np.asarray(self._tree.query(cars.xy)[1], dtype=np.int64)
            yaw, away = self.lot.slot_yaw[nearest], cars.xy - self.lot.slot_xy[nearest]
            along = np.cos(yaw) * away[:, 0] + np.sin(yaw) * away[:, 1]
            across = np.cos(yaw) * away[:, 1] - np.sin(yaw) * away[:, 0]
            local = np.stack([along, across], axis=1)
            inside = (np.abs(local) <= self._size[nearest] + MARGIN).all(axis=1)
            return np.where(inside, nearest, -1).astype(np.int64), np.ones(len(cars))
        ranks = list(range(1, min(_CANDIDATES, self.lot.n_slots) + 1))
        near = np.asarray(self._tree.query(cars.xy, k=ranks)[1], dtype=np.int64)
        yaw, away = self.lot.slot_yaw[near], self.lot.slot_xy[near] - cars.xy[:, None]
        axes = np.stack([np.cos(yaw), -np.sin(yaw), np.sin(yaw), np.cos(yaw)], axis=-1)
        axes = (axes * np.array(PARKING_SPREAD_M * 2)).reshape(*near.shape, 2, 2)
        spread = cars.covariance[:, None] + axes @ axes.swapaxes(-1, -2)
        off = (away * np.linalg.solve(spread, away[..., None])[..., 0]).sum(axis=-1)
        density = np.exp(-0.5 * off) / (2.0 * math.pi * np.sqrt(np.linalg.det(spread)))
        share = density / (density.sum(axis=1, keepdims=True) + CLUTTER_DENSITY)
        best = np.arange(len(cars)), share.argmax(axis=1)
        likely = share[best] * cars.probability.astype(np.float64)
        return np.where(likely > LEAST_ASSIGNMENT, near[best], -1).astype(np.int64), likely

    def update_from_cars(self, cars: LocatedCars) -> IntArray:
        """Update the slots of the cars in one image; return `slots_of(cars)`.

        A car that stands in its slot with a probability only is that much less evidence.
        """
        slots, likely = self._attributed(cars)
        there = slots[slots >= 0]
        # One image is one observation, even if a car has several boxes.
        sure = np.zeros(self.lot.n_slots)
        np.maximum.at(sure, there, likely[slots >= 0])
        there = np.unique(there)
        p = P_OCCUPIED if cars.covariance is None else P_PRIOR + sure[there] * (P_OCCUPIED - P_PRIOR)
        self._add(there, np.broadcast_to(_logit(p), there.shape))
        return slots

    def update_from_scan(self, scan: RangeScan) -> None:
        """Update the slots whose core beams cross: taken if beams end within the slot, free if they pass it."""
        near = self._slots_near(scan.x, scan.y, min(scan.max_range, 15.0))
        ended, passed = _beams_on_slots(
            scan.x, scan.y, np.cos(scan.angle), np.sin(scan.angle), scan.distance,
            self.lot.slot_xy[near], self.lot.slot_yaw[near], self._inner[near], CORE,
        )  # fmt: skip
        beams = ended + passed
        share = ended / np.maximum(beams, 1)
        free = np.where(share < 1.0 - _BEAM_MAJORITY, -SCAN_LOG_ODDS, 0.0)
        change = np.where(share > _BEAM_MAJORITY, SCAN_LOG_ODDS, free)
        change[beams < _LEAST_BEAMS] = 0.0
        self._add(near, change)

    def update_from_picture(
        self,
        ground: GroundView,
        vehicle: FloatArray,
        boxes: FloatArray,
        errors: RangingErrors,
        occluded: float = OCCLUDED,
    ) -> None:
        """Update the slots where a picture would show a car, and the detector has found none.

        A slot counts if a car of usual size in it would be whole in the picture; no wall stands before it, nor a slot
        that is not known to be free; and no box at its distance or nearer covers more than a little of the place. Then
        it is free, unless the detector missed the car or the picture shows another slot, as far as position and heading
        are uncertain.

        Args:
            ground: the camera above the ground.
            vehicle: (3,) x, y in m and yaw in rad of the vehicle, world frame.
            boxes: (n, 4) px, all that the detector has found.
            errors: standard deviations of position and heading.
            occluded: fraction of a slot's place in the picture from which a box hides it.
        """
        x, y, yaw = ground.mount.in_world(vehicle)
        near = self._slots_near(x, y, VIEW_REACH_M)
        if not len(near) or errors.detector.missed > MOST_MISSED:
            return
        # Corners of a usual car in each slot, ahead and to the right of the camera.
        to_x, to_y = (self.lot.slot_xy[near] - [x, y]).T
        along, across = corners_of_cars(self.lot.slot_yaw[near] - yaw)
        ahead = (math.cos(yaw) * to_x + math.sin(yaw) * to_y)[:, None] + along
        aside = (math.sin(yaw) * to_x - math.cos(yaw) * to_y)[:, None] + across
        in_front = ahead.min(axis=1) > 0.5
        near, ahead, aside = near[in_front], ahead[in_front], aside[in_front]
        heights = (np.full_like(ahead, z) for z in (0.0, 1.45))
        corners = np.concatenate([ground.pixels(ahead, aside, z) for z in heights], axis=1)
        low, high = corners.min(axis=1), corners.max(axis=1)
        size = np.array([ground.camera.width, ground.camera.height])
        inside = (np.minimum(high, size) - np.maximum(low, 0.0)) / (high - low)
        others = np.concatenate(
            [boxes, np.concatenate([low, high], axis=1)[self.log_odds[near] > -_FREE_LOG_ODDS]]
        )
        common = np.minimum(high[:, None], others[:, 2:]) - np.maximum(low[:, None], others[:, :2])
        covered = common.clip(0.0).prod(axis=2) / (high - low).prod(axis=1)[:, None]
        # A box with its lower edge above the ground at the slot's far end shows a car behind; a nearer slot's is lower.
        end = np.repeat(corners[:, :4, 1].min(axis=1)[:, None], len(others), axis=1)
        end[:, len(boxes) :] = high[:, 1, None] + 1.0
        hidden = ((covered > occluded) & (others[:, 3] >= end)).any(axis=1)
        sights = [LineString([(x, y), self.lot.slot_xy[slot]]) for slot in near]
        hidden |= np.array([len(self._walls.query(s, predicate="intersects")) > 0 for s in sights], np.bool_)
        clear = (inside >= [1.0, _SHOWN_HEIGHT]).all(axis=1) & ~hidden
        near, away = near[clear], np.hypot(*(self.lot.slot_xy[near[clear]] - [x, y]).T)
        shift = np.hypot(errors.position, errors.heading * away)
        sure = erf(self._size[near, 1] / np.maximum(math.sqrt(2.0) * shift, 1e-9))
        evidence = _logit(P_PRIOR + sure * (1.0 / (1.0 + errors.detector.missed) - P_PRIOR))
        self._add(near, -evidence * (sure > LEAST_ASSIGNMENT))

    @cached_property
    def _walls(self) -> STRtree:
        return STRtree([LineString(wall) for wall in self.lot.walls])

    def states(self) -> SlotStates:
        """Return the current estimate."""
        p = 1.0 / (1.0 + np.exp(-self.log_odds))
        return SlotStates(np.where(self.in_view, p, 0.5), self.in_view.copy())

    def observation(self) -> SlotObservation:
        """Return the slots with evidence for one of the states, and that state."""
        slots = np.flatnonzero(self.in_view & (self.log_odds != 0.0))
        return SlotObservation(slots, self.log_odds[slots] > 0.0)

    def _add(self, slots: IntArray, log_odds: FloatArray) -> None:
        self.log_odds[slots] = np.clip(self.log_odds[slots] + log_odds, -MOST_LOG_ODDS, MOST_LOG_ODDS)
        changed = slots[log_odds != 0.0]
        self.in_view[changed] = self.updated[changed] = True

    def _slots_near(self, x: float, y: float, reach: float) -> IntArray:
        return np.array(sorted(self._tree.query_ball_point([x, y], reach)), dtype=np.int64)


def _logit(p: FloatArray | float) -> FloatArray:
    return np.asarray(np.log(p / (1.0 - p)))


@compiled
def _beams_on_slots(
    x: float,
    y: float,
    cosine: FloatArray,
    sine: FloatArray,
    distance: FloatArray,
    slot_xy: FloatArray,
    slot_yaw: FloatArray,
    half_size: FloatArray,
    core: tuple[float, float],
) -> tuple[IntArray, IntArray]:
    """Count, for each slot, the beams toward its core that end within the slot and those that pass the core."""
    n = len(slot_xy)
    ended = np.zeros(n, dtype=np.int64)
    passed = np.zeros(n, dtype=np.int64)
    for s in range(n):
        c, si = math.cos(slot_yaw[s]), math.sin(slot_yaw[s])
        dx, dy = x - slot_xy[s, 0], y - slot_xy[s, 1]
        ox, oy = c * dx + si * dy, c * dy - si * dx
        for b in range(len(distance)):
            reach = distance[b]
            if math.isnan(reach):
                continue
            ux = c * cosine[b] + si * sine[b]
            uy = c * sine[b] - si * cosine[b]
            enter, leave = _crossing(ox, oy, ux, uy, core[0], core[1])
            if leave <= max(enter, 0.0):
                continue
            if reach >= leave:
                passed[s] += 1
                continue
            ex, ey = ox + reach * ux, oy + reach * uy
            if abs(ex) <= half_size[s, 0] and abs(ey) <= half_size[s, 1]:
                ended[s] += 1
    return ended, passed


@compiled
def _crossing(
    ox: float, oy: float, ux: float, uy: float, half_x: float, half_y: float
) -> tuple[float, float]:
    enter, leave = -math.inf, math.inf
    for o, u, half in ((ox, ux, half_x), (oy, uy, half_y)):
        if abs(u) < 1e-12:
            if abs(o) > half:
                return math.inf, -math.inf
            continue
        a, b = (-half - o) / u, (half - o) / u
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    return enter, leave
