"""Procedural texture of walls with windows."""

from __future__ import annotations

import math

from parkenv.compiled.jit import compiled
from sim_sensors.camera.textures import VECTOR_LEAF, Tile, hash_unit, pixel_level, sample_tile


@compiled(**VECTOR_LEAF)
def facade(
    along: float, z: float, nz: float, footprint: float, lit_windows: float, grain: Tile
) -> tuple[float, float, float]:
    """Return the factor on the wall's albedo, the light from a window, and the reflectance, for storeys of windows."""
    courses = sample_tile(grain, along * 0.4, z * 2.5, pixel_level(footprint))
    wall = 0.7 + 0.55 * courses
    if abs(nz) > 0.5:
        return wall * 0.6, 0.0, 0.0
    column = math.floor(along / 2.6)
    storey = math.floor(z / 3.0)
    u = along / 2.6 - column
    v = z / 3.0 - storey
    if not (0.22 < u < 0.78 and 0.28 < v < 0.8):
        # A sill below each window, a joint between storeys.
        sill = 0.2 < u < 0.8 and 0.24 < v <= 0.28
        return wall * (1.25 if sill else (0.8 if v > 0.97 else 1.0)), 0.0, 0.0
    if u < 0.25 or u > 0.75 or v < 0.31 or v > 0.77 or abs(u - 0.5) < 0.015:
        return 1.5, 0.0, 0.0
    chance = hash_unit(column, storey)
    glow = 0.13 * (0.5 + chance / max(lit_windows, 0.01)) if chance < lit_windows else 0.0
    # Some windows have half-closed blinds.
    blind = hash_unit(storey + 17, column + 91)
    if blind < 0.45 and v > 0.8 - 0.5 * blind:
        return 0.9, 0.4 * glow, 0.04
    return 0.12, glow, 0.12
