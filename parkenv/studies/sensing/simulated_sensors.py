"""Simulated sensors: a model fitted to the errors of the perception pipeline, and pictures of measurements."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import IntArray
from parkenv.compiled.keyed_random import world_key
from parkenv.errors import require
from parkenv.files.atomic_write import make_folder
from parkenv.files.file_names import file_name
from parkenv.files.known_names import WEATHERS
from parkenv.show.figures.survey import save_sensor_preview
from parkenv.studies.simulate import Observer, Step, simulate
from parkenv.studies.study import Progress, counted
from parkenv.studies.workers import SERIAL, Workers
from parkenv.world.lot_scene import LotScenes, slot_lot
from parkenv.world.scenario import Scenario
from parkenv.world.sensor_model import SensorBand, SensorModel
from planners.agent import make_agent
from planners.routes import DriveRoutes
from sim_sensors.camera.weather import Weather
from sim_sensors.ground_truth import vehicle_boxes
from sim_sensors.rig import SensorRig, poses_along

# Ends of the bands of distance from the car to a slot's vertex, m; the first band is the slot at the car's vertex.
BAND_ENDS = (0.5, 3.5, 6.5, 9.5, 12.5, 16.0)
# Agents whose searches are counted, so that the observations are those of typical searches.
AGENTS = ("greedy-drive", "mdp", "first-free")
# Least number of observations in a band for rates of its own; otherwise those of all bands are used.
LEAST_OBSERVATIONS = 20
_NONE = np.zeros((len(BAND_ENDS), 2, 2, 3), dtype=np.int64)
_ASSUMED = SensorModel(BAND_ENDS[-1], 0.98, 0.02)


def fitted_model(counts: IntArray) -> SensorModel:
    """Return the sensor model with the rates of counts, with a Jeffreys prior of half an error in each band.

    `counts` are of the slots in view after each step, (bands, 2, 2, 3) int64: by distance, by whether the slot lies
    beside the car, by whether it is taken, and by observed state: none, free, taken.
    """
    reported = counts.sum(axis=(0, 1))[:, 1:]
    require(
        reported.sum(axis=1).min() >= LEAST_OBSERVATIONS,
        f"{reported.sum(axis=1).tolist()} observations of free and of taken slots, want at least "
        f"{LEAST_OBSERVATIONS} of each",
    )
    false_alarm, hit = _taken_rates(reported)
    bands = []
    for i, end in enumerate(BAND_ENDS):
        for beside in (False, True):
            in_band = counts[i, int(beside)]
            in_view, reported = in_band.sum(), in_band[:, 1:]
            enough = reported.sum(axis=1).min() >= LEAST_OBSERVATIONS
            rates = _taken_rates(reported) if enough else (false_alarm, hit)
            seen = float(reported.sum() / in_view) if in_view else 0.0
            bands.append(SensorBand(end, beside, round(seen, 4), round(rates[1], 4), round(rates[0], 4)))
    return SensorModel(BAND_ENDS[-1], round(hit, 4), round(false_alarm, 4), tuple(bands))


def _taken_rates(reported: IntArray) -> tuple[float, float]:
    free, taken = (float((row[1] + 0.5) / (row.sum() + 1.0)) for row in reported)
    return free, taken


class _ObservationCounter(Observer):
    """Counts what the perception pipeline reports after each step of a search, until the car is parked."""

    def __init__(self, scenario: Scenario) -> None:
        self._starts, self._slots = scenario.slots_in_view
        distance, beside = scenario.sight_lines
        self._band = np.searchsorted(BAND_ENDS, distance)
        self._beside = beside.astype(np.int64)
        self.counts = _NONE.copy()

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        self._env: Any = env.unwrapped

    def on_step(self, step: Step) -> None:
        if step.info["parked"]:
            return
        state, observed = self._env.state, self._env.perception.observation
        rows = slice(self._starts[state.vertex], self._starts[state.vertex + 1])
        near = self._slots[rows]
        reported = np.zeros(len(near), dtype=np.int64)
        reported[np.searchsorted(near, observed.slots)] = 1 + observed.taken
        taken = state.world.occupied(near, state.time).astype(np.int64)
        np.add.at(self.counts, (self._band[rows], self._beside[rows], taken, reported), 1)


def count_observations(
    scenario: Scenario,
    rig: str,
    agent: str,
    seeds: Sequence[int],
    weather: str | None = None,
    detector: str | None = None,
) -> IntArray:
    """Search with simulated sensors, and compare the perception pipeline's reports with the true occupancy.

    There is one seed per search. The weather is drawn for each search, and the detector the scenario's, if none is
    given.
    """
    scenario = scenario.replace(sensor_model=_ASSUMED)
    env = gym.make(
        "parkenv/SearchPerception-v2", scenario=scenario, rig=rig, weather=weather, detector=detector
    )
    searcher, counter = make_agent(agent, scenario), _ObservationCounter(scenario)
    for seed in seeds:
        simulate(env, searcher, seed, (counter,))
    return counter.counts


def measure_sensors(
    scenarios: Sequence[Scenario],
    rig: str,
    searches: int,
    *,
    seed: int = 0,
    weather: str | None = None,
    detector: str | None = None,
    workers: Workers = SERIAL,
    on_progress: Callable[[], None] = lambda: None,
) -> IntArray:
    """Sum `count_observations` over all agents of `AGENTS` and all scenarios, with a number of searches of each."""
    tasks = [
        partial(count_observations, scenario, rig, agent, [s], weather, detector)
        for scenario in scenarios
        for s in range(seed, seed + searches)
        for agent in AGENTS
    ]
    counts = _NONE.copy()
    for _, observed in workers.results(tasks):
        counts += observed
        on_progress()
    return counts


def preview_sensors(
    scenario: Scenario,
    folder: Path,
    weathers: Sequence[str] = WEATHERS,
    *,
    seed: int = 0,
    progress: Progress = lambda *_: None,
) -> None:
    """Draw images, depth, disparity and scan at the place with the most parked cars, a figure for each weather."""
    make_folder(folder)
    key = world_key(seed, 0)
    arrival = scenario.occupancy.draw_arrival(scenario.arrival, key)
    scenes = LotScenes(slot_lot(scenario.lot), scenario, key, scenario.occupancy.world(key, arrival))
    entry, target = int(scenario.lot.entry_vertices[0]), int(scenario.lot.walk_m().argmin())
    path = [entry, *DriveRoutes(scenario).path(entry, target)]
    poses = poses_along(scenario.lot.vertex_xy[path], 0.5)
    parked = scenes.at(arrival.time)
    beside = poses[:, :2] + 4.0 * np.column_stack([np.sin(poses[:, 2]), -np.cos(poses[:, 2])])
    standing = cKDTree(parked.vehicle_pose[parked.present, :2])
    middle = int(standing.query_ball_point(beside, 6.0, return_length=True).argmax())

    ((_, stereo, stereo_mount),) = SensorRig.stereo().stereo_cameras
    rig = dataclasses.replace(SensorRig.thesis(), stereo_cameras=(("pair", stereo, stereo_mount),))
    name, camera, mount = rig.cameras[0]
    eye = mount.camera_pose(poses[middle])
    rendered = counted(progress, "Rendering", len(weathers))
    for preset in weathers:
        scene = scenes.at(arrival.time, poses[middle])
        capture = rig.capture(scene, poses[middle], Weather.draw(preset, seed), seed)
        boxes = vehicle_boxes(camera, scene, eye, capture.images[name])
        picture = folder / file_name(f"sensors_{scenario.name}_{preset}", ".png")
        title = f"{scenario.name}, {preset.replace('_', ' ')}"
        save_sensor_preview(scenario.lot, rig, capture, boxes, title, picture)
        rendered()
