"""Tileable noise, and image pyramids for compiled code."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_sensors.compilation import compiled

Float32Array = NDArray[np.float32]

# All fastmath flags except the one that excludes infinities: the depth of the sky is infinite.
FAST = {"reassoc", "nsz", "arcp", "contract", "afn"}
# Indices are unsigned in such functions: numba lets negative ones count from the end, which takes a comparison each.
# For functions that are called per pixel or triangle and do not allocate: numba's reference counting of their array
# arguments would cost ten times the computation.
LEAF = {"fastmath": FAST, "_nrt": False, "forceinline": True}


class Tile(NamedTuple):
    """A square, tileable grey texture with its image pyramid."""

    # (total,) float32, 0 to 1, level after level, each row-major and half as wide as the previous one
    levels: Float32Array
    start: NDArray[np.int64]  # (n_levels,) int64, start of each level
    size: int  # texels along a side of the finest level, a power of two


def fractal_noise(size: int, generator: np.random.Generator, slope: float) -> NDArray[np.float64]:
    """Return tileable noise with amplitude ∝ frequency^-slope; (size, size), mean 0, standard deviation 1."""
    frequency = np.fft.fftfreq(size)
    radius = np.hypot(frequency[:, None], frequency[None, :])
    radius[0, 0] = 1.0
    white = np.fft.fft2(generator.standard_normal((size, size)))
    noise = np.fft.ifft2(white * radius**-slope).real
    scaled: NDArray[np.float64] = (noise - noise.mean()) / noise.std()
    return scaled


def make_tile(image: NDArray[np.float64]) -> Tile:
    """Pack a square image, a power of two wide and in [0, 1], with its pyramid down to 4 texels."""
    level = np.ascontiguousarray(image, dtype=np.float32)
    levels = [level]
    while level.shape[0] > 4:
        half = level.shape[0] // 2
        level = level.reshape(half, 2, half, 2).mean(axis=(1, 3))
        levels.append(level)
    start = np.cumsum([0] + [part.size for part in levels[:-1]]).astype(np.int64)
    return Tile(np.concatenate([part.ravel() for part in levels]), start, image.shape[0])


@lru_cache(maxsize=1)
def grain_tile() -> Tile:
    """Return the grain of asphalt: white noise over some fractal noise, the same in every scene."""
    generator = np.random.default_rng(41)
    image = 0.5 + 0.13 * fractal_noise(512, generator, 0.35) + 0.07 * fractal_noise(512, generator, 0.9)
    return make_tile(np.clip(image, 0.0, 1.0))


@lru_cache(maxsize=1)
def cloud_tile() -> Tile:
    """Return soft noise for dirt, plaster, leaves and clouds, the same in every scene."""
    image = 0.5 + 0.2 * fractal_noise(512, np.random.default_rng(42), 1.35)
    return make_tile(np.clip(image, 0.0, 1.0))


@compiled(**LEAF)
def sample_tile(tile: Tile, u: float, v: float, level: int) -> float:
    """Return the bilinear value at (u, v), in periods of the tile, at one level of its pyramid."""
    level = min(max(level, 0), tile.start.shape[0] - 1)
    n = tile.size >> level
    x = u * n - 0.5
    y = v * n - 0.5
    column = int(np.floor(x))
    row = int(np.floor(y))
    a = x - column
    b = y - row
    mask = n - 1
    top = tile.start[level] + (row & mask) * n
    bottom = tile.start[level] + ((row + 1) & mask) * n
    left = column & mask
    right = (column + 1) & mask
    above = tile.levels[np.uint64(top + left)] * (1 - a) + tile.levels[np.uint64(top + right)] * a
    below = tile.levels[np.uint64(bottom + left)] * (1 - a) + tile.levels[np.uint64(bottom + right)] * a
    return float(above * (1 - b) + below * b)


@compiled(**LEAF)
def hash_unit(x: int, y: int) -> float:
    """Hash two integers to a number in [0, 1)."""
    h = (np.int64(x) * 374761393 + np.int64(y) * 668265263) & 0x7FFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0x7FFFFFFF
    return (h ^ (h >> 16)) / 2147483648.0


@compiled(**LEAF)
def pixel_level(texels: float) -> int:
    """Return the level of a 512-texel tile at which a texel is as large as a pixel that spans `texels` periods."""
    level = 0
    spans = texels * 512.0
    while spans > 1.4 and level < 7:
        spans *= 0.5
        level += 1
    return level
