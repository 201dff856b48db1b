"""The colour of every pixel: what its surface does with the sun, the sky and what it mirrors.

Deferred: the rasteriser has found the surface, so each pixel is shaded once, and once more for a pane of glass.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from sim_sensors.facades import facade
from sim_sensors.ground_texture import GroundTexture, sample_ground, sample_water
from sim_sensors.light_maps import LightMaps, open_sky, sunlit
from sim_sensors.mesh import Material
from sim_sensors.projection import ScreenTriangles
from sim_sensors.rasterizer import BAND, Visibility, interleaved
from sim_sensors.sky import look_up, sky_domes
from sim_sensors.textures import FAST, LEAF, Tile, cloud_tile, grain_tile, hash_unit, pixel_level, sample_tile
from sim_sensors.weather import Weather

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]
Color = tuple[float, float, float]

_PAINT = int(Material.PAINT)
_FACADE = int(Material.FACADE)
_FOLIAGE = int(Material.FOLIAGE)
_INTERIOR = int(Material.INTERIOR)
_GLASS_TINT = 0.72  # of the light passes a pane
_GROUND_TONE = 0.12  # albedo of the ground where it is only mirrored or bounces light
_BIAS = 0.05  # m, toward the sun, against self-shadowing

# For every material: mirror reflection at normal incidence, width of the sun's glint (1 - cosine), roughness
# noise on the albedo, and how much of the sky it gets (things inside a car get little).
_RESPONSE = np.zeros((256, 4))
_RESPONSE[:, 3] = 1.0
for _material, _row in {
    Material.PAINT: (0.05, 0.006, 0.05, 1.0),
    Material.GLASS: (0.08, 0.002, 0.0, 1.0),
    Material.TRIM: (0.02, 0.05, 0.15, 1.0),
    Material.RUBBER: (0.0, 0.1, 0.25, 0.8),
    Material.RIM: (0.16, 0.03, 0.1, 1.0),
    Material.LAMP: (0.14, 0.004, 0.1, 1.0),
    Material.PLATE: (0.02, 0.05, 0.05, 1.0),
    Material.INTERIOR: (0.0, 0.1, 0.1, 0.4),
    Material.CHROME: (0.55, 0.008, 0.02, 1.0),
    Material.FACADE: (0.0, 0.1, 0.3, 1.0),
    Material.FOLIAGE: (0.0, 0.1, 0.9, 1.0),
    Material.BARK: (0.0, 0.1, 0.6, 1.0),
    Material.STONE: (0.0, 0.1, 0.35, 1.0),
    Material.POST: (0.05, 0.05, 0.1, 1.0),
    Material.CLOTH: (0.0, 0.1, 0.25, 1.0),
}.items():
    _RESPONSE[_material] = _row

_CODES = np.arange(256) / 255.0
_LINEAR = np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4)


class _View(NamedTuple):
    """The camera: rotation (3, 3) camera to world, position (3,), intrinsics in px."""

    rotation: FloatArray
    position: FloatArray
    fx: float
    fy: float
    cx: float
    cy: float


class _Light(NamedTuple):
    """A weather's light, as arrays (3,), and its sky."""

    sun_direction: FloatArray
    sun: FloatArray
    sky: FloatArray
    horizon: FloatArray
    haze: float
    wetness: float
    lit_windows: float
    background: Float32Array
    mirrored: Float32Array
    ground: FloatArray


class _Surfaces(NamedTuple):
    """The textures of the world."""

    ground: GroundTexture
    maps: LightMaps
    grain: Tile
    cloud: Tile
    response: FloatArray
    linear: FloatArray


def shade(
    triangles: ScreenTriangles,
    visibility: Visibility,
    pose: FloatArray,
    intrinsics: tuple[float, float, float, float],
    weather: Weather,
    ground: GroundTexture,
    maps: LightMaps,
) -> Float32Array:
    """Radiance of every pixel.

    Args:
        triangles: on the screen.
        visibility: which of them each pixel sees.
        pose: (4, 4) camera to world.
        intrinsics: fx, fy, cx, cy, px.
        weather: the light.
        ground: its texture.
        maps: what keeps light away.

    Returns:
        (h, w, 3) float32, linear RGB, relative (see `Weather`).
    """
    height, width = visibility.triangle.shape
    background, mirrored = sky_domes(weather)
    sun, sky = np.array(weather.sun), np.array(weather.sky)
    light = _Light(
        np.array(weather.sun_direction),
        sun,
        sky,
        np.array(weather.horizon),
        weather.haze,
        weather.wetness,
        weather.lit_windows,
        background,
        mirrored,
        _GROUND_TONE * (1.0 - 0.5 * weather.wetness) * (sun * weather.sun_direction[2] + sky),
    )
    view = _View(np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3]), *intrinsics)
    image = np.empty((height, width, 3), dtype=np.float32)
    order = interleaved((height + BAND - 1) // BAND)
    grain, cloud = grain_tile(), cloud_tile()
    _shade(triangles, visibility, view, light, ground, maps, grain, cloud, _RESPONSE, _LINEAR, order, image)
    return image


@njit(cache=True, parallel=True, fastmath=FAST)
def _shade(
    triangles: ScreenTriangles,
    visibility: Visibility,
    view: _View,
    light: _Light,
    ground: GroundTexture,
    maps: LightMaps,
    grain: Tile,
    cloud: Tile,
    response: FloatArray,
    linear: FloatArray,
    order: NDArray[np.int64],
    image: Float32Array,
) -> None:
    for task in prange(order.shape[0]):
        # Put together here: a parallel loop takes tuples from outside, but none within a tuple.
        surfaces = _Surfaces(ground, maps, grain, cloud, response, linear)
        top = order[task] * BAND
        for y in range(top, min(image.shape[0], top + BAND)):
            _shade_row(y, triangles, visibility, view, light, surfaces, image)


@njit(**LEAF)
def _shade_row(
    y: int,
    triangles: ScreenTriangles,
    visibility: Visibility,
    view: _View,
    light: _Light,
    surfaces: _Surfaces,
    image: Float32Array,
) -> None:
    width = image.shape[1]
    r = view.rotation
    v = (y + 0.5 - view.cy) / view.fy
    row_x = r[0, 1] * v + r[0, 2]
    row_y = r[1, 1] * v + r[1, 2]
    row_z = r[2, 1] * v + r[2, 2]
    ground_level = _ground_level(row_z, view, surfaces.ground.texel)
    grain_level = ground_level + math.log2(surfaces.ground.texel / (3.0 / 512))
    for x in range(width):
        u = (x + 0.5 - view.cx) / view.fx
        dx = r[0, 0] * u + row_x
        dy = r[1, 0] * u + row_y
        dz = r[2, 0] * u + row_z
        inverse_length = 1.0 / math.sqrt(u * u + v * v + 1.0)
        inverse_depth = visibility.inverse_depth[y, x]
        t = visibility.triangle[y, x]
        if inverse_depth <= 0.0:
            red, green, blue = look_up(
                light.background,
                dx * inverse_length,
                dy * inverse_length,
                max(dz * inverse_length, 0.0),
            )
        else:
            depth = 1.0 / inverse_depth
            px = view.position[0] + dx * depth
            py = view.position[1] + dy * depth
            pz = view.position[2] + dz * depth
            if t < 0:
                dither = hash_unit(x, y)
                red, green, blue = _ground(
                    px,
                    py,
                    dx * inverse_length,
                    dy * inverse_length,
                    dz * inverse_length,
                    int(ground_level + dither),
                    int(grain_level + dither),
                    light,
                    surfaces,
                )
            else:
                nx, ny, nz = _normal(triangles.normal[t], u, v)
                red, green, blue = _surface(
                    t,
                    triangles,
                    px,
                    py,
                    pz,
                    dx * inverse_length,
                    dy * inverse_length,
                    dz * inverse_length,
                    nx,
                    ny,
                    nz,
                    depth / view.fx,
                    light,
                    surfaces,
                )
            # 1 - exp(-k) to three decimals, for the k of any road.
            k = light.haze * depth / inverse_length
            fog = 1.0 - 1.0 / (1.0 + k * (1.0 + 0.5 * k))
            red += (light.horizon[0] - red) * fog
            green += (light.horizon[1] - green) * fog
            blue += (light.horizon[2] - blue) * fog
        pane = visibility.pane[y, x]
        if pane >= 0:
            nx, ny, nz = _normal(triangles.normal[pane], u, v)
            tint = _GLASS_TINT
            for _ in range(1, min(visibility.n_panes[y, x], 4)):
                tint *= _GLASS_TINT
            depth = 1.0 / visibility.pane_inverse_depth[y, x]
            red, green, blue = _behind_glass(
                red,
                green,
                blue,
                tint,
                view.position[0] + dx * depth,
                view.position[1] + dy * depth,
                view.position[2] + dz * depth,
                dx * inverse_length,
                dy * inverse_length,
                dz * inverse_length,
                nx,
                ny,
                nz,
                light,
                surfaces,
            )
        image[y, x, 0] = red
        image[y, x, 1] = green
        image[y, x, 2] = blue


@njit(**LEAF)
def _ground_level(row_z: float, view: _View, texel: float) -> float:
    """Pyramid level at which a texel of the ground is about a pixel, in the middle of a row."""
    depth = -view.position[2] / min(row_z, -1e-3)
    # Across a pixel sees depth/f, along the ground depth²/(f·h): the geometric mean keeps edges crisp.
    footprint = depth / view.fx * math.sqrt(max(depth / view.position[2], 1.0))
    return max(math.log2(footprint / texel) - 0.4, 0.0)


@njit(**LEAF)
def _normal(matrix: Float32Array, u: float, v: float) -> Color:
    x = matrix[0] * u + matrix[1] * v + matrix[2]
    y = matrix[3] * u + matrix[4] * v + matrix[5]
    z = matrix[6] * u + matrix[7] * v + matrix[8]
    scale = 1.0 / math.sqrt(x * x + y * y + z * z + 1e-30)
    return x * scale, y * scale, z * scale


@njit(**LEAF)
def _ground(
    px: float,
    py: float,
    dx: float,
    dy: float,
    dz: float,
    level: int,
    grain_level: int,
    light: _Light,
    surfaces: _Surfaces,
) -> Color:
    albedo, grass, texel, below = sample_ground(surfaces.ground, px, py, level)
    grain = 0.55 + 0.9 * sample_tile(surfaces.grain, px / 3.0, py / 3.0, grain_level)
    sky = open_sky(surfaces.maps, px, py)
    sun = 0.0
    if light.sun[0] > 0.0:
        sun = light.sun_direction[2] * sunlit(surfaces.maps, px, py, 0.0, _BIAS)
    wet = 0.0
    if light.wetness > 0.0:
        wettable = sample_water(surfaces.ground, texel, below)
        wet = light.wetness * min(1.0, 0.45 + 1.2 * wettable)
        grain *= 1.0 - 0.45 * wet
    albedo *= grain
    # Asphalt is a warm grey, grass a yellowish green.
    red = albedo * (1.03 - 0.08 * grass) * (light.sun[0] * sun + light.sky[0] * sky)
    green = albedo * (1.0 + 0.25 * grass) * (light.sun[1] * sun + light.sky[1] * sky)
    blue = albedo * (0.95 - 0.45 * grass) * (light.sun[2] * sun + light.sky[2] * sky)
    if wet > 0.0:
        # Water mirrors what stands beyond: the sky, or the dark of a car where the sky is hidden.
        mirror = 1.0 + dz
        mirror = (0.025 + 0.975 * mirror * mirror * mirror * mirror * mirror) * wet
        mirror *= min(1.0, 0.3 + 1.1 * wettable)
        ripple = 0.05 * (grain - 1.0)
        m_red, m_green, m_blue = look_up(light.mirrored, dx + ripple, dy + ripple, max(-dz, 0.0))
        mirror *= sky * sky
        red += (m_red - red) * mirror
        green += (m_green - green) * mirror
        blue += (m_blue - blue) * mirror
    return red, green, blue


@njit(**LEAF)
def _mirror(
    px: float, py: float, pz: float, rx: float, ry: float, rz: float, light: _Light, surfaces: _Surfaces
) -> Color:
    """What the direction (rx, ry, rz) shows from a point: the sky, or the ground with its shadows."""
    if rz >= 0.0:
        red, green, blue = look_up(light.mirrored, rx, ry, rz)
        return red, green, blue
    reach = max(pz, 0.05) / max(-rz, 0.02)
    hidden = open_sky(surfaces.maps, px + rx * reach, py + ry * reach)
    # Toward the horizon stand other cars, kerbs, hedges: darker than the open ground.
    far = min(1.0, reach * 0.12)
    tone = (0.25 + 0.75 * hidden) * (1.0 - 0.45 * far)
    return light.ground[0] * tone, light.ground[1] * tone, light.ground[2] * tone


@njit(**LEAF)
def _surface(
    t: int,
    triangles: ScreenTriangles,
    px: float,
    py: float,
    pz: float,
    dx: float,
    dy: float,
    dz: float,
    nx: float,
    ny: float,
    nz: float,
    footprint: float,
    light: _Light,
    surfaces: _Surfaces,
) -> Color:
    material = triangles.material[t]
    response = surfaces.response[material]
    cosine = -(nx * dx + ny * dy + nz * dz)
    inside = False
    if cosine < 0.0:
        # Seen from behind: lining, not paint.
        nx, ny, nz, cosine = -nx, -ny, -nz, -cosine
        inside = material == _PAINT
    a_red = surfaces.linear[triangles.color[t, 0]]
    a_green = surfaces.linear[triangles.color[t, 1]]
    a_blue = surfaces.linear[triangles.color[t, 2]]
    mirror = response[0]
    received = response[3]
    glow = 0.0
    if inside:
        a_red, a_green, a_blue, mirror, received = 0.05, 0.05, 0.05, 0.0, 0.4
    # Blotches on a vertical plane through the normal: dirt, plaster, leaves.
    along = py * nx - px * ny
    size = 0.9 if material != _FOLIAGE else 0.35
    blotch = sample_tile(
        surfaces.cloud, along * size + px * 0.11, (pz + 0.5 * py) * size, pixel_level(footprint * size)
    )
    if material == _FACADE:
        shade_of_wall, glow, mirror = facade(along, pz, nz, footprint, light.lit_windows, surfaces.grain)
        a_red *= shade_of_wall
        a_green *= shade_of_wall
        a_blue *= shade_of_wall
    if material == _FOLIAGE:
        leaf = sample_tile(
            surfaces.grain, along * 0.31 + px * 0.2, pz * 0.31 + py * 0.17, pixel_level(footprint * 0.3)
        )
        nx += 1.6 * (leaf - 0.5)
        nz += 2.2 * (blotch - 0.5)
        blotch = 0.5 * blotch + 0.5 * leaf
    tone = 1.0 + response[2] * 2.0 * (blotch - 0.5)
    if pz < 0.7 and material <= Material.CHROME and not inside:
        # Road dirt on the lower body, in blotches.
        dirt = min(0.5, max(0.0, (0.75 - pz) * 0.8 * (blotch - 0.15)))
        a_red += (0.16 - a_red) * dirt
        a_green += (0.145 - a_green) * dirt
        a_blue += (0.125 - a_blue) * dirt
        mirror *= 1.0 - dirt

    sun = nx * light.sun_direction[0] + ny * light.sun_direction[1] + nz * light.sun_direction[2]
    reaches = 0.0
    if light.sun[0] > 0.0 and sun > 0.0:
        reaches = sunlit(surfaces.maps, px + 0.04 * nx, py + 0.04 * ny, pz + 0.04 * nz, _BIAS)
    sun = max(sun, 0.0) * reaches
    # The sky above, the ground's reflection below; both fail under the sills and between the wheels.
    low = min(1.0, 0.3 + 0.75 * pz)
    upward = 0.5 + 0.5 * nz
    around = open_sky(surfaces.maps, px + 0.6 * nx, py + 0.6 * ny)
    from_sky = received * upward * (0.35 + 0.65 * low) * (0.55 + 0.45 * around + 0.45 * nz * (1.0 - around))
    bounce = received * (1.0 - upward) * low * (0.3 + 0.7 * around)
    red = a_red * tone * (light.sun[0] * sun + light.sky[0] * from_sky + light.ground[0] * bounce)
    green = a_green * tone * (light.sun[1] * sun + light.sky[1] * from_sky + light.ground[1] * bounce)
    blue = a_blue * tone * (light.sun[2] * sun + light.sky[2] * from_sky + light.ground[2] * bounce)
    if mirror > 0.0:
        grazing = 1.0 - min(cosine, 1.0)
        grazing *= grazing * grazing * grazing * grazing
        mirror += (1.0 - mirror) * grazing * (0.8 if material == _PAINT else 0.5)
        # Pressed steel is never flat: what it mirrors wavers.
        waver = 0.03 * (blotch - 0.5)
        twice = 2.0 * cosine
        rx = dx + twice * nx + waver
        ry = dy + twice * ny + waver
        rz = dz + twice * nz + 2.0 * waver
        m_red, m_green, m_blue = _mirror(px, py, pz, rx, ry, rz, light, surfaces)
        red += (m_red - red) * mirror
        green += (m_green - green) * mirror
        blue += (m_blue - blue) * mirror
        if reaches > 0.0:
            off = 1.0 - (
                rx * light.sun_direction[0] + ry * light.sun_direction[1] + rz * light.sun_direction[2]
            )
            if off < 4.0 * response[1]:
                glint = max(0.0, 1.0 - off / (4.0 * response[1]))
                glint *= glint * glint * reaches * mirror * 0.05 / response[1]
                red += light.sun[0] * glint
                green += light.sun[1] * glint
                blue += light.sun[2] * glint
    return red + glow, green + 0.85 * glow, blue + 0.6 * glow


@njit(**LEAF)
def _behind_glass(
    red: float,
    green: float,
    blue: float,
    tint: float,
    px: float,
    py: float,
    pz: float,
    dx: float,
    dy: float,
    dz: float,
    nx: float,
    ny: float,
    nz: float,
    light: _Light,
    surfaces: _Surfaces,
) -> Color:
    """What is seen through a pane, and what the pane mirrors over it."""
    cosine = -(nx * dx + ny * dy + nz * dz)
    if cosine < 0.0:
        nx, ny, nz, cosine = -nx, -ny, -nz, -cosine
    grazing = 1.0 - min(cosine, 1.0)
    grazing *= grazing * grazing * grazing * grazing
    mirror = 0.08 + 0.85 * grazing
    twice = 2.0 * cosine
    m_red, m_green, m_blue = _mirror(
        px, py, pz, dx + twice * nx, dy + twice * ny, dz + twice * nz, light, surfaces
    )
    through = tint * (1.0 - mirror)
    return (
        red * through * 0.96 + m_red * mirror,
        green * through + m_green * mirror,
        blue * through * 0.97 + m_blue * mirror,
    )
