"""Tileable noise, and image pyramids for compiled code."""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.jit import compiled

Single = Any  # a scalar in compiled code, float32 mostly: numba knows its type

# All fastmath flags except the one that excludes infinities: the depth of the sky is infinite.
FAST = {"reassoc", "nsz", "arcp", "contract", "afn"}
# For functions that are called per pixel or triangle and do not allocate: numba's reference counting of their array
# arguments would cost ten times the computation. Indices are unsigned in such functions: numba lets negative ones count
# from the end, which takes a comparison each.
LEAF = {"fastmath": FAST, "_nrt": False, "forceinline": True}
# Loops over pixels that become vector instructions: single precision, no two arrays overlap, no exceptions, and no
# branches, so both sides of a choice are computed. And the functions called in such loops.
VECTOR_LOOP = {"fastmath": FAST, "_nrt": False, "error_model": "numpy", "single": True, "distinct": True}
VECTOR_LEAF = {**LEAF, "error_model": "numpy", "single": True}


class Tile(NamedTuple):
    # (total,) uint32, `quads` of the texels, 255 = 1; level after level, each row-major, half as wide as the previous
    levels: NDArray[np.uint32]
    start: NDArray[np.int32]  # (n_levels,) int32, start of each level
    size: int  # texels along a side of the finest level, a power of two


def fractal_noise(size: int, generator: np.random.Generator, slope: float) -> NDArray[np.float64]:
    """Return tileable noise with amplitude ∝ frequency^-slope; (size, size), mean 0, standard deviation 1."""
    frequency = np.fft.fftfreq(size)
    radius = np.hypot(frequency[:, None], frequency[None, :])
    radius[0, 0] = 1.0
    white = np.fft.fft2(generator.standard_normal((size, size)))
    noise = np.fft.ifft2(white * radius**-slope).real
    return np.asarray((noise - noise.mean()) / noise.std())


def make_tile(image: NDArray[np.float64]) -> Tile:
    """Pack a square image, a power of two wide and in [0, 1], with its pyramid down to 4 texels."""
    level = np.asarray(image)
    levels = [level]
    while level.shape[0] > 4:
        half = level.shape[0] // 2
        level = level.reshape(half, 2, half, 2).mean(axis=(1, 3))
        levels.append(level)
    start = np.cumsum([0] + [part.size for part in levels[:-1]]).astype(np.int32)
    packed = [quads(np.round(255.0 * part).astype(np.uint8), True).ravel() for part in levels]
    return Tile(np.concatenate(packed), start, image.shape[0])


@compiled(nogil=True)
def quads(image: NDArray[np.uint8], tiled: bool) -> NDArray[np.uint32]:
    """Pack each texel with the next in its row (second byte), column (third) and both (fourth).

    One load then fetches all four texels of a bilinear sample. After the last texel comes the first in an image that is
    `tiled`, else the last once more.
    """
    rows, columns = image.shape
    packed = np.empty((rows, columns), dtype=np.uint32)
    after = 0 if tiled else columns - 1
    for row in range(rows):
        here, below = image[row], image[row + 1 if row + 1 < rows else (0 if tiled else row)]
        for column in range(columns - 1):
            packed[row, column] = _quad(here[column], here[column + 1], below[column], below[column + 1])
        packed[row, columns - 1] = _quad(here[columns - 1], here[after], below[columns - 1], below[after])
    return packed


@compiled(forceinline=True)
def _quad(here: Single, right: Single, below: Single, across: Single) -> Single:
    return np.uint32(here) | np.uint32(right) << 8 | np.uint32(below) << 16 | np.uint32(across) << 24


@lru_cache(maxsize=1)
def grain_tile() -> Tile:
    generator = np.random.default_rng(41)
    image = 0.5 + 0.13 * fractal_noise(512, generator, 0.35) + 0.07 * fractal_noise(512, generator, 0.9)
    return make_tile(np.clip(image, 0.0, 1.0))


@lru_cache(maxsize=1)
def cloud_noise() -> NDArray[np.float64]:
    """Return soft noise for dirt, plaster, leaves and clouds, (512, 512), 0 to 1, the same in every scene."""
    return np.clip(0.5 + 0.2 * fractal_noise(512, np.random.default_rng(42), 1.35), 0.0, 1.0)


@lru_cache(maxsize=1)
def cloud_tile() -> Tile:
    return make_tile(cloud_noise())


@compiled(**VECTOR_LEAF)
def sample_tile(tile: Tile, u: Single, v: Single, level: int) -> Single:
    level = min(max(level, 0), tile.start.shape[0] - 1)
    n = tile.size >> level
    x = u * np.float32(n) - 0.5
    y = v * np.float32(n) - 0.5
    column = np.floor(x)
    row = np.floor(y)
    mask = n - 1
    i = tile.start[np.uint64(level)] + (np.int32(row) & mask) * n + (np.int32(column) & mask)
    return mix_quad(tile.levels[np.uint64(i)], x - column, y - row)


@compiled(**VECTOR_LEAF)
def mix_quad(quad: Single, a: Single, b: Single) -> Single:
    """Interpolate between the four texels of `quads`, from 0 to 1; a is the fraction along the row."""
    above = mix(byte(quad, 0), byte(quad, 8), a)
    below = mix(byte(quad, 16), byte(quad, 24), a)
    return mix(above, below, b) * (1.0 / 255.0)


@compiled(**VECTOR_LEAF)
def byte(packed: Single, shift: int) -> Single:
    return np.float32(np.int32((packed >> np.uint32(shift)) & np.uint32(255)))


@compiled(**VECTOR_LEAF)
def mix(a: Single, b: Single, fraction: Single) -> Single:
    return a + (b - a) * fraction


@compiled(**VECTOR_LEAF)
def hash_unit(x: int, y: int) -> Single:
    h = (np.int64(x) * 374761393 + np.int64(y) * 668265263) & 0x7FFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0x7FFFFFFF
    return np.float32(h ^ (h >> 16)) * (1.0 / 2147483648.0)


@compiled(**VECTOR_LEAF)
def pixel_level(texels: Single) -> Single:
    """Return the level of a 512-texel tile at which a texel is as large as a pixel that spans `texels` periods."""
    level = 0
    limit = 1.4 / 512.0
    for _ in range(7):
        level += texels > limit
        limit *= 2.0
    return level
