"""Meshes of scenery: buildings, walls, hedges, trees, pedestrians."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from parkenv.compiled.arrays import FloatArray
from sim_sensors.camera.surfaces import ShapeBuilder
from sim_sensors.errors import SensorError
from sim_sensors.mesh import Material, Mesh

TRUNK_M = 0.16  # radius of a tree's trunk at knee height, for a tree of 7 m

_STOREY = 3.0
_BAY = 2.7
_REVEAL = 0.14  # m, depth of the window in the wall
_STEP = 0.76  # m, length of a walking step


_Part = IntEnum(
    "_Part",
    "WALL PLINTH FRAME GLASS ROOM DOOR ROOF BARK LEAVES LEAVES_DARK STONE COPING SKIN HAIR COAT TROUSERS "
    "SHOES",
    start=0,
)
_MATERIAL = np.full(len(_Part), Material.STONE, dtype=np.uint8)
for _material, _parts in {
    Material.TRIM: (_Part.FRAME, _Part.DOOR),
    Material.GLASS: (_Part.GLASS,),
    Material.INTERIOR: (_Part.ROOM,),
    Material.BARK: (_Part.BARK,),
    Material.FOLIAGE: (_Part.LEAVES, _Part.LEAVES_DARK),
    Material.CLOTH: (_Part.SKIN, _Part.HAIR, _Part.COAT, _Part.TROUSERS, _Part.SHOES),
}.items():
    _MATERIAL[list(_parts)] = _material


def _made(build: ShapeBuilder, colors: dict[_Part, ArrayLike]) -> Mesh:
    palette = np.zeros((len(_Part), 3), dtype=np.uint8)
    for part, rgb in colors.items():
        palette[part] = np.clip(np.round(np.asarray(rgb, dtype=np.float64)), 0, 255)
    return build.build().dyed(_MATERIAL, palette)


def building_mesh(outline: ArrayLike, height: float, seed: int) -> Mesh:
    """Make a building with storeys of recessed windows, doors, a plinth and a cornice, in the frame of its outline.

    That is a simple polygon, (k, 2) m, counter-clockwise; the height is at least 2.4 m.
    """
    corner = np.asarray(outline, dtype=np.float64)
    rng = np.random.default_rng([seed, 11])
    build = ShapeBuilder()
    tones = np.array([[196, 186, 168], [172, 118, 92], [206, 204, 198], [150, 146, 140], [188, 164, 120]])
    wall = tones[rng.integers(len(tones))] + rng.uniform(-12, 12)
    for a, b in zip(corner, np.roll(corner, -1, axis=0), strict=True):
        _add_facade(build, a, b, height, rng)
    for i, j, k in _ears(corner):
        build.fan(np.column_stack([corner[[i, j, k]], np.full(3, height)]), _Part.ROOF)
    frame = (232, 231, 226) if rng.random() < 0.6 else (70, 72, 76)
    return _made(
        build,
        {
            _Part.WALL: wall,
            _Part.PLINTH: 0.62 * wall,
            _Part.FRAME: frame,
            _Part.GLASS: (30, 36, 38),
            _Part.ROOM: (58, 54, 50),
            _Part.DOOR: rng.uniform(30, 110, 3),
            _Part.ROOF: (92, 88, 86),
        },
    )


class _Facade(NamedTuple):
    start: FloatArray
    along: FloatArray

    def place(self, u: FloatArray, z: FloatArray, depth: FloatArray) -> FloatArray:
        out = np.array([self.along[1], -self.along[0]])
        base = self.start + u[..., None] * self.along + depth[..., None] * out
        return np.concatenate([base, z[..., None]], axis=-1)

    def add_slab(
        self, build: ShapeBuilder, box: tuple[float, float, float, float], depth: float, part: _Part
    ) -> None:
        """Add a flat panel; `box` is u, u, z, z. If it protrudes, add its upper and lower side."""
        u0, u1, z0, z1 = box
        u = np.array([u0, u1, u1, u0])
        build.fan(self.place(u, np.array([z0, z0, z1, z1]), np.full(4, depth)), part)
        if depth > 0.0:
            out = np.array([depth, depth, 0.0, 0.0])
            build.fan(self.place(u, np.full(4, z1), out), part)
            build.fan(self.place(u, np.full(4, z0), out), part, flip=True)


def _add_facade(
    build: ShapeBuilder, start: FloatArray, end: FloatArray, height: float, rng: np.random.Generator
) -> None:
    length = float(np.hypot(*(end - start)))
    facade = _Facade(start, (end - start) / length)
    bays, storeys = int((length - 0.8) / _BAY), max(1, round((height - 0.5) / _STOREY))
    tall, pitch = (height - 0.5) / storeys, length / max(bays, 1)
    centers = (np.arange(bays) + 0.5) * pitch
    wide, low, high = 0.27 * pitch, 0.32 * tall, 0.84 * tall
    sills = np.arange(storeys) * tall + 0.3
    # Every window edge appears twice: on the wall and at the bottom of the reveal.
    sides = np.repeat(np.sort(np.concatenate([centers - wide, centers + wide])), 2)
    levels = np.repeat(np.sort(np.concatenate([sills + low, sills + high])), 2)
    u, u_deep = np.array([0.0, *sides, length]), np.zeros(len(sides) + 2, dtype=bool)
    z, z_deep = np.array([0.0, 0.3, *levels, height]), np.zeros(len(levels) + 3, dtype=bool)
    u_deep[1:-1] = np.tile([False, True, True, False], bays)
    z_deep[2:-1] = np.tile([False, True, True, False], storeys)
    deep = u_deep[:, None] & z_deep[None, :]
    finish = np.full((len(u) - 1, len(z) - 1), int(_Part.WALL))
    finish[:, 0] = _Part.PLINTH
    finish[deep[:-1, :-1] & deep[1:, 1:]] = _Part.ROOM
    across, up = np.meshgrid(u, z, indexing="ij")
    build.grid(facade.place(across, up, np.where(deep, -_REVEAL, 0.0)), finish, smooth=False)
    doors = set(rng.choice(bays, size=max(1, bays // 7), replace=False).tolist()) if bays else set()
    for bay, center in enumerate(centers.tolist()):
        for storey, sill in enumerate(sills.tolist()):
            if storey == 0 and bay in doors:
                facade.add_slab(build, (center - 0.55, center + 0.55, 0.0, 2.15), 0.02, _Part.DOOR)
            else:
                _add_window(build, facade, (center - wide, center + wide, sill + low, sill + high))
    facade.add_slab(build, (-0.12, length + 0.12, height - 0.28, height), 0.14, _Part.PLINTH)


def _add_window(build: ShapeBuilder, facade: _Facade, box: tuple[float, float, float, float]) -> None:
    left, right, low, high = box
    middle = 0.5 * (left + right)
    facade.add_slab(build, box, -0.6 * _REVEAL, _Part.GLASS)
    facade.add_slab(build, (middle - 0.03, middle + 0.03, low, high), -0.5 * _REVEAL, _Part.FRAME)
    facade.add_slab(build, (left - 0.06, right + 0.06, low - 0.07, low), 0.05, _Part.FRAME)


def _ears(corner: FloatArray) -> list[tuple[int, int, int]]:
    left = list(range(len(corner)))
    triangles = []
    while len(left) > 3:
        for at in range(len(left)):
            i, j, k = left[at - 1], left[at], left[(at + 1) % len(left)]
            if _turn(corner[i], corner[j], corner[k]) <= 0:
                continue
            others = [m for m in left if m not in (i, j, k)]
            if not any(_within(corner[m], corner[i], corner[j], corner[k]) for m in others):
                triangles.append((i, j, k))
                left.pop(at)
                break
        else:
            raise SensorError(f"outline is {corner.tolist()}, want a simple polygon")
    return [*triangles, (left[0], left[1], left[2])]


def _turn(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
    return float((b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]))


def _within(p: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray) -> bool:
    return _turn(a, b, p) >= 0 and _turn(b, c, p) >= 0 and _turn(c, a, p) >= 0


def wall_mesh(start: ArrayLike, end: ArrayLike, height: float, thickness: float, seed: int) -> Mesh:
    """Make a free-standing wall with a coping; its centre line runs from start to end, (2,) m each."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    tone = np.array([150.0, 142.0, 130.0]) + np.random.default_rng([seed, 12]).uniform(-20, 20)
    build = ShapeBuilder()
    _add_bar(build, a, b, (0.0, height - 0.07), thickness, _Part.STONE)
    _add_bar(build, a, b, (height - 0.07, height), thickness + 0.08, _Part.COPING)
    return _made(build, {_Part.STONE: tone, _Part.COPING: 1.12 * tone})


def _add_bar(
    build: ShapeBuilder, a: FloatArray, b: FloatArray, levels: tuple[float, float], width: float, part: _Part
) -> None:
    along = (b - a) / np.hypot(*(b - a))
    side = 0.5 * width * np.array([-along[1], along[0]])
    ring = np.array([a - side, b - side, b + side, a + side])
    low, high = (np.column_stack([ring, np.full(4, z)]) for z in levels)
    after = [1, 2, 3, 0]
    build.quads(np.stack([low, low[after], high[after], high], axis=1), part)
    build.quads(np.stack([high, low[::-1]]) if levels[0] > 0 else high[None], part)


def hedge_mesh(start: ArrayLike, end: ArrayLike, height: float, thickness: float, seed: int) -> Mesh:
    """Make a clipped hedge, uneven by up to a tenth; its centre line runs from start to end, (2,) m each."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    rng, length = np.random.default_rng([seed, 15]), float(np.hypot(*(b - a)))
    across = 0.5 * thickness * np.array([-0.9, -1.0, -0.95, -0.7, 0.7, 0.95, 1.0, 0.9])
    up = height * np.array([0.0, 0.45, 0.9, 1.0, 1.0, 0.9, 0.45, 0.0])
    u = np.concatenate([[0.0], np.linspace(0.0, length, 2 + int(length / 0.4)), [length]])
    rough = rng.uniform(-0.1, 0.1, (2, len(u), len(up))) * min(height, thickness)
    rough[:, [0, 1, -2, -1]] = 0.0
    y, z = across + rough[0], np.where(up > 0.0, up + rough[1], 0.0)
    y[[0, -1]], z[[0, -1]] = 0.0, 0.5 * height  # both ends are closed
    along = (b - a) / length
    flat = a + u[:, None, None] * along + y[..., None] * np.array([-along[1], along[0]])
    build = ShapeBuilder()
    dark = np.where(rng.random((len(u) - 1, len(up) - 1)) < 0.4, _Part.LEAVES_DARK, _Part.LEAVES)
    build.grid(np.concatenate([flat, z[..., None]], axis=-1), dark)
    green = np.array([62.0, 80.0, 44.0]) + rng.uniform(-16, 16, 3)
    return _made(build, {_Part.LEAVES: green, _Part.LEAVES_DARK: 0.8 * green})


def tree_mesh(height: float, seed: int) -> Mesh:
    rng = np.random.default_rng([seed, 13])
    build = ShapeBuilder()
    scale = height / 7.0
    bole = 0.36 * height
    lean = rng.uniform(-0.12, 0.12, 2)
    profile = np.array([[1.6, 0.0], [1.15, 0.15], [1.0, 0.5], [0.8, bole], [0.35, 0.72 * height]])
    profile[:, 0] *= TRUNK_M * scale
    build.turned(profile, _Part.BARK, 8)
    for _ in range(int(rng.integers(11, 15))):
        angle, out = rng.uniform(0, 2 * np.pi), rng.uniform(0.02, 0.23) * height
        z = rng.uniform(0.50, 0.82) * height
        center = np.array([out * np.cos(angle), out * np.sin(angle), z])
        center[:2] += lean * z
        radius = rng.uniform(0.11, 0.155) * height * (1.25 - 0.6 * abs(z / height - 0.62))
        part = _Part.LEAVES if rng.random() < 0.6 else _Part.LEAVES_DARK
        _add_ball(build, center, radius * np.array([1.0, 1.0, 0.85]), part, rng, 0.24)
    green = np.array([74.0, 88.0, 50.0]) + rng.uniform(-16, 16, 3)
    return _made(build, {_Part.BARK: (84, 70, 56), _Part.LEAVES: green, _Part.LEAVES_DARK: 0.72 * green})


def _add_ball(
    build: ShapeBuilder,
    center: FloatArray,
    radius: FloatArray,
    part: _Part,
    rng: np.random.Generator | None = None,
    rough: float = 0.0,
) -> None:
    across, up = np.linspace(0, 2 * np.pi, 9), np.linspace(-np.pi / 2, np.pi / 2, 6)
    reach = np.ones((9, 6))
    if rng is not None:
        reach += rough * rng.uniform(-1, 1, (9, 6))
        reach[:, [0, -1]] = 1.0
    reach[-1] = reach[0]
    unit = np.stack(
        [
            np.cos(across)[:, None] * np.cos(up),
            np.sin(across)[:, None] * np.cos(up),
            np.broadcast_to(np.sin(up), (9, 6)),
        ],
        axis=-1,
    )
    unit[-1] = unit[0]
    build.grid(center + unit * reach[..., None] * radius, part)


GAITS = 8  # number of phases of a stride for which meshes are shared


def pedestrian_mesh(phase: float, seed: int) -> Mesh:
    """Make a walking pedestrian at the origin, facing along x; the step is widest at phases, in turns, of 0 and 0.5."""
    rng = np.random.default_rng([seed, 14])
    scale = rng.uniform(1.58, 1.88) / 1.75
    build = ShapeBuilder()
    swing = np.cos(2 * np.pi * phase)
    hip, shoulder = 0.92, 1.44
    for side in (1.0, -1.0):
        foot = np.array([0.5 * _STEP * swing * side, 0.10 * side, 0.06 + 0.03 * (1 - abs(swing))])
        knee = np.array([0.5 * foot[0] + 0.09, 0.10 * side, 0.50])
        _add_limb(build, np.array([0.0, 0.09 * side, hip]), knee, (0.085, 0.065), _Part.TROUSERS)
        _add_limb(build, knee, foot, (0.065, 0.045), _Part.TROUSERS)
        build.box(foot + np.array([0.06, 0.0, -0.02]), (0.27, 0.09, 0.08), _Part.SHOES, taper=(0.8, 0.9))
        elbow = np.array([-0.16 * swing * side - 0.03, 0.25 * side, 1.14])
        hand = np.array([-0.30 * swing * side + 0.10, 0.25 * side, 0.90])
        _add_limb(build, np.array([0.0, 0.20 * side, shoulder]), elbow, (0.06, 0.05), _Part.COAT)
        _add_limb(build, elbow, hand, (0.05, 0.04), _Part.COAT)
        _add_ball(build, hand, np.array([0.05, 0.035, 0.055]), _Part.SKIN)
    section = [
        (0.10, 0.145, 0.86),
        (0.115, 0.165, 1.00),
        (0.12, 0.19, 1.28),
        (0.10, 0.20, 1.42),
        (0.055, 0.06, 1.50),
    ]
    turn = np.linspace(0, 2 * np.pi, 11)
    turn[-1] = 0.0
    torso = [
        [[rx * np.cos(t), ry * np.sin(t), z] for rx, ry, z in [(0.0, 0.0, 0.86), *section]] for t in turn
    ]
    build.grid(torso, _Part.COAT)
    _add_limb(build, np.array([0.0, 0.0, 1.46]), np.array([0.02, 0.0, 1.58]), (0.055, 0.05), _Part.SKIN)
    _add_ball(build, np.array([0.02, 0.0, 1.64]), np.array([0.098, 0.078, 0.118]), _Part.SKIN)
    _add_ball(build, np.array([0.0, 0.0, 1.67]), np.array([0.10, 0.084, 0.105]), _Part.HAIR)
    coat, trousers = rng.uniform(20, 190, 3), rng.uniform(20, 90) + rng.uniform(0, 20, 3)
    skin = np.array([206.0, 160.0, 132.0]) * rng.uniform(0.5, 1.05)
    mesh = _made(
        build,
        {
            _Part.SKIN: skin,
            _Part.HAIR: rng.uniform(20, 120) * np.array([1.0, 0.85, 0.7]),
            _Part.COAT: coat,
            _Part.TROUSERS: trousers,
            _Part.SHOES: (34, 32, 30),
        },
    )
    return Mesh((mesh.vertices * np.float32(scale)), mesh.normals, mesh.triangles, mesh.material, mesh.color)


def _add_limb(
    build: ShapeBuilder, a: FloatArray, b: FloatArray, radius: tuple[float, float], part: _Part
) -> None:
    axis = (b - a) / np.linalg.norm(b - a)
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    turn = np.linspace(0, 2 * np.pi, 8)[:, None, None]
    ring = np.cos(turn) * side + np.sin(turn) * other
    ring[-1] = ring[0]
    points = np.concatenate([a + 0 * ring, a + radius[0] * ring, b + radius[1] * ring, b + 0 * ring], axis=1)
    build.grid(points, part)


def pedestrian_footprint(phase: float) -> FloatArray:
    """Return the hull of both legs at knee height, (6, 2) float64, m, pedestrian's frame, counter-clockwise."""
    stride = abs(np.cos(2 * np.pi * phase))
    front, back = 0.19 + 0.19 * stride, -0.02 - 0.18 * stride  # a knee is bent forward
    middle = 0.5 * (front + back)
    return np.array(
        [[front, -0.15], [front, 0.15], [middle, 0.18], [back, 0.15], [back, -0.15], [middle, -0.18]]
    )


def round_footprint(radius: float) -> FloatArray:
    turn = np.arange(8) * np.pi / 4
    corner = radius * np.sqrt(np.pi / (2 * np.sqrt(2)))
    return np.asarray(corner * np.column_stack([np.cos(turn), np.sin(turn)]))
