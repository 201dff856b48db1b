"""The sky of a weather in plain numpy: the reference for `sim_sensors.camera.sky`."""

import cv2
import numpy as np

from sim_sensors.camera.textures import cloud_noise, fractal_noise

_SHARP = 768  # texels across the hemisphere
_BLURRED = 160


def sky_domes(weather):
    """Return the upper hemisphere, sharp and blurred, two arrays (n, n, 3) float32, linear RGB radiance.

    Both are paraboloid maps: direction (x, y, z) with z ≥ 0 lies at ((x, y) / (1 + z) + 1) / 2 of the side.
    """
    rng = np.random.default_rng([weather.seed, 7])
    side = (np.arange(_SHARP) + 0.5) / _SHARP * 2.0 - 1.0
    u, v = np.meshgrid(side, side)
    square = u * u + v * v
    inside = np.minimum(square, 1.0)
    z = (1.0 - inside) / (1.0 + inside)
    # Corners outside the unit disc repeat the horizon, so bilinear look-ups at the rim are valid.
    stretch = np.where(square > 1.0, 1.0 / np.sqrt(square), 1.0)
    x = 2.0 * u * stretch / (1.0 + inside)
    y = 2.0 * v * stretch / (1.0 + inside)

    toward_horizon = ((1.0 - z) ** 2.2)[..., None]
    dome = np.array(weather.zenith) * (1.0 - toward_horizon) + np.array(weather.horizon) * toward_horizon
    dome *= (1.0 + 0.35 * (1 - weather.clouds) * _glow(weather, x, y, z))[..., None]
    dome = _with_clouds(dome, weather, rng, x, y, z)
    dome = _with_skyline(dome, weather, rng, x, y, z)
    sharp = np.ascontiguousarray(dome, dtype=np.float32)
    blurred = cv2.resize(sharp, (_BLURRED, _BLURRED), interpolation=cv2.INTER_AREA)
    return sharp, np.ascontiguousarray(blurred, dtype=np.float32)


def _glow(weather, x, y, z):
    """Return the brightness of the sky around the sun."""
    sun = weather.sun_direction
    cosine = np.clip(x * sun[0] + y * sun[1] + z * sun[2], 0.0, 1.0)
    return cosine**6 + 3.0 * cosine**60 + 12.0 * cosine**1500


def _with_clouds(dome, weather, rng, x, y, z):
    noise = (0.5 + 0.2 * fractal_noise(256, rng, 1.5)).astype(np.float32)
    # A layer of clouds at unit height, stretched towards the horizon but not infinitely.
    column = (x / (z + 0.2) * 0.17 * 256) % 256
    row = (y / (z + 0.2) * 0.17 * 256) % 256
    at = column.astype(np.float32), row.astype(np.float32)
    sheet = cv2.remap(noise, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    threshold = np.quantile(noise, 1.0 - weather.clouds) if weather.clouds > 0.0 else 2.0
    cover = np.clip((sheet - threshold + 0.06) * 4.0, 0.0, 1.0)[..., None]
    brightness = 0.75 + 0.5 * np.clip(sheet, 0.0, 1.0)[..., None]
    white = np.array(weather.sky) * 0.95 + np.array(weather.sun) * 0.12
    return dome * (1.0 - cover) + white * brightness * cover


def _with_skyline(dome, weather, rng, x, y, z):
    """Draw distant trees and roofs, up to about 8° high, in haze."""
    azimuth = np.mod(np.arctan2(y, x) / (2.0 * np.pi), 1.0)
    bins = 1024
    crowns = 0.05 + 0.022 * fractal_noise(bins, rng, 0.9)[0]
    roofs = np.repeat(rng.uniform(0.02, 0.13, 64), bins // 64)
    is_roof = np.repeat(rng.random(64) < 0.3, bins // 64)
    top = np.where(is_roof, roofs, np.clip(crowns, 0.012, 0.16))
    height = top[np.minimum((azimuth * bins).astype(np.int64), bins - 1)]
    built = is_roof[np.minimum((azimuth * bins).astype(np.int64), bins - 1)]
    noise = cloud_noise()
    speckle = noise[(z * 2200).astype(np.int64) % len(noise), (azimuth * 6000).astype(np.int64) % len(noise)]
    light = np.array(weather.sky) + 0.35 * np.array(weather.sun)
    leaf = np.array([0.05, 0.075, 0.03]) * (0.3 + 1.4 * speckle[..., None])
    wall = np.array([0.3, 0.27, 0.24]) * (0.8 + 0.4 * speckle[..., None])
    far = np.where(built[..., None], wall, leaf) * light
    veil = min(0.85, 0.12 + weather.haze * 120.0)
    far = far * (1.0 - veil) + np.array(weather.horizon) * veil
    mask = np.clip((height - z) * 400.0 + 0.5, 0.0, 1.0)[..., None]
    return dome * (1.0 - mask) + far * mask
