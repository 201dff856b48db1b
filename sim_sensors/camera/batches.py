"""Batches of pixels of one kind that are shaded together, so that each step is one loop of vector instructions."""

from typing import NamedTuple

import numpy as np

from parkenv.compiled.arrays import Float32Array, Int32Array
from parkenv.compiled.jit import compiled
from sim_sensors.camera.daylight import Light
from sim_sensors.camera.textures import VECTOR_LOOP, Single


class View(NamedTuple):
    """The camera: rotation (3, 3) camera to world, position (3,), intrinsics in px; all float32."""

    rotation: Float32Array
    position: Float32Array
    fx: Single
    fy: Single
    cx: Single
    cy: Single


class Places(NamedTuple):
    column: Int32Array
    row: Int32Array
    triangle: Int32Array


class Batch(NamedTuple):
    """What is known of the pixels of a batch, (n,) float32 each."""

    # m, the point that is seen, world frame
    x: Float32Array
    y: Float32Array
    z: Float32Array
    # unit vector from the camera to the point, world frame
    ray_x: Float32Array
    ray_y: Float32Array
    ray_z: Float32Array
    distance: Float32Array  # m, from the camera to the point
    depth: Float32Array  # m, along the optical axis
    # linear RGB: first the albedo, in the end the radiance
    red: Float32Array
    green: Float32Array
    blue: Float32Array
    # fractions of the sun that reaches the point, and of the sky
    sun: Float32Array
    sky: Float32Array
    # of the ground: how much water can collect, and the asphalt's grain
    wettable: Float32Array
    grain: Float32Array


BATCH_FIELDS = len(Batch._fields)


@compiled(**VECTOR_LOOP)
def locate(n: int, places: Places, inverse_depth: Float32Array, view: View, batch: Batch) -> None:
    """Set point, ray, distance and depth of the first n pixels from their inverse depth in an (h, w) image."""
    r = view.rotation
    at = view.position
    per_fx = 1.0 / view.fx
    per_fy = 1.0 / view.fy
    for i in range(n):
        u = (np.float32(places.column[i]) + 0.5 - view.cx) * per_fx
        v = (np.float32(places.row[i]) + 0.5 - view.cy) * per_fy
        depth = 1.0 / inverse_depth[np.uint64(places.row[i]), np.uint64(places.column[i])]
        x = r[0, 0] * u + r[0, 1] * v + r[0, 2]
        y = r[1, 0] * u + r[1, 1] * v + r[1, 2]
        z = r[2, 0] * u + r[2, 1] * v + r[2, 2]
        length = np.sqrt(u * u + v * v + 1.0)
        batch.x[i] = at[0] + x * depth
        batch.y[i] = at[1] + y * depth
        batch.z[i] = at[2] + z * depth
        batch.ray_x[i] = x / length
        batch.ray_y[i] = y / length
        batch.ray_z[i] = z / length
        batch.distance[i] = depth * length
        batch.depth[i] = depth


@compiled(**VECTOR_LOOP)
def fade_into_haze(n: int, light: Light, batch: Batch) -> None:
    for i in range(n):
        # 1 - exp(-k) to three decimals, for the k of usual road scenes.
        k = light.haze * batch.distance[i]
        fog = 1.0 - 1.0 / (1.0 + k * (1.0 + 0.5 * k))
        batch.red[i] += (light.horizon[0] - batch.red[i]) * fog
        batch.green[i] += (light.horizon[1] - batch.green[i]) * fog
        batch.blue[i] += (light.horizon[2] - batch.blue[i]) * fog


@compiled(**VECTOR_LOOP)
def read(n: int, places: Places, image: Float32Array, batch: Batch) -> None:
    for i in range(n):
        row, column = np.uint64(places.row[i]), np.uint64(places.column[i])
        batch.red[i] = image[row, column, 0]
        batch.green[i] = image[row, column, 1]
        batch.blue[i] = image[row, column, 2]


@compiled(**VECTOR_LOOP)
def write(n: int, places: Places, batch: Batch, image: Float32Array) -> None:
    for i in range(n):
        row, column = np.uint64(places.row[i]), np.uint64(places.column[i])
        image[row, column, 0] = batch.red[i]
        image[row, column, 1] = batch.green[i]
        image[row, column, 2] = batch.blue[i]
