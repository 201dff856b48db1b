"""The shell of a vehicle: flanks lofted around the plan, bonnet, tail, wheel arches and underside.

A flank is one sheet from the middle of the tail, around the corner and along the side, to the middle of the nose. Its
columns follow the plan of the body (a superellipse at either end), its rows the section from sill to shoulder. Lamps,
grille, seams and trim are cells of that sheet, so they have its curvature. The glasshouse is a second such sheet
between the shoulder and the roof's edge. Left and right are mirror images.
"""

from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from parkenv.compiled.arrays import FloatArray, IntArray
from sim_sensors.camera.surfaces import ShapeBuilder
from sim_sensors.vehicles.forms import Form

# Surface types of a vehicle's triangles. Bumpers are painted, or plastic on basic versions; so is the cladding along
# sills and arches on rugged ones. Bright is chrome, or black.
Finish = IntEnum(
    "Finish",
    "BODY BODY_DUSTY BODY_DIRTY SEAM GLASS TRIM BUMPER CLADDING GRILLE BRIGHT HEADLAMP REFLECTOR INDICATOR TAIL_LAMP "
    "TAIL_LAMP_DARK REVERSING_LAMP PLATE PLATE_INK PLATE_BAND TYRE RIM RIM_DARK SEAT CABIN HEADLINER UNDERSIDE MIRROR "
    "HANDLE RAIL PILLAR",
    start=0,
)
N_FINISHES = len(Finish)

# Sections: height between sill (0) and shoulder (1), and the distance (m) of the surface inside the plan.
ROWS = np.array([0.0, 0.09, 0.24, 0.40, 0.55, 0.68, 0.82, 0.93, 1.0])
COARSE_ROWS = np.array([0.0, 0.40, 0.88, 1.0])
_SIDE = np.array([0.060, 0.022, 0.006, 0.016, 0.020, 0.004, 0.012, 0.034, 0.080])
_NOSE = np.array([0.110, 0.030, 0.004, 0.000, 0.022, 0.040, 0.070, 0.125, 0.230])
_TAIL = np.array([0.140, 0.035, 0.000, 0.002, 0.030, 0.036, 0.044, 0.062, 0.105])

# Plan angle, degrees from the car's axis, of the columns around either end: grille or tailgate edge, lamp, corner.
ROUND = np.array([0.0, 11.0, 24.0, 37.0, 48.0, 58.0, 69.0, 80.0, 90.0])
COARSE_ROUND = np.array([0.0, 37.0, 69.0, 90.0])
GRILLE_EDGE, LAMP_INNER, LAMP_OUTER = 24.0, 37.0, 80.0

UPRIGHT = ("suv", "van", "pickup")  # bodies with a more upright nose
GAP = 0.014  # m, width of a seam
FLARE = 0.022  # m by which the arches protrude from the doors
_LIP = 0.15  # m above or below a height within which an arch's edge belongs to its section
_CUT = 0.012  # m over which an arch's edge drops to the sill


class Skin:
    """The surfaces of a vehicle's shell as points: the left half, from the middle of the tail to that of the nose.

    `rows`, (r,), are heights between sill and shoulder, `flank` is (c, r, 3) m, clamped to the wheel arches,
    `plan_angle`, (c,) in degrees from the axis: positive around the nose, negative around the tail, ±90 along the side,
    and `seams` are x of the middle of each door seam, front first. A coarse skin has few columns and rows, and no
    seams.
    """

    def __init__(self, form: Form, *, coarse: bool = False) -> None:
        self.form = form
        self.coarse = coarse
        self.rows = COARSE_ROWS if coarse else ROWS
        self._shoulder = _shoulder_line(form)
        self.seams = _seams(form)
        self.flank, self.plan_angle = self._loft()

    def _columns(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        form = self.form
        half = form.length / 2
        tail, nose = -half + form.tail_depth, half - form.nose_depth
        around = COARSE_ROUND if self.coarse else ROUND
        theta = np.radians(around)
        side = self._side_columns(tail, nose)
        ends = []
        for depth, power, start in (
            (-form.tail_depth, form.tail_power, tail),
            (form.nose_depth, form.nose_power, nose),
        ):
            x = start + depth * np.cos(theta).clip(0.0) ** (2 / power)
            y = self._half_width(np.array([start]))[0] * np.sin(theta) ** (2 / power)
            ends.append((x, y))
        (tail_x, tail_y), (nose_x, nose_y) = ends
        x = np.concatenate([tail_x, side, nose_x[::-1]])
        y = np.concatenate([tail_y, self._half_width(side), nose_y[::-1]])
        angle = np.concatenate([around - 180.0, np.full(len(side), 90.0), around[::-1]])
        return x, y, np.where(angle < 0, -(angle + 180.0) - 1e-9, angle)

    def _side_columns(self, tail: float, nose: float) -> FloatArray:
        form = self.form
        reach = form.arch_radius
        sweep = np.radians([180, 120, 60, 0] if self.coarse else [180, 158, 130, 104, 76, 50, 22, 0])
        arch = reach * np.cos(sweep)
        if not self.coarse:
            arch = np.concatenate([[-reach - _CUT], arch, [reach + _CUT]])
        x = [form.rear_axle + arch, form.front_axle + arch]
        if self.coarse:
            x.append(np.array([form.pillar]))
        else:
            x += [np.array([seam - GAP / 2, seam + GAP / 2]) for seam in self.seams]
            x.append(np.array([0.5 * (form.pillar + form.front_axle)]))
        merged = np.unique(np.concatenate(x))
        return merged[(merged > tail + 0.01) & (merged < nose - 0.01)]

    def _half_width(self, x: FloatArray) -> FloatArray:
        form = self.form
        ahead = np.clip(x / form.length * 2, 0.0, 1.0)
        behind = np.clip(-x / form.length * 2, 0.0, 1.0)
        boxy = 0.4 if form.body in ("van", "pickup") else 1.0
        return form.width / 2 * (1.0 - boxy * (0.045 * ahead**2 + 0.060 * behind**2))

    def _loft(self) -> tuple[FloatArray, FloatArray]:
        form = self.form
        x, y, angle = self._columns()
        # Weight of the nose's or tail's section in a column, by the direction that the plan faces there.
        end = np.cos(np.radians(np.abs(angle))) ** 2
        side_inset = np.interp(self.rows, ROWS, _SIDE)
        end_inset = np.where(
            (angle < 0)[:, None], np.interp(self.rows, ROWS, _TAIL), np.interp(self.rows, ROWS, _NOSE)
        )
        # A nose that leans back by more than its depth would have a hollow front edge.
        depth = np.where(angle < 0, form.tail_depth, form.nose_depth)
        leaning = np.where(angle < 0, _TAIL.max(), _NOSE.max() * (0.75 if form.body in UPRIGHT else 1.0))
        end_inset *= (np.minimum(leaning, 0.45 * depth) / np.where(angle < 0, _TAIL.max(), _NOSE.max()))[
            :, None
        ]
        near = np.exp(
            -(
                (
                    np.minimum(np.abs(x - form.rear_axle), np.abs(x - form.front_axle))
                    / (1.25 * form.arch_radius)
                )
                ** 4
            )
        )
        inset = end[:, None] * end_inset + (1.0 - end[:, None]) * (side_inset + FLARE * (1.0 - near[:, None]))
        facing = np.where(angle < 0, 1.0, -1.0) * np.cos(np.radians(np.abs(angle)))
        inward_y = -np.sin(np.radians(np.abs(angle)))
        points = np.empty((len(x), len(self.rows), 3))
        points[..., 0] = x[:, None] + facing[:, None] * inset
        points[..., 1] = np.maximum(y[:, None] + inward_y[:, None] * inset, 0.0)
        points[[0, -1], :, 1] = 0.0
        # The lamps' lower edge sweeps up towards the corner.
        swept = np.clip((np.abs(angle) - GRILLE_EDGE) / (LAMP_OUTER - GRILLE_EDGE), 0.0, 1.0) * (end > 1e-6)
        swept *= np.where(angle > 0, 1.0, 0.45)
        bulge = np.clip(1.0 - np.abs(self.rows - 0.60) / 0.34, 0.0, 1.0)
        rows = self.rows + 0.16 * swept[:, None] * bulge
        rise = 0.05 * np.where(angle > 0, end, 0.0) + 0.09 * np.where(angle < 0, end, 0.0)
        low = form.sill + rise
        shoulder = self._shoulder(np.clip(points[:, -1, 0], -form.length / 2, form.length / 2))
        points[..., 2] = low[:, None] + rows * (shoulder - low)[:, None]
        points[..., 1] *= form.width / 2 / points[..., 1].max()
        self._uncut = points.copy()
        for axle in (form.rear_axle, form.front_axle):
            away = np.abs(points[..., 0] - axle)
            rim = form.wheel_radius + np.sqrt(np.maximum(form.arch_radius**2 - away**2, 0.0))
            inside = (away <= form.arch_radius + 1e-6) & (np.abs(np.abs(angle) - 90.0) < 1e-6)[:, None]
            points[..., 2] = np.where(inside, np.maximum(points[..., 2], rim), points[..., 2])
        return points, angle

    @cached_property
    def edge(self) -> FloatArray:
        return self.flank[:, -1]

    def edge_between(self, low: float, high: float) -> FloatArray:
        edge = self.edge
        inner = edge[(edge[:, 0] > low + 0.01) & (edge[:, 0] < high - 0.01)]
        along = abs(inner[:, 1]) > 0.8 * edge[:, 1].max()
        # Straight stretches need few points: one per 0.2 m.
        inner = inner[~along | (np.diff(np.floor(inner[:, 0] / 0.2), prepend=-1e9) > 0)]
        x = np.concatenate([[max(low, edge[0, 0])], inner[:, 0], [min(high, edge[-1, 0])]])
        return np.column_stack(
            [x, np.interp(x, edge[:, 0], edge[:, 1]), np.interp(x, edge[:, 0], edge[:, 2])]
        )

    def section(self, height: float) -> FloatArray:
        """Return the section of the left flank at a height, (k, 2) m, with the wheel arches bridged."""
        z = self._uncut[..., 2]
        column, row = np.nonzero((z[:, :-1] <= height) & (z[:, 1:] > height))
        a, b = self._uncut[column, row], self._uncut[column, row + 1]
        share = (height - a[:, 2]) / (b[:, 2] - a[:, 2])
        # Along an arch's edge the sheet keeps the outline of its lower rows, which forms a lip.
        lip = self.flank[(self.flank[..., 2] > z) & (np.abs(self.flank[..., 2] - height) < _LIP)]
        return np.concatenate([(a + share[:, None] * (b - a))[:, :2], lip[:, :2]])


def _shoulder_line(form: Form) -> PchipInterpolator:
    half = form.length / 2
    middle = 0.5 * (form.cowl + form.glass_end)
    knots = [
        (-half - 0.01, form.deck - 0.015),
        (form.glass_end, form.deck + 0.012),
        (middle, form.belt),
        (form.cowl, form.belt - 0.02),
        (0.45 * form.cowl + 0.55 * half, form.nose + 0.62 * (form.belt - 0.02 - form.nose)),
        (half + 0.01, form.nose),
    ]
    x, z = np.array(knots).T
    return PchipInterpolator(x, z)


def _seams(form: Form) -> list[float]:
    front = min(form.front_axle - form.arch_radius - 0.09, form.cowl + 0.22)
    seams = [front, form.pillar]
    if form.doors == 2:
        seams.append(form.rear_axle + (0.55 if form.body != "pickup" else 1.25) * form.arch_radius)
    return seams


def flank_finish(skin: Skin) -> IntArray:
    form = skin.form
    middle = 0.5 * (skin.rows[1:] + skin.rows[:-1])
    row = np.broadcast_to(middle, (len(skin.flank) - 1, len(middle)))
    angle = 0.5 * (skin.plan_angle[1:] + skin.plan_angle[:-1])
    x = 0.5 * (skin.edge[1:, 0] + skin.edge[:-1, 0])
    tail = ((skin.plan_angle[1:] < 0) & (skin.plan_angle[:-1] < 0))[:, None]
    nose = (np.minimum(skin.plan_angle[1:], skin.plan_angle[:-1]) >= 0)[:, None] & (
        np.abs(angle - 90.0) > 1e-6
    )[:, None]
    side = ~tail & ~nose
    turn = np.abs(angle)[:, None]
    out = np.full(row.shape, int(Finish.BODY))
    out[row < 0.45] = Finish.BODY_DUSTY
    out[row < 0.2] = Finish.BODY_DIRTY
    out[side & (row < 0.09)] = Finish.CLADDING
    out[~side & (row < 0.42)] = Finish.BUMPER
    out[~side & (row < 0.09) & (turn < 63.0)] = Finish.TRIM
    if skin.coarse:
        out[nose & (row > 0.5) & (row < 0.9) & (turn > 48)] = Finish.HEADLAMP
        out[nose & (row > 0.5) & (row < 0.9) & (turn < LAMP_INNER)] = Finish.GRILLE
        out[tail & (row > 0.5) & (row < 0.9) & (turn > 48)] = Finish.TAIL_LAMP
        return out
    inside_seam = np.zeros(len(x), dtype=bool)
    for seam in skin.seams:
        inside_seam |= np.abs(x - seam) < 0.3 * GAP
    out[side & inside_seam[:, None] & (row > 0.09)] = Finish.SEAM
    _nose_finish(out, form, row, turn, nose)
    _tail_finish(out, form, row, turn, tail)
    return out


def _nose_finish(
    out: IntArray, form: Form, row: FloatArray, turn: FloatArray, nose: NDArray[np.bool_]
) -> None:
    slim = form.variety[1] < 0.4
    low, high = (0.68, 0.82) if slim else (0.55, 0.82)
    if form.body in ("van", "pickup") or form.variety[1] > 0.8:
        high = 0.93
    out[nose & (row > low) & (row < high) & (turn > LAMP_INNER) & (turn < LAMP_OUTER)] = Finish.HEADLAMP
    grille = nose & (turn < (LAMP_INNER if form.variety[2] < 0.6 else GRILLE_EDGE))
    bottom = 0.40 if form.variety[3] < 0.35 or form.body == "pickup" else 0.55
    out[grille & (row > bottom) & (row < 0.82)] = Finish.GRILLE
    if form.variety[3] > 0.5:
        out[grille & (row > 0.68) & (row < 0.82)] = Finish.GRILLE if slim else Finish.BRIGHT
    intake = LAMP_OUTER if form.variety[4] < 0.3 else LAMP_INNER + 11
    out[nose & (row > 0.09) & (row < 0.24) & (turn < intake)] = Finish.GRILLE


def _tail_finish(
    out: IntArray, form: Form, row: FloatArray, turn: FloatArray, tail: NDArray[np.bool_]
) -> None:
    low = 0.68 if form.body == "sedan" or form.variety[5] < 0.4 else 0.55
    inner = LAMP_INNER + 11 if form.body in ("van", "pickup", "estate", "suv") else LAMP_INNER
    if form.body in ("van", "pickup"):
        low, inner = 0.40, 69.0
    lamp = tail & (row > low) & (row < 0.99) & (turn > inner) & (turn < LAMP_OUTER + 10)
    if form.body == "sedan" or form.variety[6] < 0.4:
        lamp &= row < 0.93
    out[lamp] = Finish.TAIL_LAMP
    out[lamp & (row > 0.68) & (row < 0.82)] = (
        Finish.TAIL_LAMP_DARK if form.variety[6] < 0.5 else Finish.TAIL_LAMP
    )
    out[lamp & (row > 0.68) & (row < 0.82) & (turn < inner + 12)] = Finish.REVERSING_LAMP
    if form.variety[7] < 0.15 and form.body in ("sedan", "suv"):  # a band of light from lamp to lamp
        out[tail & (row > 0.82) & (row < 0.93) & (turn < inner)] = Finish.TAIL_LAMP_DARK
    out[tail & (row > 0.40) & (row < 0.55) & (turn < inner - 1)] = (
        Finish.TRIM if form.variety[7] > 0.85 else Finish.BODY
    )


def add_underside(build: ShapeBuilder, skin: Skin) -> None:
    lower = skin.flank[:, 0]
    floor = skin.form.sill + 0.03
    if skin.coarse:
        build.chords(lower, [1, -1], 0.0, Finish.UNDERSIDE, flip=True, smooth=False)
        return
    inner = lower.copy()
    inner[:, 1] = np.maximum(lower[:, 1] - 0.34, 0.55 * lower[:, 1])
    wall = inner.copy()
    wall[:, 2] = np.minimum(floor, inner[:, 2])
    half = np.stack([lower, inner, wall], axis=1)
    sheet = np.concatenate([half, half[:, ::-1] * [1.0, -1.0, 1.0]], axis=1)
    build.grid(sheet, Finish.UNDERSIDE, smooth=False)


def add_bonnet(build: ShapeBuilder, skin: Skin) -> None:
    """Add the bonnet; behind the foot of the windscreen it is the dashboard."""
    form = skin.form
    edge = skin.edge_between(form.cowl - 0.12, form.length)
    crown = 0.028 + 0.045 * np.clip((form.length / 2 - edge[:, 0]) / (form.length / 2 - form.cowl), 0.0, 1.0)
    crown[-1] = 0.0
    across = [1, 0, -1] if skin.coarse else [1, 0.93, 0.91, 0.5, -0.5, -0.91, -0.93, -1]
    middle = 0.5 * (edge[1:, 0] + edge[:-1, 0])
    finish = np.full((len(middle), len(across) - 1), int(Finish.BODY))
    if not skin.coarse:
        beside = middle < form.length / 2 - form.nose_depth  # the lid's front edge meets the nose
        finish[beside, 1] = finish[beside, -2] = Finish.SEAM
    finish[middle < form.cowl + 0.02] = Finish.CABIN
    build.chords(edge, across, crown, finish)


def add_tail_top(build: ShapeBuilder, skin: Skin) -> None:
    """Add the boot lid, the shelf under a rear window, or a pick-up's bed."""
    form = skin.form
    if form.body == "pickup":
        _add_bed(build, skin)
        return
    edge = skin.edge_between(-form.length, form.glass_end + 0.06)
    crown = 0.04 * np.clip((edge[:, 0] + form.length / 2) / 0.3, 0.0, 1.0)
    crown[0] = 0.0
    across = [1, 0, -1] if skin.coarse else [1, 0.9, 0.5, 0, -0.5, -0.9, -1]
    build.chords(edge, across, crown, Finish.BODY)


def _add_bed(build: ShapeBuilder, skin: Skin) -> None:
    form = skin.form
    start, end = skin.edge[0, 0], form.glass_end + 0.05
    build.chords(skin.edge_between(-form.length, start + 0.16), [1, 0.9, -0.9, -1], 0.0, Finish.BODY)
    edge = skin.edge_between(start + 0.16, end)
    low = np.where((edge[:, 0] > start + 0.165) & (edge[:, 0] < form.glass_end - 0.03), 1.0, 0.0)
    floor = form.wheel_radius * 2 + 0.04
    a = np.array([1.0, 0.91, 0.9, -0.9, -0.91, -1.0])
    deep = np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    edge = np.vstack([edge[:1], edge[:1] + np.array([0.005, 0, 0]), edge[1:]])
    low = np.concatenate([low[:1], [1.0], low[1:]])
    points = np.repeat(edge[:, None], len(a), axis=1)
    points[..., 1] *= a
    points[..., 2] += (low[:, None] * deep) * (floor - points[..., 2])
    finish = np.full((len(edge) - 1, len(a) - 1), int(Finish.TRIM))
    finish[:, [0, -1]] = Finish.BODY
    build.grid(points, finish, flip=True, smooth=False)
