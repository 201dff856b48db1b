"""What sensors can see of cars that leave: somebody who walks up and gets in, lamps, a car that moves out.

With E the departure and L the time from the first cue to it, somebody walks to the driver's door until E - L and gets
in; lamps are lit from E - `LAMPS_S` on; and the car moves out at the end, for `Cues.moving_s`. L cuts each short. False
alarms are cars that have just been backed in: their lamps are still lit.
"""

from __future__ import annotations

import math

import numpy as np

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.keyed_random import LEAVING_STREAM, keyed_uniform
from parkenv.world.cues import Cues
from parkenv.world.lot import Mouth, ParkingLot
from parkenv.world.occupancy.kernel import shown_s
from parkenv.world.occupancy.process import World
from parkenv.world.traffic import HALF_CAR, HALF_PERSON, STRIDE_M, clear_of
from sim_sensors.mesh import Lamps
from sim_sensors.movers import LOOKS, Movers
from sim_sensors.scene import Scene

# Assumptions; what is known is how long drivers take from the open door on (`parkenv.world.cues.LEAD_S`).
WALK_S, WALK_SPEED = 10.0, 1.2  # of the walk to the door that can be seen, s, m/s
DOOR_S = 5.0  # s, from the first cue until the driver is inside
LAMPS_S = 10.0
ARRIVED_S = 5.0  # for which lamps of a car that was backed in stay lit

_DOOR_M = (0.3, 0.4)  # place of a driver at the door: ahead of the car's middle, from its side
_KERB_AHEAD_M, _KERB_TURN = 0.6, 0.2  # of a car that pulls out from a kerb
_STEPS = np.linspace(0.0, 1.0, 9)  # of the way out, on which others may stand in the way


class CueScene:
    """Cues of one world over time: a pure function of (key, slot, time)."""

    def __init__(self, lot: ParkingLot, cues: Cues, key: np.uint64, world: World) -> None:
        self._lead_s, self._moving_s, self._key, self._world = cues.lead_s, cues.moving_s, key, world
        self._yaw, self._left_hand = lot.slot_yaw, lot.left_hand
        self._at_kerb = lot.slot_mouth != Mouth.REAR
        way = lot.mouth_xy() - lot.slot_xy
        half = np.hypot(*way.T)
        self._mouth, self._out = lot.mouth_xy(), way / half[:, None]
        self._deep, self._width = (
            2.0 * half + 0.2 * self._at_kerb,
            np.where(self._at_kerb, 0.0, lot.slot_width),
        )
        self._others = np.concatenate([lot.slot_corners().reshape(-1, 2), self._mouth])

    def added_to(self, scene: Scene, time: float, ego: FloatArray | None) -> Scene:
        """Return a scene of parked cars with the cues at a time, s.

        As with traffic, nobody is in the way of the searching car at `ego`, (3,) x, y, yaw: a car waits until it can
        move on, and people are hidden.
        """
        slots, people = scene.present, []
        for slot, end in zip(slots.tolist(), self._world.next_free(slots, time).tolist(), strict=True):
            left = end - time
            lead = shown_s(self._key, slot, end, self._lead_s) if left < math.inf else 0.0
            door_s = min(DOOR_S, lead / 3.0)
            if lead - door_s < left <= lead + WALK_S:
                people.append(self._driver(scene, slot, end, max(left - lead, 0.0)))
            elif left <= min(lead, LAMPS_S):
                scene = self._leaving(scene, slot, left, lead, ego)
        scene = self._arrived(scene, slots, time)
        if not people:
            return scene
        pose, stride, look = (np.array(column) for column in zip(*people, strict=True))
        clear = np.full(len(pose), True) if ego is None else clear_of(ego, pose, HALF_PERSON)
        walkers = Movers(walker_pose=pose, walker_stride=stride, walker_look=look)
        return scene.with_movers(walkers.only(np.empty(0, np.bool_), clear).joined(scene.movers))

    def _draw(self, slot: int, end: float, number: int) -> float:
        return float(keyed_uniform(self._key, LEAVING_STREAM, slot, 4 * int(end * 1000.0) + number))

    def _driver(self, scene: Scene, slot: int, end: float, left: float) -> tuple[FloatArray, float, int]:
        """Return pose, phase of the stride, and looks, `left` s before the driver is at the door."""
        x, y, yaw = scene.vehicle_pose[slot]
        side = (0.5 * scene.vehicle_boxes[slot, 1] + _DOOR_M[1]) * (-1.0 if self._left_hand else 1.0)
        c, s = math.cos(yaw), math.sin(yaw)
        door = np.array([x + c * _DOOR_M[0] - s * side, y + s * _DOOR_M[0] + c * side])
        out = self._out[slot]
        # To the mouth along the row, then along the car
        corner = door + max(out @ (self._mouth[slot] - door) + 0.6, 0.0) * out
        row = np.array([-out[1], out[0]]) * (1.0 if self._draw(slot, end, 1) < 0.5 else -1.0)
        beside, walked = float(np.hypot(*(corner - door))), WALK_SPEED * left
        if walked < beside:
            place, ahead = door + walked * out, -out
        else:
            place, ahead = corner + (walked - beside) * row, -row
        pose = np.array([*place, math.atan2(ahead[1], ahead[0])])
        return pose, walked / STRIDE_M % 1.0, int(LOOKS * self._draw(slot, end, 2))

    def _leaving(self, scene: Scene, slot: int, left: float, lead: float, ego: FloatArray | None) -> Scene:
        pose, out = scene.vehicle_pose[slot], self._out[slot]
        reverses = not self._at_kerb[slot] and math.cos(pose[2]) * out[0] + math.sin(pose[2]) * out[1] < 0.0
        lamps = Lamps.TAIL | Lamps.HEAD | (Lamps.REVERSING if reverses else Lamps(0))
        share = max(1.0 - left / max(min(lead, self._moving_s), 1e-6), 0.0)
        way = [self._moved(slot, pose, s * s * (3.0 - 2.0 * s)) for s in share * _STEPS]
        clear = np.full(len(way), True) if ego is None else clear_of(ego, np.array(way), HALF_CAR)
        moved = way[-1] if clear.all() else way[max(int(clear.argmin()) - 1, 0)]
        return scene.with_vehicle(slot, pose=moved, lamps=lamps)

    def _moved(self, slot: int, pose: FloatArray, share: float) -> FloatArray:
        x, y = pose[:2] + share * self._way_out(slot) * self._out[slot]
        if not self._at_kerb[slot]:
            return np.array([x, y, pose[2]])
        ahead, out = np.array([math.cos(pose[2]), math.sin(pose[2])]), self._out[slot]
        x, y = [x, y] + share * _KERB_AHEAD_M * ahead
        turn = math.copysign(_KERB_TURN, ahead[0] * out[1] - ahead[1] * out[0]) * math.sin(math.pi * share)
        return np.array([x, y, pose[2] + turn])

    def _way_out(self, slot: int) -> float:
        """Return how far a car moves, m: out of its slot, but not into those across the aisle."""
        out, away = self._out[slot], self._others - self._mouth[slot]
        ahead, aside = away @ out, np.abs(away @ [-out[1], out[0]])
        aisle = ahead[(ahead > 0.5) & (aside < 0.5 * self._width[slot])]
        return float(min(self._deep[slot], aisle.min(initial=np.inf) - 0.4))

    def _arrived(self, scene: Scene, slots: IntArray, time: float) -> Scene:
        begin = getattr(self._world, "arrival", None)
        before = time - ARRIVED_S
        if begin is None or before < begin.time:
            return scene
        new = self._world.sojourn(slots, time) != self._world.sojourn(slots, before)
        for slot in slots[new & ~self._at_kerb[slots]].tolist():
            yaw, out = scene.vehicle_pose[slot, 2], self._out[slot]
            if math.cos(yaw) * out[0] + math.sin(yaw) * out[1] > 0.0:
                lamps = Lamps.TAIL | Lamps.REVERSING | Lamps.HEAD
                scene = scene.with_vehicle(slot, lamps=lamps)
        return scene
