"""Pictures of what the simulated sensors measure on the way to the slot nearest to the goal."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from parkenv.compiled.keyed_random import world_key
from parkenv.files.atomic_write import make_folder
from parkenv.files.file_names import file_name
from parkenv.files.known_names import WEATHERS
from parkenv.show.figures.survey import save_sensor_preview
from parkenv.studies.study import Progress, counted
from parkenv.world.lot_scene import LotScenes, slot_lot
from parkenv.world.scenario import Scenario
from planners.routes import DriveRoutes
from sim_sensors.camera.weather import Weather
from sim_sensors.ground_truth import vehicle_boxes
from sim_sensors.rig import SensorRig, poses_along


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
