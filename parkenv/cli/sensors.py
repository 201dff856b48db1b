"""`parkenv sensors`: preview the simulated sensors."""

from __future__ import annotations

from pathlib import Path

from parkenv.cli import arguments as args
from parkenv.cli.command import add, group
from parkenv.cli.tables import make_console
from parkenv.errors import InputError, nearest
from parkenv.files.file_names import file_name
from parkenv.files.known_names import WEATHERS


def preview(
    scenario: str | None = None,
    weather: str = "all",
    drive: float = 20.0,
    every: float = 0.5,
    seed: int = 0,
    out: Path = Path("results/sensors"),
    *,
    world: args.Searches,
    traffic: args.Traffic,
) -> None:
    """Draw what the sensors measure on the way from the entry to the slot nearest to the goal.

    Writes one figure per weather, at the place with the most parked cars: the side camera's image with the true boxes,
    its depth, the stereo camera's disparity, and the laser scan from above. Also writes a short video of the side
    camera.

    Examples:
        parkenv sensors preview
        parkenv sensors preview --scenario street --weather dusk --drive 40

    Options:
        weather (NAME[,...]|all): Some of {weathers}.
        drive (0 <= M <= 10000): Length of the video, m; 0 for none.
        every (M >= 0.05): Metres between its frames.
        out, -o (DIR): Folder for the pictures and drive.gif.
    """
    import dataclasses

    import numpy as np
    from rich.progress import track
    from scipy.spatial import cKDTree

    from parkenv.compiled.keyed_random import world_key
    from parkenv.files.atomic_write import make_folder
    from parkenv.scenarios.build import build
    from parkenv.show.figures.picture_files import save_film
    from parkenv.show.figures.sensors import save_sensor_preview, with_boxes
    from parkenv.studies.fields import BUSY
    from parkenv.world.lot_scene import LotScenes, slot_lot
    from planners.routes import DriveRoutes
    from sim_sensors.camera.weather import Weather
    from sim_sensors.ground_truth import vehicle_boxes
    from sim_sensors.rig import SensorRig, poses_along

    names = args.words("--weather", ",".join(WEATHERS) if weather == "all" else weather)
    for name in names:
        if name not in WEATHERS:
            raise InputError(f"--weather has {name!r}; {nearest(name, ('all', *WEATHERS))}")
    its = build(traffic.on(world.spec(scenario), BUSY))
    make_folder(out)
    console = make_console()

    key = world_key(seed, 0)
    arrival = its.occupancy.draw_arrival(its.arrival, key)
    scenes = LotScenes(slot_lot(its.lot), its, key, its.occupancy.world(key, arrival))

    entry, target = int(its.lot.entry_vertices[0]), int(its.lot.walk_m().argmin())
    path = [entry, *DriveRoutes(its).path(entry, target)]
    poses = poses_along(its.lot.vertex_xy[path], every)
    parked = scenes.at(arrival.time)
    beside = poses[:, :2] + 4.0 * np.column_stack([np.sin(poses[:, 2]), -np.cos(poses[:, 2])])
    standing = cKDTree(parked.vehicle_pose[parked.present, :2])
    middle = int(standing.query_ball_point(beside, 6.0, return_length=True).argmax())

    ((_, stereo, stereo_mount),) = SensorRig.stereo().stereo_cameras
    rig = dataclasses.replace(SensorRig.thesis(), stereo_cameras=(("pair", stereo, stereo_mount),))
    name, camera, mount = rig.cameras[0]
    eye = mount.camera_pose(poses[middle])
    console.print("The first image after an installation waits about 20 s for the renderer to be compiled.")
    for preset in track(names, "Rendering", console=console, disable=not console.is_terminal):
        light = Weather.draw(preset, seed)
        scene = scenes.at(arrival.time, poses[middle])
        capture = rig.capture(scene, poses[middle], light, seed)
        boxes = vehicle_boxes(camera, scene, eye, capture.images[name])
        title = f"{its.name}, {preset.replace('_', ' ')}"
        save_sensor_preview(
            its.lot, rig, capture, boxes, title, out / file_name(f"sensors_{its.name}_{preset}", ".png")
        )
    n = int(drive / every)
    if n:
        frames = []
        past = poses[max(0, middle - n // 2) :][:n]
        light = Weather.draw(names[0], seed)
        for k, pose in enumerate(track(past, "Driving", console=console, disable=not console.is_terminal)):
            eye = mount.camera_pose(pose)
            scene = scenes.at(arrival.time + k * every / its.v_drive, pose)
            frame = camera.render(scene, eye, light, seed + k)
            frames.append(with_boxes(frame.image, vehicle_boxes(camera, scene, eye, frame)))
        save_film(frames, out / "drive.gif", fps=8.0)
    console.print(f"Images are in {out}")


app = group("sensors", "Preview the simulated sensors.")
add(app, "preview", preview)
