"""Animation of a whole trip from above: the car's surroundings, with the whole lot in an inset."""

from __future__ import annotations

import cv2
import numpy as np

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.driving.vehicle import SPEED
from parkenv.engine.state import SearchState
from parkenv.show.drawing import SUBPIXEL_BITS, fill_disc, fixed_point, mixed_color, write_text
from parkenv.show.drive_rendering import draw_car, draw_movers
from parkenv.show.rendering import (
    ASPHALT,
    CAR,
    GAVE_UP,
    HEIGHT,
    HUD,
    HUD_MARGIN,
    INK,
    WHITE,
    WIDTH,
    MapView,
    SearchRenderer,
    StillLayer,
    clock,
)
from parkenv.studies.trips.driven_search import DrivenSearch, Trip
from parkenv.studies.trips.vehicle_controller import VehicleController
from parkenv.world.scenario import Scenario

SPEEDUP = 5
"""Playback speed relative to real time."""
FPS = 10
LAST_S = 2.0
"""Duration of the last frame, s."""
COLORS = 96
"""Number of colours of an animation: enough for drawings, and small files."""

_SLOT_PX = 26.0  # a slot's width in the picture near the car
_INSET = 0.34
_STEP_S = 0.1


class TripRenderer(SearchRenderer):
    """Draws a search with the car at its driven pose.

    Args:
        scenario: the scenario.
        driver: the driver of the car.
        near: whether to show the car's surroundings instead of the whole lot.
    """

    def __init__(self, scenario: Scenario, driver: VehicleController, *, near: bool) -> None:
        super().__init__(scenario)
        self._driver, self._near = driver, near
        self.trail: list[FloatArray] = []
        if near:
            self._whole = None

    def rows(self) -> tuple[int, int]:
        """Return the first and last pixel row of the lot in a frame of the whole lot."""
        assert self._whole is not None
        west, south, east, north = self.scenario.lot.bounds()
        corners = self._whole(np.array([[west, south], [east, north], [west, north], [east, south]]))
        low, high = corners[:, 1].min() - 10.0, corners[:, 1].max() + 10.0
        return max(0, int(low)), min(HEIGHT - HUD, int(high))

    def _middle(self) -> FloatArray:
        return self._driver.vehicle.at_middle(self._driver.state[:3])

    def still_layer(self, state: SearchState) -> StillLayer:
        """Return the layer of the part of the lot near the car, or of the whole lot."""
        if not self._near:
            return super().still_layer(state)
        return self._window(self._middle()[:2], _SLOT_PX, 3)

    def _draw_trail(self, image: Image, view: MapView, state: SearchState) -> None:
        del state  # the driven path is not part of it
        if len(self.trail) > 1:
            points = fixed_point(view(np.array(self.trail)))
            thickness = 2 if self._near else 3
            cv2.polylines(
                image, [points], False, mixed_color(ASPHALT, CAR, 0.7), thickness, cv2.LINE_AA, SUBPIXEL_BITS
            )

    def _draw_car(self, image: Image, view: MapView, state: SearchState) -> None:
        del state
        others = self._driver.others
        if others is not None:
            draw_movers(image, view, others.poses, [outline for _, outline in others.outlines])
        if self._near:
            draw_car(image, view, self._driver.vehicle, self._driver.state, CAR)
            return
        at = view(self._middle()[:2])
        fill_disc(image, at, 11.0, INK)
        fill_disc(image, at, 8.5, CAR)

    def _draw_hud(self, image: Image, state: SearchState) -> None:
        if not self._near:
            return
        driver = self._driver
        x, baseline = HUD_MARGIN, HEIGHT - HUD // 2 + 5
        for part in (
            clock(driver.time),
            f"{driver.time - state.arrival.time:.0f} s",
            f"{3.6 * abs(float(driver.state[SPEED])):.0f} km/h",
        ):
            write_text(image, part, (x, baseline), WHITE, 15, 500)
            x += 124 if ":" in part else 76
        text = f"parked in {driver.log.attempts[-1].slot}" if state.parked else driver.doing
        failed = ":" in text
        write_text(image, text, (x, baseline), GAVE_UP if failed else CAR, 15, 600)


def film_trip(search: DrivenSearch, seed: int) -> tuple[Trip, list[Image]]:
    """Drive a trip and render it: frames of (480, 640, 3) uint8, at `FPS` frames per second."""
    driver, env = search.driver, search.env
    near = TripRenderer(search.scenario, driver, near=True)
    far = TripRenderer(search.scenario, driver, near=False)
    everything = np.arange(search.scenario.lot.n_slots)
    frames: list[Image] = []
    every = round(SPEEDUP / FPS / _STEP_S)
    steps = 0
    low, high = far.rows()

    def take() -> None:
        state = env.state
        occupied = state.world.occupied(everything, driver.time)
        if state.parked:
            occupied[state.vertex] = False  # the searching car itself stands there
        frames.append(_inset(near.frame(state, occupied), far.frame(state, occupied), low, high))

    def on_control() -> None:
        nonlocal steps
        place = driver.vehicle.at_middle(driver.state[:3])[:2]
        for renderer in (near, far):
            if not renderer.trail or np.hypot(*(place - renderer.trail[-1])) > 0.3:
                renderer.trail.append(place)
        if steps % every == 0:
            take()
        steps += 1

    trip = search.run(seed, on_control=on_control)
    take()
    return trip, frames + frames[-1:] * round(LAST_S * FPS)


def _inset(near: Image, far: Image, low: int, high: int) -> Image:
    """Return the near frame with rows `low` to `high` of the whole lot's frame as a small inset."""
    width, height = round(_INSET * WIDTH), round(_INSET * (high - low))
    small = cv2.resize(far[low:high], (width, height), interpolation=cv2.INTER_AREA)
    image = near.copy()
    image[: height + 3, : width + 3] = INK
    image[:height, :width] = small
    return image
