"""Attached parts of a vehicle: wheels, lamp reflectors, number plates, mirrors, handles, rails, cladding."""

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from sim_sensors.camera.surfaces import Shape, ShapeBuilder
from sim_sensors.vehicles.bodies import LAMP_INNER, ROUND, ROWS, Finish, Skin
from sim_sensors.vehicles.cabins import Glasshouse
from sim_sensors.vehicles.forms import Form

PLATE_M = (0.52, 0.11)
TO_LEFT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
TO_RIGHT = TO_LEFT * np.array([[1.0], [-1.0], [1.0]])

# Strokes of a character as on a seven-segment display: x0, z0, x1, z1 in the unit square.
_STROKES = np.array(
    [
        [0.0, 0.84, 1.0, 1.0],
        [0.76, 0.5, 1.0, 0.92],
        [0.76, 0.08, 1.0, 0.5],
        [0.0, 0.0, 1.0, 0.16],
        [0.0, 0.08, 0.24, 0.5],
        [0.0, 0.5, 0.24, 0.92],
        [0.0, 0.42, 1.0, 0.58],
    ]
)
_GLYPHS = (
    "012345",
    "12",
    "01346",
    "01236",
    "1256",
    "02356",
    "023456",
    "012",
    "012456",
    "345",
    "0456",
    "124560",
)


def wheel_shape(form: Form, *, coarse: bool) -> Shape:
    build = ShapeBuilder()
    radius, width = form.wheel_radius, 0.185 + 0.12 * (form.wheel_radius - 0.28)
    rim = radius * (0.64 + 0.10 * form.variety[6])
    if coarse:
        profile = [[radius, -width], [radius, 0.0], [rim, 0.0], [0.0, -0.02]]
        build.turned(profile, [Finish.TYRE, Finish.TYRE, Finish.RIM], 7)
        return build.build()
    profile = [
        [0.0, -width],
        [radius, -width],
        [radius, -0.034],
        [radius - 0.024, -0.006],
        [rim + 0.006, -0.002],
        [rim - 0.016, -0.010],
        [0.0, -0.075],
    ]
    tyre = Finish.TYRE
    build.turned(profile, [tyre, tyre, tyre, tyre, Finish.RIM, Finish.RIM_DARK], 14)
    _add_spokes(build, form, rim)
    return build.build()


def _add_spokes(build: ShapeBuilder, form: Form, rim: float) -> None:
    count = (5, 5, 6, 7, 9, 10)[int(form.variety[0] * 5.999)]
    broad = (1.0 - 0.04 * count) * 0.30 * rim
    angle = 2 * np.pi * np.arange(count) / count + np.pi / 2
    zero = np.zeros(count)
    along = np.column_stack([np.cos(angle), np.sin(angle), zero])
    wide = 0.5 * broad * np.column_stack([-np.sin(angle), np.cos(angle), zero])
    hub, end = 0.045 * along - [0, 0, 0.012], (rim - 0.012) * along - [0, 0, 0.016]
    top = np.stack([hub - 0.7 * wide, end - wide, end + wide, hub + 0.7 * wide], axis=1)
    build.quads(top, Finish.RIM)
    if count <= 7:
        low = top - [0, 0, 0.045]
        build.quads(np.stack([top[:, 1], top[:, 0], low[:, 0], low[:, 1]], axis=1), Finish.RIM)
        build.quads(np.stack([top[:, 3], top[:, 2], low[:, 2], low[:, 3]], axis=1), Finish.RIM)
    hub_angle = np.linspace(0.0, 2 * np.pi, 9)[:-1]
    disc = np.column_stack([0.078 * np.cos(hub_angle), 0.078 * np.sin(hub_angle), np.full(8, -0.009)])
    build.fan(disc, Finish.RIM)


def add_wheels(build: ShapeBuilder, form: Form, *, coarse: bool) -> None:
    wheel = wheel_shape(form, coarse=coarse)
    out = form.width / 2 - 0.030
    for x in (form.rear_axle, form.front_axle):
        narrower = 0.02 if form.body not in ("van", "pickup") else 0.035
        for turn, y in ((TO_LEFT, out - narrower), (TO_RIGHT, narrower - out)):
            build.put(wheel, offset=(x, y, form.wheel_radius), turn=turn)


def plate_places(skin: Skin) -> list[tuple[FloatArray, float]]:
    """Return the place of each plate: the middle of its outer face, (3,) m, and 1 for front or -1 for rear."""
    low = skin.form.variety[7] < 0.35 or skin.form.body == "pickup"
    places = []
    for column, facing, row in ((-1, 1.0, 0.33), (0, -1.0, 0.31 if low else 0.475)):
        section = skin.flank[column]
        x, z = np.interp(row, ROWS, section[:, 0]), np.interp(row, ROWS, section[:, 2])
        places.append((np.array([x + 0.003 * facing, 0.0, z]), facing))
    return places


def add_plates(build: ShapeBuilder, skin: Skin, text: NDArray[np.int64]) -> None:
    for at, facing in plate_places(skin):
        _add_plate(build, at, facing, text)


def _add_plate(build: ShapeBuilder, at: FloatArray, facing: float, text: NDArray[np.int64]) -> None:
    width, height = PLATE_M
    build.box(at - [0.02 * facing, 0, 0], (0.04, width, height), Finish.PLATE)

    def patches(rectangles: FloatArray) -> FloatArray:
        """Return quads of rectangles x0, z0, x1, z1 on the plate, with x in reading direction."""
        x0, z0, x1, z1 = rectangles.T
        depth = np.full_like(x0, at[0] + 0.0015 * facing)
        y0, y1 = facing * x0, facing * x1
        rows = [(depth, y, at[2] + z) for y, z in ((y0, z0), (y1, z0), (y1, z1), (y0, z1))]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)

    band = np.array([[-width / 2, -height / 2, -width / 2 + 0.042, height / 2]])
    build.quads(patches(band), Finish.PLATE_BAND)
    pitch = (width - 0.075) / len(text)
    strokes = []
    for i, glyph in enumerate(text):
        left = -width / 2 + 0.058 + i * pitch
        chosen = _STROKES[[int(c) for c in _GLYPHS[int(glyph)]]]
        strokes.append(chosen * [0.042, 0.076, 0.042, 0.076] + np.array([left, -0.038, left, -0.038]))
    build.quads(patches(np.concatenate(strokes)), Finish.PLATE_INK)


def add_reflectors(build: ShapeBuilder, skin: Skin) -> None:
    first = len(skin.flank) - len(ROUND)
    lamp = np.flatnonzero(np.isclose(skin.plan_angle, LAMP_INNER))[-1]
    high = int(np.searchsorted(ROWS, 0.82))
    for column, size in ((lamp - 1, 0.36), (lamp - 2, 0.42)):
        if column <= first:
            continue
        corners = skin.flank[column : column + 2, high - 1 : high + 1]
        center = corners.reshape(-1, 3).mean(axis=0)
        along = corners[1].mean(axis=0) - corners[0].mean(axis=0)
        up = corners[:, 1].mean(axis=0) - corners[:, 0].mean(axis=0)
        normal = np.cross(up, along)
        normal /= np.linalg.norm(normal)
        radius = size * float(np.linalg.norm(up))
        u = along / np.linalg.norm(along)
        v = np.cross(normal, u)
        turn = np.linspace(0.0, 2 * np.pi, 9)[:-1, None]
        disc = center + 0.006 * normal + radius * (np.cos(turn) * u + np.sin(turn) * v)
        build.fan(disc, Finish.REFLECTOR)
        build.fan(disc * [1.0, -1.0, 1.0], Finish.REFLECTOR, flip=True)


def add_slats(build: ShapeBuilder, skin: Skin) -> None:
    column = int(np.flatnonzero(np.isclose(skin.plan_angle, LAMP_INNER))[-1])
    for share in (0.62, 0.75):
        row = int(np.searchsorted(ROWS, share))
        part = (share + np.array([[-0.016], [0.016]]) - ROWS[row - 1]) / (ROWS[row] - ROWS[row - 1])
        low, high = skin.flank[column:, None, row - 1], skin.flank[column:, None, row]
        build.both_sides(low + part * (high - low) + np.array([0.006, 0.0, 0.0]), Finish.BRIGHT)


def add_mirrors(build: ShapeBuilder, skin: Skin) -> None:
    form = skin.form
    x = form.cowl - 0.20
    foot = np.array([np.interp(x, skin.edge[:, 0], skin.edge[:, k]) for k in range(3)])
    tall = 0.135 if form.body not in ("van", "pickup") else 0.19
    turn = np.linspace(0.0, 2 * np.pi, 9)
    turn[-1] = 0.0
    outline = np.stack([np.sign(unit) * np.abs(unit) ** 0.7 for unit in (np.cos(turn), np.sin(turn))], -1)
    rings = []
    for depth, scale in ((0.0, 0.96), (0.07, 1.0), (0.12, 0.72), (0.135, 0.0)):
        y = 0.095 * scale * outline[:, 0]
        z = 0.5 * tall * scale * outline[:, 1]
        rings.append(np.column_stack([np.full(9, depth) - 0.15 * np.maximum(y, 0.0), y, z]))
    center = foot + np.array([0.0, 0.115, 0.5 * tall + 0.03])
    housing = np.stack(rings, axis=1) + center
    glass = housing[:-1, 0] - [0.002, 0.0, 0.0]
    arm = foot + np.array([0.05, 0.01, 0.035])
    for side in (1.0, -1.0):
        mirrored = [1.0, side, 1.0]
        build.grid(housing * mirrored, Finish.MIRROR, flip=side < 0)
        build.fan(glass * mirrored, Finish.BRIGHT, flip=side > 0)
        build.box(arm * mirrored, (0.07, 0.16, 0.04), Finish.TRIM, faces="xXzZ")


def add_handles(build: ShapeBuilder, skin: Skin) -> None:
    for seam in skin.seams[1:]:
        x = seam + 0.15
        column = int(np.argmin(np.abs(skin.edge[:, 0] - x)))
        y = float(np.interp(0.80, ROWS, skin.flank[column, :, 1]))
        z = float(np.interp(0.80, ROWS, skin.flank[column, :, 2]))
        for side in (1.0, -1.0):
            build.box(
                (x, side * (y + 0.012), z),
                (0.19, 0.03, 0.028),
                Finish.HANDLE,
                faces="xXyYzZ".replace("y" if side > 0 else "Y", ""),
            )


def add_rails(build: ShapeBuilder, house: Glasshouse) -> None:
    edge = house.points[:, -1]
    form = house.form
    front, rear = form.header - 0.18, form.roof_end + 0.16
    x = np.linspace(rear, front, 4)
    side = edge[np.diff(edge[:, 0], append=edge[-1, 0] + 1) > 1e-6]
    y = np.interp(x, side[:, 0], side[:, 1]) * 0.90
    z = np.interp(x, side[:, 0], side[:, 2]) + 0.2 * form.crown + np.array([-0.005, 0.03, 0.03, -0.005])
    section = np.array([[0.018, -0.02], [0.016, 0.012], [-0.016, 0.012], [-0.018, -0.02]])
    points = np.stack([np.column_stack([x, y + dy, z + dz]) for dy, dz in section], axis=1)
    build.both_sides(points, Finish.RAIL, smooth=False)


def add_cladding(build: ShapeBuilder, skin: Skin) -> None:
    form = skin.form
    lower = skin.flank[:, 0]
    for axle in (form.rear_axle, form.front_axle):
        arch = lower[np.abs(lower[:, 0] - axle) <= form.arch_radius + 1e-6]
        hub = np.array([axle, 0.0, form.wheel_radius])
        radial = (arch - hub) * [1.0, 0.0, 1.0]
        wide = arch + 0.055 / form.arch_radius * radial
        lines = ((arch, -0.02), (arch, 0.010), (wide, 0.008), (wide, -0.02))
        lip = np.stack([line + np.array([0, out, 0]) for line, out in lines], axis=1)
        build.both_sides(lip, Finish.CLADDING)
