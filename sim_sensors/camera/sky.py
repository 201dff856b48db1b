"""The sky: its radiance in any direction, as the background of a view, and as a blurred dome for reflections.

Above the horizon a view depends only on weather and rotation, so a camera that drives straight on draws its sky once.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, rfft2

from parkenv.compiled.arrays import Float32Array, FloatArray
from parkenv.compiled.jit import compiled
from sim_sensors.camera.textures import FAST, LEAF, VECTOR_LEAF, Single, cloud_noise, fractal_noise, mix
from sim_sensors.camera.weather import Weather

_DOME = 160  # texels across the hemisphere
_SAMPLES = 3  # along each side of a texel
_BEARINGS = 1024  # steps of the skyline
_BELOW = -0.1  # z of a ray; nothing lower is sky, from any height below 100 m
_KEPT_VIEWS = 8
_MOST_11, _MOST_10 = 2047, 1023  # greatest numbers of 11 and 10 bits
_NOISE = 256


class Sky(NamedTuple):
    """A weather's sky for compiled code; colours are linear RGB radiance, (3,) each."""

    zenith: FloatArray
    horizon: FloatArray
    sun_direction: FloatArray
    glow: float  # strength of the brightness around the sun
    clouds: Float32Array  # (256, 256) tileable noise; there are clouds where it is above `threshold`
    threshold: float
    white: FloatArray  # a cloud
    top: FloatArray  # (1024,) z of the skyline by azimuth
    built: NDArray[np.bool_]  # (1024,) whether the skyline is a roof there rather than trees
    light: FloatArray  # on the skyline
    veil: float  # fraction of the skyline's colour that haze replaces
    speckle: Float32Array  # (512, 512) noise of leaves and walls


@lru_cache(maxsize=8)
def sky_of(weather: Weather) -> Sky:
    """Draw clouds and skyline of a weather: distant trees and roofs, up to about 8° high, in haze."""
    rng = np.random.default_rng([weather.seed, 7])
    noise = (0.5 + 0.2 * fractal_noise(_NOISE, rng, 1.5)).astype(np.float32)
    crowns = 0.05 + 0.022 * _first_row_of_noise(_BEARINGS, rng, 0.9)
    roofs = np.repeat(rng.uniform(0.02, 0.13, 64), _BEARINGS // 64)
    built = np.repeat(rng.random(64) < 0.3, _BEARINGS // 64)
    sky, sun = np.array(weather.sky), np.array(weather.sun)
    return Sky(
        np.array(weather.zenith),
        np.array(weather.horizon),
        np.array(weather.sun_direction),
        0.35 * (1 - weather.clouds),
        noise,
        float(np.quantile(noise, 1.0 - weather.clouds)) if weather.clouds > 0.0 else 2.0,
        0.95 * sky + 0.12 * sun,
        np.where(built, roofs, np.clip(crowns, 0.012, 0.16)),
        built,
        sky + 0.35 * sun,
        min(0.85, 0.12 + weather.haze * 120.0),
        cloud_noise().astype(np.float32),
    )


def _first_row_of_noise(size: int, generator: np.random.Generator, slope: float) -> FloatArray:
    """Return the first row of `fractal_noise`, up to rounding, without computing the others: a third of the time."""
    spectrum = rfft2(generator.standard_normal((size, size)))
    spectrum *= _falloff(size, slope)
    # Columns from 1 to size/2 - 1 stand for their mirror images, too.
    power = 2.0 * (spectrum.real**2 + spectrum.imag**2).sum(axis=0)
    power[[0, -1]] *= 0.5
    mean = spectrum[0, 0].real / size**2
    std = math.sqrt(power.sum() / size**4 - mean**2)
    return np.asarray((irfft(spectrum.mean(axis=0), size) - mean) / std)


@lru_cache(maxsize=1)
def _falloff(size: int, slope: float) -> FloatArray:
    radius = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    radius[0, 0] = 1.0
    return np.asarray(radius**-slope)


@compiled(**LEAF)
def sky_radiance(sky: Sky, x: float, y: float, z: float) -> tuple[float, float, float]:
    sun = sky.sun_direction
    near = min(max(x * sun[0] + y * sun[1] + z * sun[2], 0.0), 1.0)
    near *= near
    near *= near * near  # to the power of 6
    disc = near * near
    disc *= disc
    disc *= disc * near * near  # 60
    point = disc * disc
    point *= point
    point *= disc  # 300
    point *= point * point * point * point
    glow = 1.0 + sky.glow * (near + 3.0 * disc + 12.0 * point)
    low = (1.0 - z) ** 2.2
    # A layer of clouds at unit height, stretched towards the horizon but not infinitely.
    span = 0.17 * _NOISE / (z + 0.2)
    column, row = math.floor(x * span), math.floor(y * span)
    a, b = x * span - column, y * span - row
    c = sky.clouds
    left, right = int(column) & (_NOISE - 1), (int(column) + 1) & (_NOISE - 1)
    above, below = int(row) & (_NOISE - 1), (int(row) + 1) & (_NOISE - 1)
    sheet = (c[above, left] * (1.0 - a) + c[above, right] * a) * (1.0 - b)
    sheet += (c[below, left] * (1.0 - a) + c[below, right] * a) * b
    cover = min(max((sheet - sky.threshold + 0.06) * 4.0, 0.0), 1.0)
    bright = cover * (0.75 + 0.5 * min(max(sheet, 0.0), 1.0))
    clear = glow * (1.0 - cover)
    red = (sky.zenith[0] * (1.0 - low) + sky.horizon[0] * low) * clear + sky.white[0] * bright
    green = (sky.zenith[1] * (1.0 - low) + sky.horizon[1] * low) * clear + sky.white[1] * bright
    blue = (sky.zenith[2] * (1.0 - low) + sky.horizon[2] * low) * clear + sky.white[2] * bright
    if z < 0.17:
        azimuth = math.atan2(y, x) * (0.5 / math.pi)
        azimuth -= math.floor(azimuth)
        bearing = min(int(azimuth * _BEARINGS), _BEARINGS - 1)
        mask = min(max((sky.top[bearing] - z) * 400.0 + 0.5, 0.0), 1.0)
        if mask > 0.0:
            n = sky.speckle.shape[0]
            speckle = sky.speckle[int(z * 2200.0) % n, int(azimuth * 6000.0) % n]
            far = sky.light
            if sky.built[bearing]:
                tone = (0.8 + 0.4 * speckle) * (1.0 - sky.veil)
                f_red, f_green, f_blue = 0.3 * tone, 0.27 * tone, 0.24 * tone
            else:
                tone = (0.3 + 1.4 * speckle) * (1.0 - sky.veil)
                f_red, f_green, f_blue = 0.05 * tone, 0.075 * tone, 0.03 * tone
            red += (f_red * far[0] + sky.horizon[0] * sky.veil - red) * mask
            green += (f_green * far[1] + sky.horizon[1] * sky.veil - green) * mask
            blue += (f_blue * far[2] + sky.horizon[2] * sky.veil - blue) * mask
    return red, green, blue


@lru_cache(maxsize=8)
def mirrored_sky(weather: Weather) -> Float32Array:
    """Return the upper hemisphere as reflections show it, blurred: (160, 160, 3) float32, linear RGB radiance.

    It is a paraboloid map, which allows look-ups without trigonometry: direction (x, y, z) with z ≥ 0 lies at ((x, y) /
    (1 + z) + 1) / 2 of the side.
    """
    dome = np.empty((_DOME * _SAMPLES, _DOME * _SAMPLES, 3), dtype=np.float32)
    _fill_dome(sky_of(weather), dome)
    return np.asarray(cv2.resize(dome, (_DOME, _DOME), interpolation=cv2.INTER_AREA), dtype=np.float32)


@lru_cache(maxsize=8)
def packed_sky(weather: Weather) -> tuple[NDArray[np.uint32], np.float32]:
    """Return `mirrored_sky` for compiled code: one load fetches a texel, (160, 160) uint32.

    From the lowest bit on it has the square roots of blue (10 bits), green and red (11 bits each); their greatest codes
    stand for the radiance that is returned besides.
    """
    dome = mirrored_sky(weather)
    brightest = max(float(dome.max()), 1e-6)
    codes = np.round(np.sqrt(dome / brightest) * (_MOST_11, _MOST_11, _MOST_10)).astype(np.uint32)
    return codes[..., 0] << 21 | codes[..., 1] << 10 | codes[..., 2], np.float32(brightest)


@compiled(fastmath=FAST, nogil=True)
def _fill_dome(sky: Sky, dome: Float32Array) -> None:
    n = dome.shape[0]
    for row in range(n):
        v = (row + 0.5) / n * 2.0 - 1.0
        for column in range(n):
            u = (column + 0.5) / n * 2.0 - 1.0
            square = u * u + v * v
            # Corners outside the unit disc repeat the horizon, so bilinear look-ups at the rim are valid.
            inside = min(square, 1.0)
            stretch = 2.0 / (1.0 + inside) / math.sqrt(max(square, 1.0))
            z = (1.0 - inside) / (1.0 + inside)
            red, green, blue = sky_radiance(sky, u * stretch, v * stretch, z)
            dome[row, column, 0] = red
            dome[row, column, 1] = green
            dome[row, column, 2] = blue


def sky_of_view(
    weather: Weather,
    rotation: FloatArray,
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],
) -> Float32Array:
    """Return the sky behind every pixel of a view, (h, w, 3) float32, linear RGB radiance; the last views are kept.

    Far below the horizon it is the horizon's. `rotation`, (3, 3), is camera to world. The array must not be changed.
    """
    # Headings that differ by rounding alone share a sky.
    return _sky_of_view(weather, tuple(rotation.ravel().round(6).tolist()), intrinsics, size)


@lru_cache(maxsize=_KEPT_VIEWS)
def _sky_of_view(
    weather: Weather,
    rotation: tuple[float, ...],
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],
) -> Float32Array:
    view = np.empty((size[1], size[0], 3), dtype=np.float32)
    _fill_view(sky_of(weather), np.array(rotation).reshape(3, 3), *intrinsics, view)
    return view


@compiled(fastmath=FAST, nogil=True)
def _fill_view(
    sky: Sky, rotation: FloatArray, fx: float, fy: float, cx: float, cy: float, view: Float32Array
) -> None:
    r = rotation
    for y in range(view.shape[0]):
        v = (y + 0.5 - cy) / fy
        for x in range(view.shape[1]):
            u = (x + 0.5 - cx) / fx
            scale = 1.0 / math.sqrt(u * u + v * v + 1.0)
            dz = (r[2, 0] * u + r[2, 1] * v + r[2, 2]) * scale
            red, green, blue = sky.horizon[0], sky.horizon[1], sky.horizon[2]
            if dz > _BELOW:
                dx = (r[0, 0] * u + r[0, 1] * v + r[0, 2]) * scale
                dy = (r[1, 0] * u + r[1, 1] * v + r[1, 2]) * scale
                red, green, blue = sky_radiance(sky, dx, dy, max(dz, 0.0))
            view[y, x, 0] = red
            view[y, x, 1] = green
            view[y, x, 2] = blue


@compiled(**VECTOR_LEAF)
def look_up(
    dome: NDArray[np.uint32], brightest: np.float32, x: np.float32, y: np.float32, z: np.float32
) -> tuple[Single, Single, Single]:
    n = dome.shape[0]
    scale = 0.5 / (1.0 + z)
    last: Single = np.float32(n - 1.001)
    u = min(max((x * scale + 0.5) * np.float32(n) - 0.5, 0.0), last)
    v = min(max((y * scale + 0.5) * np.float32(n) - 0.5, 0.0), last)
    left = np.int32(u)
    top = np.int32(v)
    a = u - np.float32(left)
    b = v - np.float32(top)
    row, column, one = np.uint64(top), np.uint64(left), np.uint64(1)
    corners = (
        dome[row, column],
        dome[row, column + one],
        dome[row + one, column],
        dome[row + one, column + one],
    )
    red = _between(corners, 21, _MOST_11, a, b)
    green = _between(corners, 10, _MOST_11, a, b)
    blue = _between(corners, 0, _MOST_10, a, b)
    return red * red * brightest, green * green * brightest, blue * blue * brightest


@compiled(**VECTOR_LEAF)
def _between(
    corners: tuple[Single, Single, Single, Single], shift: int, most: int, a: Single, b: Single
) -> Single:
    c00, c01, c10, c11 = corners
    above = mix(_code(c00, shift, most), _code(c01, shift, most), a)
    below = mix(_code(c10, shift, most), _code(c11, shift, most), a)
    return mix(above, below, b) / np.float32(most)


@compiled(**VECTOR_LEAF)
def _code(texel: Single, shift: int, most: int) -> Single:
    return np.float32(np.int32((texel >> np.uint32(shift)) & np.uint32(most)))
