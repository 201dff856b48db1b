"""The static surroundings of a scene, from plain arrays: the ground and scenery."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from parkenv.compiled.arrays import FloatArray
from sim_sensors import scenery
from sim_sensors.errors import SensorError, as_floats, require_seed
from sim_sensors.mesh import Ground, Mesh

TREE_KINDS = 8
LOW_WALL_M = 0.5  # the laser passes over lower walls
WALL_THICKNESS_M = 0.24
HEDGE_THICKNESS_M = 0.8


class Standing(NamedTuple):
    """A static object: its mesh, pose x, y, yaw, and its outline 0.5 m above the ground in its own frame, if any."""

    mesh: Mesh
    pose: tuple[float, float, float]
    footprint: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Ground, buildings, walls, hedges, trees and people; world frame, SI units.

    Args:
        paved: polygons, (k, 2) m, of asphalt.
        markings: (n, 5) m: both ends of painted lines, and their width.
        buildings: outlines, (k, 2) m, simple polygons.
        building_heights: (n_buildings,) m; None: 9 m each.
        walls: (n, 5) m: both ends of free-standing walls, and their height.
        trees: (n, 3) m: x, y, height.
        pedestrians: (n, 4): x, y in m, yaw in rad, phase of the stride in turns.
        seed: 0 or more, seed of textures, trees, clothes and windows.
        hedges: (n, 5) m: both ends of hedges, and their height.

    Raises:
        SensorError: a shape is wrong, a value is not finite, a height or width is not above zero, or a wall or
        hedge has no length.
    """

    paved: Sequence[ArrayLike] = ()
    markings: ArrayLike = ()
    buildings: Sequence[ArrayLike] = ()
    building_heights: ArrayLike | None = None
    walls: ArrayLike = ()
    trees: ArrayLike = ()
    pedestrians: ArrayLike = ()
    seed: int = 0
    hedges: ArrayLike = ()
    _outlines: tuple[FloatArray, ...] = field(init=False, repr=False, default=())

    def __post_init__(self) -> None:
        require_seed(self.seed)
        tables = {"markings": 5, "walls": 5, "hedges": 5, "trees": 3, "pedestrians": 4}
        for name, columns in tables.items():
            object.__setattr__(self, name, as_floats(name, getattr(self, name), None, columns))
        for name in ("paved", "buildings"):
            rows = tuple(as_floats(f"{name}[{i}]", row, None, 2) for i, row in enumerate(getattr(self, name)))
            short = [i for i, row in enumerate(rows) if len(row) < 3]
            if short:
                raise SensorError(f"{name}[{short[0]}] has {len(rows[short[0]])} points, want 3 or more")
            object.__setattr__(self, name, rows)
        heights = (
            np.full(len(self.buildings), 9.0) if self.building_heights is None else self.building_heights
        )
        heights = as_floats("building_heights", heights, len(self.buildings))
        object.__setattr__(self, "building_heights", heights)
        least_values = (("building_heights", heights, 2.4), ("trees", self._table("trees")[:, 2], 1.5))
        for name, column, low in least_values:
            if (column < low).any():
                raise SensorError(f"{name} is {column.min()}, want heights of {low} m or more")
        for name in ("markings", "walls", "hedges"):
            table = self._table(name)
            what = "width" if name == "markings" else "height"
            if (table[:, 4] <= 0).any():
                raise SensorError(f"{name} is {table[:, 4].min()}, want a {what} above 0 m")
            length = np.hypot(*(table[:, 2:4] - table[:, :2]).T)
            if (length < 1e-6).any():
                raise SensorError(
                    f"{name}[{int(np.argmin(length))}] has a length of 0 m, want two ends apart"
                )
        object.__setattr__(
            self, "_outlines", tuple(_counter_clockwise(np.asarray(b)) for b in self.buildings)
        )

    def _table(self, name: str) -> FloatArray:
        return np.asarray(getattr(self, name))

    @cached_property
    def ground(self) -> Ground:
        """The ground for the camera."""
        return Ground(tuple(np.asarray(p) for p in self.paved), self._table("markings"), self.seed)

    @cached_property
    def standing(self) -> tuple[Standing, ...]:
        """All static objects; equal objects share a mesh."""
        things: list[Standing] = []
        for i, (outline, height) in enumerate(
            zip(self._outlines, self._table("building_heights"), strict=True)
        ):
            center = outline.mean(axis=0)
            mesh = scenery.building_mesh(outline - center, float(height), self.seed + i)
            things.append(Standing(mesh, (center[0], center[1], 0.0)))
        for i, (x0, y0, x1, y1, height) in enumerate(self._table("walls").tolist()):
            # Walls overlap at corners; with equal heights their tops would flicker.
            mesh = scenery.wall_mesh(
                [0, 0], [x1 - x0, y1 - y0], height + 0.002 * (i % 4), WALL_THICKNESS_M, self.seed
            )
            things.append(Standing(mesh, (x0, y0, 0.0)))
        for i, (x0, y0, x1, y1, height) in enumerate(self._table("hedges").tolist()):
            mesh = scenery.hedge_mesh([0, 0], [x1 - x0, y1 - y0], height, HEDGE_THICKNESS_M, self.seed + i)
            things.append(Standing(mesh, (x0, y0, 0.0)))
        trees = self._table("trees")
        kinds: dict[tuple[float, int], Mesh] = {}
        for i, (x, y, height) in enumerate(trees.tolist()):
            key = (round(height * 2) / 2, i % TREE_KINDS)
            if key not in kinds:
                kinds[key] = scenery.tree_mesh(key[0], self.seed * TREE_KINDS + key[1])
            trunk = scenery.round_footprint(scenery.TRUNK_M * key[0] / 7.0)
            things.append(Standing(kinds[key], (x, y, 2.4 * i), trunk))
        for i, (x, y, yaw, phase) in enumerate(self._table("pedestrians").tolist()):
            gait = round(phase * scenery.GAITS) % scenery.GAITS / scenery.GAITS
            person = scenery.pedestrian_mesh(gait, self.seed * 4096 + i)
            things.append(Standing(person, (x, y, yaw), scenery.pedestrian_footprint(gait)))
        return tuple(things)

    @cached_property
    def wall_segments(self) -> FloatArray:
        """Line segments of buildings, walls and hedges 0.5 m above the ground, (m, 2, 2) float64, m.

        A free-standing wall or hedge has both faces and both ends.
        """
        sides = [np.stack([a, np.roll(a, -1, axis=0)], axis=1) for a in self._outlines]
        walls, hedges = self._table("walls"), self._table("hedges")
        thick = np.repeat([WALL_THICKNESS_M, HEDGE_THICKNESS_M], [len(walls), len(hedges)])
        long = np.column_stack([np.concatenate([walls, hedges]), thick])
        for x0, y0, x1, y1, _, thickness in long[long[:, 4] > LOW_WALL_M].tolist():
            a, b = np.array([x0, y0]), np.array([x1, y1])
            along = (b - a) / np.hypot(*(b - a))
            side = 0.5 * thickness * np.array([-along[1], along[0]])
            ring = np.array([a - side, b - side, b + side, a + side])
            sides.append(np.stack([ring, np.roll(ring, -1, axis=0)], axis=1))
        return np.concatenate(sides) if sides else np.empty((0, 2, 2))


def _counter_clockwise(outline: FloatArray) -> FloatArray:
    x, y = outline.T
    area = float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2
    if abs(area) < 1e-3:
        raise SensorError(f"buildings is {outline.tolist()}, want an outline with an area")
    return outline if area > 0 else outline[::-1].copy()
