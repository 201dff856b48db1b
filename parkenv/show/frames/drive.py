"""Frames of a parking manoeuvre, from above."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.driving.collision_world import ObstacleKind
from parkenv.driving.parking_task import REACH, DriveState, ParkingTask
from parkenv.driving.vehicle import SPEED, STEERING, VehicleParameters, placed
from parkenv.show.frames.lot import HEIGHT, HUD, WIDTH, painted_finely, strip, write_line
from parkenv.show.frames.window import Window
from parkenv.show.painters.opencv import MapView, paint
from parkenv.show.scene import (
    FREE,
    SQUARE,
    Areas,
    Layer,
    Lines,
    LotScene,
    Marks,
    building_layers,
    cars,
    mixed_color,
)
from parkenv.show.tables import plural
from parkenv.world.lot import ParkingLot, corner_points

LARGEST_SCALE = 26.0  # px/m

_SIZE = (WIDTH, HEIGHT - HUD)
_MARGIN = 5.0  # m, shown around start and slot
_LINE = 0.12  # m, paint between slots
_BARRIER = 0.25  # m, kerbs and walls
_TYRE = (0.64, 0.2)  # m
_NOSE = np.array([[0.5, 0.0], [-0.3, 0.55], [-0.1, 0.0], [-0.3, -0.55]])


class DriveRenderer:
    def __init__(self, lot: ParkingLot) -> None:
        self._scene = LotScene.of(lot)
        self._task: ParkingTask | None = None
        self._center: tuple[float, float] | None = None
        self.window = Window(f"parkenv: driving on {lot.name}")

    def frame(self, state: DriveState, outlines: Sequence[FloatArray] = ()) -> Image:
        task = state.task
        if task is not self._task:
            self._task, self._center = task, None
            ends = np.concatenate([task.vehicle.corners(task.start[:3]), _box(task)])
            low, high = ends.min(axis=0) - _MARGIN, ends.max(axis=0) + _MARGIN
            self._view = MapView.fit(np.array([low, high]), _SIZE, LARGEST_SCALE)
        middle = task.vehicle.at_middle(state.vehicle[:3])[:2]
        inside = self._view(middle)
        center = (0.0, 0.0)
        if not ((inside > 30.0) & (inside < np.array(_SIZE) - 30.0)).all():
            # The window moves in steps and depends only on the car's position: equal states give equal frames.
            stride = np.array(_SIZE) / self._view.scale / 2
            along = (middle - task.slot[:2]) @ self._view.turn
            center = tuple((np.round(along / stride) * stride).tolist())
        if center != self._center:
            self._center = center
            self._shown = self._view
            if center != (0.0, 0.0):
                at = task.slot[:2] + np.array(center) @ self._view.turn.T
                turned = bool(self._view.turn[0, 0] == 0.0)
                self._shown = MapView.around(at, _SIZE, self._view.scale, turned=turned)
            fine = painted_finely(self._shown, _SIZE, _ground(self._scene, task))
            self._ground = cv2.resize(fine, _SIZE, interpolation=cv2.INTER_AREA)
        image = self._ground.copy()
        layers = [
            *trail(task.vehicle, np.array(state.trail)),
            *_movers(state.movers, outlines),
            *steered_car(task.vehicle, state.vehicle),
        ]
        paint(image, self._shown, layers)
        return np.vstack([image, _line(state)])


def _movers(poses: FloatArray, outlines: Sequence[FloatArray]) -> list[Layer]:
    layers: list[Layer] = []
    for outline, pose in zip(outlines, poses, strict=False):
        size = np.ptp(outline, axis=0)
        layers.append(Areas([[placed(outline, pose)]], "mover", "white", 1.2))
        if size[0] > 2.0:
            layers += cars(pose[None], "mover", size, glass="glass")[1:]
    return layers


def steered_car(vehicle: VehicleParameters, state: FloatArray) -> list[Layer]:
    axles = ((0.0, 0.0), (vehicle.wheelbase, float(state[STEERING])))
    side = 0.5 * vehicle.width - 0.02
    wheels = [
        (*placed(np.array([[ahead, y]]), state[:3])[0].tolist(), float(state[2]) + turn)
        for ahead, turn in axles
        for y in (-side, side)
    ]
    pose = vehicle.at_middle(state[:3])[None]
    size = (vehicle.length, vehicle.width)
    tyres = Marks(np.array(wheels), SQUARE, "ink", _TYRE)
    # The wheels are below the body, above its border.
    return [*cars(pose, "car", size, edge="ink")[:1], tyres, *cars(pose, "car", size)]


def trail(vehicle: VehicleParameters, poses: FloatArray) -> list[Layer]:
    """Return the path of the car's centre, and its outline at the start and at changes of direction."""
    step = np.diff(poses[:, :2], axis=0)
    forward = (step * np.stack([np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])], axis=1)).sum(axis=1)
    moving = np.flatnonzero(np.abs(forward) > 1e-6)
    turns = moving[1:][forward[moving[1:]] * forward[moving[:-1]] < 0.0]
    outlines = [_closed(vehicle.corners(pose)) for pose in poses[[0, *turns.tolist()]]]
    return [
        Lines(outlines, "car", px=(1.4, 1.4), halo="parked"),
        Lines([vehicle.at_middle(poses)[:, :2]], "car", px=(2.4, 2.4), halo="parked"),
    ]


def _ground(scene: LotScene, task: ParkingTask) -> list[Layer]:
    lot, own = scene.lot, _box(task)
    near = np.abs(lot.slot_xy - task.slot[:2]).max(axis=1) < REACH
    layers = [
        *building_layers(scene.buildings, ()),
        Areas(scene.paved(task.slot[:2], REACH, apron=0.0), "floor"),
        Lines([_closed(corners) for corners in scene.slots[near]], "paint", _LINE),
        Areas([[own]], mixed_color("floor", FREE, 0.75)),
        Lines([_closed(own)], "paint", _LINE),
        Areas([[placed(_NOSE, task.target)]], "paint"),
    ]
    for kind, points in zip(task.obstacles.kind.tolist(), task.obstacles.outlines(), strict=True):
        if kind == ObstacleKind.PARKED_CAR:
            layers += _parked(points)
        else:
            layers.append(Lines([points], "parked", _BARRIER, (2.0, math.inf)))
    return layers


def _parked(outline: FloatArray) -> list[Layer]:
    box = shapely.get_coordinates(shapely.minimum_rotated_rectangle(shapely.Polygon(outline)))
    side = np.diff(box[:3], axis=0)
    length, width = np.hypot(side[:, 0], side[:, 1]).tolist()
    along = side[0] if length > width else side[1]
    pose = np.array([[*box[:4].mean(axis=0), math.atan2(along[1], along[0])]])
    size = max(length, width), min(length, width)
    return [Areas([[outline]], "parked"), *cars(pose, "parked", size, glass="glass")[1:]]


def _line(state: DriveState) -> Image:
    image, task = strip(), state.task
    way = "" if task.kind == "parallel" else f", {task.way}"
    parts = (
        f"{task.lot} {task.slot_id}: {task.kind}{way}",
        f"{state.time:.1f} s",
        f"{3.6 * abs(float(state.vehicle[SPEED])):.1f} km/h",
    )
    verdicts: tuple[str, ...] = ()
    if state.parked:
        verdicts = f"parked, {plural(state.direction_changes, 'direction change')}", "parked"
    elif state.contact:
        left = state.contact.startswith("left")
        verdicts = state.contact if left else f"touched a {state.contact}", "contact"
    write_line(image, parts, verdicts, "car" if state.parked else "warning")
    return image


def _box(task: ParkingTask) -> FloatArray:
    x, y, yaw = task.slot
    length, width = (np.array([side]) for side in task.size)
    return np.asarray(corner_points(np.array([[x, y]]), np.array([yaw]), length, width)[0])


def _closed(points: FloatArray) -> FloatArray:
    return np.vstack([points, points[:1]])
