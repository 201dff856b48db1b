"""Reflection models of the materials: car paint, foliage, dirt, glass."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array
from parkenv.compiled.jit import compiled
from sim_sensors.camera.batches import Batch, Places, View
from sim_sensors.camera.daylight import SHADOW_BIAS, Light, mirrored
from sim_sensors.camera.light_maps import LightMaps, open_sky, sunlit
from sim_sensors.camera.textures import VECTOR_LEAF, VECTOR_LOOP, Single, Tile, mix, pixel_level, sample_tile
from sim_sensors.mesh import Material

_PAINT = int(Material.PAINT)
_FOLIAGE = int(Material.FOLIAGE)
_CHROME = int(Material.CHROME)
_LIT = int(Material.LIT)
_LAMP_RADIANCE = np.float32(4.0)
"""Of a white lamp: 100 cd from 80 cm², as UN Regulations 7 and 23 allow for stop and reversing lamps, are 12,500 cd/m²,
about four times a white wall under an overcast sky of 10,000 lx."""
_GLASS_TINT = 0.72  # fraction of the light that passes a pane

RESPONSE = np.zeros((256, 4), dtype=np.float32)
RESPONSE[:, 1] = 0.1
RESPONSE[:, 3] = 1.0
for _material, _row in {
    Material.PAINT: (0.05, 0.006, 0.05, 1.0),
    Material.GLASS: (0.08, 0.002, 0.0, 1.0),
    Material.TRIM: (0.02, 0.05, 0.15, 1.0),
    Material.RUBBER: (0.0, 0.1, 0.25, 0.8),
    Material.RIM: (0.16, 0.03, 0.1, 1.0),
    **dict.fromkeys(
        (Material.LAMP, Material.TAIL_LAMP, Material.REVERSING_LAMP, Material.HEAD_LAMP),
        (0.14, 0.004, 0.1, 1.0),
    ),
    Material.PLATE: (0.02, 0.05, 0.05, 1.0),
    Material.INTERIOR: (0.0, 0.1, 0.1, 0.4),
    Material.CHROME: (0.55, 0.008, 0.02, 1.0),
    Material.FOLIAGE: (0.0, 0.1, 0.9, 1.0),
    Material.BARK: (0.0, 0.1, 0.6, 1.0),
    Material.STONE: (0.0, 0.1, 0.35, 1.0),
    Material.CLOTH: (0.0, 0.1, 0.25, 1.0),
}.items():
    RESPONSE[_material] = _row
"""(256, 4) float32, for every material: mirror reflection at normal incidence, width of the sun's glint (1 - cosine),
roughness noise on the albedo, and fraction of the sky light that reaches it (low inside a car)."""

_CODES = np.arange(256) / 255.0
# (256,) float32, the linear value of every sRGB code.
LINEAR = np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4).astype(np.float32)


class Materials(NamedTuple):
    grain: Tile  # fine noise of surfaces
    cloud: Tile  # soft noise
    response: Float32Array  # see `RESPONSE`
    linear: Float32Array  # see `LINEAR`


class Surfaces(NamedTuple):
    """What is known of the pixels of a batch that show objects, (n,) each; float32 unless stated otherwise."""

    material: NDArray[np.int32]  # int32
    inside: NDArray[np.bool_]  # bool, whether it is the inner side of a car's body
    # unit vector away from the surface, on the camera's side, world frame
    normal_x: Float32Array
    normal_y: Float32Array
    normal_z: Float32Array
    cosine: Float32Array  # of the angle between that and the ray back to the camera
    along: Float32Array  # m, coordinate along a vertical wall, for textures
    blotch: Float32Array  # soft noise, 0 to 1
    mirror: Float32Array  # fraction of the light that is mirrored
    received: Float32Array  # fraction of the sky's light that reaches it
    glint: Float32Array  # 1 - cosine of the width of the sun's reflection
    # vector along which mirrored light comes to the point, reversed
    mirrored_x: Float32Array
    mirrored_y: Float32Array
    mirrored_z: Float32Array


@compiled(**VECTOR_LOOP)
def orient(
    n: int, places: Places, normals: Float32Array, view: View, batch: Batch, surfaces: Surfaces
) -> None:
    """Set the normals of the first n pixels from their triangles' matrices, (t, 9)."""
    for i in range(n):
        u = (np.float32(places.column[i]) + 0.5 - view.cx) / view.fx
        v = (np.float32(places.row[i]) + 0.5 - view.cy) / view.fy
        t = np.uint64(places.triangle[i])
        x = normals[t, 0] * u + normals[t, 1] * v + normals[t, 2]
        y = normals[t, 3] * u + normals[t, 4] * v + normals[t, 5]
        z = normals[t, 6] * u + normals[t, 7] * v + normals[t, 8]
        scale = 1.0 / np.sqrt(x * x + y * y + z * z + 1e-30)
        cosine = -(x * batch.ray_x[i] + y * batch.ray_y[i] + z * batch.ray_z[i]) * scale
        behind = cosine < 0.0
        scale = -scale if behind else scale
        surfaces.normal_x[i] = x * scale
        surfaces.normal_y[i] = y * scale
        surfaces.normal_z[i] = z * scale
        surfaces.cosine[i] = abs(cosine)
        surfaces.inside[i] = behind


@compiled(**VECTOR_LOOP)
def color_surfaces(
    n: int,
    places: Places,
    triangle_material: NDArray[np.uint8],
    triangle_color: NDArray[np.uint8],
    materials: Materials,
    batch: Batch,
    surfaces: Surfaces,
) -> None:
    """Set the albedo and the reflection of the first n pixels, plain."""
    response = materials.response
    linear = materials.linear
    for i in range(n):
        t = np.uint64(places.triangle[i])
        material = np.uint64(triangle_material[t])
        # Back faces show the interior lining, not the paint.
        inside = surfaces.inside[i] & (material == _PAINT)
        red = linear[np.uint64(triangle_color[t, 0])]
        green = linear[np.uint64(triangle_color[t, 1])]
        blue = linear[np.uint64(triangle_color[t, 2])]
        surfaces.material[i] = material
        surfaces.inside[i] = inside
        surfaces.mirror[i] = 0.0 if inside else response[material, 0]
        surfaces.glint[i] = response[material, 1]
        surfaces.received[i] = 0.4 if inside else response[material, 3]
        batch.red[i] = 0.05 if inside else red
        batch.green[i] = 0.05 if inside else green
        batch.blue[i] = 0.05 if inside else blue


@compiled(**VECTOR_LOOP)
def blotch_surfaces(n: int, cloud: Tile, focal: Single, batch: Batch, surfaces: Surfaces) -> None:
    """Set the blotches of the first n pixels, on a vertical plane through the normal: dirt, plaster, leaves."""
    for i in range(n):
        x, y, z = batch.x[i], batch.y[i], batch.z[i]
        along = y * surfaces.normal_x[i] - x * surfaces.normal_y[i]
        size = np.float32(0.35) if surfaces.material[i] == _FOLIAGE else np.float32(0.9)
        level = pixel_level(batch.depth[i] / focal * size)
        surfaces.along[i] = along
        surfaces.blotch[i] = sample_tile(cloud, along * size + x * 0.11, (z + 0.5 * y) * size, level)


@compiled(**VECTOR_LOOP)
def detail_leaves(n: int, focal: Single, grain: Tile, batch: Batch, surfaces: Surfaces) -> None:
    leafy = np.int32(0)
    for i in range(n):
        leafy += np.int32(surfaces.material[i] == _FOLIAGE)
    if leafy == 0:
        return
    for i in range(n):
        if surfaces.material[i] == _FOLIAGE:
            u = surfaces.along[i] * 0.31 + batch.x[i] * 0.2
            v = batch.z[i] * 0.31 + batch.y[i] * 0.17
            leaf = sample_tile(grain, u, v, pixel_level(batch.depth[i] / focal * 0.3))
            surfaces.normal_x[i] += 1.6 * (leaf - 0.5)
            surfaces.normal_z[i] += 2.2 * (surfaces.blotch[i] - 0.5)
            surfaces.blotch[i] = 0.5 * surfaces.blotch[i] + 0.5 * leaf


@compiled(**VECTOR_LOOP)
def soil_surfaces(n: int, response: Float32Array, batch: Batch, surfaces: Surfaces) -> None:
    """Put road dirt on the lower bodies among the first n pixels, in blotches, and roughness on all."""
    for i in range(n):
        material = surfaces.material[i]
        soft = surfaces.blotch[i]
        soiled = (batch.z[i] < 0.7) & (material <= _CHROME) & (not surfaces.inside[i])
        dirt = min(0.5, max(0.0, (0.75 - batch.z[i]) * 0.8 * (soft - 0.15)))
        dirt = dirt if soiled else np.float32(0.0)
        tone = 1.0 + response[np.uint64(material), 2] * 2.0 * (soft - 0.5)
        batch.red[i] = mix(batch.red[i], 0.16, dirt) * tone
        batch.green[i] = mix(batch.green[i], 0.145, dirt) * tone
        batch.blue[i] = mix(batch.blue[i], 0.125, dirt) * tone
        surfaces.mirror[i] *= 1.0 - dirt


@compiled(**VECTOR_LOOP)
def light_surfaces(n: int, light: Light, maps: LightMaps, batch: Batch, surfaces: Surfaces) -> None:
    to_sun = light.sun_direction
    for i in range(n):
        nx, ny, nz = surfaces.normal_x[i], surfaces.normal_y[i], surfaces.normal_z[i]
        x, y, z = batch.x[i] + 0.04 * nx, batch.y[i] + 0.04 * ny, batch.z[i] + 0.04 * nz
        reaches = sunlit(maps, x, y, z, SHADOW_BIAS)
        facing = nx * to_sun[0] + ny * to_sun[1] + nz * to_sun[2]
        batch.sun[i] = reaches if facing > 0.0 else np.float32(0.0)
    for i in range(n):
        nx, ny, nz = surfaces.normal_x[i], surfaces.normal_y[i], surfaces.normal_z[i]
        sun = max(nx * to_sun[0] + ny * to_sun[1] + nz * to_sun[2], 0.0) * batch.sun[i]
        # Sky light from above, bounced light from the ground below; both are weak under the sills and between the
        # wheels.
        low = min(1.0, 0.3 + 0.75 * batch.z[i])
        upward = 0.5 + 0.5 * nz
        around = open_sky(maps, batch.x[i] + 0.6 * nx, batch.y[i] + 0.6 * ny)
        past_cars = 0.55 + 0.45 * around + 0.45 * nz * (1.0 - around)
        from_sky = surfaces.received[i] * upward * (0.35 + 0.65 * low) * past_cars
        bounce = surfaces.received[i] * (1.0 - upward) * low * (0.3 + 0.7 * around)
        batch.red[i] *= light.sun[0] * sun + light.sky[0] * from_sky + light.ground[0] * bounce
        batch.green[i] *= light.sun[1] * sun + light.sky[1] * from_sky + light.ground[1] * bounce
        batch.blue[i] *= light.sun[2] * sun + light.sky[2] * from_sky + light.ground[2] * bounce


@compiled(**VECTOR_LOOP)
def light_lamps(
    n: int,
    places: Places,
    triangle_color: NDArray[np.uint8],
    linear: Float32Array,
    batch: Batch,
    surfaces: Surfaces,
) -> None:
    """Let the lamps that are lit among the first n pixels shine in their own colour."""
    lit = np.int32(0)
    for i in range(n):
        lit += np.int32(surfaces.material[i] == _LIT)
    if lit == 0:
        return
    for i in range(n):
        if surfaces.material[i] == _LIT:
            t = np.uint64(places.triangle[i])
            batch.red[i] = _LAMP_RADIANCE * linear[np.uint64(triangle_color[t, 0])]
            batch.green[i] = _LAMP_RADIANCE * linear[np.uint64(triangle_color[t, 1])]
            batch.blue[i] = _LAMP_RADIANCE * linear[np.uint64(triangle_color[t, 2])]


@compiled(**VECTOR_LOOP)
def mirror_in_surfaces(n: int, light: Light, maps: LightMaps, batch: Batch, surfaces: Surfaces) -> None:
    """Add to the first n pixels what they reflect of the sky and the ground, and the sun's glint."""
    to_sun = light.sun_direction
    for i in range(n):
        strength = np.float32(0.8) if surfaces.material[i] == _PAINT else np.float32(0.5)
        mirror = mix(surfaces.mirror[i], 1.0, fifth_power(1.0 - min(surfaces.cosine[i], 1.0)) * strength)
        mirror = mirror if surfaces.mirror[i] > 0.0 else np.float32(0.0)
        # Pressed steel is never flat: distort its reflections.
        waver = 0.03 * (surfaces.blotch[i] - 0.5)
        twice = 2.0 * surfaces.cosine[i]
        x = batch.ray_x[i] + twice * surfaces.normal_x[i] + waver
        y = batch.ray_y[i] + twice * surfaces.normal_y[i] + waver
        z = batch.ray_z[i] + twice * surfaces.normal_z[i] + 2.0 * waver
        off = 1.0 - (x * to_sun[0] + y * to_sun[1] + z * to_sun[2])
        glint = max(0.0, 1.0 - off / (4.0 * surfaces.glint[i]))
        surfaces.glint[i] = glint * glint * glint * batch.sun[i] * mirror * 0.05 / surfaces.glint[i]
        surfaces.mirror[i] = mirror
        surfaces.mirrored_x[i] = x
        surfaces.mirrored_y[i] = y
        surfaces.mirrored_z[i] = z
    for i in range(n):
        x, y, z = surfaces.mirrored_x[i], surfaces.mirrored_y[i], surfaces.mirrored_z[i]
        red, green, blue = mirrored(batch.x[i], batch.y[i], batch.z[i], x, y, z, light, maps)
        mirror, glint = surfaces.mirror[i], surfaces.glint[i]
        batch.red[i] = mix(batch.red[i], red, mirror) + light.sun[0] * glint
        batch.green[i] = mix(batch.green[i], green, mirror) + light.sun[1] * glint
        batch.blue[i] = mix(batch.blue[i], blue, mirror) + light.sun[2] * glint


@compiled(**VECTOR_LOOP)
def cover_with_glass(
    n: int,
    places: Places,
    n_panes: NDArray[np.uint8],
    light: Light,
    maps: LightMaps,
    batch: Batch,
    surfaces: Surfaces,
) -> None:
    """Dim the first n radiances by their number of panes, of an (h, w) image, and add the nearest pane's reflection."""
    for i in range(n):
        panes = n_panes[np.uint64(places.row[i]), np.uint64(places.column[i])]
        tint = np.float32(_GLASS_TINT)
        tint *= np.float32(_GLASS_TINT) if panes > 1 else np.float32(1.0)
        tint *= np.float32(_GLASS_TINT) if panes > 2 else np.float32(1.0)
        tint *= np.float32(_GLASS_TINT) if panes > 3 else np.float32(1.0)
        cosine = surfaces.cosine[i]
        mirror = 0.08 + 0.85 * fifth_power(1.0 - min(cosine, 1.0))
        twice = 2.0 * cosine
        red, green, blue = mirrored(
            batch.x[i],
            batch.y[i],
            batch.z[i],
            batch.ray_x[i] + twice * surfaces.normal_x[i],
            batch.ray_y[i] + twice * surfaces.normal_y[i],
            batch.ray_z[i] + twice * surfaces.normal_z[i],
            light,
            maps,
        )
        through = tint * (1.0 - mirror)
        batch.red[i] = batch.red[i] * through * 0.96 + red * mirror
        batch.green[i] = batch.green[i] * through + green * mirror
        batch.blue[i] = batch.blue[i] * through * 0.97 + blue * mirror


@compiled(**VECTOR_LEAF)
def fifth_power(x: Single) -> Single:
    square = x * x
    return square * square * x
