"""Pictures and films of manoeuvres in scenes, from above."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
from PIL import Image as PillowImage

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.driving.scene import Scene
from parkenv.driving.vehicle import STATE_SIZE, placed
from parkenv.files.atomic_write import atomic_write
from parkenv.show.figures.picture_files import save_film
from parkenv.show.frames.drive import LARGEST_SCALE, steered_car, trail
from parkenv.show.frames.lot import HEIGHT, HUD, WIDTH, painted_finely, strip, write_line
from parkenv.show.painters.opencv import MapView, paint
from parkenv.show.scene import FREE, Areas, Layer, Lines, mixed_color

# Frames per second of a film, how much faster than real it is, and its colours.
FPS, SPEED_UP, COLORS = 10, 4, 64
_SIZE = (WIDTH, HEIGHT - HUD)
_MARGIN = 2.5  # m, around what is driven
_LINE = 0.16  # m, obstacles that are lines
GAP = 6  # between pictures of a sheet, px
_STILL = 5  # times that a film shows its last frame

# A scene, its lines of `trajectories.csv`, and what is said of it.
Shown = tuple[Scene, Mapping[str, Any], str]


def save_sheet(pictures: Sequence[Image], path: Path) -> None:
    sheet = np.full((-(-len(pictures) // 2), 2, HEIGHT + GAP, WIDTH + GAP, 3), 255, dtype=np.uint8)
    for i, frame in enumerate(pictures):
        sheet[i // 2, i % 2, :HEIGHT, :WIDTH] = frame
    whole = sheet.swapaxes(1, 2).reshape(-1, 2 * (WIDTH + GAP), 3)[:-GAP, :-GAP]
    with atomic_write(path) as beside:
        PillowImage.fromarray(whole).save(beside, format="PNG")


def save_manoeuvres(shown: Sequence[Shown], path: Path) -> None:
    save_sheet(
        [_frame(scene, _states(scene, driven), f"{scene.name}: {says}") for scene, driven, says in shown],
        path,
    )


def save_manoeuvre_film(
    scene: Scene, driven: Mapping[str, Any], others: Mapping[str, Any], path: Path
) -> None:
    """Write a film of a manoeuvre as GIF, `SPEED_UP` times as fast as it was."""
    states, time = _states(scene, driven), np.array(driven["time_s"])
    ends = np.searchsorted(time, np.arange(0.0, time[-1] + SPEED_UP / FPS, SPEED_UP / FPS)).clip(1, len(time))
    users = np.zeros((len(time), 0, 3))
    if others:
        users = np.column_stack([others[name] for name in ("x_m", "y_m", "yaw_rad")])
        users[:, :2] -= scene.origin
        users = users.reshape(len(time), -1, 3)
    frames = [
        _frame(scene, states[:end], f"{scene.name}: {time[end - 1]:.1f} s", states, users[end - 1])
        for end in ends.tolist()
    ]
    save_film([*frames, *[frames[-1]] * _STILL], path, fps=FPS, colors=COLORS)


def _states(scene: Scene, driven: Mapping[str, Any]) -> FloatArray:
    columns = [driven[name] for name in ("x_m", "y_m", "yaw_rad", "speed_mps", "steering_rad")]
    states = np.zeros((len(columns[0]), STATE_SIZE))
    states[:, :5] = np.column_stack(columns)
    states[:, :2] -= scene.origin
    return states


def _frame(
    scene: Scene, states: FloatArray, text: str, whole: FloatArray | None = None, users: Sequence[Any] = ()
) -> Image:
    whole = states if whole is None else whole
    poses = np.concatenate([whole[:: max(1, len(whole) // 200), :3], scene.target[None]])
    corners = scene.vehicle.corners(poses).reshape(-1, 2)
    view = MapView.fit(
        np.array([corners.min(axis=0) - _MARGIN, corners.max(axis=0) + _MARGIN]), _SIZE, LARGEST_SCALE
    )
    fine = painted_finely(view, _SIZE, _ground(scene), "floor", 2)
    image = cv2.resize(fine, _SIZE, interpolation=cv2.INTER_AREA)
    others = [placed(user.outline, pose) for user, pose in zip(scene.crossings, users, strict=False)]
    car = [*trail(scene.vehicle, states[:, :3]), *steered_car(scene.vehicle, states[-1])]
    paint(image, view, [*car, Areas([[outline] for outline in others], "mover")])
    line = strip()
    write_line(line, (text,))
    return np.vstack([image, line])


def _ground(scene: Scene) -> list[Layer]:
    goal = scene.vehicle.corners(scene.target)
    solid = [s for s in scene.shapes if s.geom_type == "Polygon"]
    lines = [shapely.get_coordinates(s) for s in scene.shapes if s.geom_type != "Polygon"]
    return [
        Areas([[goal]], mixed_color("floor", FREE, 0.6)),
        Lines([np.vstack([goal, goal[:1]])], "white", 0.1),
        Areas([[shapely.get_coordinates(shape)] for shape in solid], "ink"),
        Lines(
            [np.repeat(line, 2, axis=0) if len(line) == 1 else line for line in lines],
            "ink",
            _LINE,
            (3.0, np.inf),
        ),
    ]
