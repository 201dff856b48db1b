"""Texture of the ground: asphalt with patches, cracks, oil and worn paint, drawn once per scene."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.jit import compiled
from sim_sensors.camera.textures import VECTOR_LEAF, Single, byte, fractal_noise, mix
from sim_sensors.mesh import Ground

_FINEST = 0.025  # m a texel
_MOST_TEXELS = 20e6
_MARGIN = 6.0  # m of ground drawn around paved and painted areas
_STRIP = 64  # rows
_SUBPIXEL = 4  # bits of fraction in OpenCV's polygon corners


class GroundTexture(NamedTuple):
    # (total,) from the lowest byte on: square root of the grey albedo, fraction of grass, capacity for water, 255 = 1
    texels: NDArray[np.uint32]
    start: NDArray[np.int32]  # (n_levels,) first texel of each level
    shape: NDArray[np.int32]  # (n_levels, 2) rows and columns of each level
    per_m: NDArray[np.float32]  # (n_levels, 2) texels per metre along y and x
    x: float  # m, and y: corner of the image
    y: float
    texel: float  # m, side of a texel of the finest level


_TEXTURES: WeakKeyDictionary[Ground, GroundTexture] = WeakKeyDictionary()


def ground_texture(ground: Ground) -> GroundTexture:
    """Return the texture of a ground; made on first use (about 1 s) and cached as long as the ground exists."""
    if ground not in _TEXTURES:
        _TEXTURES[ground] = _draw(ground)
    return _TEXTURES[ground]


def _draw(ground: Ground) -> GroundTexture:
    generator = np.random.default_rng(ground.seed)
    low, high = _extent(ground)
    texel = max(_FINEST, math.sqrt(float(np.prod(high - low)) / _MOST_TEXELS))
    columns, rows = (np.ceil((high - low) / texel / 16).astype(int) * 16).tolist()

    def corners(points: NDArray[np.float64]) -> NDArray[np.int32]:
        # OpenCV's coordinates start at the centre of the first pixel.
        pixels: NDArray[np.float64] = (points - low) / texel - 0.5
        return np.asarray(np.round(pixels * 2**_SUBPIXEL), dtype=np.int32)

    paved = np.zeros((rows, columns), dtype=np.uint8)
    for polygon in ground.paved:
        cv2.fillPoly(paved, [corners(polygon)], 255, cv2.LINE_AA, _SUBPIXEL)
    paint = np.zeros_like(paved)
    for x0, y0, x1, y1, width in ground.markings:
        cv2.fillConvexPoly(paint, corners(_strip(x0, y0, x1, y1, width)), 255, cv2.LINE_AA, _SUBPIXEL)

    blotches = _spread(fractal_noise(512, generator, 1.3), columns, texel, 40.0)
    mottles = _spread(fractal_noise(512, generator, 0.8), columns, texel, 9.0)
    grains = _beside(generator.standard_normal((512, 512)).astype(np.float32), columns)

    def noise(strip: slice) -> list[NDArray[np.float32]]:
        return [each[np.arange(strip.start, strip.stop) % len(each)] for each in (blotches, mottles, grains)]

    # What is computed in strips stays in the processor's cache.
    strips = [slice(first, min(first + _STRIP, rows)) for first in range(0, rows, _STRIP)]
    asphalt = np.empty(paved.shape, dtype=np.float32)
    for strip in strips:
        blotch, mottle, grain = noise(strip)
        asphalt[strip] = 0.115 * (1.0 + 0.16 * blotch + 0.1 * mottle + 0.13 * grain)
    _repair(asphalt, generator, texel)
    stains = _stains(paved.shape, ground, corners, generator, texel)
    cracks = _cracks(paved.shape, generator, texel)
    texels = np.empty((rows, columns, 3), dtype=np.uint8)
    for strip in strips:
        blotch, mottle, grain = noise(strip)
        dark = asphalt[strip] * (1.0 - 0.75 * (stains[strip].astype(np.float32) / 255.0))
        dark *= 1.0 - 0.6 * cracks[strip].astype(np.float32) / 255.0
        # Paint wears off under tyres and on protruding stones.
        wear = np.clip(0.8 - 0.28 * mottle - 0.2 * blotch - 0.14 * grain, 0.1, 0.95)
        cover = wear * (paint[strip].astype(np.float32) / 255.0)
        grey = dark * (1.0 - cover) + (0.5 + 0.05 * blotch + 0.02 * grain) * cover

        on_pavement = paved[strip].astype(np.float32) / 255.0
        grass = 0.075 * (1.0 + 0.2 * blotch + 0.25 * mottle + 0.35 * grain)
        light = np.sqrt(np.clip(grey * on_pavement + grass * (1.0 - on_pavement), 0.004, 1.0))
        water = np.clip(0.4 - 0.3 * blotch - 0.1 * mottle, 0.0, 1.0) * on_pavement
        for channel, values in enumerate((light, 1.0 - on_pavement, water)):
            texels[strip, :, channel] = (values * 255.0).astype(np.uint8)
    return _pyramid(texels, low, texel)


def _extent(ground: Ground) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    points = [np.zeros((1, 2)) if not ground.paved and not len(ground.markings) else np.empty((0, 2))]
    points.extend(ground.paved)
    points.extend((ground.markings[:, :2], ground.markings[:, 2:4]))
    stacked = np.concatenate(points)
    return stacked.min(axis=0) - _MARGIN, stacked.max(axis=0) + _MARGIN


def _strip(x0: float, y0: float, x1: float, y1: float, width: float) -> NDArray[np.float64]:
    along = np.array([x1 - x0, y1 - y0])
    across = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9) * width / 2.0
    start, end = np.array([x0, y0]), np.array([x1, y1])
    return np.stack([start - across, end - across, end + across, start + across])


def _spread(noise: NDArray[np.float64], columns: int, texel: float, period: float) -> NDArray[np.float32]:
    size = max(8, round(period / texel))
    return _beside(cv2.resize(noise.astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC), columns)


def _beside(tile: NDArray[Any], columns: int) -> NDArray[np.float32]:
    return np.tile(tile, columns // tile.shape[1] + 1)[:, :columns]


def _repair(asphalt: NDArray[np.float32], generator: np.random.Generator, texel: float) -> None:
    rows, columns = asphalt.shape
    for _ in range(int(asphalt.size * texel**2 / 250.0)):
        height, width = (generator.uniform(0.5, 3.5, 2) / texel).astype(int)
        row, column = int(generator.integers(rows)), int(generator.integers(columns))
        asphalt[row : row + height, column : column + width] *= generator.uniform(0.72, 1.18)


def _stains(
    shape: tuple[int, ...],
    ground: Ground,
    corners: Callable[[NDArray[np.float64]], NDArray[np.int32]],
    generator: np.random.Generator,
    texel: float,
) -> NDArray[np.uint8]:
    """Return how dark oil and rust stains are, 255 = 1; they are denser near markings."""
    stain = np.zeros(shape[:2], dtype=np.uint8)
    n_lines = len(ground.markings)
    area = shape[0] * shape[1] * texel**2
    for _ in range(int(area / 12.0)):
        center = generator.uniform(0.0, 1.0, 2) * (shape[1], shape[0])
        if n_lines and generator.random() < 0.6:
            line = ground.markings[generator.integers(n_lines)]
            near = line[:2] + (line[2:4] - line[:2]) * generator.random() + generator.normal(0.0, 1.1, 2)
            center = corners(near[None, :])[0] / 2**_SUBPIXEL
        radius = max(1, round(float(generator.exponential(0.09)) / texel))
        cv2.circle(stain, (int(center[0]), int(center[1])), radius, int(generator.integers(40, 160)), -1)
    return np.asarray(cv2.GaussianBlur(stain, (0, 0), 1.6), dtype=np.uint8)


def _cracks(shape: tuple[int, ...], generator: np.random.Generator, texel: float) -> NDArray[np.uint8]:
    rows, columns = shape
    mask = np.zeros((rows, columns), dtype=np.uint8)
    for _ in range(int(rows * columns * texel**2 / 90.0)):
        steps = int(generator.integers(6, 40))
        heading = generator.uniform(0.0, 2.0 * np.pi) + np.cumsum(generator.normal(0.0, 0.35, steps))
        path = np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0) * 0.12 / texel
        path += generator.uniform(0.0, 1.0, 2) * (columns, rows)
        cv2.polylines(mask, [path.astype(np.int32)], False, int(generator.integers(70, 200)), 1, cv2.LINE_AA)
    return mask


def _pyramid(image: NDArray[np.uint8], low: NDArray[np.float64], texel: float) -> GroundTexture:
    levels = [image]
    while min(image.shape[:2]) > 8 and len(levels) < 9:
        half = (max(1, image.shape[1] // 2), max(1, image.shape[0] // 2))
        image = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        levels.append(image)
    shape = np.array([level.shape[:2] for level in levels], dtype=np.int32)
    start = np.concatenate([[0], np.cumsum(shape.prod(axis=1))[:-1]]).astype(np.int32)
    texels = np.concatenate([_packed(level).ravel() for level in levels])
    # Levels are not exact halves where a side is odd.
    per_m = (shape / (shape[0] * texel)).astype(np.float32)
    return GroundTexture(texels, start, shape, per_m, float(low[0]), float(low[1]), texel)


def _packed(image: NDArray[np.uint8]) -> NDArray[np.uint32]:
    wide = np.zeros((*image.shape[:2], 4), dtype=np.uint8)
    wide[..., :3] = image
    return wide.view("<u4")[..., 0].astype(np.uint32)


@compiled(**VECTOR_LEAF)
def sample_ground(texture: GroundTexture, x: Single, y: Single, level: int) -> tuple[Single, Single, Single]:
    """Sample the ground at (x, y), m: grey albedo, fraction of grass, and how much water can collect there."""
    step = np.uint64(min(max(level, 0), texture.shape.shape[0] - 1))
    columns = texture.shape[step, 1]
    # Beyond the drawn part the texture repeats, mirrored, so no streaks run to the horizon.
    u = _mirrored((x - np.float32(texture.x)) * texture.per_m[step, 1] - 0.5, np.float32(columns))
    v = _mirrored(
        (y - np.float32(texture.y)) * texture.per_m[step, 0] - 0.5, np.float32(texture.shape[step, 0])
    )
    column = np.int32(u)
    row = np.int32(v)
    a = u - np.float32(column)
    b = v - np.float32(row)
    i = np.uint64(texture.start[step] + row * columns + column)
    j = i + np.uint64(columns)
    one = np.uint64(1)
    t = texture.texels
    t00, t01, t10, t11 = t[i], t[i + one], t[j], t[j + one]
    above = mix(byte(t00, 0), byte(t01, 0), a)
    below = mix(byte(t10, 0), byte(t11, 0), a)
    root = mix(above, below, b) * (1.0 / 255.0)
    water = byte(t00, 16) + byte(t01, 16) + byte(t10, 16) + byte(t11, 16)
    return root * root, byte(t00, 8) * (1.0 / 255.0), water * (1.0 / 1020.0)


@compiled(**VECTOR_LEAF)
def _mirrored(u: Single, n: Single) -> Single:
    span = n - 1.001
    u = abs(u)
    u -= 2.0 * span * np.floor(u / (2.0 * span))
    return max(min(u, 2.0 * span - u), 0.0)
