"""The parts that frames of all environments share: the lot with its slots, the goal, and the line of text below."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.compiled.jit import compiled
from parkenv.show.painters.opencv import (
    SUBPIXEL_BITS,
    SUPERSAMPLING,
    MapView,
    fixed_point,
    paint,
    text_width,
    write_label,
    write_text,
)
from parkenv.show.scene import (
    ARROWHEAD,
    BELIEF_SCALE,
    CAR_BODY,
    DISC,
    PALETTE,
    REAR_WINDOW,
    SQUARE,
    WINDSCREEN,
    Color,
    Layer,
    LotScene,
    Marks,
    placed_shape,
    posed,
)
from parkenv.world.lot import ParkingLot
from parkenv.world.occupancy.arrival_window import DAY_NAMES
from parkenv.world.week import DAY_S

WIDTH, HEIGHT = 640, 480
HUD = 34  # height, px, of the line of text below the map
HUD_MARGIN = 14
MARGIN = 8.0  # margin, px, around the lot
# Slot width, px, below which a frame shows a window around the car instead of the whole lot.
SMALLEST_SLOT = 4.0
WINDOW_SLOT = 9.0  # width, px, of a slot in such a window
LARGEST_SCALE = 22.0  # largest scale, px/m, so that a small lot does not fill the frame
PIXELS = MapView(np.eye(2), 1.0, np.zeros(2))  # for layers in pixels

_LINE_WIDTH = 0.14  # m, paint between slots
_EDGE = 3.0  # m, around the lot's features
_CAR_EDGE, _NEAR = 0.12, 8.0  # m; px/m from which parked cars have a light edge, visible on any colour


def clock(time: float) -> str:
    day, second = divmod(int(time), int(DAY_S))
    return f"{DAY_NAMES[day % 7].title()} {second // 3600:02d}:{second // 60 % 60:02d}:{second % 60:02d}"


@dataclass(frozen=True, eq=False)
class StillLayer:
    view: MapView  # map view of the frame
    image: Image  # (height, width, 3) uint8, the image without slots
    slots: NDArray[np.int64]  # (m,) int64, the slots in the image
    pixel: NDArray[np.int64]  # (k,) int64, index of each pixel that shows a slot, in the flattened image
    slot: NDArray[np.int64]  # (k,) int64, index into `slots` of the slot it shows
    cover: NDArray[np.float32]  # (k,) float32, fraction of the pixel covered by the slot; the rest is paint
    car: NDArray[np.float32]  # (k, 3) float32, colour of a parked car there, multiplied by `car_cover`
    car_cover: NDArray[np.float32]  # (k,) float32, fraction of the pixel covered by the car


class LotFrames:
    """Pictures of one lot with its slots.

    Ground, slots and cars are drawn once at high resolution; a picture then only mixes colours, so its cost does not
    grow with the number of slots. If slots would be less than `smallest_slot` px wide, a picture shows a window around
    a place, which moves in steps of half its size.
    """

    def __init__(
        self,
        lot: ParkingLot,
        size: tuple[int, int] = (WIDTH, HEIGHT - HUD),
        *,
        smallest_slot: float = SMALLEST_SLOT,
    ) -> None:
        self.size, self._scene = size, LotScene.of(lot)
        self._still: StillLayer | None = None
        self._window_at = np.zeros(2)
        slot_width = float(np.median(np.minimum(lot.slot_width, lot.slot_length)))
        self._scale = WINDOW_SLOT / slot_width
        fitted = MapView.fit(lot_corners(lot), size, LARGEST_SCALE, MARGIN)
        self.whole = fitted if fitted.scale * slot_width >= smallest_slot else None

    def still(self, place: FloatArray) -> StillLayer:
        # The window depends only on the place: equal states give equal frames.
        stride = np.array(self.size) / self._scale / 2
        at = np.zeros(2) if self.whole is not None else np.round(place / stride)
        if self._still is None or (at != self._window_at).any():
            self._window_at = at
            view = self.whole or MapView.around(at * stride, self.size, self._scale)
            self._still = draw_still_layer(self._scene, view, self.size)
        return self._still

    def slots(self, place: FloatArray, colors: Image, taken: NDArray[np.bool_]) -> Image:
        still = self.still(place)
        image = still.image.copy()
        _paint_slots(
            image.reshape(-1, 3), still.pixel, still.slot, still.cover, still.car, still.car_cover,
            colors[still.slots], taken[still.slots],
        )  # fmt: skip
        return image


@compiled
def _paint_slots(
    flat: Image,
    pixel: NDArray[np.int64],
    slot: NDArray[np.int64],
    cover: NDArray[np.float32],
    car: NDArray[np.float32],
    car_cover: NDArray[np.float32],
    colors: Image,
    taken: NDArray[np.bool_],
) -> None:
    for i in range(len(pixel)):
        s, p = slot[i], pixel[i]
        for c in range(3):
            value = flat[p, c] + cover[i] * (np.float32(colors[s, c]) - flat[p, c])
            if taken[s]:
                value = value * (np.float32(1.0) - car_cover[i]) + car[i, c]
            flat[p, c] = np.uint8(value + np.float32(0.5))


def lot_corners(lot: ParkingLot) -> FloatArray:
    low_x, low_y, high_x, high_y = lot.bounds()
    return np.array([[low_x - _EDGE, low_y - _EDGE], [high_x + _EDGE, high_y + _EDGE]])


def painted_finely(
    view: MapView,
    size: tuple[int, int],
    layers: Sequence[Layer],
    ground: str = "ground",
    times: int = SUPERSAMPLING,
) -> Image:
    image = np.full((size[1] * times, size[0] * times, 3), PALETTE[ground], dtype=np.uint8)
    paint(image, view.finer(times), layers)
    return image


def draw_still_layer(scene: LotScene, view: MapView, size: tuple[int, int]) -> StillLayer:
    width, height = size
    lot, fine = scene.lot, view.finer()
    at = view(lot.slot_xy)
    reach = view.scale * float(np.hypot(lot.slot_length, lot.slot_width).max()) / 2
    slots = np.flatnonzero((at > -reach).all(axis=1) & (at < np.array(size) + reach).all(axis=1))
    poses = posed(lot.slot_xy[slots], lot.slot_yaw[slots])
    slot_size = np.stack([lot.slot_length, lot.slot_width], axis=1)[slots]

    center = (np.array(size) / 2 - view.shift) @ view.turn.T / view.scale
    entries = Marks(scene.entries, ARROWHEAD, "entry", px=16.0, edge="white", edge_px=1.5)
    image = painted_finely(view, size, [*scene.ground(center, max(size) / 2 / view.scale), entries])

    label = np.full(image.shape[:2], -1, dtype=np.int32)
    cars = np.zeros_like(image)
    has_car = np.zeros(image.shape[:2], dtype=np.uint8)
    boxes = fixed_point(fine(placed_shape(SQUARE, poses, slot_size - max(_LINE_WIDTH, 0.8 / view.scale))))
    car_size = np.minimum([0.8, 0.62] * slot_size, [4.4, 1.75])
    edges = fixed_point(fine(placed_shape(CAR_BODY, poses, car_size + 2 * _CAR_EDGE * (view.scale > _NEAR))))
    bodies, *panes = (
        fixed_point(fine(placed_shape(part, poses, car_size))) for part in (CAR_BODY, WINDSCREEN, REAR_WINDOW)
    )
    fills = (
        (image, boxes, PALETTE["paint"]),
        (cars, edges, PALETTE["paint"]),
        (has_car, edges, 1),
        (cars, bodies, PALETTE["parked"]),
        *((cars, pane, PALETTE["glass"]) for pane in panes),
    )
    for i in range(len(slots)):
        cv2.fillConvexPoly(label, boxes[i], i, 8, SUBPIXEL_BITS)
        for canvas, corners, color in fills:
            cv2.fillConvexPoly(canvas, corners[i], color, 8, SUBPIXEL_BITS)

    blocks = _blocks(label)
    owner = blocks.max(axis=-1)
    pixel = np.flatnonzero(owner >= 0)
    owner = owner.ravel()[pixel]
    own = blocks.reshape(height * width, -1)[pixel] == owner[:, None]
    cars_here = _blocks(has_car).reshape(-1, SUPERSAMPLING**2)[pixel]
    colors = np.stack([_blocks(cars[..., c]).reshape(-1, SUPERSAMPLING**2)[pixel] for c in range(3)], axis=-1)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _draw_north(small, view)
    car = (colors * cars_here[..., None]).mean(axis=1, dtype=np.float32)
    cover, car_cover = (of_pixel.mean(axis=1, dtype=np.float32) for of_pixel in (own, cars_here))
    return StillLayer(view, small, slots, pixel, owner.astype(np.int64), cover, car, car_cover)


def _blocks(fine: NDArray[Any]) -> NDArray[Any]:
    rows, columns = fine.shape[0] // SUPERSAMPLING, fine.shape[1] // SUPERSAMPLING
    split = fine.reshape(rows, SUPERSAMPLING, columns, SUPERSAMPLING)
    return split.swapaxes(1, 2).reshape(rows, columns, SUPERSAMPLING**2)


def _draw_north(image: Image, view: MapView) -> None:
    north = np.array([0.0, 1.0]) @ view.turn
    at = np.array([float(image.shape[1] - 22), 24.0])
    pose = posed(at + 3.0 * north, float(np.arctan2(north[1], north[0])))
    paint(image, PIXELS, [Marks(pose, ARROWHEAD, "ink", (14.0, 10.0))])
    write_label(image, "N", at - 12.0 * north, "ink", 12, 600)


def paint_goal(image: Image, view: MapView, goal: FloatArray, here: FloatArray | None = None) -> None:
    """Paint a goal, (2,) m; one outside of the image as an arrow to it, with the distance from `here`, (2,) m."""
    size = np.array(image.shape[1::-1], dtype=np.float64)
    at = view(goal)
    low, high = np.full(2, 14.0), size - 14.0
    if here is None or ((at >= low) & (at <= high)).all():
        paint(image, PIXELS, [Marks(posed(at), DISC, "goal", px=19.0, edge="white", edge_px=1.5)])
        write_label(image, "G", at, "white", 13, 700)
        return
    away = at - size / 2
    edge = size / 2 + away * np.min((high - low) / 2 / np.maximum(np.abs(away), 1e-9))
    pose = posed(edge, float(np.arctan2(away[1], away[0])))
    triangle = np.array([[0.56, 0.0], [-0.44, 0.39], [-0.44, -0.39]])
    paint(image, PIXELS, [Marks(pose, triangle, "goal", px=18.0, edge="white", edge_px=3.0)])
    text = f"goal {np.hypot(*(goal - here)):.0f} m"
    ahead = away / np.hypot(*away)
    room = np.abs(ahead) @ [text_width(text, 13, 700) / 2, 6.0] + 16.0
    write_label(image, text, edge - room * ahead, "goal", 13, 700, halo=True)


def write_line(
    image: Image,
    parts: Sequence[str],
    verdicts: Sequence[str] = (),
    color: str | Color = "car",
    room: int = 0,
) -> None:
    """Write texts side by side on a strip, and the first verdict that leaves `room` px free, in a colour."""
    x, baseline = HUD_MARGIN, image.shape[0] // 2 + 5
    for part in parts:
        write_text(image, part, (x, baseline), "white", 15, 500)
        x += max(text_width(part, 15, 500), 46) + 18
    for verdict in verdicts:
        if x + text_width(verdict, 15, 600) <= image.shape[1] - HUD_MARGIN - room:
            write_text(image, verdict, (x, baseline), color, 15, 600)
            break


def strip(height: int = HUD, width: int = WIDTH) -> Image:
    return np.full((height, width, 3), PALETTE["ink"], np.uint8)


def draw_belief_key(image: Image, at: tuple[int, int], size: tuple[int, int]) -> None:
    """Draw the colours of beliefs from free to taken, with the upper left corner `at` and a size in px.

    The upper half shows slots that have not been observed, the lower half those that have.
    """
    (left, top), (width, height) = at, size
    bar = np.linspace(0, 255, width).astype(int)
    for half in (0, 1):
        rows = slice(top + half * height // 2, top + (half + 1) * height // 2)
        image[rows, left : left + width] = BELIEF_SCALE[half, bar]
