"""Drive past every slot, see, and remember: a session of the survey (T §3.3, §4)."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.mapping.grid import OccupancyGrid
from parkenv.mapping.odometry import PoseNoise
from parkenv.mapping.route import SurveyRoute, survey_route
from parkenv.mapping.slots import SlotFilter, SlotStates
from parkenv.mapping.store import Session
from parkenv.mapping.survey_score import SurveyScore
from parkenv.perception.ranging import CarSightings
from parkenv.perception.stack import Look, PerceptionStack
from parkenv.world.keyed_random import world_key
from parkenv.world.lot_scene import LotScenes, slot_lot
from parkenv.world.occupancy import Arrival, ArrivalWindow
from parkenv.world.scenario import Scenario
from sim_sensors.camera.weather import PRESETS, Weather
from sim_sensors.rig import RIG_NAMES, Capture, SensorRig, poses_along

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_SEEDS = 1 << 31


@dataclass(frozen=True)
class SurveySettings:
    """How a survey is driven.

    Args:
        rig: `laser`: the thesis's camera and 270° laser; `stereo`: a stereo pair alone; `both_sides`: a second camera,
            to the left, beside the laser, so that aisles with slots on either side are driven once.
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
        if self.rig not in RIG_NAMES:
            raise InputError(f"rig is {self.rig!r}, want one of {', '.join(RIG_NAMES)}")
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
        score: what else was right and wrong.
        frame_s: (f,) s, that each capture took to be understood.
        grid: of the session.
        looks: some captures that show many cars, with what was made of them, for pictures.
    """

    session: Session
    arrival: Arrival
    states: SlotStates
    truth: BoolArray
    parked: int
    found: int
    score: SurveyScore
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


class SurveyMoment(NamedTuple):
    """What a session has come to after one capture.

    Grid and slots are the session's own, which go on changing; who keeps them copies them.

    Attributes:
        time: s since Monday 00:00.
        capture: what was measured.
        look: what was made of it.
        grid: of the session so far.
        slots: what is known of the slots so far.
        truth: (n_slots,) bool, what stands in the slots now; for pictures and scores only.
    """

    time: float
    capture: Capture
    look: Look
    grid: OccupancyGrid
    slots: SlotFilter
    truth: BoolArray


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
        self.stack = stack or PerceptionStack(SensorRig.named(self.settings.rig))
        self.route: SurveyRoute = survey_route(scenario.lot, both_sides=self.settings.rig == "both_sides")
        self._slots = slot_lot(scenario.lot)

    def key_of(self, number: int) -> str:
        """What the map file calls a session: equal for equal drives."""
        s = self.settings
        noise = f"{s.pose_noise.position:g}m{s.pose_noise.heading:g}rad"
        return f"{self.scenario.name}/{s.rig}/{s.weather or 'any'}/{s.every:g}m/{noise}/seed{s.seed}/{number:05d}"

    def drive(
        self, number: int, *, pictures: int = 0, on_moment: Callable[[SurveyMoment], None] | None = None
    ) -> SessionResult:
        """Drive one session: at every pose detect, range, and update grid and slots.

        Args:
            number: 0 or more; equal numbers are equal drives.
            pictures: how many captures to keep.
            on_moment: told of every capture, for those who watch.
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
        # Of each stretch of the way, the capture that shows most.
        shown: dict[int, tuple[int, Capture, Look]] = {}

        slots, score = SlotFilter(lot), SurveyScore(lot.n_slots)
        last_look = np.full(lot.n_slots, arrival.time)
        low_x, low_y, high_x, high_y = lot.bounds()
        grid = OccupancyGrid((low_x - 2.0, low_y - 2.0), (high_x + 2.0, high_y + 2.0), 0.25)
        cars: list[FloatArray] = []
        frame_s = []
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
            frame_s.append(clock.perf_counter() - begun)
            last_look[slots.told] = time
            if on_moment is not None:
                taken = world.occupied(np.arange(lot.n_slots), time)
                on_moment(SurveyMoment(time, capture, look, grid, slots, taken))
            plainly = [self.stack.locate_plainly(view, belief) for view in look.views]
            score.take(scene, capture, look, placed, plainly)
            stretch, cars_there = i * pictures // len(poses), sum(len(view.cars) for view in look.views)
            if pictures and (stretch not in shown or cars_there > shown[stretch][0]):
                shown[stretch] = cars_there, capture, look
        truth = np.array(
            [world.occupied([s], t)[0] for s, t in enumerate(last_look.tolist())], dtype=np.bool_
        )
        states = slots.states()
        found_cars = np.concatenate(cars) if cars else np.empty((0, 3))
        p = np.where(states.in_view, states.p_occupied, np.nan)
        session = Session(self.key_of(number), arrival.time, settings.rig, preset, p, found_cars)
        return SessionResult(
            session, arrival, states, truth,
            int(truth.sum()), int((truth & score.found).sum()), score, np.array(frame_s), grid,
            tuple((capture, look) for _, capture, look in shown.values()),
        )  # fmt: skip


def _update_grid(
    grid: OccupancyGrid, cars: CarSightings, camera: tuple[float, float, float], half_width: float
) -> None:
    x, y, yaw = camera
    away = cars.xy - np.array([x, y])
    angle = np.arctan2(away[:, 1], away[:, 0]) - yaw
    polar = np.column_stack([(angle + np.pi) % (2 * np.pi) - np.pi, cars.distance])
    grid.update((x, y), yaw, float(np.arctan(half_width)), polar)
