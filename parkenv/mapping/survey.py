"""A survey session: drive past every slot, and estimate which are taken (T §3.3, §4)."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.compiled.keyed_random import world_key
from parkenv.errors import InputError, require_number, require_one_of, require_whole
from parkenv.files.known_names import LOCALISERS
from parkenv.mapping.grid import OccupancyGrid
from parkenv.mapping.odometry import PoseNoise
from parkenv.mapping.route import SurveyRoute, survey_route
from parkenv.mapping.scan_matching import make_locate
from parkenv.mapping.store import Session
from parkenv.mapping.survey_score import SurveyScore, true_boxes
from parkenv.perception.detector_registry import DEFAULT_DETECTOR, detector_version
from parkenv.perception.monocular import RangingErrors
from parkenv.perception.pipeline import CameraView, PerceptionPipeline, PerceptionResult, localize_as_thesis
from parkenv.perception.slot_filter import SlotFilter, SlotStates
from parkenv.world.lot import ParkingLot
from parkenv.world.lot_scene import LotScenes, slot_lot
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.process import Arrival, World
from parkenv.world.scenario import Scenario
from sim_sensors.camera.weather import PRESETS, Weather
from sim_sensors.rig import RIG_NAMES, Capture, SensorRig, TimedCapture, poses_along
from sim_sensors.scene import Scene

_SEEDS = 1 << 31


@dataclass(frozen=True)
class SurveySettings:
    # `laser`: the thesis's camera and 270° laser; `stereo`: only a stereo camera; `both_sides`: a laser, a camera to
    # the right and one to the left, so that aisles with slots on both sides are driven once
    rig: str = "laser"
    every: float = 1.25  # distance between captures, m
    weather: str | None = None  # one of `sim_sensors.camera.weather.PRESETS`; None draws one for each session
    # arrival windows of the sessions; the k-th session uses the k-th window, cyclically
    windows: tuple[ArrivalWindow, ...] = (ArrivalWindow(),)
    pose_noise: PoseNoise = field(default_factory=PoseNoise)  # errors of the vehicle's odometry
    localise: str = "none"  # what corrects the odometry: `none` or `scan-matching`
    seed: int = 0  # seed of worlds, weather and noise
    # as `make_detector` takes it: `hog`, `side`, `front`, `net`, a model file or `MODULE:CLASS`
    detector: str = DEFAULT_DETECTOR
    picture_width: int | None = None  # px, of the cameras' pictures; None: the rig's own

    def __post_init__(self) -> None:
        require_one_of("rig", self.rig, RIG_NAMES)
        if self.weather is not None:
            require_one_of("weather", self.weather, PRESETS)
        require_one_of("localise", self.localise, LOCALISERS)
        if self.rig == "camera":
            require_one_of("localise of a rig without ranges", self.localise, LOCALISERS[:1])
        if not self.windows:
            raise InputError("windows is empty, want at least one")
        if self.picture_width is not None:
            require_whole("picture_width", self.picture_width, least=64)
        require_number("every", self.every, above=0.0)


@dataclass(frozen=True, eq=False)
class SessionResult:
    session: Session  # the record for the map file
    arrival: Arrival  # start of the session
    states: SlotStates  # the filter's final estimate
    # (n_slots,) bool, taken when the slot was last observed, or at the start if it was never observed
    truth: BoolArray
    parked: int  # number of cars in slots then; `found`: how many of them were detected
    found: int
    score: SurveyScore  # errors of detection and of the cars' poses
    odometry: FloatArray  # (f, 3) x, y, yaw of the vehicle by its odometry, one for each capture
    poses: FloatArray  # (f, 3) the same as estimated
    true_poses: FloatArray  # (f, 3) the same in truth
    car_captures: NDArray[np.int64]  # (n,) the capture in which each of `session.cars` was located
    frame_s: FloatArray  # (f,) s, processing time of each capture
    grid: OccupancyGrid  # the occupancy grid of the session
    shown: tuple[PerceptionResult, ...]  # results of some captures with many cars, for figures

    @property
    def slot_accuracy(self) -> float:
        """Fraction of all slots whose state is correct; unknown slots count as wrong."""
        return float(((self.states.occupied == self.truth) & self.states.in_view).mean())

    @property
    def slot_accuracy_seen(self) -> float:
        seen = self.states.in_view
        return float((self.states.occupied == self.truth)[seen].mean()) if seen.any() else float("nan")


class SurveyFrame(NamedTuple):
    """The state of a session after one capture.

    Grid and slots are shared with the session, which keeps updating them: copy them to keep them.
    """

    result: PerceptionResult  # pipeline result for the capture
    grid: OccupancyGrid  # the occupancy grid so far
    slots: SlotFilter  # the slot filter so far
    truth: BoolArray  # (n_slots,) bool, true current states; only for figures and scores
    odometry: FloatArray  # (3,) x, y, yaw of the vehicle by its odometry


class Survey:
    """Survey sessions in a scenario's world.

    Args:
        scenario: defines lot, occupancy and traffic.
        settings: settings of the survey.
    """

    def __init__(self, scenario: Scenario, settings: SurveySettings | None = None) -> None:
        self.scenario = scenario
        self.settings = settings or SurveySettings()
        rig = SensorRig.named(self.settings.rig)
        rig = rig.mirrored() if scenario.lot.left_hand else rig
        if self.settings.picture_width is not None:
            rig = rig.resized(self.settings.picture_width)
        noise = self.settings.pose_noise
        self.pipeline = PerceptionPipeline(
            rig, scenario.lot, self.settings.detector, RangingErrors.of_poses(noise.position, noise.heading)
        )
        self.route: SurveyRoute = survey_route(scenario.lot, both_sides=self.settings.rig == "both_sides")
        self._slots = slot_lot(scenario.lot)

    def key_of(self, number: int) -> str:
        """Return the key of a session in the map file; identical sessions have equal keys."""
        s = self.settings
        noise = f"{s.pose_noise.position:g}m{s.pose_noise.heading:g}rad"
        noise += f"{s.pose_noise.drift:g}drift" if s.pose_noise.drift else ""
        noise += "" if s.localise == "none" else f"/{s.localise}"
        detector = "" if s.detector == DEFAULT_DETECTOR else f"{detector_version(s.detector)}/"
        detector += "" if s.picture_width is None else f"{s.picture_width}px/"
        drive = f"{s.rig}/{s.weather or 'any'}/{s.every:g}m/{noise}/{detector}seed{s.seed}"
        return f"{self.scenario.name}/{drive}/{number:05d}"

    def draw(self, number: int) -> SurveyDrive:
        """Draw what determines the captures of a session: its cars, light, way and noise.

        Surveys that differ in their detectors, or in rigs with the same route, draw the same.
        """
        scenario, settings = self.scenario, self.settings
        key = world_key(settings.seed, number)
        arrival = scenario.occupancy.draw_arrival(settings.windows[number % len(settings.windows)], key)
        world = scenario.occupancy.world(key, arrival)
        rng = np.random.default_rng([int(key), 1])
        preset = settings.weather or str(rng.choice(PRESETS))
        poses = poses_along(self.route.path, settings.every)
        odometry = settings.pose_noise.estimated(poses, rng)
        return SurveyDrive(
            self.pipeline.rig, LotScenes(self._slots, scenario, key, world), world, arrival, preset,
            Weather.draw(preset, int(key) % _SEEDS), poses, odometry,
            arrival.time + settings.every / scenario.v_drive * np.arange(len(poses), dtype=np.float64),
            [int(rng.integers(_SEEDS)) for _ in poses],
        )  # fmt: skip

    def drive(
        self, number: int, *, pictures: int = 0, on_frame: Callable[[SurveyFrame], None] | None = None
    ) -> SessionResult:
        """Drive one session: capture at every pose, run the pipeline, and update the grid.

        Args:
            number: 0 or more; determines the session.
            pictures: number of results to keep for figures.
            on_frame: called after every capture.
        """
        drive, lot = self.draw(number), self.scenario.lot
        session, score = SessionMap(self.pipeline, lot, self.settings.localise), SurveyScore(lot.n_slots)
        observed_at, poses = np.full(lot.n_slots, drive.arrival.time), np.empty_like(drive.odometry)
        views, frame_s = [], []
        shown: dict[int, PerceptionResult] = {}  # of each section of the route, that with the most cars
        for i, time in enumerate(drive.times.tolist()):
            scene, capture = drive.capture(i)
            session.slots.updated[:] = False
            begun = clock.perf_counter()
            result = session.add(TimedCapture(time, capture), drive.odometry[i])
            frame_s.append(clock.perf_counter() - begun)
            poses[i] = result.vehicle
            views += [i] * len(result.views)
            observed_at[session.slots.updated] = time
            by_median = [localize_as_thesis(view, result.vehicle) for view in result.views]
            score.add(scene, result, by_median, true_boxes(drive.rig, scene, capture))
            section = i * pictures // len(drive.poses)
            if pictures and (section not in shown or result.n_cars > shown[section].n_cars):
                shown[section] = result
            if on_frame is not None:
                taken = drive.world.occupied(np.arange(lot.n_slots), time)
                on_frame(SurveyFrame(result, session.grid, session.slots, taken, drive.odometry[i]))
        truth = np.array(
            [drive.world.occupied([s], t)[0] for s, t in enumerate(observed_at.tolist())], np.bool_
        )
        return SessionResult(
            session.session(self.key_of(number), drive.arrival.time, self.settings.rig, drive.preset),
            drive.arrival, session.slots.states(), truth, int(truth.sum()), int((truth & score.found).sum()), score,
            drive.odometry, poses, drive.poses, np.repeat(np.array(views, np.int64), [len(c) for c in session.cars]),
            np.array(frame_s), session.grid, tuple(shown.values()),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SurveyDrive:
    rig: SensorRig
    scenes: LotScenes
    world: World  # the true occupancy
    arrival: Arrival  # start of the session
    preset: str  # one of `sim_sensors.camera.weather.PRESETS`
    weather: Weather
    poses: FloatArray  # (f, 3) x, y, yaw of the vehicle, one for each capture
    odometry: FloatArray  # (f, 3) the same by its odometry
    times: FloatArray  # (f,) s
    seeds: list[int]  # of the noise of each capture

    def capture(self, i: int) -> tuple[Scene, Capture]:
        """Return the true scene at capture i, and the measurements; captures may be skipped, not repeated."""
        scene = self.scenes.at(float(self.times[i]), self.poses[i])
        return scene, self.rig.capture(scene, self.poses[i], self.weather, self.seeds[i])


class SessionMap:
    """What a session maps so far: slots, the grid, and the poses of the cars that each view located, (k, 3) each."""

    def __init__(self, pipeline: PerceptionPipeline, lot: ParkingLot, localise: str) -> None:
        self._pipeline, self._locate = pipeline, make_locate(localise, lot)
        low_x, low_y, high_x, high_y = lot.bounds()
        self.slots = SlotFilter(lot)
        self.grid = OccupancyGrid((low_x - 2.0, low_y - 2.0), (high_x + 2.0, high_y + 2.0), 0.25)
        self.cars: list[FloatArray] = []

    def add(self, captured: TimedCapture, odometry: FloatArray) -> PerceptionResult:
        return self.record(self._pipeline.process(captured, self.slots, self._locate(odometry)))

    def record(self, result: PerceptionResult) -> PerceptionResult:
        """Add what was located in a capture to the grid and to the cars."""
        for view in result.views:
            _update_grid(self.grid, view, result.vehicle)
            self.cars.append(view.cars.poses)
        return result

    def session(self, key: str, time: float, rig: str, weather: str) -> Session:
        states = self.slots.states()
        p = np.where(states.in_view, states.p_occupied, np.nan)
        return Session(key, time, rig, weather, p, np.concatenate([np.empty((0, 3)), *self.cars]))


def _update_grid(grid: OccupancyGrid, view: CameraView, vehicle: FloatArray) -> None:
    x, y, yaw = view.mount.in_world(vehicle)
    away = view.cars.xy - np.array([x, y])
    bearing = np.arctan2(away[:, 1], away[:, 0]) - yaw
    polar = np.column_stack([(bearing + np.pi) % (2 * np.pi) - np.pi, view.cars.distance])
    grid.update((x, y), yaw, float(np.arctan(view.camera.width / view.camera.fx / 2.0)), polar)
