"""Scenes of parking slots and their occupancy: vehicle models and parking poses."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike

from parkenv.compiled.arrays import FloatArray, IntArray
from sim_sensors.errors import SensorError, as_floats, as_integers, require_numbers, require_seed
from sim_sensors.scene import NO_VEHICLE, Fleet, Scene
from sim_sensors.surroundings import Surroundings
from sim_sensors.vehicles.vehicle import VehicleModel

LINE_M = 0.10  # width of painted slot lines
LIBRARY_MODELS = 100  # number of vehicle models from which cars are drawn
PAVED_MARGIN_M = 7.0
KERB_ROOM_M = 0.1  # m by which a kerbside slot must be wider than its car
# m; least distance between a car and the closed end of its slot, where another row may begin.
NOSE_GAP_M = 0.05


@dataclass(frozen=True)
class ParkingManners:
    """Distribution of parking poses.

    The offsets of a car are normally distributed with these standard deviations. They are clipped at three standard
    deviations and such that the car's rectangle stays within its slot; a car that is too long extends out of the open
    end. A model is used only in slots that it fits.
    """

    lateral_m: float = 0.12  # standard deviation across the slot, m
    along_m: float = 0.20  # standard deviation along the slot, m
    yaw_rad: float = float(np.radians(1.5))  # standard deviation of the heading, rad
    # fraction of cars that parked in reverse, opposite to the slot's yaw; none in kerbside slots
    nose_out: float = 0.25
    door_room_m: float = 0.40  # m by which a slot must be wider than its car, except kerbside slots
    # m by which a car may be longer than its slot; in a kerbside slot it must be shorter by this
    overhang_m: float = 0.20

    def __post_init__(self) -> None:
        require_numbers(self, "lateral_m along_m yaw_rad door_room_m overhang_m", least=0.0)
        require_numbers(self, "nose_out", least=0.0, most=1.0)


@lru_cache(maxsize=1)
def vehicle_library() -> tuple[VehicleModel, ...]:
    """Return the vehicle models from which cars are drawn, with bodies, sizes and paints drawn by frequency."""
    return tuple(VehicleModel.from_seed(None, seed) for seed in range(LIBRARY_MODELS))


@dataclass(frozen=True, eq=False)
class SlotLot:
    """Parking slots, and the car of each arrival.

    The model and pose of a car depend only on (seed, slot, arrival), not on other slots or the order of arrivals.

    Args:
        slot_xy: (n, 2) m, centres.
        slot_yaw: (n,) rad, heading of a car that is parked nose-in.
        slot_length: (n,) or () m, along the yaw.
        slot_width: (n,) or () m.
        kerbside: (n,) or () bool, slots that lie along the lane.
        surroundings: ground and scenery; None: asphalt under and around the slots, and painted lines.
        manners: distribution of parking poses.
        seed: 0 or more.

    Raises:
        SensorError: a shape or value is wrong, or no model fits a slot.
    """

    slot_xy: ArrayLike
    slot_yaw: ArrayLike
    slot_length: ArrayLike
    slot_width: ArrayLike
    kerbside: ArrayLike = False
    surroundings: Surroundings | None = None
    manners: ParkingManners = field(default_factory=ParkingManners)
    seed: int = 0

    def __post_init__(self) -> None:
        xy = as_floats("slot_xy", self.slot_xy, None, 2)
        n = len(xy)
        object.__setattr__(self, "slot_xy", xy)
        for name in ("slot_yaw", "slot_length", "slot_width"):
            value = np.asarray(getattr(self, name))
            column = as_floats(name, np.broadcast_to(value, (n,)) if value.ndim == 0 else value, n)
            if name != "slot_yaw" and (column <= 0).any():
                raise SensorError(f"{name} is {column.min()}, want lengths above 0 m")
            object.__setattr__(self, name, column)
        if np.asarray(self.kerbside).shape not in ((), (n,)):
            raise SensorError(f"kerbside has shape {np.asarray(self.kerbside).shape}, want ({n},)")
        object.__setattr__(self, "kerbside", np.broadcast_to(np.asarray(self.kerbside, dtype=bool), (n,)))
        require_seed(self.seed)
        if self.surroundings is None:
            object.__setattr__(self, "surroundings", slot_surroundings(self))
        lonely = [i for i in range(n) if not len(self.fitting[i])]
        if lonely:
            length, width = self._column("slot_length")[lonely[0]], self._column("slot_width")[lonely[0]]
            raise SensorError(f"slot {lonely[0]}: no vehicle fits {length} m × {width} m, want a larger slot")

    def _column(self, name: str) -> FloatArray:
        return np.asarray(getattr(self, name))

    @cached_property
    def fleet(self) -> Fleet:
        """All models, with the surroundings."""
        assert self.surroundings is not None
        return Fleet(vehicle_library(), self.surroundings)

    @cached_property
    def fitting(self) -> list[IntArray]:
        """The models that fit each slot."""
        size = np.array([m.size for m in vehicle_library()])
        spare = np.where(self._column("kerbside"), -self.manners.overhang_m, self.manners.overhang_m)
        # In kerbside slots doors open over the pavement and the street.
        room = np.where(self._column("kerbside"), KERB_ROOM_M, self.manners.door_room_m)
        length, width = self._column("slot_length") + spare, self._column("slot_width") - room
        known: dict[tuple[float, float], IntArray] = {}
        out = []
        for key in zip(length.tolist(), width.tolist(), strict=True):
            if key not in known:
                known[key] = np.flatnonzero((size[:, 0] <= key[0]) & (size[:, 1] <= key[1]))
            out.append(known[key])
        return out

    def arrival(self, slot: int, number: int) -> tuple[FloatArray, int]:
        """Return the car of one arrival.

        Args:
            slot: index of the slot.
            number: index of the car among the arrivals at this slot, 0 or more.

        Returns:
            (3,) float64, x, y in m and yaw in rad; index of its model in the fleet.
        """
        manners = self.manners
        rng = np.random.default_rng([self.seed, slot, number])
        chosen = int(self.fitting[slot][rng.integers(len(self.fitting[slot]))])
        side, along, turn = np.clip(rng.normal(0.0, 1.0, 3), -3.0, 3.0)
        backed_in = bool(rng.random() < manners.nose_out) and not self._column("kerbside")[slot]
        length, width, _ = self.fleet.models[chosen].size
        turn *= manners.yaw_rad
        broad = width * np.cos(turn) + length * abs(np.sin(turn))
        long = length * np.cos(turn) + width * abs(np.sin(turn))
        room = max(0.5 * (self._column("slot_width")[slot] - broad), 0.0)
        side = float(np.clip(side * manners.lateral_m, -room, room))
        ahead = 0.5 * (self._column("slot_length")[slot] - long) - NOSE_GAP_M
        along = float(np.clip(along * manners.along_m, -abs(ahead), ahead))
        yaw = float(self._column("slot_yaw")[slot])
        heading = np.array([np.cos(yaw), np.sin(yaw)])
        xy = self._column("slot_xy")[slot] + along * heading + side * np.array([-heading[1], heading[0]])
        return np.array([*xy, yaw + turn + (np.pi if backed_in else 0.0)]), chosen

    def scene(self, occupied: ArrayLike, arrivals: ArrayLike = 0) -> Scene:
        """Return the scene of an occupancy; place i of the scene is slot i.

        Args:
            occupied: (n,) bool.
            arrivals: (n,) or () int, 0 or more: index of the arrival in each slot.
        """
        n = len(self._column("slot_xy"))
        taken = np.asarray(occupied)
        if taken.shape != (n,) or taken.dtype != bool:
            raise SensorError(f"occupied has shape {taken.shape} of {taken.dtype}, want ({n},) bool")
        number = np.asarray(arrivals)
        number = as_integers(
            "arrivals", np.broadcast_to(number, (n,)) if number.ndim == 0 else number, n, least=0
        )
        pose = np.column_stack([self._column("slot_xy"), self._column("slot_yaw")])
        model = np.full(n, NO_VEHICLE, dtype=np.int64)
        for slot in np.flatnonzero(taken).tolist():
            pose[slot], model[slot] = self.arrival(slot, int(number[slot]))
        return Scene(pose, model, self.fleet)

    def filled(self, scene: Scene, slot: int, arrival: int) -> Scene:
        """Return the scene after one arrival at a slot; use `Scene.without_vehicle` for a departure."""
        pose, model = self.arrival(slot, arrival)
        return scene.with_vehicle(slot, pose=pose, model=self.fleet.models[model])


def slot_surroundings(lot: SlotLot, lanes: Sequence[ArrayLike] = (), **more: object) -> Surroundings:
    """Return asphalt under slots and lanes, and painted lines at both sides of slots and at the ends of kerbside ones.

    The asphalt reaches `PAVED_MARGIN_M` beyond lanes, polylines (k, 2) m, and slots; `more` are other fields.
    """
    plain = Surroundings(**more)  # type: ignore[arg-type]
    ends = slot_lines(lot)
    everything = [ends[:, :2], ends[:, 2:4], *(as_floats("lanes", lane, None, 2) for lane in lanes)]
    point = np.concatenate(everything)
    paved = list(plain.paved)
    if len(point) and not paved:
        low, high = point.min(axis=0) - PAVED_MARGIN_M, point.max(axis=0) + PAVED_MARGIN_M
        paved = [np.array([low, [high[0], low[1]], high, [low[0], high[1]]])]
    return replace(plain, paved=paved, markings=np.concatenate([ends, np.asarray(plain.markings)]))


def slot_lines(lot: SlotLot) -> FloatArray:
    """Return ends and width of the lines of all slots, (k, 5) float64, m; a line between two slots appears once."""
    xy, yaw = np.asarray(lot.slot_xy), np.asarray(lot.slot_yaw)
    half = 0.5 * np.column_stack([np.asarray(lot.slot_length), np.asarray(lot.slot_width)])
    heading = np.column_stack([np.cos(yaw), np.sin(yaw)])
    ahead, aside = half[:, :1] * heading, half[:, 1:] * np.column_stack([-heading[:, 1], heading[:, 0]])
    corner = {(i, j): xy + i * ahead + j * aside for i in (-1, 1) for j in (-1, 1)}
    kerb = np.asarray(lot.kerbside)
    lines = [np.hstack([corner[-1, j], corner[1, j]]) for j in (-1, 1)]
    lines += [np.hstack([corner[i, -1], corner[i, 1]])[kerb] for i in (-1, 1)]
    table = np.concatenate(lines)
    middle = np.round((table[:, :2] + table[:, 2:]) / 2 / 0.15)
    once = np.sort(np.unique(middle, axis=0, return_index=True)[1])
    return np.column_stack([table[once], np.full(len(once), LINE_M)])
