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
from parkenv.show.figures.picture_files import save_film
from parkenv.show.figures.survey import save_sensor_preview, with_boxes
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
    drive: float = 20.0,
    every: float = 0.5,
    seed: int = 0,
    progress: Progress = lambda *_: None,
) -> None:
    """Draw images, depth, disparity and scan at the place with the most parked cars, and film the way past it.

    There is a figure for each weather. The film, drive.gif, has the first one, is `drive` long, m (0: none), with
    frames `every` m.
    """
    make_folder(folder)
    key = world_key(seed, 0)
    arrival = scenario.occupancy.draw_arrival(scenario.arrival, key)
    scenes = LotScenes(slot_lot(scenario.lot), scenario, key, scenario.occupancy.world(key, arrival))
    entry, target = int(scenario.lot.entry_vertices[0]), int(scenario.lot.walk_m().argmin())
    path = [entry, *DriveRoutes(scenario).path(entry, target)]
    poses = poses_along(scenario.lot.vertex_xy[path], every)
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
    n = int(drive / every)
    past = poses[max(0, middle - n // 2) :][:n]
    filmed = counted(progress, "Driving", len(past)) if n else None
    light = Weather.draw(weathers[0], seed)
    frames = []
    for k, pose in enumerate(past):
        assert filmed is not None
        eye = mount.camera_pose(pose)
        scene = scenes.at(arrival.time + k * every / scenario.v_drive, pose)
        frame = camera.render(scene, eye, light, seed + k)
        frames.append(with_boxes(frame.image, vehicle_boxes(camera, scene, eye, frame)))
        filmed()
    if frames:
        save_film(frames, folder / "drive.gif", fps=8.0)
