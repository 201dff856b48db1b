"""Render a search from above: frames for videos and windows, and text for terminals."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.compiled.jit import compiled
from parkenv.driving.lot_outline import APRON, LotOutline
from parkenv.engine.state import SearchState
from parkenv.show import drawing
from parkenv.show.drawing import Color
from parkenv.show.window import Window
from parkenv.world.lot import ParkingLot
from parkenv.world.occupancy.process import DAY_NAMES
from parkenv.world.scenario import Scenario
from parkenv.world.week import DAY_S

WIDTH, HEIGHT = 640, 480
HUD = 34  # height, px, of the line of text below the map
HUD_MARGIN = 14
KEY_WIDTH = 172  # width, px, of the colour key at the right of that line
MARGIN = 8  # margin, px, around the lot
SMALLEST_SLOT = 4.0
"""Slot width, px, below which a frame shows a window around the car instead of the whole lot."""
WINDOW_SLOT = 9.0  # width, px, of a slot in such a window
LARGEST_SCALE = 22.0  # largest scale, px/m, so that a small lot does not fill the frame
SUPERSAMPLING = 4

BELIEF_ANCHORS: tuple[Color, ...] = (
    (0, 128, 115),
    (106, 190, 170),
    (245, 238, 215),
    (240, 150, 95),
    (192, 50, 25),
)
"""Colours of P(taken) = 0, 1/4, 1/2, 3/4, 1: greenish to red, distinguishable with any colour vision."""

GROUND: Color = (226, 228, 221)
ASPHALT: Color = (112, 116, 122)
BUILDING: Color = (190, 186, 178)
WALL: Color = (122, 116, 108)
PARKED_CAR: Color = (46, 52, 60)
GLASS: Color = (128, 140, 152)
CAR: Color = (255, 208, 0)
INK: Color = (24, 27, 31)
WALK: Color = (24, 82, 186)
GAVE_UP: Color = (255, 140, 90)
WHITE: Color = (255, 255, 255)

_LINE_WIDTH = 0.14  # m, paint between slots
_EDGE = 3.0  # m, around the lot's features
_PALENESS = 0.62

TEXT_WIDTH, TEXT_ROWS = 78, 17
"""Rows of the text map: with the lines above and below, it fits an 80 × 24 terminal."""
TEXT_CELL_LEAST, TEXT_CELL = 1.25, 3.5
"""Smallest and largest width, m, of a cell; larger lots show a window around the car, so slots stay apart."""


def _belief_scale() -> Image:
    """Colours, (2, 256, 3), of P(taken) = i/255: pale for unobserved slots, full for observed ones."""
    anchors = np.array(BELIEF_ANCHORS, dtype=np.float64)
    at = np.linspace(0.0, len(anchors) - 1.0, 256)
    full = np.stack([np.interp(at, np.arange(len(anchors)), channel) for channel in anchors.T], axis=1)
    pale = full + _PALENESS * (np.array(GROUND) - full)
    return np.round(np.stack([pale, full])).astype(np.uint8)


_BELIEF_SCALE = _belief_scale()


def belief_colors(p_occupied: NDArray[np.floating], seen: NDArray[np.bool_]) -> Image:
    """Return the colours, (n, 3) uint8 RGB, of slots with these probabilities of being taken, (n,)."""
    colors: Image = _BELIEF_SCALE[seen.astype(np.intp), np.round(255.0 * p_occupied).astype(np.intp)]
    return colors


def clock(time: float) -> str:
    """Weekday and time of day.

    Args:
        time: s since Monday 00:00.

    Examples:
        >>> clock(86400.0 + 34867.0)
        'Tue 09:41:07'
    """
    day, second = divmod(int(time), int(DAY_S))
    return f"{DAY_NAMES[day % 7].title()} {second // 3600:02d}:{second // 60 % 60:02d}:{second % 60:02d}"


@dataclass(frozen=True, eq=False)
class MapView:
    """Maps the lot's coordinates to pixels: `pixels = xy @ turn * scale + shift`."""

    turn: FloatArray  # (2, 2), north up, or north to the right
    scale: float  # px/m
    shift: FloatArray  # (2,) px

    @classmethod
    def fit(cls, xy: FloatArray, size: tuple[float, float], largest_scale: float = np.inf) -> Self:
        """Fit all points, (k, 2) m, centred, into an image of this width and height, px.

        North is up, or to the right if that makes the lot more than 20 % larger.
        """
        low, high = xy.min(axis=0), xy.max(axis=0)
        extent = np.maximum(high - low, 1e-6)
        upright, turned = (float(np.min(np.array(size) / e)) for e in (extent, extent[::-1]))
        scale = turned if turned > 1.2 * upright else upright
        return cls.around((low + high) / 2, size, min(scale, largest_scale), turned=scale > upright)

    @classmethod
    def around(
        cls, center: FloatArray, size: tuple[float, float], scale: float, *, turned: bool = False
    ) -> Self:
        """Centre the image on a point, (2,) m."""
        turn = np.array([[0.0, 1.0], [1.0, 0.0]] if turned else [[1.0, 0.0], [0.0, -1.0]])
        return cls(turn, scale, np.array(size) / 2 - center @ turn * scale)

    def __call__(self, xy: FloatArray) -> FloatArray:
        """Pixels, (..., 2), x right and y down, of points, (..., 2) m."""
        pixels: FloatArray = xy @ self.turn * self.scale + self.shift
        return pixels


@dataclass(frozen=True, eq=False)
class StillLayer:
    """The static background of the frames, and the pixels of the slots."""

    view: MapView  # map view of the frame
    image: Image  # (HEIGHT, WIDTH, 3) uint8, the image without slots
    slots: NDArray[np.int64]  # (m,) int64, the slots in the image
    pixel: NDArray[np.int64]  # (k,) int64, index of each pixel that shows a slot, in the flattened image
    slot: NDArray[np.int64]  # (k,) int64, index into `slots` of the slot it shows
    cover: NDArray[np.float32]  # (k,) float32, fraction of the pixel covered by the slot; the rest is paint
    car: NDArray[np.float32]  # (k, 3) float32, colour of a parked car there, multiplied by `car_cover`
    car_cover: NDArray[np.float32]  # (k,) float32, fraction of the pixel covered by the car


@compiled
def paint_slots(
    flat: Image,
    pixel: NDArray[np.int64],
    slot: NDArray[np.int64],
    cover: NDArray[np.float32],
    car: NDArray[np.float32],
    car_cover: NDArray[np.float32],
    colors: Image,
    taken: NDArray[np.bool_],
) -> None:
    """Paint the slots of a `StillLayer`, whose fields are the arguments, into its flattened image, (k, 3) uint8.

    Args:
        flat: the image, changed in place.
        pixel: as in `StillLayer`, as are the next four.
        slot: index into its slots.
        cover: fraction covered by the slot.
        car: colour of a parked car.
        car_cover: fraction covered by the car.
        colors: (m, 3) uint8, colour of each slot.
        taken: (m,) bool, whether a car stands in it.
    """
    for i in range(len(pixel)):
        s, p = slot[i], pixel[i]
        for c in range(3):
            value = flat[p, c] + cover[i] * (np.float32(colors[s, c]) - flat[p, c])
            if taken[s]:
                value = value * (np.float32(1.0) - car_cover[i]) + car[i, c]
            flat[p, c] = np.uint8(value + np.float32(0.5))


class SearchRenderer:
    """Renderer of the searches in one scenario.

    Asphalt, slots and cars are drawn once at high resolution; a frame then only mixes colours, so its cost does not
    grow with the number of slots. If slots would be less than `SMALLEST_SLOT` px wide, the frame shows a window around
    the car, which moves in steps of half its size.

    Args:
        scenario: the scenario.
        size: width and height of the map, px.
        hud: height of the line of text below it, px.

    Attributes:
        outline: the lot's shapes.
        window: shows frames on the screen.
    """

    def __init__(
        self, scenario: Scenario, size: tuple[int, int] = (WIDTH, HEIGHT - HUD), hud: int = HUD
    ) -> None:
        self.scenario = scenario
        self._map_size, self._hud = size, hud
        self.outline = LotOutline.of(scenario.lot)
        self._still: StillLayer | None = None
        self._window_at: tuple[int, int] | None = None
        self.window = Window(f"parkenv: {scenario.name}")
        self._size = (float(size[0]), float(size[1]))
        lot = scenario.lot
        room = (self._size[0] - 2 * MARGIN, self._size[1] - 2 * MARGIN)
        fitted = MapView.fit(lot_corners(lot), room, LARGEST_SCALE)
        self._slot_width = float(np.median(np.minimum(lot.slot_width, lot.slot_length)))
        self._whole: MapView | None = None
        if fitted.scale * self._slot_width >= SMALLEST_SLOT:
            self._whole = MapView(fitted.turn, fitted.scale, fitted.shift + MARGIN)

    def frame(self, state: SearchState, occupied: NDArray[np.bool_]) -> Image:
        """Render the current state, (480, 640, 3) uint8 RGB.

        A slot's colour shows the belief, pale until the slot has been observed. Parked cars show the true occupancy,
        so frames are for spectators, not for agents.

        Args:
            state: state of an environment with the renderer's scenario.
            occupied: (n_slots,) bool, the true occupancy.
        """
        image = self.draw_slots(state, occupied)
        view = self.still_layer(state).view
        self._draw_trail(image, view, state)
        self._draw_goal(image, view, state)
        self._draw_car(image, view, state)
        self._draw_hud(image, state)
        return image

    def draw_slots(self, state: SearchState, occupied: NDArray[np.bool_]) -> Image:
        """Render lot, beliefs and parked cars; see `frame`."""
        ground = self.still_layer(state)
        image = ground.image.copy()
        slots = ground.slots
        paint_slots(
            image.reshape(-1, 3),
            ground.pixel,
            ground.slot,
            ground.cover,
            ground.car,
            ground.car_cover,
            belief_colors(state.belief.p_occupied[slots], state.belief.observed[slots]),
            occupied[slots],
        )
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

    def still_layer(self, state: SearchState) -> StillLayer:
        """Return the static layer for the part of the lot that a frame shows."""
        if self._whole is not None:
            if self._still is None:
                self._still = self._draw_still_layer(self._whole)
            return self._still
        return self._window(self.scenario.lot.vertex_xy[state.vertex], WINDOW_SLOT, 2)

    def _window(self, place: FloatArray, slot_px: float, parts: int) -> StillLayer:
        """Return the layer around a position, (2,) m, with slots `slot_px` wide; it moves by 1/`parts` of its size."""
        # The window depends only on the position: equal states give equal frames.
        scale = slot_px / self._slot_width
        stride = np.array(self._size) / scale / parts
        column, row = np.round(place / stride).astype(int)
        if self._still is None or self._window_at != (column, row):
            self._window_at = column, row
            view = MapView.around(np.array([column, row]) * stride, self._size, scale)
            self._still = self._draw_still_layer(view)
        return self._still

    def _draw_still_layer(self, view: MapView) -> StillLayer:
        return draw_still_layer(self.scenario.lot, self.outline, view, self._map_size, self._hud)

    def _pose(self, state: SearchState) -> tuple[FloatArray, float]:
        """Return the car's position, (2,) m, and yaw."""
        lot, vertex = self.scenario.lot, state.vertex
        if state.parked:
            return lot.slot_xy[vertex], float(lot.slot_yaw[vertex])
        ahead = lot.vertex_xy[vertex] - lot.vertex_xy[state.path[-2] if len(state.path) > 1 else vertex]
        if not ahead.any():
            ahead = _way_in(lot, vertex)
        return lot.vertex_xy[vertex], float(np.arctan2(ahead[1], ahead[0]))

    def _place(self, state: SearchState) -> str:
        lot, vertex = self.scenario.lot, state.vertex
        if state.parked:
            return f"parked in slot {lot.slot_ids[vertex]}, {state.walk_s:.0f} s to walk"
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
        xy, yaw = self._pose(state)
        heading = np.array([np.cos(yaw), np.sin(yaw)]) @ view.turn
        quarter = round(float(np.arctan2(heading[1], heading[0])) / (np.pi / 2)) % 4
        put(xy[None], np.array([">v<^"[quarter]]))
        return ["".join(row).rstrip() for row in rows]

    def _draw_trail(self, image: Image, view: MapView, state: SearchState) -> None:
        xy = self.scenario.lot.vertex_xy[state.path]
        if state.parked:
            xy = np.vstack([xy, self.scenario.lot.slot_xy[state.vertex]])
        points = drawing.fixed_point(view(xy))
        ages = np.linspace(0, len(points) - 1, min(len(points), 25)).astype(int)
        thickness = min(max(2, round(0.5 * view.scale)), 5)
        for i, (first, last) in enumerate(pairwise(ages)):
            fresh = 0.35 + 0.65 * (i + 1) / (len(ages) - 1)
            color = drawing.mixed_color(ASPHALT, CAR, fresh)
            cv2.polylines(
                image, [points[first : last + 1]], False, color, thickness, cv2.LINE_AA, drawing.SUBPIXEL_BITS
            )

    def _draw_goal(self, image: Image, view: MapView, state: SearchState) -> None:
        lot = self.scenario.lot
        goal = view(lot.goals[self.scenario.goal])
        if state.parked:
            drawing.draw_dashes(image, view(lot.slot_xy[state.vertex]), goal, WALK)
        low, high = np.full(2, 14.0), np.array(self._size) - 14.0
        if (goal >= low).all() and (goal <= high).all():
            drawing.fill_disc(image, goal, 11.0, WHITE)
            drawing.fill_disc(image, goal, 9.5, WALK)
            drawing.write_label(image, "G", goal, WHITE, 13, 700)
            return
        middle = np.array(self._size) / 2
        away = goal - middle
        edge = middle + away * np.min((high - low) / 2 / np.maximum(np.abs(away), 1e-9))
        yaw = float(np.arctan2(away[1], away[0]))
        tip = np.array([[10.0, 0.0], [-8.0, 7.0], [-8.0, -7.0]]) @ drawing.rotation(yaw)
        drawing.fill_polygon(image, edge + 1.35 * tip, WHITE)
        drawing.fill_polygon(image, edge + tip, WALK)
        away_m = float(np.hypot(*(lot.goals[self.scenario.goal] - lot.vertex_xy[state.vertex])))
        text = f"goal {away_m:.0f} m"
        ahead = away / np.hypot(*away)
        room = np.abs(ahead) @ [drawing.text_width(text, 13, 700) / 2, 6.0] + 16.0
        drawing.write_label(image, text, edge - room * ahead, WALK, 13, 700, halo=True)

    def _draw_car(self, image: Image, view: MapView, state: SearchState) -> None:
        xy, yaw = self._pose(state)
        at = view(xy)
        if not state.parked:
            center = drawing.fixed_point(at)
            radius = round(self.scenario.sensor_model.view_range * view.scale * 2**drawing.SUBPIXEL_BITS)
            cv2.circle(image, tuple(center), radius, WHITE, 1, cv2.LINE_AA, drawing.SUBPIXEL_BITS)
        heading = np.array([np.cos(yaw), np.sin(yaw)]) @ view.turn
        turn = drawing.rotation(float(np.arctan2(heading[1], heading[0])))
        # A small car is drawn larger than to scale, to stay visible.
        length = max(4.4 * view.scale, 17.0)
        for part, color, swell in (
            (CAR_BODY, INK, 3.0),
            (CAR_BODY, CAR, 0.0),
            (WINDSCREEN, INK, 0.0),
            (REAR_WINDOW, INK, 0.0),
        ):
            drawing.fill_polygon(image, at + part * (np.array([length, 0.44 * length]) + swell) @ turn, color)

    def _draw_hud(self, image: Image, state: SearchState) -> None:
        parts = [
            clock(state.time),
            f"{state.time - state.arrival.time + state.walk_s + state.gave_up_s:.0f} s",
            f"{state.failed_parks} failed",
        ]
        x, baseline = HUD_MARGIN, HEIGHT - HUD // 2 + 5
        for part in parts:
            x = drawing.write_text(image, part, (x, baseline), WHITE, 15, 500) + 18
        if state.parked:
            place = f"parked in {self.scenario.lot.slot_ids[state.vertex]}"
            for verdict in (f"{place}, {state.walk_s:.0f} s to walk", place, "parked"):
                if x + drawing.text_width(verdict, 15, 600) <= WIDTH - KEY_WIDTH:
                    drawing.write_text(image, verdict, (x, baseline), CAR, 15, 600)
                    break
        elif state.over:
            drawing.write_text(image, "lot is full", (x, baseline), GAVE_UP, 15, 600)


def _fitting(words: list[str], width: int) -> str:
    """Join as many words as fit, and the number of the others."""
    for n in range(len(words), 0, -1):
        text = ", ".join(words[:n]) + (f", +{len(words) - n}" if n < len(words) else "")
        if len(text) <= width:
            return text
    return f"{len(words)} slots" if words else ""


def lot_corners(lot: ParkingLot) -> FloatArray:
    """Return two opposite corners, (2, 2) m, of what a frame of the whole lot shows."""
    low_x, low_y, high_x, high_y = lot.bounds()
    return np.array([[low_x - _EDGE, low_y - _EDGE], [high_x + _EDGE, high_y + _EDGE]])


def _way_in(lot: ParkingLot, vertex: int) -> FloatArray:
    """Return the unit vector, (2,), of the edge out of a vertex that points most directly toward the slots."""
    ahead = lot.vertex_xy[lot.neighbors[vertex][lot.neighbors[vertex] >= 0]] - lot.vertex_xy[vertex]
    if not len(ahead):
        return np.array([1.0, 0.0])
    ahead /= np.hypot(ahead[:, 0], ahead[:, 1])[:, None]
    best: FloatArray = ahead[np.argmax(ahead @ (lot.slot_xy.mean(axis=0) - lot.vertex_xy[vertex]))]
    return best


def draw_outline(
    image: Image,
    view: MapView,
    outline: LotOutline,
    center: FloatArray,
    reach: float,
    *,
    apron: float = APRON,
) -> None:
    """Draw buildings, asphalt and walls.

    Args:
        image: (h, w, 3) uint8, drawn upon.
        view: map view of the image, which has `SUPERSAMPLING` times the resolution of the frame.
        outline: outline of the lot.
        center: (2,) m, centre of the part to draw.
        reach: m, half the size of that part along both axes.
        apron: m, width of the asphalt beyond the kerbs.
    """
    for building in outline.buildings:
        cv2.fillPoly(
            image, [drawing.fixed_point(view(building))], BUILDING, cv2.LINE_8, drawing.SUBPIXEL_BITS
        )
    for rings in outline.paved(center, reach, apron=apron):
        pixels = [drawing.fixed_point(view(ring)) for ring in rings]
        cv2.fillPoly(image, pixels, ASPHALT, cv2.LINE_8, drawing.SUBPIXEL_BITS)
    thickness = max(SUPERSAMPLING, round(0.3 * view.scale))
    for wall in (*outline.buildings, *outline.walls):
        cv2.polylines(
            image, [drawing.fixed_point(view(wall))], False, WALL, thickness, 8, drawing.SUBPIXEL_BITS
        )


def draw_still_layer(
    lot: ParkingLot, outline: LotOutline, view: MapView, size: tuple[int, int], hud: int
) -> StillLayer:
    """Draw everything static at `SUPERSAMPLING` times the resolution, and average it down.

    Args:
        lot: the lot.
        outline: its shapes.
        view: map view of the frame.
        size: width and height of the map, px.
        hud: height of the line of text below it, px; it is left out if 0.
    """
    width, height = size
    fine = MapView(view.turn, view.scale * SUPERSAMPLING, view.shift * SUPERSAMPLING)
    shape = (height * SUPERSAMPLING, width * SUPERSAMPLING)
    at = view(lot.slot_xy)
    reach = view.scale * float(np.hypot(lot.slot_length, lot.slot_width).max()) / 2
    inside = (at > -reach).all(axis=1) & (at < np.array(size) + reach).all(axis=1)
    slots = np.flatnonzero(inside)
    along = np.stack([np.cos(lot.slot_yaw), np.sin(lot.slot_yaw)], axis=1)[slots, None]
    left = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    slot_length, slot_width = lot.slot_length[slots, None, None], lot.slot_width[slots, None, None]

    def placed(part: FloatArray, long: FloatArray, wide: FloatArray) -> NDArray[np.int32]:
        """Place a unit-size shape, (k, 2), in every slot; returns (m, k, 2) fixed-point pixels."""
        xy = lot.slot_xy[slots, None] + part[:, :1] * long * along + part[:, 1:] * wide * left
        return drawing.fixed_point(fine(xy))

    image = np.full((*shape, 3), GROUND, dtype=np.uint8)
    center = (np.array(size) / 2 - view.shift) @ view.turn.T / view.scale
    draw_outline(image, fine, outline, center, max(size) / 2 / view.scale)
    for x, y, yaw in outline.entries:
        onward = np.array([np.cos(yaw), np.sin(yaw)]) @ view.turn
        arrow = SUPERSAMPLING * _ENTRY_MARK @ drawing.rotation(float(np.arctan2(onward[1], onward[0])))
        drawing.fill_polygon(image, fine(np.array([x, y])) + arrow, WHITE)

    label = np.full(shape, -1, dtype=np.int32)
    cars = np.zeros((*shape, 3), dtype=np.uint8)
    has_car = np.zeros(shape, dtype=np.uint8)
    line = max(_LINE_WIDTH, 0.8 / view.scale)
    boxes = placed(_BOX, slot_length - line, slot_width - line)
    long, wide = np.minimum(0.8 * slot_length, 4.4), np.minimum(0.62 * slot_width, 1.75)
    bodies = placed(CAR_BODY, long, wide)
    glass = np.stack([placed(WINDSCREEN, long, wide), placed(REAR_WINDOW, long, wide)])
    for i in range(len(slots)):
        cv2.fillConvexPoly(image, boxes[i], WHITE, 8, drawing.SUBPIXEL_BITS)
        cv2.fillConvexPoly(label, boxes[i], i, 8, drawing.SUBPIXEL_BITS)
        cv2.fillConvexPoly(cars, bodies[i], PARKED_CAR, 8, drawing.SUBPIXEL_BITS)
        cv2.fillConvexPoly(has_car, bodies[i], 1, 8, drawing.SUBPIXEL_BITS)
        for pane in glass[:, i]:
            cv2.fillConvexPoly(cars, pane, GLASS, 8, drawing.SUBPIXEL_BITS)

    blocks = _blocks(label)
    owner = blocks.max(axis=-1)
    pixel = np.flatnonzero(owner >= 0)
    owner = owner.ravel()[pixel]
    blocks = blocks.reshape(height * width, -1)[pixel]
    own = blocks == owner[:, None]
    cars_here = _blocks(has_car).reshape(-1, SUPERSAMPLING**2)[pixel]
    colors = np.stack([_blocks(cars[..., c]).reshape(-1, SUPERSAMPLING**2)[pixel] for c in range(3)], axis=-1)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _draw_north(small, view)
    return StillLayer(
        view=view,
        image=np.vstack([small, _hud_strip(width, hud)]) if hud else small,
        slots=slots,
        pixel=pixel,
        slot=owner.astype(np.int64),
        cover=own.mean(axis=1, dtype=np.float32),
        car=(colors * cars_here[..., None]).mean(axis=1, dtype=np.float32),
        car_cover=cars_here.mean(axis=1, dtype=np.float32),
    )


def _blocks(fine: NDArray[Any]) -> NDArray[Any]:
    """Group the fine pixels by pixel, (rows, columns, SUPERSAMPLING ** 2)."""
    rows, columns = fine.shape[0] // SUPERSAMPLING, fine.shape[1] // SUPERSAMPLING
    split = fine.reshape(rows, SUPERSAMPLING, columns, SUPERSAMPLING)
    return split.swapaxes(1, 2).reshape(rows, columns, SUPERSAMPLING**2)


def _hud_strip(width: int, height: int) -> Image:
    """Return the background of the line of text, with the colour key."""
    image = np.full((height, width, 3), INK, np.uint8)
    top, right = height - height // 2 - 6, width - HUD_MARGIN
    drawing.write_label(image, "taken", np.array([right - 18.0, top + 6.0]), WHITE, 13, 400)
    draw_belief_key(image, (right - 116, top), (72, 12))
    drawing.write_label(image, "free", np.array([right - 132.0, top + 6.0]), WHITE, 13, 400)
    return image


def draw_belief_key(image: Image, at: tuple[int, int], size: tuple[int, int]) -> None:
    """Draw the colours of beliefs from free to taken, with the upper left corner `at` and a size in px.

    The upper half shows slots that have not been observed, the lower half those that have.
    """
    (left, top), (width, height) = at, size
    bar = np.linspace(0, 255, width).astype(int)
    for half in (0, 1):
        rows = slice(top + half * height // 2, top + (half + 1) * height // 2)
        image[rows, left : left + width] = _BELIEF_SCALE[half, bar]


def _draw_north(image: Image, view: MapView) -> None:
    north = np.array([0.0, 1.0]) @ view.turn
    at = np.array([float(image.shape[1] - 22), 24.0])
    turn = drawing.rotation(float(np.arctan2(north[1], north[0])))
    drawing.fill_polygon(
        image, at + np.array([[11.0, 0.0], [-3.0, 5.0], [-1.0, 0.0], [-3.0, -5.0]]) @ turn, INK
    )
    drawing.write_label(image, "N", at - 12.0 * north, INK, 12, 600)


_BOX = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
_ENTRY_MARK = np.array([[9.0, 0.0], [-6.0, 8.0], [-2.0, 0.0], [-6.0, -8.0]])
_CORNER = np.linspace(0, 2 * np.pi, 28, endpoint=False)
CAR_BODY = 0.5 * np.stack([np.sign(f) * np.abs(f) ** 0.4 for f in (np.cos(_CORNER), np.sin(_CORNER))], axis=1)
"""Outline of a car of unit length and width, nose to +x."""
WINDSCREEN = np.array([[0.24, -0.40], [0.24, 0.40], [0.10, 0.32], [0.10, -0.32]])
REAR_WINDOW = np.array([[-0.36, -0.36], [-0.36, 0.36], [-0.26, 0.30], [-0.26, -0.30]])
