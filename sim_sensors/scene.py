"""Scenes: vehicles and their surroundings for the sensors; scenes that differ in one vehicle share the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from sim_sensors.errors import SensorError, as_floats, as_integers
from sim_sensors.laser.footprints import ScanPlane
from sim_sensors.mesh import Ground, Instances, Mesh, MeshPool
from sim_sensors.movers import LOOKS, Movers, people_meshes
from sim_sensors.scenery import GAITS, pedestrian_footprint
from sim_sensors.surroundings import Surroundings
from sim_sensors.vehicles.vehicle import COARSE, DETAILED, FOOTPRINT_CORNERS, VehicleModel

NO_VEHICLE = -1


class Footprints(NamedTuple):
    # (n, k, 2) float64, m, world frame, counter-clockwise: a row for every vehicle place, then the posts, trunks and
    # people of the surroundings, then moving objects
    corners: FloatArray
    n_corners: IntArray  # (n,) int64, number of corners used; 0 for an empty place
    # (n,) int64, as in `Instances.ids`: place + 1 for a vehicle, larger for a moving vehicle, 0 for everything else
    ids: IntArray
    walls: FloatArray  # (m, 2, 2) float64, m, world frame: ends of line segments


class Fleet:
    """The meshes of a scene: its surroundings, and every vehicle model with its coarse version.

    Scenes that differ only in the poses of these vehicles share it.
    """

    def __init__(self, models: Sequence[VehicleModel], surroundings: Surroundings) -> None:
        self.models = tuple(models)
        self.surroundings = surroundings

    def with_model(self, model: VehicleModel) -> Fleet:
        larger = Fleet((*self.models, model), self.surroundings)
        if "pool" in self.__dict__:
            larger.__dict__["pool"] = _joined(self.pool, [model.mesh(DETAILED), model.mesh(COARSE)])
        return larger

    def require_models(self, model: IntArray) -> None:
        if model.max(initial=NO_VEHICLE) >= len(self.models):
            raise SensorError(f"vehicle_model is {model.tolist()}, want at most {len(self.models) - 1}")

    @cached_property
    def _scenery(self) -> tuple[list[Mesh], list[int]]:
        meshes: list[Mesh] = []
        place: dict[int, int] = {}
        index = []
        for thing in self.surroundings.standing:
            if id(thing.mesh) not in place:
                place[id(thing.mesh)] = len(meshes)
                meshes.append(thing.mesh)
            index.append(place[id(thing.mesh)])
        return meshes, index

    @cached_property
    def pool(self) -> MeshPool:
        """Meshes of the surroundings and of pedestrians, then the detailed and the coarse mesh of each model."""
        meshes = [*self._scenery[0], *people_meshes()]
        before = len(meshes)
        for model in self.models:
            meshes += [model.mesh(DETAILED), model.mesh(COARSE)]
        return _joined(None, meshes, scenery=before)

    def mesh_of(self, model: IntArray) -> NDArray[np.int32]:
        return (len(self._scenery[0]) + LOOKS * GAITS + 2 * model).astype(np.int32)

    @cached_property
    def scenery_instances(self) -> Instances:
        things = self.surroundings.standing
        pose = np.zeros((len(things), 4))
        if things:
            pose[:, [0, 1, 3]] = [thing.pose for thing in things]
        return Instances(
            np.array(self._scenery[1], dtype=np.int32), pose, np.zeros(len(things), dtype=np.int32)
        )

    @cached_property
    def sizes(self) -> FloatArray:
        return np.array([m.size for m in self.models]).reshape(-1, 3)

    @cached_property
    def outlines(self) -> tuple[FloatArray, IntArray]:
        """(n_models, k, 2) float64 footprints, vehicle frame, and (n_models,) int64 their numbers of corners."""
        return _padded([m.footprint() for m in self.models])

    @cached_property
    def posts(self) -> tuple[FloatArray, IntArray]:
        shapes = [(t.footprint, np.array([t.pose])) for t in self.surroundings.standing]
        return _padded([_placed(shape, pose)[0] for shape, pose in shapes if shape is not None])


@dataclass(frozen=True, eq=False)
class Scene:
    """Vehicles in numbered places, and their surroundings. World frame, SI units.

    A place may be empty, so the ids of other vehicles do not change when a vehicle leaves. Make a scene with
    `from_arrays`, or from parking slots with `slot_scenes.SlotLot`.

    Args:
        vehicle_pose: (n, 3) float64: x, y in m, yaw in rad, of each place.
        vehicle_model: (n,) int64, index into `fleet.models`; `NO_VEHICLE` for an empty place.
        fleet: the meshes.

    Raises:
        SensorError: a shape is wrong, a pose is not finite, or the fleet does not have a model.

    Examples:
        >>> scene = Scene.from_arrays([[0, 0, 0], [0, 3, 0.02]], seeds=[1, 2], bodies=["van", None])
        >>> scene.n_vehicles, scene.without_vehicle(0).instances.ids.tolist()
        (2, [2])
    """

    vehicle_pose: FloatArray
    vehicle_model: IntArray
    fleet: Fleet
    movers: Movers | None = field(default=None, init=False)
    lamps: NDArray[np.uint8] | None = field(default=None, init=False)  # (n,) `Lamps` that are lit; None: none

    def __post_init__(self) -> None:
        pose = as_floats("vehicle_pose", self.vehicle_pose, None, 3)
        model = as_integers("vehicle_model", self.vehicle_model, len(pose), least=NO_VEHICLE)
        self.fleet.require_models(model)
        self._set(pose, model, self.fleet)

    def _set(
        self,
        pose: FloatArray,
        model: IntArray,
        fleet: Fleet,
        movers: Movers | None = None,
        lamps: NDArray[np.uint8] | None = None,
    ) -> None:
        for array in (pose, model):
            array.setflags(write=False)
        named = {
            "vehicle_pose": pose,
            "vehicle_model": model,
            "fleet": fleet,
            "movers": movers,
            "lamps": lamps,
        }
        for name, value in named.items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_arrays(
        cls,
        poses: ArrayLike,
        seeds: ArrayLike,
        bodies: Sequence[str | None] | None = None,
        paints: Sequence[tuple[int, int, int] | None] | None = None,
        surroundings: Surroundings | None = None,
    ) -> Scene:
        """Make a scene from arrays of vehicles.

        Args:
            poses: (n, 3): x, y in m, yaw in rad.
            seeds: (n,) int, seed of each vehicle's model.
            bodies: (n,) names from `vehicles.classes.BODIES`; None for a body drawn by the seed.
            paints: (n,) sRGB triples; None for a paint drawn by the seed.
            surroundings: None for an open plain.

        Raises:
            SensorError: as for the class, or the lengths differ.
        """
        pose = as_floats("poses", poses, None, 3)
        seed = as_integers("seeds", seeds, len(pose))
        models: dict[VehicleModel, int] = {}
        index = []
        for name, column in (("bodies", bodies), ("paints", paints)):
            if column is not None and len(column) != len(pose):
                raise SensorError(f"{name} has {len(column)} entries, want {len(pose)}")
        for i, number in enumerate(seed.tolist()):
            model = VehicleModel.from_seed(None if bodies is None else bodies[i], number)
            paint = None if paints is None else paints[i]
            if paint is not None:
                model = model.painted(paint)
            index.append(models.setdefault(model, len(models)))
        fleet = Fleet(tuple(models), surroundings or Surroundings())
        return cls(pose, np.array(index, dtype=np.int64), fleet)

    @property
    def n_vehicles(self) -> int:
        """Number of places, including empty ones."""
        return len(self.vehicle_pose)

    @cached_property
    def present(self) -> IntArray:
        """The occupied places, ascending."""
        return np.flatnonzero(self.vehicle_model != NO_VEHICLE)

    @property
    def vehicle_boxes(self) -> FloatArray:
        """Length, width, height of each vehicle without mirrors, (n, 3) float64, m; 0 for an empty place."""
        boxes = np.zeros((self.n_vehicles, 3))
        boxes[self.present] = self.fleet.sizes[self.vehicle_model[self.present]]
        return boxes

    @property
    def pool(self) -> MeshPool:
        """The meshes; the same object for all scenes that were derived from one by changing vehicles."""
        return self.fleet.pool

    @property
    def ground(self) -> Ground:
        """The plane below."""
        return self.fleet.surroundings.ground

    @cached_property
    def instances(self) -> Instances:
        """The poses of all meshes, in their detailed version; `pool.coarse` maps these to coarse ones."""
        still, movers = self.still_instances, self.movers
        if movers is None:
            return still
        pose = np.zeros((movers.n_vehicles + movers.n_walkers, 4))
        pose[:, [0, 1, 3]] = np.concatenate([movers.vehicle_pose, movers.walker_pose])
        walkers = len(self.fleet._scenery[0]) + GAITS * movers.walker_look + movers.gait
        mesh = [self.fleet.mesh_of(movers.vehicle_model), walkers.astype(np.int32)]
        return Instances(
            np.concatenate([still.mesh, *mesh]),
            np.concatenate([still.pose, pose]),
            np.concatenate([still.ids, self._mover_ids.astype(np.int32)]),
            still,
            None if still.lamps is None else np.pad(still.lamps, (0, len(pose))),
        )

    @property
    def _mover_ids(self) -> IntArray:
        assert self.movers is not None
        ids = np.zeros(self.movers.n_vehicles + self.movers.n_walkers, dtype=np.int64)
        ids[: self.movers.n_vehicles] = self.n_vehicles + 1 + np.arange(self.movers.n_vehicles)
        return ids

    @cached_property
    def still_instances(self) -> Instances:
        """The instances that do not move."""
        scenery = self.fleet.scenery_instances
        pose = np.zeros((len(self.present), 4))
        pose[:, [0, 1, 3]] = self.vehicle_pose[self.present]
        mesh = self.fleet.mesh_of(self.vehicle_model[self.present])
        return Instances(
            np.concatenate([scenery.mesh, mesh]),
            np.concatenate([scenery.pose, pose]),
            np.concatenate([scenery.ids, (self.present + 1).astype(np.int32)]),
            lamps=None if self.lamps is None else np.pad(self.lamps[self.present], (len(scenery.ids), 0)),
        )

    def footprints(self) -> Footprints:
        """Return the obstacles 0.5 m above the ground: convex polygons of vehicles and posts, and wall segments."""
        outline, count = self.fleet.outlines
        posts, post_count = self.fleet.posts
        corners = np.zeros((self.n_vehicles + len(posts), FOOTPRINT_CORNERS, 2))
        n_corners = np.zeros(len(corners), dtype=np.int64)
        n_corners[self.present] = count[self.vehicle_model[self.present]]
        n_corners[self.n_vehicles :] = post_count
        corners[self.present] = _placed(
            outline[self.vehicle_model[self.present]], self.vehicle_pose[self.present]
        )
        corners[self.n_vehicles :] = posts
        corners[np.arange(FOOTPRINT_CORNERS) >= n_corners[:, None]] = 0.0
        ids = np.concatenate([np.arange(self.n_vehicles) + 1, np.zeros(len(posts), dtype=np.int64)])
        if self.movers is not None:
            moving, how_many = self._mover_footprints(self.movers)
            corners = np.concatenate([corners, moving])
            n_corners = np.concatenate([n_corners, how_many])
            ids = np.concatenate([ids, self._mover_ids])
        return Footprints(corners, n_corners, ids, self.fleet.surroundings.wall_segments)

    def _mover_footprints(self, movers: Movers) -> tuple[FloatArray, IntArray]:
        outline, count = self.fleet.outlines
        people, people_count = _padded([pedestrian_footprint(g / GAITS) for g in range(GAITS)])
        shape = np.concatenate([outline[movers.vehicle_model], people[movers.gait]])
        how_many = np.concatenate([count[movers.vehicle_model], people_count[movers.gait]])
        moving = _placed(shape, np.concatenate([movers.vehicle_pose, movers.walker_pose]))
        moving[np.arange(FOOTPRINT_CORNERS) >= how_many[:, None]] = 0.0
        return moving, how_many

    @cached_property
    def scan_plane(self) -> ScanPlane:
        """The footprints for the laser scanner; ids are those of `instances`.

        A scene that was derived from one with a plane changes a copy of it, which is many times as fast.
        """
        corners, n_corners, ids, walls = self.footprints()
        return ScanPlane(corners, n_corners, walls, ids)

    def footprint(self, i: int) -> FloatArray:
        """Return the footprint of the vehicle in place i, (k, 2) float64, m, world frame; (0, 2) if it is empty."""
        self._check_place(i)
        if self.vehicle_model[i] == NO_VEHICLE:
            return np.empty((0, 2))
        outline, count = self.fleet.outlines
        model = self.vehicle_model[i]
        return np.asarray(
            _placed(outline[model : model + 1, : count[model]], self.vehicle_pose[i : i + 1])[0]
        )

    def with_vehicle(
        self, i: int, *, pose: ArrayLike | None = None, model: VehicleModel | None = None, lamps: int = 0
    ) -> Scene:
        """Return a scene with another vehicle in place i, or the same one at another pose; everything else is shared.

        Args:
            i: the place.
            pose: (3,): x, y in m, yaw in rad; None: unchanged.
            model: None: unchanged. A model that is not in the fleet is added to a copy of its meshes.
            lamps: the `Lamps` that are lit.

        Raises:
            SensorError: the place does not exist, the pose is not finite, or an empty place gets no model.
        """
        self._check_place(i)
        fleet, number = self.fleet, int(self.vehicle_model[i])
        if model is not None:
            if model not in fleet.models:
                fleet = fleet.with_model(model)
            number = fleet.models.index(model)
        if number == NO_VEHICLE:
            raise SensorError(f"model: place {i} is empty, want a model for it")
        return self._changed(i, self.vehicle_pose[i] if pose is None else pose, number, fleet, lamps)

    def without_vehicle(self, i: int) -> Scene:
        """Return a scene in which place i is empty; everything else is shared."""
        self._check_place(i)
        return self._changed(i, self.vehicle_pose[i], NO_VEHICLE, self.fleet)

    def with_movers(self, movers: Movers | None) -> Scene:
        """Return the scene with moving vehicles and pedestrians; everything else is shared.

        Args:
            movers: moving objects, or None. The k-th vehicle has the id `n_vehicles` + 1 + k; people have 0.

        Raises:
            SensorError: the fleet does not have a model.
        """
        if movers is self.movers:
            return self
        if movers is not None:
            self.fleet.require_models(movers.vehicle_model)
        scene = object.__new__(Scene)
        scene._set(self.vehicle_pose, self.vehicle_model, self.fleet, movers, self.lamps)
        scene.__dict__["still_instances"] = self.still_instances
        return scene

    def _check_place(self, i: int) -> None:
        if not 0 <= i < self.n_vehicles:
            raise SensorError(f"place is {i}, want 0 to {self.n_vehicles - 1}")

    def _changed(self, i: int, pose: ArrayLike, number: int, fleet: Fleet, lamps: int = 0) -> Scene:
        new_pose, new_model, lit = self.vehicle_pose.copy(), self.vehicle_model.copy(), self.lamps
        new_pose[i] = as_floats("pose", pose, 3)
        new_model[i] = number
        if lamps or lit is not None:
            lit = np.zeros(self.n_vehicles, np.uint8) if lit is None else lit.copy()
            lit[i] = lamps
        scene = object.__new__(Scene)
        scene._set(new_pose, new_model, fleet, self.movers, lit)
        if "scan_plane" in self.__dict__:
            scene.__dict__["scan_plane"] = self.scan_plane.with_footprint(i, scene.footprint(i))
        return scene


def _placed(outline: FloatArray, pose: FloatArray) -> FloatArray:
    c, s = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])
    x = c * outline[..., 0] - s * outline[..., 1] + pose[:, 0, None]
    return np.stack([x, s * outline[..., 0] + c * outline[..., 1] + pose[:, 1, None]], axis=-1)


def _padded(outlines: Sequence[FloatArray]) -> tuple[FloatArray, IntArray]:
    corners = np.zeros((len(outlines), FOOTPRINT_CORNERS, 2))
    for row, outline in zip(corners, outlines, strict=True):
        row[: len(outline)] = outline
    return corners, np.array([len(o) for o in outlines], dtype=np.int64)


def _joined(pool: MeshPool | None, meshes: Sequence[Mesh], scenery: int = 0) -> MeshPool:
    """Append meshes to a pool: first `scenery` meshes without a coarse version, then pairs of detailed and coarse."""
    start = 0 if pool is None else len(pool.radius)
    parts: list[Mesh | MeshPool] = [*([] if pool is None else [pool]), *meshes]
    if not parts:
        parts = [_NOTHING]
    vertex_start, triangle_start = (
        np.zeros(1, np.int64) if pool is None else getattr(pool, f"{name}_start")
        for name in ("vertex", "triangle")
    )
    vertices = np.array([len(m.vertices) for m in meshes], dtype=np.int64)
    triangles = np.array([len(m.triangles) for m in meshes], dtype=np.int64)
    radius = [float(np.sqrt((m.vertices.astype(np.float64) ** 2).sum(axis=1).max())) for m in meshes]
    coarse = np.arange(start, start + len(meshes), dtype=np.int32)
    coarse[scenery::2] += 1
    shared = ("vertices", "normals", "triangles", "material", "color")
    return MeshPool(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in shared},
        vertex_start=np.concatenate([vertex_start, vertex_start[-1] + np.cumsum(vertices)]),
        triangle_start=np.concatenate([triangle_start, triangle_start[-1] + np.cumsum(triangles)]),
        radius=np.concatenate([np.empty(0) if pool is None else pool.radius, radius]).astype(np.float32),
        coarse=coarse if pool is None or pool.coarse is None else np.concatenate([pool.coarse, coarse]),
    )


_NOTHING = Mesh(
    np.empty((0, 3), np.float32),
    np.empty((0, 3), np.float32),
    np.empty((0, 3), np.int32),
    np.empty(0, np.uint8),
    np.empty((0, 3), np.uint8),
)
