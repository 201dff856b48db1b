"""Which slots are taken: a static-state binary Bayes filter for each, over one session (T §3.3.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from parkenv.mapping.grid import P_FREE, P_OCCUPIED
from parkenv.perception.ranging import CarSightings
from parkenv.perception.sweeps import Sweep
from parkenv.world.lot import Mouth, ParkingLot
from sim_sensors.compilation import compiled

FloatArray = NDArray[np.float64]

CORE = (0.8, 0.45)
"""Half length and half width, m, of the middle of a slot, which every parked car covers."""
MARGIN = 0.35
"""m, that a parked car may stick out of its slot towards the lane."""
INSET = 0.1
"""m, that beams must end within the lines to the neighbours: their cars stand up to there."""
LOOK_LOG_ODDS = 1.2
"""What one look through the middle of a slot, or at something that fills it, adds or takes away."""
MOST_LOG_ODDS = 4.0
"""Bound of what is believed of a slot: a car that comes or goes while the drive lasts is to be noticed."""
_LEAST_BEAMS = 4
_CLEAR = 0.6


@dataclass(frozen=True, eq=False)
class SlotStates:
    """What a session knows of every slot.

    Attributes:
        p_occupied: (n_slots,) float64; 0.5 where nothing was seen.
        in_view: (n_slots,) bool, whether the slot was ever seen well enough to tell.
    """

    p_occupied: FloatArray
    in_view: NDArray[np.bool_]

    @property
    def occupied(self) -> NDArray[np.bool_]:
        """(n_slots,) bool, the indicator of eq. 3.11."""
        return self.p_occupied > 0.5


class SlotFilter:
    """Evidence on each slot in log-odds, from detected cars and from what beams pass through.

    The thesis counts detections alone: a car is put into the nearest slot, and at the end of a session slots without
    a car are free (`thesis_states`). Here a slot that was never in view stays unknown, a car counts only inside of a
    slot, so that traffic and people are not taken for parked cars, and beams that end in a slot or cross its middle
    say taken or free as well.

    Args:
        lot: whose slots.

    Attributes:
        log_odds: (n_slots,) float64, of taken against free.
        in_view: (n_slots,) bool.
        told: (n_slots,) bool, slots on which there has been evidence since somebody cleared this.
    """

    def __init__(self, lot: ParkingLot) -> None:
        self.lot = lot
        self._tree = cKDTree(lot.slot_xy)
        self._size = 0.5 * np.stack([lot.slot_length, lot.slot_width], axis=1)
        open_ended = (lot.slot_mouth == Mouth.REAR)[:, None]
        self._inner = self._size + np.where(open_ended, [MARGIN, -INSET], [-INSET, MARGIN])
        self.log_odds = np.zeros(lot.n_slots)
        self.in_view = np.zeros(lot.n_slots, dtype=np.bool_)
        self.told = np.zeros(lot.n_slots, dtype=np.bool_)
        self._visual = np.zeros(lot.n_slots)

    def slots_of(self, cars: CarSightings) -> NDArray[np.int64]:
        """The slot that each car stands in, (n,) int64; -1 where it stands in none."""
        if not len(cars):
            return np.empty(0, dtype=np.int64)
        nearest = np.asarray(self._tree.query(cars.xy)[1], dtype=np.int64)
        local = self._in_slot(cars.xy, nearest)
        inside = (np.abs(local) <= self._size[nearest] + MARGIN).all(axis=1)
        return np.where(inside, nearest, -1).astype(np.int64)

    def see_cars(self, cars: CarSightings) -> NDArray[np.int64]:
        """Detected cars are in the slots nearest to them; `slots_of` them."""
        slots = self.slots_of(cars)
        if len(cars):
            _, nearest = self._tree.query(cars.xy)
            np.add.at(self._visual, nearest, _logit(P_OCCUPIED))
        there = slots[slots >= 0]
        # One look says it once, however many boxes a car has.
        self.log_odds[np.unique(there)] += _logit(P_OCCUPIED)
        self.in_view[there] = self.told[there] = True
        self._clip()
        return slots

    def see_through(self, sweep: Sweep) -> None:
        """Beams that were aimed at the middle of a slot and ended in the slot, or went on behind it."""
        near = self._near(sweep)
        if not len(near):
            return
        ended, passed = _beams_on_slots(
            sweep.x, sweep.y, np.cos(sweep.angle), np.sin(sweep.angle), sweep.distance,
            self.lot.slot_xy[near], self.lot.slot_yaw[near], self._inner[near], CORE,
        )  # fmt: skip
        looks = ended + passed
        share = ended / np.maximum(looks, 1)
        change = np.where(share > _CLEAR, LOOK_LOG_ODDS, np.where(share < 1.0 - _CLEAR, -LOOK_LOG_ODDS, 0.0))
        change[looks < _LEAST_BEAMS] = 0.0
        self.log_odds[near] += change
        self.in_view[near] |= change != 0.0
        self.told[near] |= change != 0.0
        self._clip()

    def states(self) -> SlotStates:
        """What is known now."""
        p = 1.0 / (1.0 + np.exp(-self.log_odds))
        return SlotStates(np.where(self.in_view, p, 0.5), self.in_view.copy())

    def thesis_states(self) -> SlotStates:
        """The thesis's rule: slots to which a detection went are taken, all others free."""
        evidence = np.where(self._visual > 0.0, self._visual, _logit(P_FREE))
        return SlotStates(1.0 / (1.0 + np.exp(-evidence)), np.ones(self.lot.n_slots, dtype=np.bool_))

    def _clip(self) -> None:
        np.clip(self.log_odds, -MOST_LOG_ODDS, MOST_LOG_ODDS, out=self.log_odds)

    def _near(self, sweep: Sweep) -> NDArray[np.int64]:
        found = self._tree.query_ball_point([sweep.x, sweep.y], min(sweep.reach, 15.0))
        return np.array(sorted(found), dtype=np.int64)

    def _in_slot(self, xy: FloatArray, slot: NDArray[np.int64]) -> FloatArray:
        """Points in the frames of slots, along and across."""
        yaw = self.lot.slot_yaw[slot]
        away = xy - self.lot.slot_xy[slot]
        along = np.cos(yaw) * away[:, 0] + np.sin(yaw) * away[:, 1]
        return np.stack([along, np.cos(yaw) * away[:, 1] - np.sin(yaw) * away[:, 0]], axis=1)


def _logit(p: float) -> float:
    return math.log(p / (1.0 - p))


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
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Of the beams aimed at each slot's core, how many end within the slot, and how many go on behind the core."""
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
    """Where a ray enters and leaves a rectangle about the origin; enter > leave where it misses."""
    enter, leave = -math.inf, math.inf
    for o, u, half in ((ox, ux, half_x), (oy, uy, half_y)):
        if abs(u) < 1e-12:
            if abs(o) > half:
                return math.inf, -math.inf
            continue
        a, b = (-half - o) / u, (half - o) / u
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    return enter, leave
