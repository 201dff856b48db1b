"""Draw anti-aliased shapes and text on images with subpixel precision (OpenCV)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, Image

Color = tuple[int, int, int]

SUBPIXEL_BITS = 4
FONT = cv2.FontFace("sans")


def rotation(yaw: float) -> FloatArray:
    """Return the matrix that rotates row vectors by `yaw` in image axes."""
    return np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])


def fixed_point(pixels: FloatArray) -> NDArray[np.int32]:
    """Convert pixels to OpenCV's fixed-point numbers, whose pixel centres are integers."""
    fixed: NDArray[np.int32] = np.round((pixels - 0.5) * 2**SUBPIXEL_BITS).astype(np.int32)
    return fixed


def mixed_color(start: Color, end: Color, share: float) -> Color:
    """Interpolate between two colours."""
    red, green, blue = (round(a + share * (b - a)) for a, b in zip(start, end, strict=True))
    return red, green, blue


def fill_polygon(image: Image, pixels: FloatArray, color: Color) -> None:
    """Fill a polygon, (k, 2) px, anti-aliased."""
    cv2.fillPoly(image, [fixed_point(pixels)], color, cv2.LINE_AA, SUBPIXEL_BITS)


def fill_disc(image: Image, at: FloatArray, radius: float, color: Color) -> None:
    """Fill a disc, anti-aliased."""
    x, y = fixed_point(at).tolist()
    cv2.circle(image, (x, y), round(radius * 2**SUBPIXEL_BITS), color, -1, cv2.LINE_AA, SUBPIXEL_BITS)


def draw_dashes(image: Image, start: FloatArray, end: FloatArray, color: Color) -> None:
    """Draw a dashed line."""
    n = max(1, round(float(np.hypot(*(end - start))) / 9.0))
    ends = start + np.linspace(0, 1, 2 * n)[:, None] * (end - start)
    for dash in fixed_point(ends).reshape(n, 2, 2):
        cv2.polylines(image, [dash], False, color, 2, cv2.LINE_AA, SUBPIXEL_BITS)


def write_text(image: Image, text: str, at: tuple[int, int], color: Color, size: int, weight: int) -> int:
    """Write text from a point on the baseline; returns its right end, px."""
    (right, _), _ = cv2.putText(image, text, at, color, FONT, size, weight)
    return int(right)


def write_tag(image: Image, text: str, at: tuple[int, int], color: Color) -> None:
    """Write dark text on a coloured ground with its upper left corner at a point."""
    left, top = at
    end = left + 8 + text_width(text, 13, 600)
    cv2.rectangle(image, at, (end, top + 20), color, cv2.FILLED)
    write_text(image, text, (left + 4, top + 15), (16, 16, 16), 13, 600)


def text_width(text: str, size: int, weight: int) -> int:
    """Return the width of a text, px."""
    _, _, width, _ = cv2.getTextSize((1 << 14, 1 << 14), text, (0, 0), FONT, size, weight)
    return int(width)


def write_label(
    image: Image, text: str, at: FloatArray, color: Color, size: int, weight: int, *, halo: bool = False
) -> None:
    """Write text centred at a point, kept inside the image."""
    width = text_width(text, size, weight)
    left = int(np.clip(round(at[0] - width / 2), 2, image.shape[1] - width - 2))
    base = round(at[1] + 0.36 * size)
    if halo:
        for dx, dy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            cv2.putText(image, text, (left + dx, base + dy), (255, 255, 255), FONT, size, weight)
    cv2.putText(image, text, (left, base), color, FONT, size, weight)
