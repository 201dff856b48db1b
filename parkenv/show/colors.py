"""Colours of pictures: what a lot is made of, cars and marks, and the belief about a slot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Image

Color = tuple[int, int, int]

PALETTE: Mapping[str, Color] = {
    "ground": (228, 231, 223),
    "asphalt": (104, 108, 114),
    "paint": (255, 255, 255),
    "building": (200, 194, 182),
    "wall": (126, 118, 107),
    "entry": (29, 138, 78),
    "goal": (24, 82, 186),
    "parked": (46, 52, 60),
    "glass": (128, 140, 152),
    "car": (255, 208, 0),
    "mover": (24, 82, 186),
    "resident": (74, 150, 226),
    "ink": (24, 27, 31),
    "white": (255, 255, 255),
    "warning": (255, 140, 90),
    "leaving": (148, 70, 200),
    "floor": (206, 209, 212),
    "side": (255, 127, 80),
    "oblique": (120, 200, 80),
    "end": (86, 180, 233),
    "wrong": (224, 33, 138),
    "graph": (255, 217, 138),
}
"""Names of colours, each with one meaning: yellow is the car, blue the goal and the walk to it.

Pages have their own values, for light and dark themes, in `report/style.css`.
"""

BELIEF_ANCHORS: tuple[Color, ...] = (
    (0, 128, 115),
    (106, 190, 170),
    (245, 238, 215),
    (240, 150, 95),
    (192, 50, 25),
)
"""Colours of P(taken) = 0, 1/4, 1/2, 3/4, 1: greenish to red, distinguishable with any colour vision."""
FREE: Color = BELIEF_ANCHORS[0]

_PALENESS = 0.62


def rgb(color: Any) -> Color:
    if isinstance(color, str) and not color.startswith("#"):
        return PALETTE[color]
    red, green, blue = bytes.fromhex(color[1:]) if isinstance(color, str) else map(int, color)
    return red, green, blue


def hex_color(name: str) -> str:
    return "#{:02x}{:02x}{:02x}".format(*PALETTE[name])


def mixed_color(start: str | Color, end: str | Color, share: float) -> Color:
    red, green, blue = (round(a + share * (b - a)) for a, b in zip(rgb(start), rgb(end), strict=True))
    return red, green, blue


def _belief_scale() -> Image:
    anchors = np.array(BELIEF_ANCHORS, dtype=np.float64)
    at = np.linspace(0.0, len(anchors) - 1.0, 256)
    full = np.stack([np.interp(at, np.arange(len(anchors)), channel) for channel in anchors.T], axis=1)
    pale = full + _PALENESS * (np.array(PALETTE["ground"]) - full)
    return np.round(np.stack([pale, full])).astype(np.uint8)


BELIEF_SCALE = _belief_scale()
"""Colours, (2, 256, 3) uint8, of P(taken) = i/255: unobserved slots, then observed ones."""


def belief_colors(p_occupied: NDArray[np.floating], seen: NDArray[np.bool_]) -> Image:
    """Return the colours, (n, 3) uint8 RGB, of slots with these probabilities of being taken, (n,)."""
    return np.asarray(BELIEF_SCALE[seen.astype(np.intp), np.round(255.0 * p_occupied).astype(np.intp)])
