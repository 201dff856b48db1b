"""Paint the layers of a scene, and text, on images: anti-aliased, with subpixel precision (OpenCV)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.show.scene import HALO_PX, PALETTE, Areas, Color, Layer, Lines, Marks, Paint, placed_shape, rgb

SUBPIXEL_BITS = 4
SUPERSAMPLING = 4
FONT = cv2.FontFace("sans")


@dataclass(frozen=True, eq=False)
class MapView:
    """Maps the lot's coordinates to pixels: `pixels = xy @ turn * scale + shift`."""

    turn: FloatArray  # (2, 2), north up, or north to the right
    scale: float  # px/m
    shift: FloatArray  # (2,) px
    density: int = 1  # pixels of the image for a pixel of the picture, along both axes

    @classmethod
    def fit(
        cls, xy: FloatArray, size: tuple[float, float], largest_scale: float = np.inf, margin: float = 0.0
    ) -> Self:
        """Fit all points, (k, 2) m, centred, into an image of this width and height, px.

        North is up, or to the right if that makes the lot more than 20 % larger.
        """
        low, high = xy.min(axis=0), xy.max(axis=0)
        extent = np.maximum(high - low, 1e-6)
        room = np.array(size) - 2 * margin
        upright, turned = (float(np.min(room / e)) for e in (extent, extent[::-1]))
        scale = turned if turned > 1.2 * upright else upright
        return cls.around((low + high) / 2, size, min(scale, largest_scale), turned=scale > upright)

    @classmethod
    def around(
        cls, center: FloatArray, size: tuple[float, float], scale: float, *, turned: bool = False
    ) -> Self:
        turn = np.array([[0.0, 1.0], [1.0, 0.0]] if turned else [[1.0, 0.0], [0.0, -1.0]])
        return cls(turn, scale, np.array(size) / 2 - center @ turn * scale)

    def __call__(self, xy: FloatArray) -> FloatArray:
        """Pixels, (..., 2), x right and y down, of points, (..., 2) m."""
        return np.asarray(xy @ self.turn * self.scale + self.shift)

    def yaw(self, yaw: FloatArray) -> FloatArray:
        ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1) @ self.turn
        return np.asarray(np.arctan2(ahead[..., 1], ahead[..., 0]))

    def finer(self, times: int = SUPERSAMPLING) -> MapView:
        return MapView(self.turn, times * self.scale, times * self.shift, times)


def paint(image: Image, view: MapView, layers: Sequence[Layer]) -> None:
    for layer in layers:
        below = image.copy() if layer.opacity < 1.0 else None
        if isinstance(layer, Areas):
            _paint_areas(image, view, layer)
        elif isinstance(layer, Lines):
            _paint_lines(image, view, layer)
        else:
            _paint_marks(image, view, layer)
        if below is not None:
            cv2.addWeighted(image, layer.opacity, below, 1.0 - layer.opacity, 0.0, image)


def _paint_areas(image: Image, view: MapView, layer: Areas) -> None:
    for rings, color in zip(layer.polygons, _colors(layer.color, len(layer.polygons)), strict=True):
        pixels = [fixed_point(view(ring)) for ring in rings]
        cv2.fillPoly(image, pixels, color, _line_type(view), SUBPIXEL_BITS)
        if layer.edge is not None:
            thickness = max(1, round(layer.edge_px * view.density))
            cv2.polylines(image, pixels, True, rgb(layer.edge), thickness, _line_type(view), SUBPIXEL_BITS)


def _paint_lines(image: Image, view: MapView, layer: Lines) -> None:
    if not len(layer.lines):
        return
    least, most = (end * view.density for end in layer.px)
    width = min(max(layer.width * view.scale, least), most)
    all_pixels = view(np.concatenate(layer.lines))
    ends = [0, *accumulate(map(len, layer.lines))]
    # All lines are rounded at once: most have two points only.
    fixed = fixed_point(all_pixels)
    lines = [fixed[first:last] for first, last in pairwise(ends)]

    def stroke(lines: Sequence[NDArray[np.int32]], color: Color, thickness: float) -> None:
        cv2.polylines(image, lines, False, color, max(1, round(thickness)), _line_type(view), SUBPIXEL_BITS)

    if layer.halo is not None:
        stroke(lines, rgb(layer.halo), width + HALO_PX * view.density)
    parts = [[line] for line in lines]
    if layer.dash is not None:
        on, off = (part * view.density for part in layer.dash)
        pixels = (all_pixels[first:last] for first, last in pairwise(ends))
        parts = [[*fixed_point(_dashes(line, on, off))] for line in pixels]
    if _is_one(layer.color):
        stroke([piece for pieces in parts for piece in pieces], rgb(layer.color), width)
        return
    for pieces, color in zip(parts, _colors(layer.color, len(parts)), strict=True):
        stroke(pieces, color, width)


def _dashes(pixels: FloatArray, on: float, off: float) -> FloatArray:
    along = np.r_[0.0, np.cumsum(np.hypot(*np.diff(pixels, axis=0).T))]
    n = max(1, round((along[-1] + off) / (on + off)))
    start = (on + off) * np.arange(n) * (along[-1] + off) / (n * (on + off))
    ends = np.stack([start, np.minimum(start + on, along[-1])], axis=1)
    return np.stack([np.interp(ends, along, axis) for axis in pixels.T], axis=-1)


def _paint_marks(image: Image, view: MapView, layer: Marks) -> None:
    if not len(layer.poses):
        return
    at = np.column_stack([view(layer.poses[:, :2]), view.yaw(layer.poses[:, 2])])
    size = layer.sizes(view.scale, layer.px * view.density)
    fills = [(size, _colors(layer.color, len(at)))]
    if layer.edge is not None:
        fills.insert(0, (size + 2.0 * layer.edge_px * view.density, [rgb(layer.edge)] * len(at)))
    for shown, colors in fills:
        for corners, color in zip(fixed_point(placed_shape(layer.shape, at, shown)), colors, strict=True):
            cv2.fillPoly(image, [corners], color, _line_type(view), SUBPIXEL_BITS)


def _colors(color: Paint, n: int) -> list[Color]:
    return [rgb(color)] * n if _is_one(color) else [rgb(each) for each in color]


def _is_one(color: Paint) -> bool:
    return isinstance(color, str) or (isinstance(color, tuple) and isinstance(color[0], int))


def _line_type(view: MapView) -> int:
    """Anti-alias, unless the image is averaged down later."""
    return cv2.LINE_AA if view.density == 1 else cv2.LINE_8


def fixed_point(pixels: FloatArray) -> NDArray[np.int32]:
    """Convert pixels to OpenCV's fixed-point numbers, whose pixel centres are integers."""
    return np.asarray(np.round((pixels - 0.5) * 2**SUBPIXEL_BITS).astype(np.int32))


def write_text(
    image: Image, text: str, at: tuple[int, int], color: str | Color, size: int, weight: int
) -> int:
    (right, _), _ = cv2.putText(image, text, at, rgb(color), FONT, size, weight)
    return int(right)


def write_tag(image: Image, text: str, at: tuple[int, int], color: Color) -> None:
    left, top = at
    end = left + 8 + text_width(text, 13, 600)
    cv2.rectangle(image, at, (end, top + 20), color, cv2.FILLED)
    write_text(image, text, (left + 4, top + 15), (16, 16, 16), 13, 600)


def text_width(text: str, size: int, weight: int) -> int:
    _, _, width, _ = cv2.getTextSize((1 << 14, 1 << 14), text, (0, 0), FONT, size, weight)
    return int(width)


def write_label(
    image: Image,
    text: str,
    at: Sequence[float] | FloatArray,
    color: str | Color,
    size: int,
    weight: int,
    *,
    halo: bool = False,
) -> None:
    width = text_width(text, size, weight)
    left = int(np.clip(round(at[0] - width / 2), 2, image.shape[1] - width - 2))
    base = round(at[1] + 0.36 * size)
    if halo:
        for dx, dy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            cv2.putText(image, text, (left + dx, base + dy), PALETTE["white"], FONT, size, weight)
    cv2.putText(image, text, (left, base), rgb(color), FONT, size, weight)
