"""Frames and text of a search, from above."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import SlotBelief
from parkenv.compiled.arrays import FloatArray, Image
from parkenv.engine.state import SearchState
from parkenv.show.frames.lot import (
    HUD,
    HUD_MARGIN,
    LotFrames,
    clock,
    draw_belief_key,
    lot_corners,
    paint_goal,
    strip,
    write_line,
)
from parkenv.show.frames.window import Window
from parkenv.show.painters.opencv import MapView, paint, write_label
from parkenv.show.scene import DISC, Layer, Lines, Marks, belief_colors, cars, mixed_color, posed
from parkenv.world.lot import ParkingLot
from parkenv.world.scenario import Scenario

_LIKELY = 0.25  # P(about to leave) from which a car is marked
_KEY_WIDTH = 158  # width, px, of the colour key at the right of the line of text

# Rows of the text map: with the lines above and below, it fits an 80 × 24 terminal.
TEXT_WIDTH, TEXT_ROWS = 78, 17
# Smallest and largest width, m, of a cell; larger lots show a window around the car, so slots stay apart.
TEXT_CELL_LEAST, TEXT_CELL = 1.25, 3.5


class SearchRenderer:
    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.frames = LotFrames(scenario.lot)
        self._key = _strip_with_key()
        self.window = Window(f"parkenv: {scenario.name}")

    def frame(self, state: SearchState, occupied: NDArray[np.bool_] | None = None) -> Image:
        """Render the current state, (480, 640, 3) uint8 RGB.

        A slot's colour shows the belief, pale until the slot has been observed. Parked cars show the true occupancy,
        so frames are for spectators, not for agents.
        """
        lot, belief = self.scenario.lot, state.belief
        if occupied is None:
            occupied = state.world.occupied(np.arange(lot.n_slots), state.time)
        here = lot.vertex_xy[state.vertex]
        image = self.frames.slots(here, belief_colors(belief.p_occupied, belief.observed), occupied)
        view, pose = self.frames.still(here).view, car_pose(self.scenario, state.path, parked=state.parked)
        goal = lot.goals[self.scenario.goal]
        path = lot.vertex_xy[state.path]
        if state.parked:
            path = np.vstack([path, pose[:2]])
        paint(image, view, [fading_trail(path), *([walk(pose[:2], goal)] if state.parked else [])])
        paint_goal(image, view, goal, here)
        around = [leaving_cars(lot, belief)]
        around += [] if state.parked else [view_range(self.scenario, pose)]
        paint(image, view, [*around, *searching_car(pose)])
        return np.vstack([image, self._line(state)])

    def _line(self, state: SearchState) -> Image:
        image = self._key.copy()
        parts = (clock(state.time), f"{state.total_s:.0f} s", f"{state.failed_parks} failed")
        if state.parked:
            place = f"parked in {self.scenario.lot.slot_ids[state.vertex]}"
            verdicts = (
                f"{place}, {_price_and_walk(state)}",
                f"{place}, {state.walk_s:.0f} s to walk",
                place,
                "parked",
            )
            write_line(image, parts, verdicts, room=_KEY_WIDTH)
        else:
            write_line(image, parts, ("lot is full",) * bool(state.over), "warning", _KEY_WIDTH)
        return image

    def text(self, state: SearchState) -> str:
        """Render what the car knows as text, at most 22 lines of 78 characters."""
        lot, belief = self.scenario.lot, state.belief
        starts, seen_from = self.scenario.slots_in_view
        near = seen_from[starts[state.vertex] : starts[state.vertex + 1]]
        observations = [
            f"{lot.slot_ids[s]} {'taken' if belief.p_occupied[s] > 0.5 else 'free'}" for s in near
        ]
        around = _fitting(observations, TEXT_WIDTH - len("in view: ")) or "no slot"
        lines = [
            f"{lot.name}: {self._place(state)}",
            f"{clock(state.time)}  elapsed {state.time - state.arrival.time:.1f} s  "
            f"failed attempts {state.failed_parks}  observed {int(belief.observed.sum())}/{lot.n_slots}",
            f"in view: {around}",
            *self._text_map(state),
            "observed: o free  # taken   not: . likely free  : undecided  % likely taken",
            "<>^v car   + driven   G goal   E entry",
        ]
        return "\n".join(line[:TEXT_WIDTH] for line in lines)

    def _place(self, state: SearchState) -> str:
        lot, vertex = self.scenario.lot, state.vertex
        if state.parked:
            return f"parked in slot {lot.slot_ids[vertex]}, {_price_and_walk(state)}"
        if state.over:
            return "every slot is taken, parking elsewhere"
        return f"at slot {lot.slot_ids[vertex]}" if vertex < lot.n_slots else f"at junction {vertex}"

    def _text_map(self, state: SearchState) -> list[str]:
        lot, belief = self.scenario.lot, state.belief
        size = (TEXT_WIDTH - 1.0, 2.0 * TEXT_ROWS - 1.0)  # a character is twice as high as wide
        view = MapView.fit(lot_corners(lot), size, 1 / TEXT_CELL_LEAST)
        if view.scale < 1 / TEXT_CELL:
            view = MapView.around(lot.vertex_xy[state.vertex], size, 1 / TEXT_CELL)
        rows = np.full((TEXT_ROWS, TEXT_WIDTH), " ")

        def put(xy: FloatArray, glyphs: NDArray[np.str_]) -> None:
            column, row = np.floor(view(xy) / [1.0, 2.0]).astype(int).T
            here = (column >= 0) & (column < TEXT_WIDTH) & (row >= 0) & (row < TEXT_ROWS)
            rows[row[here], column[here]] = glyphs[here]

        # If slots share a cell, the one most likely to be free is written last.
        order = np.argsort(-belief.p_occupied, kind="stable")
        likely = np.searchsorted([1 / 3, 2 / 3], belief.p_occupied)
        glyphs = np.where(belief.observed, np.array(list("oo#"))[likely], np.array(list(".:%"))[likely])
        put(lot.vertex_xy[state.path], np.full(len(state.path), "+"))
        put(lot.slot_xy[order], glyphs[order])
        put(lot.entries, np.full(len(lot.entries), "E"))
        put(lot.goals[[self.scenario.goal]], np.array(["G"]))
        pose = car_pose(self.scenario, state.path, parked=state.parked)
        put(pose[None, :2], np.array([">v<^"[round(float(view.yaw(pose[2])) / (np.pi / 2)) % 4]]))
        return ["".join(row).rstrip() for row in rows]


def _price_and_walk(state: SearchState) -> str:
    price = f"price {state.parking_cost_s:.0f} s, " if state.parking_cost_s else ""
    return f"{price}{state.walk_s:.0f} s to walk"


def _strip_with_key() -> Image:
    image = strip()
    top, right = HUD // 2 - 6, image.shape[1] - HUD_MARGIN
    write_label(image, "taken", (right - 18.0, top + 6.0), "white", 13, 400)
    draw_belief_key(image, (right - 116, top), (72, 12))
    write_label(image, "free", (right - 132.0, top + 6.0), "white", 13, 400)
    return image


def car_pose(scenario: Scenario, path: Sequence[int], *, parked: bool) -> FloatArray:
    lot, vertex = scenario.lot, path[-1]
    if parked:
        return np.array([*lot.slot_xy[vertex], lot.slot_yaw[vertex]])
    ahead = lot.vertex_xy[vertex] - lot.vertex_xy[path[-2] if len(path) > 1 else vertex]
    if not ahead.any():
        ahead = _way_in(lot, vertex)
    return np.array([*lot.vertex_xy[vertex], np.arctan2(ahead[1], ahead[0])])


def searching_car(pose: FloatArray) -> list[Layer]:
    return cars(pose[None], "car", px=17.0, edge="ink")


def view_range(scenario: Scenario, pose: FloatArray) -> Layer:
    circle = pose[:2] + 2.0 * scenario.sensor_model.view_range * DISC
    return Lines([np.vstack([circle, circle[:1]])], "white")


def leaving_cars(lot: ParkingLot, belief: SlotBelief) -> Layer:
    """Mark the slots whose cars are likely about to leave, by the belief."""
    slots = np.flatnonzero(belief.announced > _LIKELY)
    return Marks(posed(lot.slot_xy[slots]), DISC, "leaving", px=11.0, edge="white", edge_px=2.0)


def walk(slot: FloatArray, goal: FloatArray) -> Layer:
    return Lines([np.stack([slot, goal])], "goal", px=(2.0, 2.0), dash=(4.5, 4.5))


def fading_trail(path: FloatArray) -> Layer:
    ages = np.linspace(0, len(path) - 1, min(len(path), 25)).astype(int)
    pieces = [path[first : last + 1] for first, last in pairwise(ages)]
    colors = [mixed_color("asphalt", "car", 0.35 + 0.65 * (i + 1) / len(pieces)) for i in range(len(pieces))]
    return Lines(pieces, colors, 0.5, (2.0, 5.0))


def _fitting(words: list[str], width: int) -> str:
    for n in range(len(words), 0, -1):
        text = ", ".join(words[:n]) + (f", +{len(words) - n}" if n < len(words) else "")
        if len(text) <= width:
            return text
    return f"{len(words)} slots" if words else ""


def _way_in(lot: ParkingLot, vertex: int) -> FloatArray:
    ahead = lot.vertex_xy[lot.neighbors[vertex][lot.neighbors[vertex] >= 0]] - lot.vertex_xy[vertex]
    if not len(ahead):
        return np.array([1.0, 0.0])
    ahead /= np.hypot(ahead[:, 0], ahead[:, 1])[:, None]
    return np.asarray(ahead[np.argmax(ahead @ (lot.slot_xy.mean(axis=0) - lot.vertex_xy[vertex]))])
