"""Film of a search through simulated sensors: the lot from above, the camera's view, captions, clock and legend."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.engine.state import SearchState
from parkenv.envs.perception import SearchPerceptionEnv
from parkenv.show.columns import OPTIONAL_TIMES, TIME_COLORS
from parkenv.show.drawing import SUBPIXEL_BITS, draw_dashes, fill_disc, fixed_point, write_text
from parkenv.show.figures.picture_files import save_film
from parkenv.show.figures.survey import draw_detections
from parkenv.show.rendering import (
    CAR,
    GLASS,
    GROUND,
    INK,
    PARKED_CAR,
    WALK,
    WHITE,
    MapView,
    SearchRenderer,
    clock,
    draw_belief_key,
)
from parkenv.studies.compare.cases import Case
from parkenv.studies.simulate import EpisodeResult, Observer, Step
from parkenv.world.lot import PARK
from parkenv.world.scenario import Scenario
from planners.agent import Agent

FPS = 10.0
DRIVE_SPEEDUP, WALK_SPEEDUP = 3.0, 12.0
"""Playback speed relative to real time."""
MOST_FRAMES = 360
"""Maximum number of frames; longer searches are played faster."""
COLORS = 192
"""Number of colours of a film: enough for drawings and the camera's image."""
WIDTH, CAPTION, PANEL = 840, 48, 172
"""Width of a frame, and heights of the caption and of the panel below the map, px."""
MAP_HEIGHT = (220, 420)
"""Least and greatest height of the map, px."""
PAPER = (248, 248, 245)
SOFT = (96, 104, 112)
INTRO_S, FAILED_S, PARKED_S, LAST_S = 2.5, 1.2, 1.2, 4.0
"""How long single frames are shown, s."""

_PARKING_FRAMES = 5
_CAMERA = (213, 160)


class FilmRenderer(SearchRenderer):
    """Draws the map of a film, with the car at any pose.

    Args:
        scenario: the scenario.

    Attributes:
        pose: position, (2,) m, and yaw of the car.
        trail: positions of the car so far.
    """

    def __init__(self, scenario: Scenario) -> None:
        west, south, east, north = scenario.lot.bounds()
        height = int(np.clip(WIDTH * (north - south + 6.0) / (east - west + 6.0), *MAP_HEIGHT))
        super().__init__(scenario, (WIDTH, height), hud=0)
        self.pose: tuple[FloatArray, float] = (np.zeros(2), 0.0)
        self.trail: list[FloatArray] = []

    def map_image(self, state: SearchState, slots: Image, plan: Sequence[FloatArray] = ()) -> Image:
        """Draw trail, plan, goal and car on an image of the slots from `draw_slots`."""
        image, view = slots.copy(), self.still_layer(state).view
        if len(plan) > 1:
            pixels = view(np.array(plan))
            cv2.polylines(image, [fixed_point(pixels)], False, INK, 2, cv2.LINE_AA, SUBPIXEL_BITS)
            fill_disc(image, pixels[-1], 5.0, INK)
        self._draw_trail(image, view, state)
        self._draw_goal(image, view, state)
        self._draw_car(image, view, state)
        return image

    def place(self, state: SearchState) -> tuple[FloatArray, float]:
        """Return position and yaw of the car at its vertex, or in its slot."""
        return super()._pose(state)

    def _pose(self, state: SearchState) -> tuple[FloatArray, float]:
        del state
        return self.pose

    def _draw_trail(self, image: Image, view: MapView, state: SearchState) -> None:
        del state
        points = fixed_point(view(np.array([*self.trail, self.pose[0]])))
        cv2.polylines(image, [points], False, INK, 5, cv2.LINE_AA, SUBPIXEL_BITS)
        cv2.polylines(image, [points], False, CAR, 3, cv2.LINE_AA, SUBPIXEL_BITS)


class SearchFilm(Observer):
    """Films a search in `parkenv/SearchPerception-v2`.

    Args:
        scenario: the scenario.
        agent: the agent, whose plans are shown if it has `plan_preview`.
        name: name of the agent.

    Attributes:
        frames: the frames so far, (h, w, 3) uint8.
    """

    def __init__(self, scenario: Scenario, agent: Agent, name: str) -> None:
        self._scenario, self._name = scenario, name
        self._preview_of = getattr(agent, "plan_preview", None)
        self.frames: list[Image] = []

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        """Show the lot and the forecast at the arrival."""
        del observation
        inner = env.unwrapped
        assert isinstance(inner, SearchPerceptionEnv)
        self._env = inner
        self._renderer = FilmRenderer(inner.scenario)
        self._slots = self._slots_image()
        self._camera = np.full((_CAMERA[1], _CAMERA[0], 3), GROUND, np.uint8)
        self._parts = dict.fromkeys(TIME_COLORS, 0.0)
        self._renderer.pose = self._renderer.place(inner.state)
        self._take("A car arrives. Its map says how likely each slot is taken.", hold=INTRO_S)

    def on_step(self, step: Step) -> None:
        """Show the way to the next vertex, or the parking attempt."""
        state, lot, renderer = self._env.state, self._scenario.lot, self._renderer
        start, yaw = renderer.pose
        end, end_yaw = renderer.place(state)
        info = step.info
        before = dict(self._parts)
        self._parts |= {key: float(info[key]) for key in self._parts if key != "walk_s"}
        if step.action == PARK and not state.parked:
            name = lot.slot_ids[state.vertex]
            self._slots = self._slots_image()
            self._take(f"Slot {name} is taken after all: a failed attempt", hold=FAILED_S)
            return
        plan = self._plan(step)
        seconds = self._parts["drive_s"] - before["drive_s"]
        count = _PARKING_FRAMES if state.parked else max(1, round(seconds * FPS / DRIVE_SPEEDUP))
        text = f"Slot {lot.slot_ids[state.vertex]} is free: it parks" if state.parked else self._seen_so_far()
        turn = math.remainder(end_yaw - yaw, 2 * math.pi)
        renderer.trail.append(start)
        for i in range(1, count + 1):
            share = i / count
            # On a lane the car has turned by the first half of an edge.
            heading = yaw + turn * (share if state.parked else min(2 * share, 1.0))
            renderer.pose = start + share * (end - start), heading
            elapsed = {k: before[k] + share * (self._parts[k] - before[k]) for k in before}
            if i == count:
                self._look()
            self._take(text, [renderer.pose[0], *plan], elapsed)
        renderer.pose = end, end_yaw

    def on_end(self, result: EpisodeResult) -> None:
        """Show the driver's walk, and the total."""
        state, lot, info = self._env.state, self._scenario.lot, result.info
        if not state.parked:
            self._parts |= {key: float(info[key]) for key in self._parts}
            self._take(f"No free slot found: {info['total_s']:.0f} s", hold=LAST_S)
            return
        slot, goal = lot.slot_xy[state.vertex], lot.goals[self._scenario.goal]
        self._slots = self._slots_image()
        text = f"The driver walks {info['walked_m']:.0f} m to the goal"
        self._take(text, hold=PARKED_S)
        count = max(2, round(float(info["walk_s"]) * FPS / WALK_SPEEDUP))
        for i in range(1, count + 1):
            share = i / count
            elapsed = self._parts | {"walk_s": share * float(info["walk_s"])}
            self._take(text, elapsed=elapsed, walker=slot + share * (goal - slot))
        self._parts |= {key: float(info[key]) for key in self._parts}
        self._take(f"At the goal after {info['total_s']:.0f} s", hold=LAST_S, walker=goal)

    def save(self, path: Path) -> None:
        """Write the film as a GIF.

        Raises:
            InputError: the file cannot be written.
        """
        step = -(-len(self.frames) // MOST_FRAMES)
        save_film([*self.frames[:-1:step], self.frames[-1]], path, fps=FPS, colors=COLORS)

    def _slots_image(self) -> Image:
        state = self._env.state
        occupied = state.world.occupied(np.arange(self._scenario.lot.n_slots), state.time)
        if state.parked:
            occupied[state.vertex] = False  # the searching car itself is there
        return self._renderer.draw_slots(state, occupied)

    def _seen_so_far(self) -> str:
        belief = self._env.state.belief
        taken = int((belief.p_occupied[belief.observed] > 0.5).sum())
        free = int(belief.observed.sum()) - taken
        return (
            f"Its camera and laser saw {taken} taken and {free} free slots" if taken + free else "It searches"
        )

    def _plan(self, step: Step) -> list[FloatArray]:
        """Return the vertices that the agent intends to drive along."""
        if self._preview_of is None or step.action == PARK:
            return []
        path = self._preview_of(step.observation, int(step.action), step.memory).path
        return [self._scenario.lot.vertex_xy[v] for v in path]

    def _look(self) -> None:
        """Update the picture of the camera and the colours of the slots."""
        self._slots = self._slots_image()
        results = self._env.perception.results
        if results and not self._env.state.parked:
            view = results[-1].views[0]
            drawn = draw_detections(view.image, view.detections, view.cars.detection)
            self._camera = cv2.resize(drawn, _CAMERA, interpolation=cv2.INTER_AREA)

    def _take(
        self,
        caption: str,
        plan: Sequence[FloatArray] = (),
        elapsed: dict[str, float] | None = None,
        walker: FloatArray | None = None,
        hold: float = 0.0,
    ) -> None:
        """Draw a frame, and show it for `hold` seconds."""
        state = self._env.state
        parts = elapsed or self._parts
        middle = self._renderer.map_image(state, self._slots, plan)
        if walker is not None:
            at = self._renderer.still_layer(state).view(walker)
            fill_disc(middle, at, 8.0, WHITE)
            fill_disc(middle, at, 6.0, WALK)
        top = np.full((CAPTION, WIDTH, 3), INK, np.uint8)
        write_text(top, caption, (16, 32), WHITE, 22, 600)
        seconds = sum(parts.values())
        write_text(top, clock(state.arrival.time + seconds)[4:], (WIDTH - 186, 32), CAR, 20, 500)
        write_text(top, f"{seconds:.0f} s", (WIDTH - 76, 32), CAR, 22, 700)
        frame = np.vstack([top, middle, self._panel(parts)])
        self.frames += [frame] * max(1, round(hold * FPS))

    def _panel(self, parts: dict[str, float]) -> Image:
        """Draw the camera's image, the parts of the time so far, and the legend."""
        panel = np.full((PANEL, WIDTH, 3), PAPER, np.uint8)
        width, height = _CAMERA
        panel[6 : 6 + height, 6 : 6 + width] = self._camera
        cv2.rectangle(panel, (6, 6), (6 + 136, 6 + 20), INK, cv2.FILLED)
        write_text(panel, "camera, detected cars", (11, 20), WHITE, 12, 500)
        left = width + 28
        x = write_text(panel, f"agent {self._name}:", (left, 28), INK, 16, 700) + 12
        for key, (name, color) in TIME_COLORS.items():
            if key in OPTIONAL_TIMES and not parts[key]:
                continue
            rgb = tuple(int(color[i : i + 2], 16) for i in (1, 3, 5))
            cv2.rectangle(panel, (x, 15), (x + 13, 28), rgb, cv2.FILLED)
            x = write_text(panel, f"{name} {parts[key]:.0f} s", (x + 20, 28), INK, 16, 500) + 20
        self._legend(panel, left)
        return panel

    def _legend(self, panel: Image, left: int) -> None:
        def words(text: str, x: int, y: int) -> None:
            write_text(panel, text, (x, y), SOFT, 15, 500)

        def car(x: int, y: int, body: tuple[int, int, int], glass: tuple[int, int, int]) -> None:
            cv2.rectangle(panel, (x, y - 11), (x + 26, y + 1), INK, cv2.FILLED)
            cv2.rectangle(panel, (x + 1, y - 10), (x + 25, y), body, cv2.FILLED)
            cv2.rectangle(panel, (x + 16, y - 8), (x + 19, y - 2), glass, cv2.FILLED)

        right = left + 300
        car(left, 63, CAR, INK)
        words("the searching car", left + 38, 63)
        car(right, 63, PARKED_CAR, GLASS)
        words("a parked car, hidden until seen", right + 38, 63)
        cv2.line(panel, (left, 88), (left + 22, 88), INK, 2, cv2.LINE_AA)
        fill_disc(panel, np.array([left + 22.0, 88.0]), 5.0, INK)
        words("its plan", left + 38, 93)
        draw_dashes(panel, np.array([right, 88.0]), np.array([right + 28.0, 88.0]), WALK)
        words("the walk to the goal G", right + 38, 93)
        cv2.circle(panel, (left + 412, 118), 9, GLASS, 2, cv2.LINE_AA)
        words("sensor range", left + 430, 123)
        for half, (text, y) in enumerate((("what the map says", 123), ("what the car has seen", 151))):
            scale = np.zeros((24, 90, 3), np.uint8)
            draw_belief_key(scale, (0, 0), (90, 24))
            words("free", left, y)
            panel[y - 11 : y + 1, left + 40 : left + 130] = scale[12 * half : 12 * half + 12]
            words(f"taken: {text}", left + 140, y)


def film_search(case: Case, seed: int, path: Path) -> None:
    """Repeat a search of a case with simulated sensors, and write a film of it.

    Raises:
        InputError: the file cannot be written.
    """
    runner = case.runner()
    film = SearchFilm(case.scenario, runner.agent, case.label)
    runner.run(seed, (film,))
    film.save(path)
