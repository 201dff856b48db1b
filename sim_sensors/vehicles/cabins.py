"""The glasshouse of a vehicle and its interior: pillars, panes, roof, seats, dashboard."""

from typing import NamedTuple

import numpy as np

from parkenv.compiled.arrays import FloatArray, IntArray
from sim_sensors.camera.surfaces import ShapeBuilder
from sim_sensors.vehicles.bodies import Finish, Skin
from sim_sensors.vehicles.forms import Form

CURL = (0.055, 0.050)  # m inwards and upwards by which the roof's edge curves above the panes
BASE = 0.012  # m by which the glasshouse extends below the shoulder
HEADER_BOW = 0.10  # m
BULGE = 0.018  # m, bulge of the panes
LEVELS = np.array([0.0, 0.06, 0.36, 0.70, 1.0])  # of the rows, from the shoulder to the top of the panes
COARSE_LEVELS = np.array([0.0, 1.0])

# By body: the last pillar's width at its foot and at its top, m.
_LAST_PILLAR = {
    "hatchback": (0.20, 0.20),
    "sedan": (0.34, 0.24),
    "estate": (0.10, 0.13),
    "suv": (0.14, 0.16),
    "van": (0.10, 0.12),
    "pickup": (0.13, 0.13),
}


class Post(NamedTuple):
    foot: float
    top: float
    ahead: Finish


def _posts(form: Form) -> list[Post]:
    foot, top = _LAST_PILLAR[form.body]
    pillar = form.pillar
    panes = form.side_windows
    glass = [Finish.GLASS if i < panes else Finish.BODY for i in range(3)]
    posts = []
    rear_foot, rear_top = form.glass_end + foot, form.roof_end + top
    quarter = form.rear_axle + 0.30 * form.arch_radius
    if panes == 3 and quarter - 0.04 > max(rear_foot, rear_top) + 0.12:
        posts.append(Post(rear_foot, rear_top, glass[2]))
        posts.append(Post(quarter - 0.025, quarter - 0.065, Finish.PILLAR))
        posts.append(Post(quarter + 0.025, quarter - 0.015, glass[1]))
    else:
        posts.append(Post(rear_foot, rear_top, glass[1]))
    posts.append(Post(pillar - 0.045, pillar - 0.075, Finish.PILLAR))
    posts.append(Post(pillar + 0.045, pillar + 0.005, glass[0]))
    posts.append(Post(form.cowl - 0.075, form.header - 0.085, Finish.BODY))
    return posts


class Glasshouse:
    """The left half of the glasshouse as a sheet of points, from the rear window to the windscreen.

    Attributes:
        points: (c, r, 3) m, from the shoulder to the roof's edge.
        finish: (c - 1, r - 1) int64, `Finish` of each cell.
        roof_crown: (c,) m, rise of the roof from each point of its edge to the middle.
        ridge: z of the roof's highest edge, m.
    """

    def __init__(self, skin: Skin) -> None:
        form = self.form = skin.form
        coarse = skin.coarse
        rear = np.array([0.0, 0.91] if coarse else [0.0, 0.45, 0.80, 0.91])
        front = np.array([0.93, 0.0] if coarse else [0.93, 0.80, 0.45, 0.0])
        posts = _posts(form)
        n_rear, n_front = len(rear), len(front)
        g = np.concatenate([rear, np.ones(len(posts) + 2), front])
        foot_x = np.concatenate(
            [
                form.glass_end - form.rear_bow * (1 - rear**2),
                [form.glass_end, *[p.foot for p in posts], form.cowl],
                form.cowl + form.screen_bow * (1 - front**2),
            ]
        )
        top_x = np.concatenate(
            [
                form.roof_end - 0.8 * form.rear_bow * (1 - rear**2),
                [form.roof_end, *[p.top for p in posts], form.header],
                form.header + HEADER_BOW * (1 - front**2),
            ]
        )
        foot = self._feet(skin, foot_x, g)
        edge, self.roof_crown = self._roof_edge(skin, top_x, g)
        self.ridge = form.height - form.crown
        facing = np.zeros((len(g), 2))
        facing[:n_rear, 0], facing[-n_front:, 0] = -1.0, 1.0
        facing[n_rear:-n_front, 1] = 1.0
        facing[[n_rear, -n_front - 1]] = [[-0.7, 0.7], [0.7, 0.7]]
        below = edge.copy()
        below[:, :2] += CURL[0] * facing
        below[:, 1] *= g > 0.0
        below[:, 2] -= CURL[1]
        level = (COARSE_LEVELS if coarse else LEVELS)[None, :, None]
        sheet = foot[:, None] + level * (below - foot)[:, None]
        sheet[..., :2] += BULGE * 4 * level * (1 - level) * facing[:, None]
        sheet[[0, -1], :, 1] = 0.0
        self.points = np.concatenate([sheet, edge[:, None]], axis=1)
        self.finish = self._finish(posts, n_rear, n_front)

    def _feet(self, skin: Skin, x: FloatArray, g: FloatArray) -> FloatArray:
        form, edge = self.form, skin.edge
        y = np.interp(np.clip(x, form.glass_end, form.cowl), edge[:, 0], edge[:, 1]) * g
        z = np.interp(x, edge[:, 0], edge[:, 2])
        crown = np.where(x > 0, 0.060, 0.025 if form.body != "pickup" else 0.0)
        return np.column_stack([x, y, z + crown * (1 - g**2) - BASE])

    def _roof_edge(self, skin: Skin, x: FloatArray, g: FloatArray) -> tuple[FloatArray, FloatArray]:
        form = self.form
        top = form.pillar - 0.035
        ahead = np.clip((x - top) / (form.header - top), 0.0, 1.2)
        behind = np.clip((top - x) / (top - form.roof_end), 0.0, 1.2)
        shoulder = float(np.interp(form.pillar, skin.edge[:, 0], skin.edge[:, 1]))
        half = shoulder - form.tumblehome - CURL[0]
        boxy = form.body in ("van", "pickup")
        y = (half - 0.045 * ahead**2 - (0.015 if boxy else 0.055) * behind**2) * g
        z = form.height - form.crown - form.roof_drop[0] * ahead**2 - form.roof_drop[1] * behind**2
        return np.column_stack([x, y, z + form.crown * (1 - g**2)]), form.crown * g**2

    def _finish(self, posts: list[Post], n_rear: int, n_front: int) -> IntArray:
        columns, rows = self.points.shape[0] - 1, self.points.shape[1] - 1
        out = np.full((columns, rows), int(Finish.BODY))
        panes = slice(1 if rows > 2 else 0, rows - 1)
        blind = self.form.body == "van" and self.form.side_windows == 1 and self.form.variety[2] < 0.5
        out[: n_rear - 1, panes] = Finish.BODY if blind else Finish.GLASS
        out[-n_front + 1 :, panes] = Finish.GLASS
        for i, post in enumerate(posts):
            out[n_rear + 1 + i, panes] = post.ahead
        if rows == 2:
            return out
        out[-n_front + 1 :, 0] = Finish.TRIM
        side = slice(n_rear, columns - n_front + 1)
        glazed = out[side, 1] != Finish.BODY
        out[side, 0] = np.where(
            glazed, Finish.BRIGHT if self.form.variety[4] > 0.7 else Finish.TRIM, Finish.BODY
        )
        return out

    def add_shell(self, build: ShapeBuilder, *, coarse: bool) -> None:
        build.both_sides(self.points, self.finish)
        edge = self.points[:, -1]
        across = np.array([1, 0, -1] if coarse else [1, 0.82, 0.45, 0, -0.45, -0.82, -1])
        build.chords(edge, across, self.roof_crown, Finish.BODY)
        lining = edge[[0, len(edge) // 2, -1]] if coarse else edge[3:-3]
        build.chords(
            lining - [0, 0, 0.02], [0.98, 0, -0.98], 0.5 * 0.03, Finish.HEADLINER, flip=True, smooth=False
        )


def add_cabin(build: ShapeBuilder, skin: Skin) -> None:
    form = skin.form
    rear, front = form.glass_end + 0.05, form.cowl - 0.11
    edge = skin.edge_between(rear, front)
    if skin.coarse:
        edge = edge[[0, len(edge) // 2, -1]]
    edge = np.vstack(
        [edge[:1], edge[:1] + np.array([0.02, 0, 0]), edge[1:-1], edge[-1:] - [0.02, 0, 0], edge[-1:]]
    )
    deep = np.ones(len(edge))
    deep[[0, -1]] = 0.0
    floor = form.sill + 0.16
    wall = edge - [0.0, 0.05, 0.02]
    foot = edge - [0.0, 0.11, 0.0]
    foot[:, 2] = np.where(deep > 0, floor, edge[:, 2] - 0.02)
    # The back of the dashboard leans towards the driver, above the bulkhead.
    half = np.stack([edge - [0, 0, 0.012], wall, foot], axis=1)
    sheet = np.concatenate([half, half[:, ::-1] * [1.0, -1.0, 1.0]], axis=1)
    build.grid(sheet, Finish.CABIN, flip=True, smooth=False)


def add_seats(build: ShapeBuilder, skin: Skin) -> None:
    form = skin.form
    top = form.height - 0.27
    across = 0.205 * form.width
    for side in (1.0, -1.0):
        _add_seat(build, (form.pillar - 0.10, side * across), top, 0.46, headrests=(0.0,))
    if form.side_windows > 1 or form.body != "van":
        rear = max(form.glass_end + 0.42, form.pillar - 0.98)
        if form.body in ("hatchback", "pickup"):
            rear = max(form.glass_end + 0.30, form.pillar - 0.88)
        _add_seat(build, (rear, 0.0), top - 0.05, form.width - 0.52, headrests=(0.42, -0.42))
    _add_steering_wheel(build, np.array([form.cowl - 0.36, across, form.belt + 0.01]))


def _add_seat(
    build: ShapeBuilder, place: tuple[float, float], top: float, width: float, headrests: tuple[float, ...]
) -> None:
    x, y = place
    cushion, back = top - 0.70, top - 0.16
    build.box(
        (x + 0.26, y, cushion - 0.09), (0.54, width, 0.18), Finish.SEAT, taper=(0.94, 0.92), faces="xXyYZ"
    )
    height = back - cushion + 0.06
    build.box(
        (x - 0.02, y, cushion - 0.06 + height / 2),
        (0.17, width, height),
        Finish.SEAT,
        taper=(0.62, 0.80),
        lean=-0.20,
        faces="xXyYZ",
    )
    for offset in headrests:
        build.box(
            (x - 0.215, y + offset, top - 0.075),
            (0.10, 0.27, 0.15),
            Finish.SEAT,
            taper=(0.7, 0.72),
            lean=-0.03,
        )


def _add_steering_wheel(build: ShapeBuilder, center: FloatArray) -> None:
    angle = np.linspace(0.0, 2 * np.pi, 11)
    ring = np.stack([0.42 * np.sin(angle), np.cos(angle), 0.91 * np.sin(angle)], axis=-1)
    build.grid(center + np.stack([0.185 * ring, 0.155 * ring], axis=1), Finish.TRIM, smooth=False)
    build.box(center + np.array([0.03, 0.0, -0.01]), (0.05, 0.30, 0.07), Finish.TRIM, faces="xZ")
