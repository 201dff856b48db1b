"""Scenes of a parking lot for the simulated sensors."""

import hashlib
from collections import OrderedDict
from dataclasses import replace
from itertools import pairwise

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.world.cue_scene import CueScene
from parkenv.world.lot import Mouth, ParkingLot, is_building
from parkenv.world.occupancy.process import World
from parkenv.world.scenario import Scenario
from parkenv.world.traffic import LotTraffic
from sim_sensors.scene import Scene
from sim_sensors.slot_scenes import SlotLot, slot_surroundings

WALL_HEIGHT = 1.8  # height, m, of walls given as open lines; closed lines are buildings

CARS_APART = 1 << 31  # keys of worlds, modulo this, number their first cars
_KEPT_LOTS = 4
_SLOT_LOTS: OrderedDict[bytes, SlotLot] = OrderedDict()


def slot_lot(lot: ParkingLot, seed: int = 0) -> SlotLot:
    """Convert a lot for `sim_sensors`: `slot_lot(lot).scene(occupied)` is its scene, in which place i is slot i.

    Closed walls become buildings, open ones free-standing walls; `seed` is that of vehicle models and textures. Within
    a process, equal lots share one object: the ground texture and the vehicle meshes take seconds to create, and every
    task of a worker process has a new copy of its lot.
    """
    key = _content(lot, seed)
    if key not in _SLOT_LOTS:
        _SLOT_LOTS[key] = _make_slot_lot(lot, seed)
        if len(_SLOT_LOTS) > _KEPT_LOTS:
            _SLOT_LOTS.popitem(last=False)
    _SLOT_LOTS.move_to_end(key)
    return _SLOT_LOTS[key]


def _content(lot: ParkingLot, seed: int) -> bytes:
    columns = (lot.slot_xy, lot.slot_yaw, lot.slot_length, lot.slot_width, lot.slot_mouth)
    arrays = map(np.asarray, (*columns, *lot.walls, *(lane.points for lane in lot.lanes)))
    parts = (f"{array.shape}{array.dtype}".encode() + array.tobytes() for array in arrays)
    return hashlib.sha256(str(seed).encode() + b"".join(parts)).digest()


def _make_slot_lot(lot: ParkingLot, seed: int) -> SlotLot:
    buildings = [wall[:-1] for wall in lot.walls if is_building(wall)]
    open_walls = [wall for wall in lot.walls if not is_building(wall)]
    legs = [[*start, *end, WALL_HEIGHT] for wall in open_walls for start, end in pairwise(wall)]
    shapes = (lot.slot_xy, lot.slot_yaw, lot.slot_length, lot.slot_width)
    slots = SlotLot(*shapes, kerbside=lot.slot_mouth != Mouth.REAR, seed=seed)
    lanes = [lane.points for lane in lot.lanes]
    around = slot_surroundings(slots, lanes, buildings=buildings, walls=legs, seed=seed)
    return replace(slots, surroundings=around)


class LotScenes:
    """Scenes of one world, that of a key, over time.

    Parked cars, cues of departures and traffic depend only on the world. Consecutive scenes are updated incrementally.
    """

    def __init__(self, slots: SlotLot, scenario: Scenario, key: np.uint64, world: World) -> None:
        self._slots, self._world = slots, world
        self._everything = np.arange(scenario.lot.n_slots)
        self._first_car = int(key) % CARS_APART
        self._traffic = LotTraffic(scenario.lot, scenario.goal, scenario.traffic, key, slots)
        self._cues = None if scenario.cues is None else CueScene(scenario.lot, scenario.cues, key, world)
        self._stretch = np.empty(0, dtype=np.int64)
        self._scene: Scene | None = None

    def at(self, time: float, ego: FloatArray | None = None) -> Scene:
        taken = self._world.occupied(self._everything, time)
        sojourn = self._world.sojourn(self._everything, time)
        if self._scene is None:
            self._scene = self._slots.scene(taken, self._first_car + sojourn)
        else:
            for slot in np.flatnonzero(sojourn != self._stretch).tolist():
                if taken[slot]:
                    car = self._first_car + int(sojourn[slot])
                    self._scene = self._slots.filled(self._scene, slot, car)
                else:
                    self._scene = self._scene.without_vehicle(slot)
        self._stretch = sojourn
        scene = self._scene.with_movers(self._traffic.at(time, ego))
        return scene if self._cues is None else self._cues.added_to(scene, time, ego)
