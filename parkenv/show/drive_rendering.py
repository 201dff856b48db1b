"""Render a parking manoeuvre from above."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.driving.collision_world import ObstacleKind
from parkenv.driving.drive_state import DriveState
from parkenv.driving.lot_outline import LotOutline
from parkenv.driving.parking_task import REACH, ParkingTask
from parkenv.driving.vehicle import SPEED, STEERING, VehicleParameters, placed
from parkenv.show.drawing import (
    SUBPIXEL_BITS,
    Color,
    fill_polygon,
    fixed_point,
    mixed_color,
    text_width,
    write_text,
)
from parkenv.show.rendering import (
    ASPHALT,
    BELIEF_ANCHORS,
    CAR,
    GAVE_UP,
    GLASS,
    GROUND,
    HEIGHT,
    HUD,
    HUD_MARGIN,
    INK,
    PARKED_CAR,
    SUPERSAMPLING,
    WALL,
    WHITE,
    WIDTH,
    MapView,
    draw_outline,
)
from parkenv.show.window import Window
from parkenv.world.lot import ParkingLot

LARGEST_SCALE = 26.0  # px/m
FREE: Color = BELIEF_ANCHORS[0]
MOVING: Color = (24, 82, 186)
KERB: Color = (150, 148, 140)

_MARGIN = 5.0  # m, shown around start and slot
_LINE = 0.12  # m, paint between slots
_TYRE = np.array([[-0.32, -0.1], [0.32, -0.1], [0.32, 0.1], [-0.32, 0.1]])
_PANES = (
    np.array([[0.24, -0.40], [0.24, 0.40], [0.10, 0.32], [0.10, -0.32]]),
    np.array([[-0.38, -0.36], [-0.38, 0.36], [-0.28, 0.30], [-0.28, -0.30]]),
)
_ANGLE = np.linspace(0.0, 2.0 * math.pi, 40, endpoint=False)
_BODY = 0.5 * np.stack([np.sign(f) * np.abs(f) ** 0.3 for f in (np.cos(_ANGLE), np.sin(_ANGLE))], axis=1)
"""Outline of a car of unit length and width, nose to +x."""


class DriveRenderer:
    """Renderer of parking manoeuvres on one lot, to scale.

    Args:
        lot: the lot.
    """

    def __init__(self, lot: ParkingLot) -> None:
        self._lot = lot
        self._outline = LotOutline.of(lot)
        self._task: ParkingTask | None = None
        self._center: tuple[float, float] | None = None
        self.window = Window(f"parkenv: driving on {lot.name}")

    def frame(self, state: DriveState, outlines: Sequence[FloatArray] = ()) -> Image:
        """Render the current state, (480, 640, 3) uint8 RGB.

        Args:
            state: state of an environment on the renderer's lot.
            outlines: outlines of the moving road users, (k, 2) m each, in their own frames.
        """
        task = state.task
        if task is not self._task:
            self._task, self._center = task, None
            ends = np.concatenate([task.vehicle.corners(task.start[:3]), _box(task.slot, *task.size)])
            low, high = ends.min(axis=0) - _MARGIN, ends.max(axis=0) + _MARGIN
            size = (float(WIDTH), float(HEIGHT - HUD))
            self._view = MapView.fit(np.array([low, high]), size, LARGEST_SCALE)
        middle = task.vehicle.at_middle(state.vehicle[:3])[:2]
        inside = self._view(middle)
        center = (0.0, 0.0)
        if not ((inside > 30.0) & (inside < np.array([WIDTH, HEIGHT - HUD]) - 30.0)).all():
            # The window moves in steps and depends only on the car's position: equal states give equal frames.
            stride = np.array([WIDTH, HEIGHT - HUD]) / self._view.scale / 2
            along = (middle - task.slot[:2]) @ self._view.turn
            center = tuple((np.round(along / stride) * stride).tolist())
        if center != self._center:
            self._center = center
            self._shown = self._view
            if center != (0.0, 0.0):
                at = task.slot[:2] + np.array(center) @ self._view.turn.T
                turned = bool(self._view.turn[0, 0] == 0.0)
                self._shown = MapView.around(
                    at, (float(WIDTH), float(HEIGHT - HUD)), self._view.scale, turned=turned
                )
            self._ground = _ground(self._lot, self._outline, task, self._shown)
        image = self._ground.copy()
        view = self._shown
        _draw_trail(image, view, state)
        if len(state.movers):
            draw_movers(image, view, state.movers, outlines)
        draw_car(image, view, task.vehicle, state.vehicle, CAR)
        _draw_hud(image, state)
        return image


def draw_movers(image: Image, view: MapView, poses: FloatArray, outlines: Sequence[FloatArray]) -> None:
    """Draw moving cars and people, distinguished by their size."""
    for outline, pose in zip(outlines, poses, strict=False):
        size = np.ptp(outline, axis=0)
        fill_polygon(image, view(placed(outline, pose)), MOVING)
        if size[0] > 2.0:
            for pane in _PANES:
                fill_polygon(image, view(placed(pane * size, pose)), GLASS)


def draw_car(
    image: Image, view: MapView, vehicle: VehicleParameters, state: FloatArray, color: Color
) -> None:
    """Draw a car with its steered wheels.

    Args:
        image: (h, w, 3) uint8, drawn upon.
        view: maps metres to pixels.
        vehicle: the car.
        state: (6,) as in `parkenv.driving.vehicle`.
        color: colour of its body.
    """
    middle = vehicle.at_middle(state[:3])
    size = np.array([vehicle.length, vehicle.width])
    fill_polygon(image, view(placed(_BODY * (size + 3.0 / view.scale), middle)), INK)
    for ahead, turn in ((0.0, 0.0), (vehicle.wheelbase, float(state[STEERING]))):
        for side in (-1.0, 1.0):
            own = np.array([ahead, side * (0.5 * vehicle.width - 0.02), turn])
            wheel = placed(placed(_TYRE, own), state[:3])
            fill_polygon(image, view(wheel), INK)
    fill_polygon(image, view(placed(_BODY * size, middle)), color)
    for pane in _PANES:
        fill_polygon(image, view(placed(pane * size, middle)), INK)


def _draw_trail(image: Image, view: MapView, state: DriveState) -> None:
    """Draw the path of the car's centre, and its outline at the start and at changes of direction."""
    vehicle, poses = state.task.vehicle, np.array(state.trail)
    color = mixed_color(ASPHALT, CAR, 0.75)
    step = np.diff(poses[:, :2], axis=0)
    forward = (step * np.stack([np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])], axis=1)).sum(axis=1)
    moving = np.flatnonzero(np.abs(forward) > 1e-6)
    turns = moving[1:][forward[moving[1:]] * forward[moving[:-1]] < 0.0]
    for pose in poses[[0, *turns.tolist()]]:
        corners = fixed_point(view(vehicle.corners(pose)))
        cv2.polylines(image, [corners], True, mixed_color(ASPHALT, CAR, 0.55), 1, cv2.LINE_AA, SUBPIXEL_BITS)
    points = fixed_point(view(vehicle.at_middle(poses)[:, :2]))
    cv2.polylines(image, [points], False, color, 2, cv2.LINE_AA, SUBPIXEL_BITS)


def _ground(lot: ParkingLot, outline: LotOutline, task: ParkingTask, view: MapView) -> Image:
    """Draw everything static at `SUPERSAMPLING` times the resolution, and average it down."""
    fine = MapView(view.turn, view.scale * SUPERSAMPLING, view.shift * SUPERSAMPLING)
    shape = ((HEIGHT - HUD) * SUPERSAMPLING, WIDTH * SUPERSAMPLING)
    image = np.full((*shape, 3), GROUND, dtype=np.uint8)

    def thick(metres: float) -> int:
        return max(SUPERSAMPLING, round(metres * fine.scale))

    def stroke(points: FloatArray, color: Color, metres: float, *, closed: bool = False) -> None:
        pixels = fixed_point(fine(points))
        cv2.polylines(image, [pixels], closed, color, thick(metres), cv2.LINE_8, SUBPIXEL_BITS)

    draw_outline(image, fine, outline, task.slot[:2], REACH, apron=0.0)
    near = np.flatnonzero(np.abs(lot.slot_xy - task.slot[:2]).max(axis=1) < REACH)
    for i in near.tolist():
        stroke(_box(np.array([*lot.slot_xy[i], lot.slot_yaw[i]]), lot.slot_length[i], lot.slot_width[i]), WHITE, _LINE,
                closed=True)  # fmt: skip
    own = fixed_point(fine(_box(task.slot, *task.size)))
    cv2.fillConvexPoly(image, own, mixed_color(ASPHALT, FREE, 0.75), cv2.LINE_8, SUBPIXEL_BITS)
    stroke(_box(task.slot, *task.size), WHITE, _LINE, closed=True)
    nose = np.array([[0.5, 0.0], [-0.3, 0.55], [-0.1, 0.0], [-0.3, -0.55]])
    cv2.fillPoly(image, [fixed_point(fine(placed(nose, task.target)))], WHITE, cv2.LINE_8, SUBPIXEL_BITS)
    for kind, points in zip(task.obstacles.kind.tolist(), task.obstacles.outlines(), strict=True):
        if kind == ObstacleKind.PARKED_CAR:
            _draw_parked(image, fine, points)
        elif kind == ObstacleKind.KERB:
            stroke(points, KERB, 0.2)
        else:
            stroke(points, WALL, 0.3)
    small = cv2.resize(image, (WIDTH, HEIGHT - HUD), interpolation=cv2.INTER_AREA)
    return np.vstack([small, np.full((HUD, WIDTH, 3), INK, np.uint8)])


def _draw_parked(image: Image, view: MapView, outline: FloatArray) -> None:
    """Draw a parked car from its footprint, with equal windows at both ends."""
    cv2.fillConvexPoly(image, fixed_point(view(outline)), PARKED_CAR, cv2.LINE_8, SUBPIXEL_BITS)
    box = shapely.get_coordinates(shapely.minimum_rotated_rectangle(shapely.Polygon(outline)))
    side = np.diff(box[:3], axis=0)
    length, width = np.hypot(side[:, 0], side[:, 1]).tolist()
    along = side[0] if length > width else side[1]
    pose = np.array([*box[:4].mean(axis=0), math.atan2(along[1], along[0])])
    size = np.array([max(length, width), min(length, width)])
    for pane in _PANES:
        cv2.fillConvexPoly(
            image, fixed_point(view(placed(pane * size, pose))), GLASS, cv2.LINE_8, SUBPIXEL_BITS
        )


def _draw_hud(image: Image, state: DriveState) -> None:
    task = state.task
    way = "" if task.kind == "parallel" else f", {task.way}"
    parts = [
        f"{task.lot} {task.slot_id}: {task.kind}{way}",
        f"{state.time:.1f} s",
        f"{3.6 * abs(float(state.vehicle[SPEED])):.1f} km/h",
    ]
    x, baseline = HUD_MARGIN, HEIGHT - HUD // 2 + 5
    for part in parts:
        write_text(image, part, (x, baseline), WHITE, 15, 500)
        x += max(text_width(part, 15, 500), 64) + 18
    if state.parked:
        changes = (
            f"parked, {state.direction_changes} direction change{'' if state.direction_changes == 1 else 's'}"
        )
        verdicts, color = [changes, "parked"], CAR
    elif state.contact:
        left = state.contact.startswith("left")
        verdicts, color = [state.contact if left else f"touched a {state.contact}", "contact"], GAVE_UP
    else:
        return
    for verdict in verdicts:
        if x + text_width(verdict, 15, 600) <= WIDTH - HUD_MARGIN:
            write_text(image, verdict, (x, baseline), color, 15, 600)
            break


def _box(pose: FloatArray, length: float, width: float) -> FloatArray:
    """Return the corners, (4, 2) m, of a rectangle."""
    half = 0.5 * np.array([length, width])
    return placed(half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]), pose)
