"""Random textures behind the cars of simulated images, so that models do not learn that backgrounds are smooth.

Real streets have brick, leaves, fences, shop windows and posters right behind the cars; the simulated ones have flat
walls. Grain, bars and boxes of random shape and contrast replace them (domain randomization, Tobin et al. 2017).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, Image

_OCTAVES = (2.0, 4.0, 8.0, 16.0, 32.0)  # px
_ON_THE_GROUND = 0.15


def with_backdrop(grey: Image, far: NDArray[np.bool_], rng: np.random.Generator) -> Image:
    """Add texture to the background of an image, and sometimes a little to the rest.

    Args:
        grey: (h, w) uint8.
        far: (h, w) bool, mask of the background behind the cars.
        rng: random generator.
    """
    if not far.any():
        return grey
    texture = random_texture(grey.shape, rng) * np.float32(rng.uniform(8.0, 45.0))
    before = np.float32(_ON_THE_GROUND if rng.random() < 0.3 else 0.0)
    values = grey.astype(np.float32)
    mean = values[far].mean()
    behind = mean + (values - mean) * np.float32(rng.uniform(0.3, 1.0))
    values = np.where(far, behind + texture, values + before * texture)
    return np.asarray(np.clip(values, 0.0, 255.0), dtype=np.uint8)


def random_texture(shape: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
    """Return random texture, (h, w) float32, mean 0, standard deviation 1: grain, bars or neither, perhaps boxes."""
    texture = np.zeros(shape, dtype=np.float32)
    kind = rng.choice(["grain", "bars", "boxes"], p=[0.6, 0.2, 0.2])
    if kind == "grain":
        texture += _grain(shape, rng)
    elif kind == "bars":
        texture += _bars(shape, rng)
    if kind == "boxes" or rng.random() < 0.5:
        texture = _standardized(texture)
        _draw_boxes(texture, rng)
    return _standardized(texture)


def _grain(shape: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
    """Return noise of several scales, stretched: leaves, stone, plaster."""
    height, width = shape
    grain = np.zeros(shape, dtype=np.float32)
    for size in _OCTAVES:
        across, down = size * np.exp(rng.normal(0.0, 0.4, 2))
        coarse = rng.standard_normal((max(2, int(height / down)), max(2, int(width / across))))
        fine = cv2.resize(coarse.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
        grain += fine * np.float32(size ** rng.uniform(-0.3, 0.5))
    return grain


def _bars(shape: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
    """Return stripes, grids and bricks at any angle, mostly upright."""
    height, width = shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    angle = float(rng.choice([0.0, math.pi / 2, rng.uniform(0.0, math.pi)]))
    pitch = rng.uniform(5.0, 40.0)
    u = (x * math.cos(angle) + y * math.sin(angle)) / pitch
    v = (y * math.cos(angle) - x * math.sin(angle)) / (pitch * rng.uniform(0.3, 3.0))
    if rng.random() < 0.5:
        u = u + 0.5 * (np.floor(v) % 2)
    thick = rng.uniform(0.08, 0.5)
    bars = u % 1.0 < thick
    if rng.random() < 0.6:
        bars |= v % 1.0 < thick
    return np.asarray(bars, dtype=np.float32)


def _draw_boxes(texture: Float32Array, rng: np.random.Generator) -> None:
    """Draw signs, windows, doors: rectangles of any shade, mostly upright."""
    height, width = texture.shape
    for _ in range(int(rng.integers(4, 40))):
        center = float(rng.uniform(0, width)), float(rng.uniform(0, height))
        across, down = np.exp(rng.uniform(1.2, 4.6, 2)).tolist()
        turn = float(rng.uniform(-90.0, 90.0)) if rng.random() < 0.25 else 0.0
        corners = cv2.boxPoints((center, (across, down), turn)).astype(np.int32)
        cv2.fillPoly(texture, [corners], float(rng.normal(0.0, 1.5)))


def _standardized(texture: Float32Array) -> Float32Array:
    centred = texture - texture.mean()
    deviation = float(centred.std())
    return np.asarray(centred / deviation if deviation > 0.0 else centred, dtype=np.float32)
