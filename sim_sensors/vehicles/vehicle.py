"""Parametric vehicle models: a body, a size, a paint and a seed determine the mesh."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from sim_sensors.camera.surfaces import Shape, ShapeBuilder
from sim_sensors.errors import SensorError, require_seed
from sim_sensors.mesh import Material, Mesh
from sim_sensors.vehicles import bodies, parts
from sim_sensors.vehicles.bodies import Finish, Skin
from sim_sensors.vehicles.cabins import Glasshouse, add_cabin, add_seats
from sim_sensors.vehicles.classes import BODIES, draw_body, draw_paint, draw_size
from sim_sensors.vehicles.forms import Form, draw_form

KNEE_M = 0.5  # height of the laser plane above ground, m (T §3.3.2)
FOOTPRINT_CORNERS = 24  # maximum number of corners of a footprint
DETAILED, COARSE = 0, 1  # levels of detail of a mesh

_DUST = np.array([128.0, 116.0, 98.0])
_SHAPES_KEPT = 1024


@dataclass(frozen=True)
class VehicleModel:
    """A vehicle model: shape, paint and trim.

    Args:
        body: one of `vehicles.classes.BODIES`.
        segment: market segment, as in `vehicles.classes.SIZE_CLASSES`; it determines wheels and nose.
        size: length, width without mirrors, height, m.
        paint: sRGB, 0 to 255.
        seed: 0 or more, seed of all other details.

    Raises:
        SensorError: the body is unknown, the size is implausible, or paint or seed is out of range.

    Examples:
        >>> car = VehicleModel.from_seed("estate", 7)
        >>> car.body, car.footprint().shape[1], car == VehicleModel.from_seed("estate", 7)
        ('estate', 2, True)
    """

    body: str
    segment: str
    size: tuple[float, float, float]
    paint: tuple[int, int, int]
    seed: int

    def __post_init__(self) -> None:
        if self.body not in BODIES:
            raise SensorError(f"body is {self.body!r}, want one of {', '.join(BODIES)}")
        require_seed(self.seed)
        limits = ((3.2, 6.0), (1.5, 2.2), (1.3, 2.2))
        for name, value, (low, high) in zip(("length", "width", "height"), self.size, limits, strict=True):
            if not low <= value <= high:
                raise SensorError(f"size is {value}, want a {name} of {low} to {high} m")
        if len(self.paint) != 3 or not all(0 <= c <= 255 for c in self.paint):
            raise SensorError(f"paint is {self.paint!r}, want three numbers from 0 to 255")

    @classmethod
    def from_seed(cls, body: str | None, seed: int) -> VehicleModel:
        """Draw a model: size, paint and trim by frequency.

        Args:
            body: one of `vehicles.classes.BODIES`; None draws it by `BODY_SHARE`.
            seed: 0 or more.
        """
        if body is not None and body not in BODIES:
            raise SensorError(f"body is {body!r}, want one of {', '.join(BODIES)}")
        require_seed(seed)
        rng = np.random.default_rng([int(seed), 1])
        drawn = draw_body(rng)
        chosen = drawn if body is None else body
        segment, size = draw_size(chosen, rng)
        return cls(chosen, segment, size, draw_paint(rng), int(seed))

    def painted(self, paint: tuple[int, int, int]) -> VehicleModel:
        """Return the same car in another colour, sRGB; its shape is shared."""
        return replace(self, paint=paint)

    @property
    def length(self) -> float:
        """Length, m."""
        return self.size[0]

    @property
    def width(self) -> float:
        """Width without mirrors, m."""
        return self.size[1]

    @property
    def height(self) -> float:
        """Height, m."""
        return self.size[2]

    @cached_property
    def form(self) -> Form:
        """The proportions of the body."""
        return draw_form(self.body, self.segment, self.size, np.random.default_rng([self.seed, 2]))

    def mesh(self, level: int = DETAILED) -> Mesh:
        """Return the mesh, vehicle frame.

        Shapes are cached, so the same model in another paint is cheap.

        Args:
            level: `DETAILED` (0), about 3,800 triangles, or `COARSE` (1), about 560.
        """
        if level not in (DETAILED, COARSE):
            raise SensorError(f"level is {level!r}, want 0 (detailed) or 1 (coarse)")
        return _shape(self.painted((0, 0, 0)), level).dyed(*self._palette())

    def footprint(self) -> FloatArray:
        """Return the footprint 0.5 m above the ground.

        Returns:
            (k, 2) float64, m, vehicle frame: a convex polygon, counter-clockwise, at most `FOOTPRINT_CORNERS`
            corners, within 2 cm of the convex hull of the mesh's section at `KNEE_M`.
        """
        return _footprint(self.painted((0, 0, 0))).copy()

    def _palette(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        rng = np.random.default_rng([self.seed, 3])
        variety = self.form.variety
        paint = np.array(self.paint, dtype=np.float64)
        dirt = float(rng.beta(1.3, 4.0))
        plain = self.body in ("van", "pickup") and variety[3] < 0.4
        rugged = plain or (self.body == "suv" and variety[5] < 0.65)
        plastic = np.array([44.0, 45.0, 47.0]) + rng.uniform(-8, 10)
        cabin = np.array([40.0, 40.0, 42.0]) + rng.uniform(-12, 22)
        seat = cabin * rng.uniform(0.9, 1.25) if rng.random() < 0.8 else np.array([128.0, 112.0, 92.0])
        silver = np.array([168.0, 170.0, 173.0])
        rim = silver * rng.uniform(0.75, 1.1) if rng.random() < 0.78 else np.full(3, 38.0)
        bright = np.array([196.0, 198.0, 200.0]) if variety[2] < 0.6 else np.array([26.0, 26.0, 28.0])
        dusty = paint + (0.05 + 0.25 * dirt) * (_DUST - paint)
        dirty = paint + (0.12 + 0.55 * dirt) * (_DUST - paint)
        handle = (Material.PAINT, paint) if variety[1] < 0.75 and not plain else (Material.TRIM, plastic)
        table: dict[Finish, tuple[Material, FloatArray | tuple[int, int, int]]] = {
            Finish.BODY: (Material.PAINT, paint),
            Finish.BODY_DUSTY: (Material.PAINT, dusty),
            Finish.BODY_DIRTY: (Material.PAINT, dirty),
            Finish.SEAM: (Material.TRIM, 0.35 * paint * 0.5 + 8),
            Finish.GLASS: (Material.GLASS, np.array([26.0, 32.0, 31.0]) + rng.uniform(0, 8)),
            Finish.TRIM: (Material.TRIM, (24, 24, 25)),
            Finish.BUMPER: (Material.TRIM, plastic) if plain else (Material.PAINT, dusty),
            Finish.CLADDING: (Material.TRIM, plastic + dirt * 30) if rugged else (Material.PAINT, dirty),
            Finish.GRILLE: (Material.TRIM, (17, 17, 18)),
            Finish.BRIGHT: (Material.CHROME, bright),
            Finish.HEADLAMP: (Material.HEAD_LAMP, (62, 66, 72)),
            Finish.REFLECTOR: (Material.HEAD_LAMP, (238, 242, 246)),
            Finish.INDICATOR: (Material.LAMP, (222, 128, 30)),
            Finish.TAIL_LAMP: (Material.TAIL_LAMP, (150, 14, 18)),
            Finish.TAIL_LAMP_DARK: (Material.TAIL_LAMP, (96, 8, 12)),
            Finish.REVERSING_LAMP: (Material.REVERSING_LAMP, (172, 96, 94)),
            Finish.PLATE: (Material.PLATE, (228, 228, 222)),
            Finish.PLATE_INK: (Material.PLATE, (22, 22, 24)),
            Finish.PLATE_BAND: (Material.PLATE, (20, 60, 150)),
            Finish.TYRE: (Material.RUBBER, np.array([30.0, 30.0, 31.0]) + 26 * dirt),
            Finish.RIM: (Material.RIM, rim + 0.25 * dirt * (_DUST - rim)),
            Finish.RIM_DARK: (Material.RIM, (26, 26, 27)),
            Finish.SEAT: (Material.INTERIOR, seat),
            Finish.CABIN: (Material.INTERIOR, cabin),
            Finish.HEADLINER: (Material.INTERIOR, (120, 118, 114)),
            Finish.UNDERSIDE: (Material.TRIM, (14, 14, 14)),
            Finish.MIRROR: handle,
            Finish.HANDLE: handle,
            Finish.RAIL: (Material.CHROME, bright),
            Finish.PILLAR: (Material.TRIM, (20, 20, 21)),
        }
        material = np.zeros(bodies.N_FINISHES, dtype=np.uint8)
        color = np.zeros((bodies.N_FINISHES, 3), dtype=np.uint8)
        for finish, (kind, rgb) in table.items():
            material[finish] = kind
            color[finish] = np.clip(np.round(rgb), 0, 255)
        return material, color


@lru_cache(maxsize=_SHAPES_KEPT)
def _skin(model: VehicleModel, coarse: bool) -> Skin:
    return Skin(model.form, coarse=coarse)


@lru_cache(maxsize=2 * _SHAPES_KEPT)
def _shape(model: VehicleModel, level: int) -> Shape:
    coarse = level == COARSE
    form, skin, build = model.form, _skin(model, coarse), ShapeBuilder()
    house = Glasshouse(skin)
    build.both_sides(skin.flank, bodies.flank_finish(skin))
    bodies.add_underside(build, skin)
    bodies.add_bonnet(build, skin)
    bodies.add_tail_top(build, skin)
    house.add_shell(build, coarse=coarse)
    add_cabin(build, skin)
    parts.add_wheels(build, form, coarse=coarse)
    if coarse:
        return build.build()
    add_seats(build, skin)
    parts.add_plates(build, skin, np.random.default_rng([model.seed, 4]).integers(0, 12, 7))
    parts.add_reflectors(build, skin)
    parts.add_mirrors(build, skin)
    parts.add_handles(build, skin)
    if form.variety[2] < 0.7:
        parts.add_slats(build, skin)
    if form.body in ("suv", "estate") and form.variety[4] < 0.6:
        parts.add_rails(build, house)
    if form.body in ("suv", "pickup"):
        parts.add_cladding(build, skin)
    return build.build()


@lru_cache(maxsize=_SHAPES_KEPT)
def _footprint(model: VehicleModel) -> FloatArray:
    skin = _skin(model, False)
    left = skin.section(KNEE_M)
    for at, _ in parts.plate_places(skin):  # flat plates protrude from a round bumper
        if abs(at[2] - KNEE_M) < parts.PLATE_M[1] / 2:
            left = np.vstack([left, [at[0], parts.PLATE_M[0] / 2]])
    hull = _convex_hull(np.vstack([left, left * [1.0, -1.0]]))
    while len(hull) > FOOTPRINT_CORNERS:
        before, after = np.roll(hull, 1, axis=0), np.roll(hull, -1, axis=0)
        chord, reach = after - before, hull - before
        lost = np.abs(chord[:, 0] * reach[:, 1] - chord[:, 1] * reach[:, 0]) / np.hypot(*chord.T)
        hull = np.delete(hull, int(np.argmin(lost)), axis=0)
    return hull


def _convex_hull(points: FloatArray) -> FloatArray:
    ordered = np.unique(np.round(points, 9), axis=0)

    def chain(row: list[list[float]]) -> list[list[float]]:
        out: list[list[float]] = []
        for p in row:
            while len(out) > 1 and (
                (out[-1][0] - out[-2][0]) * (p[1] - out[-2][1])
                - (out[-1][1] - out[-2][1]) * (p[0] - out[-2][0])
                <= 1e-7
            ):
                out.pop()
            out.append(p)
        return out[:-1]

    row: list[list[float]] = ordered.tolist()
    return np.array(chain(row) + chain(row[::-1]))
