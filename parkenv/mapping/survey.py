"""Drive past every slot, see, and remember: a session of the survey (T §3.3, §4)."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.keyed_random import world_key
from parkenv.lot_scene import LotScenes, slot_lot
from parkenv.mapping.grid import OccupancyGrid
from parkenv.mapping.odometry import PoseNoise
from parkenv.mapping.route import SurveyRoute, survey_route
from parkenv.mapping.slots import SlotFilter, SlotStates
from parkenv.mapping.store import Session
from parkenv.occupancy import Arrival, ArrivalWindow
from parkenv.perception.ranging import CarSightings
from parkenv.perception.stack import Look, PerceptionStack
from parkenv.scenario import Scenario
from sim_sensors.ground_truth import VehicleBoxes, vehicle_boxes
from sim_sensors.laser import LaserScanner
from sim_sensors.rig import Capture, Mount, SensorRig, poses_along
from sim_sensors.scene import Scene
from sim_sensors.weather import PRESETS, Weather

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

SURVEY_RIGS = {"laser": SensorRig.thesis, "stereo": SensorRig.stereo}
"""Rigs by the word that the command line knows."""
MATCH = 0.3
"""Intersection over union from which a detection is of a car."""
_SEEDS = 1 << 31
_TRUTH = LaserScanner()


@dataclass(frozen=True)
class SurveySettings:
    """How a survey is driven.

    Args:
        rig: `laser`: the thesis's camera and 270° laser; `stereo`: a stereo pair alone.
        every: m between captures.
        weather: one of the presets; None draws one for each session.
        windows: when sessions begin; the k-th session takes the k-th, round and round.
        pose_noise: how wrong the car is about where it is.
        seed: of worlds, weather and noise.

    Raises:
        InputError: an unknown rig or weather, no window, or a distance that is not positive.
    """

    rig: str = "laser"
    every: float = 1.25
    weather: str | None = None
    windows: tuple[ArrivalWindow, ...] = (ArrivalWindow(),)
    pose_noise: PoseNoise = field(default_factory=PoseNoise)
    seed: int = 0

    def __post_init__(self) -> None:
        if self.rig not in SURVEY_RIGS:
            raise InputError(f"rig is {self.rig!r}, want one of {', '.join(SURVEY_RIGS)}")
        if self.weather is not None and self.weather not in PRESETS:
            raise InputError(f"weather is {self.weather!r}, want one of {', '.join(PRESETS)}")
        if not self.windows:
            raise InputError("windows is empty, want at least one")
        if not (np.isfinite(self.every) and self.every > 0.0):
            raise InputError(f"every is {self.every} m, want a finite distance above 0")


@dataclass(frozen=True, eq=False)
class SessionResult:
    """A session, what it found, and how right that is.

    Attributes:
        session: for the map file.
        arrival: when it began.
        states: what the filter knows at the end.
        truth: (n_slots,) bool, taken at the last look at it; when the drive began where there was none.
        parked: how many cars stood in slots then, and `found`, how many of them were detected.
        detections: how many there were, and `right`, how many of them were of cars.
        range_error: (k,) m, of the distances of right detections against the exact ones.
        frame_s: (f,) s, that each capture took to be understood.
        grid: of the session.
        looks: some captures with what was made of them, for pictures.
    """

    session: Session
    arrival: Arrival
    states: SlotStates
    truth: BoolArray
    parked: int
    found: int
    detections: int
    right: int
    range_error: FloatArray
    frame_s: FloatArray
    grid: OccupancyGrid
    looks: tuple[tuple[Capture, Look], ...]

    @property
    def slot_accuracy(self) -> float:
        """Share of all slots whose state is right; unknown ones are not."""
        return float(((self.states.occupied == self.truth) & self.states.in_view).mean())

    @property
    def slot_accuracy_seen(self) -> float:
        """Share of the slots in view whose state is right."""
        seen = self.states.in_view
        return float((self.states.occupied == self.truth)[seen].mean()) if seen.any() else float("nan")


class Survey:
    """Sessions in a scenario's world.

    Args:
        scenario: lot, occupancy and traffic.
        settings: how to drive.
        stack: of the settings' rig; made with the shipped models where None.
    """

    def __init__(
        self, scenario: Scenario, settings: SurveySettings | None = None, stack: PerceptionStack | None = None
    ) -> None:
        self.scenario = scenario
        self.settings = settings or SurveySettings()
        self.stack = stack or PerceptionStack(SURVEY_RIGS[self.settings.rig]())
        self.route: SurveyRoute = survey_route(scenario.lot)
        self._slots = slot_lot(scenario.lot)

    def key_of(self, number: int) -> str:
        """What the map file calls a session: equal for equal drives."""
        s = self.settings
        noise = f"{s.pose_noise.position:g}m{s.pose_noise.heading:g}rad"
        return f"{self.scenario.name}/{s.rig}/{s.weather or 'any'}/{s.every:g}m/{noise}/seed{s.seed}/{number:05d}"

    def drive(self, number: int, *, pictures: int = 0) -> SessionResult:
        """Drive one session: at every pose detect, range, and update grid and slots.

        Args:
            number: 0 or more; equal numbers are equal drives.
            pictures: how many captures to keep.
        """
        scenario, settings, lot = self.scenario, self.settings, self.scenario.lot
        key = world_key(settings.seed, number)
        window = settings.windows[number % len(settings.windows)]
        arrival = scenario.occupancy.draw_arrival(window, key)
        world = scenario.occupancy.world(key, arrival)
        scenes = LotScenes(self._slots, scenario, key, world)
        rng = np.random.default_rng([int(key), 1])
        preset = settings.weather or str(rng.choice(PRESETS))
        weather = Weather.draw(preset, int(key) % _SEEDS)

        poses = poses_along(self.route.path, settings.every)
        believed = settings.pose_noise.estimated(poses, rng)
        times = arrival.time + settings.every / scenario.v_drive * np.arange(len(poses))
        kept = (len(poses) * np.linspace(0.15, 0.85, pictures)).astype(int).tolist()

        slots, score = SlotFilter(lot), _Score(lot.n_slots)
        last_look = np.full(lot.n_slots, arrival.time)
        low_x, low_y, high_x, high_y = lot.bounds()
        grid = OccupancyGrid((low_x - 2.0, low_y - 2.0), (high_x + 2.0, high_y + 2.0), 0.25)
        cars: list[FloatArray] = []
        looks = []
        for i, (pose, belief, time) in enumerate(zip(poses, believed, times.tolist(), strict=True)):
            scene = scenes.at(time, pose)
            capture = self.stack.rig.capture(scene, pose, weather, int(rng.integers(_SEEDS)))
            slots.told[:] = False
            begun = clock.perf_counter()
            look = self.stack.look(capture, belief)
            for sweep in look.sweeps:
                slots.see_through(sweep)
            placed = [slots.see_cars(view.cars) for view in look.views]
            for view in look.views:
                _update_grid(
                    grid, view.cars, view.mount.in_world(belief), view.camera.width / view.camera.fx / 2.0
                )
                cars.append(np.column_stack([view.cars.xy, view.cars.yaw]))
            score.frame_s.append(clock.perf_counter() - begun)
            last_look[slots.told] = time
            score.take(scene, pose, capture, look, placed)
            if i in kept:
                looks.append((capture, look))
        truth = np.array(
            [world.occupied([s], t)[0] for s, t in enumerate(last_look.tolist())], dtype=np.bool_
        )
        states = slots.states()
        found_cars = np.concatenate(cars) if cars else np.empty((0, 3))
        p = np.where(states.in_view, states.p_occupied, np.nan)
        session = Session(self.key_of(number), arrival.time, settings.rig, preset, p, found_cars)
        return SessionResult(
            session, arrival, states, truth,
            int(truth.sum()), int((truth & score.found).sum()), score.detections, score.right,
            np.array(score.range_error), np.array(score.frame_s), grid, tuple(looks),
        )  # fmt: skip


class _Score:
    """Counts what a session gets right, by looking at what it cannot see."""

    def __init__(self, n_slots: int) -> None:
        self.found = np.zeros(n_slots, dtype=np.bool_)
        self.detections = self.right = 0
        self.range_error: list[float] = []
        self.frame_s: list[float] = []

    def take(
        self,
        scene: Scene,
        pose: FloatArray,
        capture: Capture,
        look: Look,
        placed: Sequence[NDArray[np.int64]],
    ) -> None:
        """Count one look."""
        for view, slots in zip(look.views, placed, strict=True):
            frame = (
                capture.images[view.name] if view.name in capture.images else capture.pairs[view.name].left
            )
            boxes = vehicle_boxes(view.camera, scene, view.mount.camera_pose(pose), frame)
            matched = _matched(view.detections.boxes, boxes)
            self.detections += len(matched)
            self.right += int((matched > 0).sum())
            slots = slots[slots >= 0]
            self.found[slots[np.isin(slots, scene.present)]] = True
            self._range(scene, pose, view.mount, view.cars)

    def _range(self, scene: Scene, pose: FloatArray, mount: Mount, cars: CarSightings) -> None:
        """Errors of the distances, against an exact scan from the same place."""
        if not len(cars):
            return
        exact, ids = _TRUTH.scan_with_ids(scene.scan_plane, mount.in_world(pose))
        for car, distance in zip(cars.xy, cars.distance, strict=True):
            # The car that stands where it was seen; its distance is the median of the beams on it.
            place = _place_of(scene, car)
            on_it = np.isfinite(exact) & (ids == place + 1)
            if place >= 0 and on_it.sum() >= 3:
                self.range_error.append(abs(distance - float(np.median(exact[on_it]))))


def _place_of(scene: Scene, xy: FloatArray) -> int:
    """The parked car nearest to a point, -1 if none is within 3 m."""
    present = scene.present
    if not len(present):
        return -1
    away = np.hypot(*(scene.vehicle_pose[present, :2] - xy).T)
    nearest = int(away.argmin())
    return int(present[nearest]) if away[nearest] < 3.0 else -1


def _matched(found: NDArray[np.float32], boxes: VehicleBoxes) -> NDArray[np.int64]:
    """(n,) the id of the vehicle that each detection is of; 0 where it is of none."""
    match = np.zeros(len(found), dtype=np.int64)
    best = np.full(len(found), MATCH)
    area = (found[:, 2] - found[:, 0]) * (found[:, 3] - found[:, 1])
    for k in np.flatnonzero(boxes.visible_fraction > 0.05):
        for true in (boxes.box[k].astype(np.float64), boxes.visible_box[k].astype(np.float64)):
            inner = np.minimum(found[:, 2:], true[2:]) - np.maximum(found[:, :2], true[:2])
            common = np.clip(inner, 0.0, None).prod(axis=1)
            overlap = common / (area + (true[2] - true[0]) * (true[3] - true[1]) - common)
            better = overlap > best
            match[better], best[better] = boxes.ids[k], overlap[better]
    return match


def _update_grid(
    grid: OccupancyGrid, cars: CarSightings, camera: tuple[float, float, float], half_width: float
) -> None:
    x, y, yaw = camera
    away = cars.xy - np.array([x, y])
    angle = np.arctan2(away[:, 1], away[:, 0]) - yaw
    polar = np.column_stack([(angle + np.pi) % (2 * np.pi) - np.pi, cars.distance])
    grid.update((x, y), yaw, float(np.arctan(half_width)), polar)
