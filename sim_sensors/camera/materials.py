"""Reflection models of the materials: car paint, foliage, dirt, glass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_sensors.camera.daylight import SHADOW_BIAS, Color, Light, Vector, mirrored
from sim_sensors.camera.light_maps import LightMaps, open_sky, sunlit
from sim_sensors.camera.projection import ScreenTriangles
from sim_sensors.camera.textures import LEAF, Tile, pixel_level, sample_tile
from sim_sensors.compilation import compiled
from sim_sensors.facades import facade
from sim_sensors.mesh import Material

FloatArray = NDArray[np.float64]

_PAINT = int(Material.PAINT)
_FACADE = int(Material.FACADE)
_FOLIAGE = int(Material.FOLIAGE)
_GLASS_TINT = 0.72  # fraction of the light that passes a pane

RESPONSE = np.zeros((256, 4))
RESPONSE[:, 3] = 1.0
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
    RESPONSE[_material] = _row
"""(256, 4) float64, for every material: mirror reflection at normal incidence, width of the sun's glint (1 - cosine),
roughness noise on the albedo, and fraction of the sky light that reaches it (low inside a car)."""

_CODES = np.arange(256) / 255.0
LINEAR = np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4)
"""(256,) float64, the linear value of every sRGB code."""


class Materials(NamedTuple):
    """Lookup tables of surface appearance.

    Attributes:
        grain, cloud: fine and soft noise of surfaces.
        response: (256, 4) float64, see `RESPONSE`.
        linear: (256,) float64, see `LINEAR`.
    """

    grain: Tile
    cloud: Tile
    response: FloatArray
    linear: FloatArray


@compiled(**LEAF)
def surface_radiance(
    t: int,
    triangles: ScreenTriangles,
    point: Vector,
    ray: Vector,
    normal: Vector,
    footprint: float,
    light: Light,
    maps: LightMaps,
    materials: Materials,
) -> Color:
    """Return the radiance, linear RGB, of a point of triangle `t` seen along a ray.

    The point, m, and the unit vectors `ray` and `normal` are in the world frame; a pixel spans `footprint`, m.
    """
    px, py, pz = point
    nx, ny, nz = normal
    dx, dy, dz = ray
    material = triangles.material[t]
    response = materials.response[material]
    cosine = -(nx * dx + ny * dy + nz * dz)
    inside = False
    if cosine < 0.0:
        # Back faces show the interior lining, not the paint.
        nx, ny, nz, cosine = -nx, -ny, -nz, -cosine
        inside = material == _PAINT
    a_red = materials.linear[triangles.color[t, 0]]
    a_green = materials.linear[triangles.color[t, 1]]
    a_blue = materials.linear[triangles.color[t, 2]]
    mirror = response[0]
    received = response[3]
    glow = 0.0
    if inside:
        a_red, a_green, a_blue, mirror, received = 0.05, 0.05, 0.05, 0.0, 0.4
    # Blotches on a vertical plane through the normal: dirt, plaster, leaves.
    along = py * nx - px * ny
    size = 0.9 if material != _FOLIAGE else 0.35
    blotch = sample_tile(
        materials.cloud, along * size + px * 0.11, (pz + 0.5 * py) * size, pixel_level(footprint * size)
    )
    if material == _FACADE:
        shade_of_wall, glow, mirror = facade(along, pz, nz, footprint, light.lit_windows, materials.grain)
        a_red *= shade_of_wall
        a_green *= shade_of_wall
        a_blue *= shade_of_wall
    if material == _FOLIAGE:
        leaf = sample_tile(
            materials.grain, along * 0.31 + px * 0.2, pz * 0.31 + py * 0.17, pixel_level(footprint * 0.3)
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
        reaches = sunlit(maps, px + 0.04 * nx, py + 0.04 * ny, pz + 0.04 * nz, SHADOW_BIAS)
    sun = max(sun, 0.0) * reaches
    # Sky light from above, bounced light from the ground below; both are weak under the sills and between the wheels.
    low = min(1.0, 0.3 + 0.75 * pz)
    upward = 0.5 + 0.5 * nz
    around = open_sky(maps, px + 0.6 * nx, py + 0.6 * ny)
    from_sky = received * upward * (0.35 + 0.65 * low) * (0.55 + 0.45 * around + 0.45 * nz * (1.0 - around))
    bounce = received * (1.0 - upward) * low * (0.3 + 0.7 * around)
    red = a_red * tone * (light.sun[0] * sun + light.sky[0] * from_sky + light.ground[0] * bounce)
    green = a_green * tone * (light.sun[1] * sun + light.sky[1] * from_sky + light.ground[1] * bounce)
    blue = a_blue * tone * (light.sun[2] * sun + light.sky[2] * from_sky + light.ground[2] * bounce)
    if mirror > 0.0:
        grazing = 1.0 - min(cosine, 1.0)
        grazing *= grazing * grazing * grazing * grazing
        mirror += (1.0 - mirror) * grazing * (0.8 if material == _PAINT else 0.5)
        # Pressed steel is never flat: distort its reflections.
        waver = 0.03 * (blotch - 0.5)
        twice = 2.0 * cosine
        rx = dx + twice * nx + waver
        ry = dy + twice * ny + waver
        rz = dz + twice * nz + 2.0 * waver
        m_red, m_green, m_blue = mirrored(px, py, pz, rx, ry, rz, light, maps)
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


@compiled(**LEAF)
def through_glass(
    color: Color, n_panes: int, point: Vector, ray: Vector, normal: Vector, light: Light, maps: LightMaps
) -> Color:
    """Return the radiance, linear RGB, of a color through panes of glass, plus the reflection of the nearest one."""
    nx, ny, nz = normal
    dx, dy, dz = ray
    tint = _GLASS_TINT
    for _ in range(1, min(n_panes, 4)):
        tint *= _GLASS_TINT
    cosine = -(nx * dx + ny * dy + nz * dz)
    if cosine < 0.0:
        nx, ny, nz, cosine = -nx, -ny, -nz, -cosine
    grazing = 1.0 - min(cosine, 1.0)
    grazing *= grazing * grazing * grazing * grazing
    mirror = 0.08 + 0.85 * grazing
    twice = 2.0 * cosine
    rx, ry, rz = dx + twice * nx, dy + twice * ny, dz + twice * nz
    m_red, m_green, m_blue = mirrored(point[0], point[1], point[2], rx, ry, rz, light, maps)
    through = tint * (1.0 - mirror)
    return (
        color[0] * through * 0.96 + m_red * mirror,
        color[1] * through + m_green * mirror,
        color[2] * through * 0.97 + m_blue * mirror,
    )
