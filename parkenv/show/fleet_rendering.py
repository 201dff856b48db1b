"""Render a fleet from above: frames for videos and windows."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.driving.lot_outline import LotOutline
from parkenv.engine.fleet import CarPoses, Fleet
from parkenv.show import drawing
from parkenv.show.drawing import Color
from parkenv.show.rendering import (
    CAR,
    CAR_BODY,
    HEIGHT,
    HUD,
    HUD_MARGIN,
    INK,
    LARGEST_SCALE,
    MARGIN,
    REAR_WINDOW,
    WALK,
    WHITE,
    WIDTH,
    WINDSCREEN,
    MapView,
    clock,
    draw_still_layer,
    lot_corners,
    paint_slots,
)
from parkenv.show.window import Window

SLOT: Color = (126, 130, 136)
FLEET_PARKED: Color = (74, 150, 226)
SMALLEST_CAR = 7.0  # length, px


class FleetRenderer:
    """Renderer of a fleet: the whole lot, cars that search (yellow), cars of the fleet that are parked (blue), others.

    Args:
        fleet: the fleet.

    Attributes:
        window: shows frames on the screen.
    """

    def __init__(self, fleet: Fleet) -> None:
        self.fleet = fleet
        lot = fleet.scenario.lot
        size = (WIDTH, HEIGHT - HUD)
        room = (float(size[0] - 2 * MARGIN), float(size[1] - 2 * MARGIN))
        fitted = MapView.fit(lot_corners(lot), room, LARGEST_SCALE)
        self._view = MapView(fitted.turn, fitted.scale, fitted.shift + MARGIN)
        self._still = draw_still_layer(lot, LotOutline.of(lot), self._view, size, 0)
        self._key = _hud()
        self.window = Window(f"parkenv: {fleet.scenario.name}")

    def frame(self) -> Image:
        """Render the present moment, (480, 640, 3) uint8 RGB, with the true occupancy: not for agents."""
        fleet, still = self.fleet, self._still
        image = still.image.copy()
        taken = fleet.taken()
        own = fleet.slots["car"] >= 0
        paint_slots(
            image.reshape(-1, 3),
            still.pixel,
            still.slot,
            still.cover,
            still.car,
            still.car_cover,
            np.full((len(still.slots), 3), SLOT, np.uint8),
            (taken & ~own)[still.slots],
        )
        lot = fleet.scenario.lot
        parked = np.flatnonzero(own)
        self._draw_cars(image, CarPoses(lot.slot_xy[parked], lot.slot_yaw[parked]), FLEET_PARKED)
        for goal in {scenario.goal for scenario in fleet.scenarios}:
            at = self._view(lot.goals[goal])
            drawing.fill_disc(image, at, 11.0, WHITE)
            drawing.fill_disc(image, at, 9.5, WALK)
            drawing.write_label(image, "G", at, WHITE, 13, 700)
        self._draw_cars(image, fleet.poses(), CAR, outline=True)
        return np.vstack([image, self._hud()])

    def _draw_cars(self, image: Image, poses: CarPoses, color: Color, *, outline: bool = False) -> None:
        length = max(4.4 * self._view.scale, SMALLEST_CAR)
        size = np.array([length, 0.42 * length])
        parts = [(CAR_BODY, color, 0.0), (WINDSCREEN, INK, 0.0), (REAR_WINDOW, INK, 0.0)]
        if outline:
            parts.insert(0, (CAR_BODY, INK, 2.0))
        centers = self._view(poses.xy)
        headings = np.stack([np.cos(poses.yaw), np.sin(poses.yaw)], axis=1) @ self._view.turn
        turns = np.stack([headings, np.stack([-headings[:, 1], headings[:, 0]], axis=1)], axis=1)
        for part, paint, swell in parts:
            corners = drawing.fixed_point(centers[:, None] + part * (size + swell) @ turns)
            for corner in corners:
                cv2.fillConvexPoly(image, corner, paint, cv2.LINE_AA, drawing.SUBPIXEL_BITS)

    def _hud(self) -> Image:
        image, totals = self._key.copy(), self.fleet.totals
        x, baseline = HUD_MARGIN, HUD // 2 + 5
        for text in (
            clock(self.fleet.time),
            f"{totals['searching']:.0f} searching",
            f"{totals['parked']:.0f} parked",
            f"{totals['gone']:.0f} gone",
        ):
            x = drawing.write_text(image, text, (x, baseline), WHITE, 15, 500) + 18
        return image


def _hud() -> Image:
    """Return the background of the line of text, with the key of colours."""
    image: NDArray[np.uint8] = np.full((HUD, WIDTH, 3), INK, np.uint8)
    x = float(WIDTH - HUD_MARGIN)
    for text, color in (("parked", FLEET_PARKED), ("searching", CAR)):
        width = drawing.text_width(text, 13, 400)
        drawing.write_label(image, text, np.array([x - width / 2, HUD / 2]), WHITE, 13, 400)
        drawing.fill_disc(image, _point(x - width - 12.0, HUD / 2), 5.0, color)
        x -= width + 30.0
    return image


def _point(x: float, y: float) -> FloatArray:
    return np.array([x, y])
