"""Small scenes of boxes, and a ray caster in double precision that shares nothing with the rasteriser."""

import math
from dataclasses import dataclass

import numpy as np

from sim_sensors.camera.rasterizer import FAR
from sim_sensors.mesh import Ground, Instances, Material, Mesh, MeshPool
from sim_sensors.vehicles.vehicle import COARSE, DETAILED, VehicleModel


@dataclass(frozen=True, eq=False)
class ToyScene:
    pool: MeshPool
    instances: Instances
    ground: Ground

    def soup(self):
        """(n, 3, 3) float64, corners in the world of all triangles that are not glass."""
        parts = []
        for mesh, (x, y, z, yaw) in zip(self.instances.mesh, self.instances.pose, strict=True):
            vertices = self.pool.vertices[self.pool.vertex_start[mesh] : self.pool.vertex_start[mesh + 1]]
            chosen = slice(self.pool.triangle_start[mesh], self.pool.triangle_start[mesh + 1])
            keep = self.pool.material[chosen] != Material.GLASS
            turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
            parts.append((vertices.astype(float) @ turn + (x, y, z))[self.pool.triangles[chosen][keep]])
        return np.concatenate(parts)


def box_mesh(length, width, height, material=Material.PAINT, color=(150, 30, 30), splits=1):
    """A box on the ground, each face split into `splits` squared quads."""
    points, normals, triangles = [], [], []
    grid = np.linspace(-1.0, 1.0, splits + 1)
    half = np.array([length, width, height]) / 2.0
    for axis in range(3):
        for sign in (-1, 1):
            u, v = np.meshgrid(grid, grid, indexing="ij")
            face = np.empty((splits + 1, splits + 1, 3))
            face[..., axis] = sign
            face[..., (axis + 1) % 3] = u
            face[..., (axis + 2) % 3] = v
            start = sum(len(part) for part in points)
            index = start + np.arange((splits + 1) ** 2).reshape(splits + 1, splits + 1)
            a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
            quads = np.stack([a, b, c, d] if sign > 0 else [a, d, c, b], axis=-1).reshape(-1, 4)
            triangles.extend([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
            points.append((face * half + (0.0, 0.0, half[2])).reshape(-1, 3))
            normal = np.zeros(3)
            normal[axis] = sign
            normals.append(np.tile(normal, ((splits + 1) ** 2, 1)))
    faces = np.concatenate(triangles).astype(np.int32)
    materials, colors = np.full(len(faces), material, np.uint8), np.tile(np.uint8(color), (len(faces), 1))
    points, normals = (np.concatenate(part).astype(np.float32) for part in (points, normals))
    return Mesh(points, normals, faces, materials, colors)


def toy_scene(meshes, placed, ids, coarse=None, ground=None):
    """A scene of meshes; `placed` has (mesh, x, y, z, yaw) for each instance."""
    counts = [[len(mesh.vertices), len(mesh.triangles)] for mesh in meshes]
    start = np.concatenate([np.zeros((1, 2), dtype=np.int64), np.cumsum(counts, axis=0)])
    pool = MeshPool(
        *(np.concatenate([getattr(mesh, name) for mesh in meshes]) for name in Mesh.__dataclass_fields__),
        np.ascontiguousarray(start[:, 0]),
        np.ascontiguousarray(start[:, 1]),
        np.array([np.linalg.norm(mesh.vertices, axis=1).max() for mesh in meshes], dtype=np.float32),
        None if coarse is None else np.array(coarse, dtype=np.int32),
    )
    placed = np.array(placed, dtype=float).reshape(-1, 5)
    instances = Instances(placed[:, 0].astype(np.int32), placed[:, 1:].copy(), np.array(ids, dtype=np.int32))
    if ground is None:
        square = np.array([(-15.0, -15.0), (15.0, -15.0), (15.0, 15.0), (-15.0, 15.0)])
        ground = Ground((square,), np.array([[2.0, -3.0, 7.0, -3.0, 0.12]]), 0)
    return ToyScene(pool, instances, ground)


def random_boxes(seed, count=40):
    """Boxes of car size all round, some glass, none at the origin."""
    generator = np.random.default_rng(seed)
    materials = [Material.PAINT, Material.PAINT, Material.STONE, Material.GLASS]
    meshes = [
        box_mesh(*generator.uniform(0.5, 4.0, 3), materials[i % 4], generator.integers(20, 230, 3), i % 3 + 1)
        for i in range(8)
    ]
    angle, distance = generator.uniform(-np.pi, np.pi, count), generator.uniform(5.0, 40.0, count)
    which, yaw = generator.integers(0, len(meshes), count), generator.uniform(-np.pi, np.pi, count)
    placed = np.column_stack([which, distance * np.cos(angle), distance * np.sin(angle), 0.0 * yaw, yaw])
    return toy_scene(meshes, placed, np.arange(1, count + 1))


def ray_depth(scene, camera, pose):
    """(h, w) float64, m along the optical axis, of the first opaque surface: every ray against every triangle.

    Moeller and Trumbore, *Fast, minimum storage ray-triangle intersection*, 1997, in double precision.
    """
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    rays = rays.reshape(-1, 3) @ pose[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        best = np.where(rays[:, 2] < 0.0, -pose[2, 3] / rays[:, 2], np.inf)
        best[best > FAR] = np.inf
        for a, b, c in scene.soup():
            first, second, offset = b - a, c - a, pose[:3, 3] - a
            p = np.cross(rays, second)
            scale = 1.0 / (p @ first)
            u, q = (p @ offset) * scale, np.cross(offset, first)
            v, t = (rays @ q) * scale, (second @ q) * scale
            hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.05)
            best = np.where(hit & (t < best), t, best)
    return best.reshape(camera.height, camera.width)


def parked_cars(columns=50, models=40):
    """Cars nose-in on both sides of a lane along x, no space left free; far ones have coarse meshes."""
    cars = [VehicleModel.from_seed(None, seed) for seed in range(models)]
    meshes = [car.mesh(level) for level in (DETAILED, COARSE) for car in cars]
    coarse = np.tile(np.arange(models, 2 * models), 2)
    generator = np.random.default_rng(0)
    placed = [
        (generator.integers(models), (column - (columns - 1) / 2.0) * 2.55, y, 0.0, math.pi / 2)
        for y in (-6.0, -11.2, 6.0, 11.2)
        for column in range(columns)
    ]
    return toy_scene(meshes, placed, range(1, len(placed) + 1), coarse.tolist())
