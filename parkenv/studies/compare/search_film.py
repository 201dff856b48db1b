"""Film of a search through simulated sensors: the lot from above, the camera's view, captions, clock and legend."""

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.engine.search_record import Moment, SearchRecord
from parkenv.show.figures.picture_files import save_film
from parkenv.show.figures.survey import draw_detections
from parkenv.show.frames.lot import PIXELS, LotFrames, clock, draw_belief_key, paint_goal, strip
from parkenv.show.frames.search import car_pose, leaving_cars, searching_car, view_range, walk
from parkenv.show.painters.opencv import paint, write_text
from parkenv.show.scene import DISC, PALETTE, Layer, Lines, Marks, belief_colors, cars, posed, rgb
from parkenv.studies.compare.cases import Case
from parkenv.world.cost_terms import COST_FIELDS, COST_TERMS
from parkenv.world.lot import PARK

FPS = 10.0
DRIVE_SPEEDUP, WALK_SPEEDUP = 3.0, 12.0  # playback speed relative to real time
MOST_FRAMES = 360  # maximum number of frames; longer searches are played faster
COLORS = 192  # number of colours of a film: enough for drawings and the camera's image
# Width of a frame, and heights of the caption and of the panel below the map, px.
WIDTH, CAPTION, PANEL = 840, 48, 172
MAP_HEIGHT = (220, 420)  # least and greatest height of the map, px
PAPER = (248, 248, 245)
SOFT = (96, 104, 112)
INTRO_S, FAILED_S, PARKED_S, LAST_S = 2.5, 1.2, 1.2, 4.0  # how long single frames are shown, s

_PARKING_FRAMES = 5
_CAMERA = (213, 160)


class SearchFilm:
    def __init__(self, record: SearchRecord) -> None:
        self._record, self._scenario = record, record.scenario
        self.frames: list[Image] = []
        lot = self._scenario.lot
        west, south, east, north = lot.bounds()
        height = int(np.clip(WIDTH * (north - south + 6.0) / (east - west + 6.0), *MAP_HEIGHT))
        self._map = LotFrames(lot, (WIDTH, height))
        self._camera = np.full((_CAMERA[1], _CAMERA[0], 3), PALETTE["ground"], np.uint8)
        self._parts = dict.fromkeys(COST_FIELDS, 0.0)
        self._moment, self._path = record.moments[0], [record.moments[0].vertex]
        self._pose, self._trail = car_pose(self._scenario, self._path, parked=False), list[FloatArray]()
        self._look(camera=False)
        self._take("A car arrives. Its map says how likely each slot is taken.", hold=INTRO_S)
        for moment in record.moments[1:]:
            self._step(moment)
        self._end()

    def _step(self, moment: Moment) -> None:
        lot, before = self._scenario.lot, dict(self._parts)
        self._moment = moment
        if moment.vertex != self._path[-1]:
            self._path.append(moment.vertex)
        start, end = self._pose, car_pose(self._scenario, self._path, parked=self._parked)
        self._parts |= {key: float(moment.info[key]) for key in self._parts if key != "walk_s"}
        if moment.action == PARK and not self._parked:
            self._look(camera=False)
            self._take(
                f"Slot {lot.slot_ids[moment.vertex]} is taken after all: a failed attempt", hold=FAILED_S
            )
            return
        plan = [lot.vertex_xy[v] for v in moment.plan] if moment.action != PARK else []
        seconds = self._parts["drive_s"] - before["drive_s"]
        count = _PARKING_FRAMES if self._parked else max(1, round(seconds * FPS / DRIVE_SPEEDUP))
        text = (
            f"Slot {lot.slot_ids[moment.vertex]} is free: it parks" if self._parked else self._seen_so_far()
        )
        turn = math.remainder(end[2] - start[2], 2 * math.pi)
        self._trail.append(start[:2])
        for i in range(1, count + 1):
            share = i / count
            # On a lane the car has turned by the first half of an edge.
            heading = start[2] + turn * (share if self._parked else min(2 * share, 1.0))
            self._pose = np.array([*(start + share * (end - start))[:2], heading])
            elapsed = {k: before[k] + share * (self._parts[k] - before[k]) for k in before}
            if i == count:
                self._look()
            self._take(text, [self._pose[:2], *plan], elapsed)
        self._pose = end

    def _end(self) -> None:
        lot, metrics = self._scenario.lot, self._record.metrics
        if not self._parked:
            self._parts |= {key: float(metrics[key]) for key in self._parts}
            self._take(f"No free slot found: {metrics['total_s']:.0f} s", hold=LAST_S)
            return
        slot, goal = lot.slot_xy[self._moment.vertex], lot.goals[self._scenario.goal]
        self._look()
        text = f"The driver walks {metrics['walked_m']:.0f} m to the goal"
        self._take(text, hold=PARKED_S)
        count = max(2, round(float(metrics["walk_s"]) * FPS / WALK_SPEEDUP))
        for i in range(1, count + 1):
            share = i / count
            elapsed = self._parts | {"walk_s": share * float(metrics["walk_s"])}
            self._take(text, elapsed=elapsed, walker=slot + share * (goal - slot))
        self._parts |= {key: float(metrics[key]) for key in self._parts}
        self._take(f"At the goal after {metrics['total_s']:.0f} s", hold=LAST_S, walker=goal)

    def save(self, path: Path) -> None:
        step = -(-len(self.frames) // MOST_FRAMES)
        save_film([*self.frames[:-1:step], self.frames[-1]], path, fps=FPS, colors=COLORS)

    @property
    def _parked(self) -> bool:
        return bool(self._moment.info.get("parked"))

    def _look(self, *, camera: bool = True) -> None:
        """Update the colours of the slots and the picture of the camera."""
        moment, slots = self._moment, np.arange(self._scenario.lot.n_slots)
        occupied = self._record.world.occupied(slots, moment.time)
        if self._parked:
            occupied[moment.vertex] = False  # the searching car itself is there
        elif camera and moment.captures:
            view = moment.captures[-1].views[0]
            drawn = draw_detections(view.image, view.detections, view.cars.detection)
            self._camera = cv2.resize(drawn, _CAMERA, interpolation=cv2.INTER_AREA)
        belief = moment.belief
        colors = belief_colors(belief.p_occupied, belief.observed)
        self._slots = self._map.slots(self._here, colors, occupied)

    @property
    def _here(self) -> FloatArray:
        here: FloatArray = self._scenario.lot.vertex_xy[self._moment.vertex]
        return here

    def _map_image(self, plan: Sequence[FloatArray], walker: FloatArray | None) -> Image:
        scenario, here = self._scenario, self._here
        image, view, goal = self._slots.copy(), self._map.still(here).view, scenario.lot.goals[scenario.goal]
        layers: list[Layer] = []
        if len(plan) > 1:
            layers += [
                Lines([np.array(plan)], "ink", px=(2.0, 2.0)),
                Marks(posed(plan[-1]), DISC, "ink", px=10.0),
            ]
        trail = np.array([*self._trail, self._pose[:2]])
        layers.append(Lines([trail], "car", px=(3.0, 3.0), halo="ink"))
        if self._parked:
            layers.append(walk(scenario.lot.slot_xy[self._moment.vertex], goal))
        paint(image, view, layers)
        paint_goal(image, view, goal, here)
        around = [leaving_cars(scenario.lot, self._moment.belief)]
        around += [] if self._parked else [view_range(scenario, self._pose)]
        walker_at = (
            [] if walker is None else [Marks(posed(walker), DISC, "goal", px=12.0, edge="white", edge_px=2.0)]
        )
        paint(image, view, [*around, *searching_car(self._pose), *walker_at])
        return image

    def _seen_so_far(self) -> str:
        belief = self._moment.belief
        if belief.announced.max(initial=0.0) > 0.5:
            leaving = self._scenario.lot.slot_ids[int(belief.announced.argmax())]
            return f"The car in slot {leaving} is about to leave"
        seen = belief.p_occupied[belief.observed] > 0.5
        saw = f"Its camera and laser saw {seen.sum()} taken and {(~seen).sum()} free slots"
        return saw if len(seen) else "It searches"

    def _take(
        self,
        caption: str,
        plan: Sequence[FloatArray] = (),
        elapsed: dict[str, float] | None = None,
        walker: FloatArray | None = None,
        hold: float = 0.0,
    ) -> None:
        parts = elapsed or self._parts
        top = strip(CAPTION, WIDTH)
        write_text(top, caption, (16, 32), "white", 22, 600)
        seconds = sum(parts.values())
        write_text(top, clock(self._record.arrival.time + seconds)[4:], (WIDTH - 186, 32), "car", 20, 500)
        write_text(top, f"{seconds:.0f} s", (WIDTH - 76, 32), "car", 22, 700)
        frame = np.vstack([top, self._map_image(plan, walker), self._panel(parts)])
        self.frames += [frame] * max(1, round(hold * FPS))

    def _panel(self, parts: dict[str, float]) -> Image:
        panel = np.full((PANEL, WIDTH, 3), PAPER, np.uint8)
        width, height = _CAMERA
        panel[6 : 6 + height, 6 : 6 + width] = self._camera
        cv2.rectangle(panel, (6, 6), (6 + 136, 6 + 20), PALETTE["ink"], cv2.FILLED)
        write_text(panel, "camera, detected cars", (11, 20), "white", 12, 500)
        left = width + 28
        x = write_text(panel, f"agent {self._record.agent}:", (left, 28), "ink", 16, 700) + 12
        for term in COST_TERMS:
            if parts[term.field] or not term.optional:
                cv2.rectangle(panel, (x, 15), (x + 13, 28), rgb(term.color), cv2.FILLED)
                words = f"{term.label} {parts[term.field]:.0f} s"
                x = 20 + write_text(panel, words, (x + 20, 28), "ink", 16, 500)
        _draw_legend(panel, left, self._scenario.cues is not None)
        return panel


def _draw_legend(panel: Image, left: int, cues: bool) -> None:
    right, size = left + 300, (26.0, 12.0)
    circle = np.array([left + 412.0, 118.0]) + 18.0 * np.vstack([DISC, DISC[:1]])
    layers = [
        *cars(posed(np.array([left + 13.0, 58.0])), "car", size, edge="ink"),
        *cars(posed(np.array([right + 13.0, 58.0])), "parked", size, glass="glass"),
        Lines([np.array([[left, 88.0], [left + 22.0, 88.0]])], "ink", px=(2.0, 2.0)),
        Marks(posed(np.array([left + 22.0, 88.0])), DISC, "ink", px=10.0),
        walk(np.array([right, 88.0]), np.array([right + 28.0, 88.0])),
        Lines([circle], "glass", px=(2.0, 2.0)),
    ]
    paint(panel, PIXELS, layers)
    scale = np.zeros((24, 90, 3), np.uint8)
    draw_belief_key(scale, (0, 0), (90, 24))
    words = [
        ("the searching car", left + 38, 63),
        ("a parked car, hidden until seen", right + 38, 63),
        ("its plan", left + 38, 93),
        ("the walk to the goal G", right + 38, 93),
        ("sensor range", left + 430, 123),
    ]
    if cues:
        paint(panel, PIXELS, [Marks(posed(np.array([left + 412.0, 148.0])), DISC, "leaving", px=11.0)])
        words.append(("about to leave", left + 430, 153))
    for half, (text, y) in enumerate((("what the map says", 123), ("what the car has seen", 151))):
        words += [("free", left, y), (f"taken: {text}", left + 140, y)]
        panel[y - 11 : y + 1, left + 40 : left + 130] = scale[12 * half : 12 * half + 12]
    for text, x, y in words:
        write_text(panel, text, (x, y), SOFT, 15, 500)


def film_search(case: Case, seed: int, path: Path) -> None:
    SearchFilm(case.runner().run(seed, moments=True)).save(path)
