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
from parkenv.envs.perception import SearchPerceptionEnv
from parkenv.show.colors import PALETTE, belief_colors, rgb
from parkenv.show.figures.picture_files import save_film
from parkenv.show.figures.survey import draw_detections
from parkenv.show.frames.lot import PIXELS, LotFrames, clock, draw_belief_key, paint_goal, strip
from parkenv.show.frames.search import car_pose, searching_car, view_range, walk
from parkenv.show.painters.opencv import paint, write_text
from parkenv.show.scene import DISC, Lines, Marks, cars, posed
from parkenv.studies.compare.cases import Case
from parkenv.studies.simulate import EpisodeResult, Observer, Step
from parkenv.world.cost_terms import COST_FIELDS, COST_TERMS
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
        lot = inner.scenario.lot
        west, south, east, north = lot.bounds()
        height = int(np.clip(WIDTH * (north - south + 6.0) / (east - west + 6.0), *MAP_HEIGHT))
        self._map = LotFrames(lot, (WIDTH, height))
        self._slots = self._slots_image()
        self._camera = np.full((_CAMERA[1], _CAMERA[0], 3), PALETTE["ground"], np.uint8)
        self._parts = dict.fromkeys(COST_FIELDS, 0.0)
        self._pose, self._trail = car_pose(inner.scenario, inner.state), list[FloatArray]()
        self._take("A car arrives. Its map says how likely each slot is taken.", hold=INTRO_S)

    def on_step(self, step: Step) -> None:
        """Show the way to the next vertex, or the parking attempt."""
        state, lot = self._env.state, self._scenario.lot
        start, end = self._pose, car_pose(self._scenario, state)
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
        turn = math.remainder(end[2] - start[2], 2 * math.pi)
        self._trail.append(start[:2])
        for i in range(1, count + 1):
            share = i / count
            # On a lane the car has turned by the first half of an edge.
            heading = start[2] + turn * (share if state.parked else min(2 * share, 1.0))
            self._pose = np.array([*(start + share * (end - start))[:2], heading])
            elapsed = {k: before[k] + share * (self._parts[k] - before[k]) for k in before}
            if i == count:
                self._look()
            self._take(text, [self._pose[:2], *plan], elapsed)
        self._pose = end

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
        belief = state.belief
        return self._map.slots(self._here, belief_colors(belief.p_occupied, belief.observed), occupied)

    @property
    def _here(self) -> FloatArray:
        """Position of the car's vertex, (2,) m, which a window on a large lot shows."""
        here: FloatArray = self._scenario.lot.vertex_xy[self._env.state.vertex]
        return here

    def _map_image(self, plan: Sequence[FloatArray], walker: FloatArray | None) -> Image:
        """Return the map with the plan, the trail, the goal, the car and the walking driver."""
        state, scenario, here = self._env.state, self._scenario, self._here
        image, view, goal = self._slots.copy(), self._map.still(here).view, scenario.lot.goals[scenario.goal]
        if len(plan) > 1:
            line = np.array(plan)
            paint(
                image,
                view,
                [Lines([line], "ink", px=(2.0, 2.0)), Marks(posed(line[-1]), DISC, "ink", px=10.0)],
            )
        trail = np.array([*self._trail, self._pose[:2]])
        paint(image, view, [Lines([trail], "car", px=(3.0, 3.0), halo="ink")])
        if state.parked:
            paint(image, view, [walk(scenario.lot.slot_xy[state.vertex], goal)])
        paint_goal(image, view, goal, here)
        if not state.parked:
            paint(image, view, [view_range(scenario, self._pose)])
        paint(image, view, searching_car(self._pose))
        if walker is not None:
            paint(image, view, [Marks(posed(walker), DISC, "goal", px=12.0, edge="white", edge_px=2.0)])
        return image

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
        top = strip(CAPTION, WIDTH)
        write_text(top, caption, (16, 32), "white", 22, 600)
        seconds = sum(parts.values())
        write_text(top, clock(state.arrival.time + seconds)[4:], (WIDTH - 186, 32), "car", 20, 500)
        write_text(top, f"{seconds:.0f} s", (WIDTH - 76, 32), "car", 22, 700)
        frame = np.vstack([top, self._map_image(plan, walker), self._panel(parts)])
        self.frames += [frame] * max(1, round(hold * FPS))

    def _panel(self, parts: dict[str, float]) -> Image:
        """Draw the camera's image, the parts of the time so far, and the legend."""
        panel = np.full((PANEL, WIDTH, 3), PAPER, np.uint8)
        width, height = _CAMERA
        panel[6 : 6 + height, 6 : 6 + width] = self._camera
        cv2.rectangle(panel, (6, 6), (6 + 136, 6 + 20), PALETTE["ink"], cv2.FILLED)
        write_text(panel, "camera, detected cars", (11, 20), "white", 12, 500)
        left = width + 28
        x = write_text(panel, f"agent {self._name}:", (left, 28), "ink", 16, 700) + 12
        for term in COST_TERMS:
            if term.optional and not parts[term.field]:
                continue
            cv2.rectangle(panel, (x, 15), (x + 13, 28), rgb(term.color), cv2.FILLED)
            x = (
                write_text(panel, f"{term.label} {parts[term.field]:.0f} s", (x + 20, 28), "ink", 16, 500)
                + 20
            )
        self._legend(panel, left)
        return panel

    def _legend(self, panel: Image, left: int) -> None:
        def words(text: str, x: int, y: int) -> None:
            write_text(panel, text, (x, y), SOFT, 15, 500)

        right, size = left + 300, (26.0, 12.0)
        dots = posed(np.array([left + 22.0, 88.0]))
        circle = np.array([left + 412.0, 118.0]) + 18.0 * np.vstack([DISC, DISC[:1]])
        layers = [
            *cars(posed(np.array([left + 13.0, 58.0])), "car", size, edge="ink"),
            *cars(posed(np.array([right + 13.0, 58.0])), "parked", size, glass="glass"),
            Lines([np.array([[left, 88.0], [left + 22.0, 88.0]])], "ink", px=(2.0, 2.0)),
            Marks(dots, DISC, "ink", px=10.0),
            walk(np.array([right, 88.0]), np.array([right + 28.0, 88.0])),
            Lines([circle], "glass", px=(2.0, 2.0)),
        ]
        paint(panel, PIXELS, layers)
        words("the searching car", left + 38, 63)
        words("a parked car, hidden until seen", right + 38, 63)
        words("its plan", left + 38, 93)
        words("the walk to the goal G", right + 38, 93)
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
