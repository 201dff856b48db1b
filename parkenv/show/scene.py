"""What is seen of a lot from above: layers of plain shapes, m, which every painter draws.

A picture is the scene of a lot, with further layers on top. `painters.opencv` paints layers on images, `painters.axes`
on the axes of a figure, and `report/lot_view.js` on the canvas of a page.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.driving.drivable_area import DrivableArea
from parkenv.world.drive_graph import linestrings
from parkenv.world.lot import ParkingLot, is_building

Color = tuple[int, int, int]

PALETTE: Mapping[str, Color] = {
    "ground": (228, 231, 223),
    "asphalt": (104, 108, 114),
    "paint": (255, 255, 255),
    "building": (200, 194, 182),
    "wall": (126, 118, 107),
    "entry": (29, 138, 78),
    "goal": (24, 82, 186),
    "parked": (46, 52, 60),
    "glass": (128, 140, 152),
    "car": (255, 208, 0),
    "mover": (24, 82, 186),
    "resident": (74, 150, 226),
    "ink": (24, 27, 31),
    "white": (255, 255, 255),
    "warning": (255, 140, 90),
    "leaving": (148, 70, 200),
    "floor": (206, 209, 212),
    "side": (255, 127, 80),
    "oblique": (120, 200, 80),
    "end": (86, 180, 233),
    "wrong": (224, 33, 138),
    "graph": (255, 217, 138),
}
"""Names of colours, each with one meaning: yellow is the car, blue the goal and the walk to it.

Pages have their own values, for light and dark themes, in `report/style.css`.
"""

# Colours of P(taken) = 0, 1/4, 1/2, 3/4, 1: greenish to red, distinguishable with any colour vision.
BELIEF_ANCHORS: tuple[Color, ...] = (
    (0, 128, 115),
    (106, 190, 170),
    (245, 238, 215),
    (240, 150, 95),
    (192, 50, 25),
)
FREE: Color = BELIEF_ANCHORS[0]

_PALENESS = 0.62


def rgb(color: Any) -> Color:
    if isinstance(color, str) and not color.startswith("#"):
        return PALETTE[color]
    red, green, blue = bytes.fromhex(color[1:]) if isinstance(color, str) else map(int, color)
    return red, green, blue


def hex_color(name: str) -> str:
    return "#{:02x}{:02x}{:02x}".format(*PALETTE[name])


def mixed_color(start: str | Color, end: str | Color, share: float) -> Color:
    red, green, blue = (round(a + share * (b - a)) for a, b in zip(rgb(start), rgb(end), strict=True))
    return red, green, blue


def _belief_scale() -> Image:
    anchors = np.array(BELIEF_ANCHORS, dtype=np.float64)
    at = np.linspace(0.0, len(anchors) - 1.0, 256)
    full = np.stack([np.interp(at, np.arange(len(anchors)), channel) for channel in anchors.T], axis=1)
    pale = full + _PALENESS * (np.array(PALETTE["ground"]) - full)
    return np.round(np.stack([pale, full])).astype(np.uint8)


# Colours, (2, 256, 3) uint8, of P(taken) = i/255: unobserved slots, then observed ones.
BELIEF_SCALE = _belief_scale()


def belief_colors(p_occupied: NDArray[np.floating], seen: NDArray[np.bool_]) -> Image:
    """Return the colours, (n, 3) uint8 RGB, of slots with these probabilities of being taken, (n,)."""
    return np.asarray(BELIEF_SCALE[seen.astype(np.intp), np.round(255.0 * p_occupied).astype(np.intp)])


Rings = Sequence[FloatArray]  # A polygon, m: its outer ring, (k, 2), and its holes
# A name in `PALETTE`, "#rrggbb" or RGB; or one for each shape, also as (n, 3) RGB in 0..1 (figures only).
Paint = str | Color | Sequence[str] | Sequence[Color] | FloatArray

APRON = 0.25  # width of the asphalt beyond the kerbs, m
ARROW_EVERY = 24.0  # approximate distance between two direction arrows on a one-way lane, m

_CORNER = np.linspace(0, 2 * np.pi, 40, endpoint=False)
# Outline of a car of unit length and width, nose to +x.
CAR_BODY = 0.5 * np.stack(
    [np.sign(f) * np.abs(f) ** 0.36 for f in (np.cos(_CORNER), np.sin(_CORNER))], axis=1
)
WINDSCREEN = np.array([[0.24, -0.40], [0.24, 0.40], [0.10, 0.32], [0.10, -0.32]])
REAR_WINDOW = np.array([[-0.36, -0.36], [-0.36, 0.36], [-0.26, 0.30], [-0.26, -0.30]])
DISC = 0.5 * np.stack([np.cos(_CORNER), np.sin(_CORNER)], axis=1)
SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
ARROWHEAD = np.array([[0.6, 0.0], [-0.5, 0.5], [-0.22, 0.0], [-0.5, -0.5]])
LANE_ARROW = np.array(
    [[0.5, 0.0], [-0.06, 0.5], [-0.06, 0.13], [-0.5, 0.13], [-0.5, -0.13], [-0.06, -0.13], [-0.06, -0.5]]
)
_TIP = 0.5 * np.pi + 0.2 * np.pi * np.arange(10)
STAR = np.stack([np.cos(_TIP), np.sin(_TIP)], axis=1) * np.where(np.arange(10) % 2, 0.2, 0.5)[:, None]


@dataclass(frozen=True, eq=False)
class Areas:
    polygons: Sequence[Rings]
    color: Paint
    edge: Paint | None = None  # of their outlines
    edge_px: float = 0.8
    opacity: float = 1.0


@dataclass(frozen=True, eq=False)
class Lines:
    lines: Sequence[FloatArray]  # (k, 2) m each
    color: Paint
    width: float = 0.0  # m
    px: tuple[float, float] = (1.0, math.inf)  # least and greatest width in the picture
    dash: tuple[float, float] | None = None  # lengths of a dash and of a gap, px
    halo: str | Color | None = (
        None  # colour of a line below that is wider by `HALO_PX`, visible on any ground
    )
    opacity: float = 1.0


HALO_PX = 1.8


@dataclass(frozen=True, eq=False)
class Marks:
    """One shape at several poses, to scale, but not too small to see."""

    poses: FloatArray  # (n, 3): x, y, m, and yaw
    shape: FloatArray  # (k, 2), of unit length and width, nose to +x
    color: Paint
    size: tuple[float, float] | FloatArray = (0.0, 0.0)  # length and width, m; or those of each, (n, 2)
    px: float = 0.0  # least length in the picture; the width grows in proportion
    edge: str | Color | None = None  # colour of a border around it
    edge_px: float = 1.5
    opacity: float = 1.0

    def sizes(self, scale: float, least: float) -> FloatArray:
        size = scale * np.broadcast_to(np.asarray(self.size, dtype=np.float64), (len(self.poses), 2))
        long = size[:, :1]
        # Shapes without a size of their own are as wide as long.
        return np.where(long > 0.0, size * np.maximum(1.0, least / np.maximum(long, 1e-9)), least)


Layer = Areas | Lines | Marks


def cars(
    poses: FloatArray,
    color: Paint,
    size: tuple[float, float] = (4.4, 1.94),
    *,
    px: float = 0.0,
    edge: str | None = None,
    glass: str = "ink",
) -> list[Layer]:
    body = Marks(poses, CAR_BODY, color, size, px, edge)
    return [body, *(Marks(poses, pane, glass, size, px) for pane in (WINDSCREEN, REAR_WINDOW))]


def posed(xy: FloatArray, yaw: FloatArray | float = 0.0) -> FloatArray:
    xy = xy.reshape(-1, 2)
    return np.column_stack([xy, np.broadcast_to(yaw, len(xy))])


def placed_shape(shape: FloatArray, poses: FloatArray, size: FloatArray) -> FloatArray:
    """Return a shape, (k, 2), at poses, (n, 3), with a length and width each, (n, 2): (n, k, 2)."""
    cos, sin = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    along, across = (shape * size[:, None]).transpose(2, 0, 1)
    x, y = poses[:, 0, None] + along * cos - across * sin, poses[:, 1, None] + along * sin + across * cos
    return np.stack([x, y], axis=-1)


def arrows_along(lines: Sequence[FloatArray], every: float) -> FloatArray:
    """Return poses, (n, 3), evenly spaced over each straight piece of lines, about `every` m apart, at least one."""
    arrows = []
    for points in lines:
        for start, step in zip(points, np.diff(points, axis=0), strict=False):
            n = max(1, round(math.hypot(*step) / every))
            arrows += [(*(start + (i + 0.5) / n * step), math.atan2(step[1], step[0])) for i in range(n)]
    return np.array(arrows, dtype=np.float64).reshape(-1, 3)


def poses_on(line: FloatArray, at: FloatArray) -> FloatArray:
    """Return poses, (n, 3), on a line, (k, 2), at distances from its start, (n,) m."""
    step = np.diff(line, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    along = np.r_[0.0, np.cumsum(length)]
    leg = np.clip(np.searchsorted(along, at, side="right") - 1, 0, len(length) - 1)
    xy = np.stack([np.interp(at, along, axis) for axis in line.T], axis=1)
    return posed(xy, np.arctan2(step[leg, 1], step[leg, 0]))


@dataclass(frozen=True, eq=False)
class LotScene:
    lot: ParkingLot
    buildings: tuple[FloatArray, ...]  # outlines of buildings, (k, 2) each, closed
    walls: tuple[FloatArray, ...]  # other walls, (k, 2) each
    slots: FloatArray  # (n_slots, 4, 2), corners of the slots
    slot_lines: FloatArray  # (n_slots, 4, 2), painted lines: three sides of each slot, without its mouth
    centre_lines: tuple[FloatArray, ...]  # centre lines of the two-way lanes, (k, 2) each
    arrows: FloatArray  # (a, 3), direction arrows on the one-way lanes
    entries: FloatArray  # (e, 3), a car entering
    area: DrivableArea  # the asphalt

    @classmethod
    def of(cls, lot: ParkingLot) -> Self:
        corners = lot.slot_corners()
        first = np.array([0, 3, 1])[lot.slot_mouth]
        return cls(
            lot=lot,
            buildings=tuple(wall for wall in lot.walls if is_building(wall)),
            walls=tuple(wall for wall in lot.walls if not is_building(wall)),
            slots=corners,
            slot_lines=corners[np.arange(lot.n_slots)[:, None], (first[:, None] + np.arange(4)) % 4],
            centre_lines=tuple(lane.points for lane in lot.lanes if not lane.oneway),
            arrows=arrows_along([lane.points for lane in lot.lanes if lane.oneway], ARROW_EVERY),
            entries=_entries(lot),
            area=DrivableArea(lot),
        )

    def paved(
        self,
        center: FloatArray | None = None,
        reach: float = math.inf,
        *,
        apron: float = APRON,
        joined: bool = True,
    ) -> list[Rings]:
        """Return the polygons of the asphalt, which ends at the kerbs of `DrivableArea`.

        They are exact within `reach`, m, around the centre along both axes; None is the whole lot. On the `apron`, m,
        beyond the kerbs the outer painted lines are visible. Polygons that may overlap (`joined` is False) are found
        at once for a whole town.
        """
        if center is None:
            low, high = np.array(self.lot.bounds()).reshape(2, 2)
            center, reach = (low + high) / 2, float((high - low).max()) / 2
        area = self.area.around(center, reach) if joined else self.area.parts()
        polygons = shapely.get_parts(shapely.buffer(area, apron, quad_segs=2) if apron else area)
        return [
            tuple(shapely.get_coordinates(ring) for ring in (polygon.exterior, *polygon.interiors))
            for polygon in polygons
        ]

    def ground(
        self, center: FloatArray | None = None, reach: float = math.inf, *, joined: bool = True
    ) -> list[Layer]:
        """Return the layers below the slots: buildings, asphalt, walls and the marks of the lanes; see `paved`."""
        return [
            *building_layers(self.buildings, ()),
            Areas(self.paved(center, reach, joined=joined), "asphalt"),
            *building_layers((), (*self.buildings, *self.walls)),
            Lines(self.centre_lines, "paint", 0.12, (0.5, 1.2), dash=(6.0, 8.0), opacity=0.45),
            Marks(self.arrows, LANE_ARROW, "paint", (3.2, 1.5), opacity=0.8),
        ]

    def data(self) -> dict[str, Any]:
        lot = self.lot
        entries = Marks(self.entries, ARROWHEAD, "entry", (2.4, 2.4), px=13.0)
        return {
            "name": lot.name,
            "bounds": rounded(np.array(lot.bounds())),
            "slot_ids": list(lot.slot_ids),
            "slots": [rounded(corners) for corners in self.slots],
            "vertices": [rounded(xy) for xy in lot.vertex_xy],
            "yaw": [round(float(a), 3) for a in lot.vertex_yaw],
            "goals": [rounded(xy) for xy in lot.goals],
            "ground": [layer_data(layer) for layer in (*self.ground(), entries)],
        }


def building_layers(buildings: Sequence[FloatArray], walls: Sequence[FloatArray]) -> list[Layer]:
    return [Areas([[ring] for ring in buildings], "building"), Lines(walls, "wall", 0.3, (1.0, 4.0))]


def layer_data(layer: Layer, digits: int = 2) -> dict[str, Any]:
    """Return a layer for a page: its kind, its colour's name, and its numbers."""
    data: dict[str, Any] = {"color": layer.color, "opacity": layer.opacity}
    if isinstance(layer, Areas):
        return data | {"areas": [[rounded(ring, digits) for ring in rings] for rings in layer.polygons]}
    if isinstance(layer, Lines):
        lines = [rounded(points, digits) for points in layer.lines]
        return data | {
            "lines": lines,
            "width": layer.width,
            "px": layer.px[0],
            "dash": list(layer.dash or ()),
        }
    size = np.broadcast_to(np.asarray(layer.size), (1, 2))[0]
    marks, shape = [rounded(pose) for pose in layer.poses], rounded(layer.shape * size)
    return data | {"marks": marks, "shape": shape, "length": size[0], "px": layer.px}


def rounded(values: FloatArray, digits: int = 2) -> list[float]:
    return [round(float(v), digits) for v in values.ravel()]


def _entries(lot: ParkingLot) -> FloatArray:
    lines = linestrings([lane.points for lane in lot.lanes])
    middle = lot.slot_xy.mean(axis=0)
    entries = []
    for xy in lot.entries:
        k = int(np.argmin(np.asarray(shapely.distance(lines, shapely.Point(xy)))))
        at = shapely.line_locate_point(lines[k], shapely.Point(xy))
        ends = shapely.line_interpolate_point(lines[k], [max(at - 1.0, 0.0), at, at + 1.0])
        before, here, after = shapely.get_coordinates(ends)
        directions = [after - here] if lot.lanes[k].oneway else [after - here, before - here]
        onward = max(directions, key=lambda direction: float(direction @ (middle - here)))
        entries.append((*xy, math.atan2(onward[1], onward[0])))
    return np.array(entries).reshape(-1, 3)
