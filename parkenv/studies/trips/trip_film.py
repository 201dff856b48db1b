"""Animation of a whole trip from above: the car's surroundings, with the whole lot in an inset."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.driving.vehicle import SPEED
from parkenv.show.colors import PALETTE, belief_colors, mixed_color
from parkenv.show.frames.drive import movers, steered_car
from parkenv.show.frames.lot import HEIGHT, HUD, WIDTH, LotFrames, clock, paint_goal, write_line
from parkenv.show.frames.search import KEY_WIDTH, strip_with_key, walk
from parkenv.show.painters.opencv import paint, write_tag
from parkenv.show.scene import DISC, Layer, Lines, Marks, posed
from parkenv.studies.trips.driven_search import DrivenSearch, Trip

SPEEDUP = 5
"""Playback speed relative to real time."""
FPS = 10
LAST_S = 2.0
"""Duration of the last frame, s."""
COLORS = 96
"""Number of colours of an animation: enough for drawings, and small files."""

_SLOT_PX = 26.0  # a slot's width in the picture near the car
_INSET, _MARGIN = 0.34, 10
_CAPTION = "Colours: what the car believes"
_STEP_S = 0.1


class TripFrames:
    """Frames of a driven search: the car's surroundings, with the whole lot as an inset.

    Args:
        search: the search.
    """

    def __init__(self, search: DrivenSearch) -> None:
        self._search = search
        lot = search.scenario.lot
        self._near = LotFrames(lot, smallest_slot=math.inf, window_slot=_SLOT_PX, parts=3)
        self._far = LotFrames(lot, smallest_slot=0.0)
        assert self._far.whole is not None
        west, south, east, north = lot.bounds()
        rows = self._far.whole(np.array([[west, south], [east, north], [west, north], [east, south]]))[:, 1]
        self._rows = slice(max(0, int(rows.min() - 10.0)), min(HEIGHT - HUD, int(rows.max() + 10.0)))
        self._key = strip_with_key()
        self.trail: list[FloatArray] = []

    @property
    def middle(self) -> FloatArray:
        """Position of the car's centre, (2,) m."""
        driver = self._search.driver
        middle: FloatArray = driver.vehicle.at_middle(driver.state[:3])[:2]
        return middle

    def frame(self, occupied: NDArray[np.bool_]) -> Image:
        """Render the present moment, (480, 640, 3) uint8 RGB."""
        driver, here = self._search.driver, self.middle
        disc = Marks(posed(here), DISC, "car", px=17.0, edge="ink", edge_px=2.5)
        near = self._picture(self._near, occupied, 2.0, steered_car(driver.vehicle, driver.state))
        far = self._picture(self._far, occupied, 3.0, [disc])[self._rows]
        width, height = round(_INSET * WIDTH), round(_INSET * len(far))
        inset = cv2.resize(far, (width, height), interpolation=cv2.INTER_AREA)
        framed = cv2.copyMakeBorder(inset, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=PALETTE["ink"])
        near[_MARGIN : _MARGIN + height + 4, _MARGIN : _MARGIN + width + 4] = framed
        write_tag(near, _CAPTION, (_MARGIN, 2 * _MARGIN + height + 4), PALETTE["white"])
        return np.vstack([near, self._line()])

    def _picture(
        self, frames: LotFrames, occupied: NDArray[np.bool_], trail_px: float, car: list[Layer]
    ) -> Image:
        search, here, state = self._search, self.middle, self._search.env.state
        belief, scenario, others = state.belief, search.scenario, search.driver.others
        image = frames.slots(here, belief_colors(belief.p_occupied, belief.observed), occupied)
        view, goal = frames.still(here).view, scenario.lot.goals[scenario.goal]
        if len(self.trail) > 1:
            color = mixed_color("asphalt", "car", 0.7)
            paint(image, view, [Lines([np.array(self.trail)], color, px=(trail_px, trail_px))])
        if state.parked:
            paint(image, view, [walk(scenario.lot.slot_xy[state.vertex], goal)])
        paint_goal(image, view, goal, here)
        moving = [] if others is None else movers(others.poses, [outline for _, outline in others.outlines])
        paint(image, view, [*moving, *car])
        return image

    def _line(self) -> Image:
        """Return the line of text below the map."""
        driver, state, image = self._search.driver, self._search.env.state, self._key.copy()
        parts = (
            clock(driver.time),
            f"{driver.time - state.arrival.time:.0f} s",
            f"{3.6 * abs(float(driver.state[SPEED])):.0f} km/h",
        )
        text = f"parked in {driver.log.attempts[-1].slot}" if state.parked else driver.doing
        write_line(image, parts, (text,), "warning" if ":" in text else "car", KEY_WIDTH)
        return image


def film_trip(search: DrivenSearch, seed: int) -> tuple[Trip, list[Image]]:
    """Drive a trip and render it: frames of (480, 640, 3) uint8, at `FPS` frames per second."""
    env, film = search.env, TripFrames(search)
    everything = np.arange(search.scenario.lot.n_slots)
    frames: list[Image] = []
    every = round(SPEEDUP / FPS / _STEP_S)
    steps = 0

    def take() -> None:
        state = env.state
        occupied = state.world.occupied(everything, search.driver.time)
        if state.parked:
            occupied[state.vertex] = False  # the searching car itself stands there
        frames.append(film.frame(occupied))

    def on_control() -> None:
        nonlocal steps
        if not film.trail or np.hypot(*(film.middle - film.trail[-1])) > 0.3:
            film.trail.append(film.middle)
        if steps % every == 0:
            take()
        steps += 1

    trip = search.run(seed, on_control=on_control)
    take()
    return trip, frames + frames[-1:] * round(LAST_S * FPS)
