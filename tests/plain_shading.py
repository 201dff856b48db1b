"""The radiance of pixels in plain Python and double precision: the reference for `sim_sensors.camera.shading`."""

import math
from dataclasses import dataclass

import numpy as np

from sim_sensors.camera.materials import LINEAR, RESPONSE
from sim_sensors.camera.sky import mirrored_sky, sky_of_view
from sim_sensors.camera.textures import cloud_tile, grain_tile
from sim_sensors.mesh import Material


def plain_radiance(triangles, visibility, pose, intrinsics, weather, ground, maps):
    """(h, w, 3) float64, of the arguments of `shade`."""
    height, width = visibility.triangle.shape
    sky = sky_of_view(weather, np.ascontiguousarray(pose[:3, :3]), intrinsics, (width, height))
    view = _PlainView(triangles, visibility, pose, intrinsics, weather, ground, maps, mirrored_sky(weather))
    image = sky.astype(float)
    for y in range(height):
        for x in range(width):
            image[y, x] = view.color(x, y, image[y, x])
    return image


def _bilinear(image, u, v):
    """Value at column u and row v of an image, whose last texel is followed by the first."""
    column, row = math.floor(u), math.floor(v)
    a, b = u - column, v - row
    rows, columns = image.shape[:2]
    top, bottom = image[row % rows], image[(row + 1) % rows]
    left, right = column % columns, (column + 1) % columns
    return (top[left] * (1 - a) + top[right] * a) * (1 - b) + (bottom[left] * (1 - a) + bottom[right] * a) * b


def _tile(tile, u, v, level):
    level = min(max(level, 0), len(tile.start) - 1)
    n = tile.size >> level
    texels = tile.levels[tile.start[level] : tile.start[level] + n * n].reshape(n, n) & 255
    return _bilinear(texels / 255.0, u * n - 0.5, v * n - 0.5)


def _tile_level(spans):
    return min(7, max(0, math.ceil(math.log2(max(spans * 512.0, 1e-9) / 1.4))))


def _dither(x, y):
    h = (x * 374761393 + y * 668265263) & 0x7FFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0x7FFFFFFF
    return (h ^ (h >> 16)) / 2147483648.0


@dataclass
class _PlainView:
    triangles: object
    visibility: object
    pose: object
    intrinsics: tuple
    weather: object
    ground: object
    maps: object
    dome: object

    def __post_init__(self):
        self.sun, self.sky = np.array(self.weather.sun), np.array(self.weather.sky)
        self.to_sun = np.array(self.weather.sun_direction)
        wet = self.weather.wetness
        self.bounced = 0.12 * (1.0 - 0.5 * wet) * (self.sun * self.to_sun[2] + self.sky)

    def color(self, x, y, behind):
        seen, (fx, fy, cx, cy) = self.visibility, self.intrinsics
        uv = np.array([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, 1.0])
        ray, length = self.pose[:3, :3] @ uv, np.linalg.norm(uv)
        color = behind
        if seen.inverse_depth[y, x] > 0.0:
            depth = 1.0 / float(seen.inverse_depth[y, x])
            point, t = self.pose[:3, 3] + ray * depth, seen.triangle[y, x]
            if t < 0:
                color = self._ground(x, y, point, ray / length)
            else:
                color = self._surface(t, point, ray / length, self._normal(t, uv), depth / fx)
            k = self.weather.haze * depth * length
            fade = 1.0 - 1.0 / (1.0 + k * (1.0 + 0.5 * k))
            color = color + (np.array(self.weather.horizon) - color) * fade
        pane = seen.pane[y, x]
        if pane >= 0:
            point = self.pose[:3, 3] + ray / float(seen.pane_inverse_depth[y, x])
            color = self._through(color, seen.n_panes[y, x], point, ray / length, self._normal(pane, uv))
        return color

    def _normal(self, t, uv):
        normal = self.triangles.normal[t].astype(float).reshape(3, 3) @ uv
        return normal / np.linalg.norm(normal)

    def _sunlit(self, point):
        u, v, height = self.maps.to_shadow @ [*point, 1.0]
        n = len(self.maps.shadow)
        if not (0.0 <= u - 0.5 < n - 1 and 0.0 <= v - 0.5 < n - 1):
            return 1.0
        row, column = int(v - 0.5), int(u - 0.5)
        lit = (self.maps.shadow[row : row + 2, column : column + 2] <= height + 0.05).astype(float)
        return _bilinear(lit, u - 0.5 - column, v - 0.5 - row)

    def _open(self, x, y):
        u = (x - self.maps.x) * self.maps.texels_per_m - 0.5
        v = (y - self.maps.y) * self.maps.texels_per_m - 0.5
        n = len(self.maps.contact)
        if not (0.0 <= u < n - 1 and 0.0 <= v < n - 1):
            return 1.0
        row, column = int(v), int(u)
        hidden = (self.maps.contact[row : row + 2, column : column + 2] & 255) / 255.0
        return 1.0 - _bilinear(hidden, u - column, v - row)

    def _dome(self, x, y, z):
        n = len(self.dome)
        u, v = ((np.array([x, y]) * 0.5 / (1.0 + z) + 0.5) * n - 0.5).clip(0.0, n - 1.001)
        return _bilinear(self.dome, u, v)

    def _mirrored(self, point, ray):
        if ray[2] >= 0.0:
            return self._dome(*ray)
        reach = max(point[2], 0.05) / max(-ray[2], 0.02)
        open_sky = self._open(point[0] + ray[0] * reach, point[1] + ray[1] * reach)
        return self.bounced * (0.25 + 0.75 * open_sky) * (1.0 - 0.45 * min(1.0, reach * 0.12))

    def _ground_texel(self, x, y, level):
        g = self.ground
        level = min(max(level, 0), len(g.shape) - 1)
        rows, columns = (int(n) for n in g.shape[level])
        texels = g.texels[g.start[level] : g.start[level] + rows * columns].reshape(rows, columns)
        place = []
        for at, low, per_m, n in ((x, g.x, g.per_m[level, 1], columns), (y, g.y, g.per_m[level, 0], rows)):
            span = n - 1.001
            u = abs((at - low) * float(per_m) - 0.5) % (2.0 * span)
            place.append(min(u, 2.0 * span - u))
        column, row = int(place[0]), int(place[1])
        near = texels[row : row + 2, column : column + 2]
        root = _bilinear((near & 255) / 255.0, place[0] - column, place[1] - row)
        return root**2, float(near[0, 0] >> 8 & 255) / 255.0, float((near >> 16 & 255).mean()) / 255.0

    def _ground(self, x, y, point, ray):
        _, fy, _, cy = self.intrinsics
        down = min(self.pose[2, 1] * (y + 0.5 - cy) / fy + self.pose[2, 2], -1e-3)
        depth = -self.pose[2, 3] / down
        footprint = depth / self.intrinsics[0] * math.sqrt(max(depth / self.pose[2, 3], 1.0))
        level = max(math.log2(footprint / self.ground.texel) - 0.4, 0.0)
        grain_level = int(level + math.log2(self.ground.texel / (3.0 / 512)) + _dither(x, y))
        albedo, grass, wettable = self._ground_texel(*point[:2], int(level + _dither(x, y)))
        grain = 0.55 + 0.9 * _tile(grain_tile(), point[0] / 3.0, point[1] / 3.0, grain_level)
        open_sky = self._open(*point[:2])
        sun = self.to_sun[2] * self._sunlit([*point[:2], 0.0])
        wet = self.weather.wetness * min(1.0, 0.45 + 1.2 * wettable)
        grain *= 1.0 - 0.45 * wet
        tint = np.array([1.03 - 0.08 * grass, 1.0 + 0.25 * grass, 0.95 - 0.45 * grass])
        color = albedo * grain * tint * (self.sun * sun + self.sky * open_sky)
        mirror = (0.025 + 0.975 * (1.0 + ray[2]) ** 5) * wet * min(1.0, 0.3 + 1.1 * wettable) * open_sky**2
        ripple = 0.05 * (grain - 1.0)
        return color + (self._dome(ray[0] + ripple, ray[1] + ripple, max(-ray[2], 0.0)) - color) * mirror

    def _surface(self, t, point, ray, normal, footprint):
        material = self.triangles.material[t]
        mirror, width, roughness, received = RESPONSE[material].astype(float)
        albedo = LINEAR[self.triangles.color[t]].astype(float)
        cosine = -normal @ ray
        inside = cosine < 0.0 and material == Material.PAINT
        if cosine < 0.0:
            normal, cosine = -normal, -cosine
        if inside:
            albedo, mirror, received = np.full(3, 0.05), 0.0, 0.4
        along = point[1] * normal[0] - point[0] * normal[1]
        size = 0.35 if material == Material.FOLIAGE else 0.9
        u, v = along * size + point[0] * 0.11, (point[2] + 0.5 * point[1]) * size
        blotch = _tile(cloud_tile(), u, v, _tile_level(footprint * size))
        if material == Material.FOLIAGE:
            u, v = along * 0.31 + point[0] * 0.2, point[2] * 0.31 + point[1] * 0.17
            leaf = _tile(grain_tile(), u, v, _tile_level(footprint * 0.3))
            normal = normal + np.array([1.6 * (leaf - 0.5), 0.0, 2.2 * (blotch - 0.5)])
            blotch = 0.5 * blotch + 0.5 * leaf
        if point[2] < 0.7 and material <= Material.CHROME and not inside:
            dirt = min(0.5, max(0.0, (0.75 - point[2]) * 0.8 * (blotch - 0.15)))
            albedo = albedo + (np.array([0.16, 0.145, 0.125]) - albedo) * dirt
            mirror *= 1.0 - dirt
        facing = normal @ self.to_sun
        reaches = self._sunlit(point + 0.04 * normal) if facing > 0.0 and self.sun[0] > 0.0 else 0.0
        low, upward = min(1.0, 0.3 + 0.75 * point[2]), 0.5 + 0.5 * normal[2]
        around = self._open(*(point + 0.6 * normal)[:2])
        past_cars = 0.55 + 0.45 * around + 0.45 * normal[2] * (1.0 - around)
        light = self.sun * max(facing, 0.0) * reaches
        light = light + self.sky * received * upward * (0.35 + 0.65 * low) * past_cars
        light = light + self.bounced * received * (1.0 - upward) * low * (0.3 + 0.7 * around)
        color = albedo * (1.0 + roughness * 2.0 * (blotch - 0.5)) * light
        if mirror > 0.0:
            strength = 0.8 if material == Material.PAINT else 0.5
            mirror += (1.0 - mirror) * (1.0 - min(cosine, 1.0)) ** 5 * strength
            waver = 0.03 * (blotch - 0.5)
            reflected = ray + 2.0 * cosine * normal + np.array([waver, waver, 2.0 * waver])
            color = color + (self._mirrored(point, reflected) - color) * mirror
            glint = max(0.0, 1.0 - (1.0 - reflected @ self.to_sun) / (4.0 * width)) ** 3
            color = color + self.sun * glint * reaches * mirror * 0.05 / width
        return color

    def _through(self, color, n_panes, point, ray, normal):
        cosine = -normal @ ray
        if cosine < 0.0:
            normal, cosine = -normal, -cosine
        mirror = 0.08 + 0.85 * (1.0 - min(cosine, 1.0)) ** 5
        through = 0.72 ** min(n_panes, 4) * (1.0 - mirror) * np.array([0.96, 1.0, 0.97])
        return color * through + self._mirrored(point, ray + 2.0 * cosine * normal) * mirror
