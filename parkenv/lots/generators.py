"""Slots: their columns, rows of them, generated lots (a grid, a city), and their shapes from polygons and lanes."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from itertools import count
from typing import Any, Self

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import require_number, require_whole
from parkenv.world.drive_graph import LANE_OFFSET, SLOT_REACH
from parkenv.world.lot import Lane, Mouth, ParkingLot, corner_points, mouth_heading, mouth_points

BAY_SIZE = (5.0, 2.5)  # length and width, m, of a perpendicular or angled slot
KERB_SIZE = (6.0, 2.1)  # length and width, m, of a kerbside slot
TWO_WAY_HALF_WIDTH = 3.0  # distance from the centre line of a two-way street to its parked cars, m
ONE_WAY_HALF_WIDTH = 2.0  # distance from the centre line of a one-way street to its parked cars, m
# Distance from the centre of a crossing to the first parked car, m: no parking within 5 m of the kerbs' corner.
CROSSING_CLEARANCE = TWO_WAY_HALF_WIDTH + KERB_SIZE[1] + 5.0
# Distance from the centre line of a street to the buildings, m: half the street, parked cars and a footway.
BUILDING_SETBACK = TWO_WAY_HALF_WIDTH + KERB_SIZE[1] + 2.9


@dataclass(frozen=True, eq=False)
class Slots:
    """The columns of n slots: each field `name` is the column `slot_name` of `ParkingLot`.

    An empty `parking_cost_s` means zeros, an empty `zone` or `facility` none.
    """

    xy: FloatArray
    yaw: FloatArray
    length: FloatArray
    width: FloatArray
    mouth: NDArray[np.int8]
    parking_cost_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    zone: NDArray[np.str_] = field(default_factory=lambda: np.zeros(0, np.str_))
    facility: NDArray[np.str_] = field(default_factory=lambda: np.zeros(0, np.str_))

    def __post_init__(self) -> None:
        for name, dtype in (("parking_cost_s", np.float64), ("zone", np.str_), ("facility", np.str_)):
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.zeros(len(self.xy), dtype))

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, index: NDArray[np.intp] | BoolArray | slice) -> Self:
        return type(self)(*(getattr(self, f.name)[index] for f in fields(self)))

    @classmethod
    def of_lot(cls, lot: ParkingLot) -> Self:
        return cls(*(getattr(lot, f"slot_{f.name}") for f in fields(cls)))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def columns(self) -> dict[str, Any]:
        return {f"slot_{f.name}": getattr(self, f.name) for f in fields(self)}

    def mouths(self) -> FloatArray:
        """Return the middles of the sides by which the slots are entered, (n, 2) m."""
        return mouth_points(self.xy, self.yaw, self.length, self.width, self.mouth)

    def outward(self) -> FloatArray:
        """Return the directions that the mouths face, (n, 2) unit vectors."""
        heading = mouth_heading(self.yaw, self.mouth)
        return np.stack([np.cos(heading), np.sin(heading)], axis=1)

    def boxes(self, shrink: float | FloatArray = 0.0) -> NDArray[np.object_]:
        """Return the rectangles, (n,) polygons, m, narrower and shorter by `shrink` m."""
        return np.asarray(
            shapely.polygons(corner_points(self.xy, self.yaw, self.length - shrink, self.width - shrink))
        )


def bay_row(
    start: ArrayLike,
    heading: float,
    n: int,
    *,
    size: tuple[float, float] = BAY_SIZE,
    angle: float = np.pi / 2,
) -> Slots:
    """Create n perpendicular or angled slots on the left of a line along their mouths; sizes are length and width, m.

    Below a right `angle` between the line and the cars, those that drive along it turn in directly.
    """
    length, width = size
    along = np.array([np.cos(heading), np.sin(heading)])
    left = np.array([-along[1], along[0]])
    nose = np.cos(angle) * along + np.sin(angle) * left
    # The near corner of an angled slot touches the line, so the middle of its mouth is behind it.
    mouth = (
        np.asarray(start, dtype=np.float64)
        + (np.arange(n)[:, None] + 0.5) * width / np.sin(angle) * along
        + width / 2 * abs(np.cos(angle)) * left
    )
    return Slots(
        xy=mouth + length / 2 * nose,
        yaw=np.full(n, np.arctan2(nose[1], nose[0])),
        length=np.full(n, length),
        width=np.full(n, width),
        mouth=np.zeros(n, dtype=np.int8),
    )


NO_SLOTS = bay_row((0.0, 0.0), 0.0, 0)


def kerb_rows(
    start: FloatArray, end: FloatArray, left: BoolArray, size: tuple[float, float] = KERB_SIZE
) -> tuple[Slots, NDArray[np.intp]]:
    """Create as many kerbside slots as fit along m kerbs, evenly spaced; return them and the kerb of each.

    Start and end, (m, 2) m, are of the carriageway's edge in the direction of traffic; cars park on the `left` of it.
    """
    length, width = size
    reach = np.hypot(*(end - start).T)
    # The small tolerance keeps rounding from removing a slot at a kerb of exactly k slots.
    n_on = np.floor(reach / length + 1e-9).astype(np.intp)
    kerb = np.repeat(np.arange(len(start)), n_on)
    rank = np.arange(len(kerb)) - np.repeat(np.cumsum(n_on) - n_on, n_on)
    along = ((end - start) / reach[:, None])[kerb]
    outward = np.where(left, 1.0, -1.0)[kerb, None] * np.stack([-along[:, 1], along[:, 0]], axis=1)
    pitch = (reach / np.maximum(n_on, 1))[kerb]
    slots = Slots(
        xy=start[kerb] + ((rank + 0.5) * pitch)[:, None] * along + width / 2 * outward,
        yaw=np.arctan2(along[:, 1], along[:, 0]),
        length=np.full(len(kerb), length),
        width=np.full(len(kerb), width),
        mouth=np.where(left, Mouth.RIGHT, Mouth.LEFT)[kerb].astype(np.int8),
    )
    return slots, kerb


def grid_lot(
    rows: int, columns: int, *, name: str = "grid", pitch: float = 2.5, depth: float = 5.0, aisle: float = 6.0
) -> ParkingLot:
    """Create rows of perpendicular slots along parallel two-way aisles, connected by a road at either end.

    Rows are in pairs back to back: row 0 south of the first aisle, rows 1 and 2 between the first and the second, and
    so on. The entry is at the west end of the south aisle, the goal east of the lot.

    Args:
        rows: number of rows of slots; two rows share an aisle.
        columns: slots per row.
        name: the lot's name.
        pitch: width of a slot, m.
        depth: length of a slot, m.
        aisle: width of an aisle and of the end roads, m.
    """
    require_whole("grid lot: rows", rows, least=1)
    require_whole("grid lot: columns", columns, least=1)
    for what, value, low, high in (
        ("pitch", pitch, 1.0, 100.0),
        ("depth", depth, 1.0, 100.0),
        ("aisle", aisle, 2 * LANE_OFFSET, 2 * SLOT_REACH),
    ):
        require_number(f"grid lot: {what}", value, least=low, most=high)

    n_aisles = (rows + 1) // 2
    aisle_y = np.arange(n_aisles) * (2 * depth + aisle)
    west, east = -aisle / 2, columns * pitch + aisle / 2

    row, column = (index.ravel() for index in np.indices((rows, columns)))
    up = row % 2 == 1  # the second row of an aisle is north of it
    side = np.where(up, 1.0, -1.0)
    slots = Slots(
        xy=np.stack([(column + 0.5) * pitch, aisle_y[row // 2] + side * (aisle + depth) / 2], axis=1),
        yaw=side * np.pi / 2,
        length=np.full(len(row), depth),
        width=np.full(len(row), pitch),
        mouth=np.zeros(len(row), dtype=np.int8),
    )
    lanes = [Lane(np.array([[west, y], [east, y]])) for y in aisle_y]
    if n_aisles > 1:
        lanes += [Lane(np.stack([np.full(n_aisles, x), aisle_y], axis=1)) for x in (west, east)]
    return ParkingLot(
        name=name,
        slot_ids=tuple(f"{r}-{c}" for r in range(rows) for c in range(columns)),
        **slots.columns(),
        lanes=tuple(lanes),
        entries=np.array([[west, 0.0]]),
        goals=np.array([[east + aisle, aisle_y[-1] / 2]]),
    )


def city_lot(n_slots: int, seed: int = 0) -> ParkingLot:
    """Create a city of one-way and two-way streets with `n_slots` kerbside slots around its blocks.

    A million slots take seconds. The same seed gives the same city.

    Every street runs from one edge of the city to the other, and the streets along the edges are two-way, so every
    slot can be reached from every other. Slots are numbered crossing by crossing from the south-west, so neighbours
    have close numbers. If more slots fit than requested, random ones are omitted, like driveways. The block in the
    middle is a square without a building; the goal is its centre.
    """
    require_whole("city: n_slots", n_slots, least=1)
    # A block has about 45 slots: add rows of blocks until all slots fit.
    for n_blocks in count(max(1, int(np.sqrt(n_slots / 48)))):
        # Blocks of 60-140 m × 50-110 m; two in five streets are one-way.
        rng = np.random.default_rng([seed, n_blocks])
        x = np.cumsum(rng.uniform(60.0, 140.0, n_blocks + 1))
        y = np.cumsum(rng.uniform(50.0, 110.0, n_blocks + 1))
        shift = rng.uniform(-6.0, 6.0, (n_blocks + 1, n_blocks + 1, 2))
        oneway = rng.choice([-1, 0, 0, 0, 1], size=(2, n_blocks + 1))
        oneway[:, [0, -1]] = 0
        streets = StreetGrid(np.stack(np.meshgrid(x, y), axis=-1) + shift, along=oneway[0], across=oneway[1])
        slots = streets.kerb_slots()
        if len(slots) >= n_slots:
            break
    slots = slots[np.sort(np.random.default_rng([seed, n_slots]).permutation(len(slots))[:n_slots])]

    crossings = streets.crossings
    gate = crossings[len(crossings) // 2, 0]
    outside = gate - np.array([30.0, 0.0])
    corners = streets.blocks()
    middle = (len(corners) // 2, len(corners[0]) // 2)
    built = np.ones(corners.shape[:2], dtype=bool)
    built[middle] = False
    return ParkingLot(
        name=f"city-{n_slots}-{seed}",
        slot_ids=tuple(map(str, range(n_slots))),
        **slots.columns(),
        lanes=(*streets.lanes(), Lane(np.stack([outside, gate]))),
        entries=outside[None],
        goals=corners[middle].mean(axis=0)[None],
        walls=tuple(outlines(corners[built], BUILDING_SETBACK)),
    )


@dataclass(frozen=True, eq=False)
class StreetGrid:
    """A grid of streets, `along` from west to east and `across` from south to north."""

    crossings: FloatArray  # (n_along, n_across, 2) m, crossing of street i along and street j across
    # (n_along,) int: 0 for a two-way street, 1 for a one-way street eastward, -1 westward
    along: IntArray
    # (n_across,) int: 0 for a two-way street, 1 for a one-way street northward, -1 southward
    across: IntArray

    def lanes(self) -> list[Lane]:
        streets = [*self.crossings, *self.crossings.swapaxes(0, 1)]
        directions = np.concatenate([self.along, self.across])
        return [
            Lane(points[::-1] if direction < 0 else points, oneway=bool(direction))
            for points, direction in zip(streets, directions, strict=True)
        ]

    def blocks(self) -> FloatArray:
        """Return the corners of the blocks, (n_along - 1, n_across - 1, 4, 2) m, counter-clockwise."""
        p = self.crossings
        return np.stack([p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]], axis=2)

    def kerb_slots(self, outer: bool = True) -> Slots:
        """Create slots on both sides of all streets, crossing by crossing; `outer`: also on the outer sides."""
        p = self.crossings
        n_along, n_across = p.shape[:2]
        number = np.arange(n_along * n_across).reshape(n_along, n_across)
        # Each crossing owns the segments of street to its east and to its north.
        start = np.concatenate([p[:, :-1].reshape(-1, 2), p[:-1].reshape(-1, 2)])
        end = np.concatenate([p[:, 1:].reshape(-1, 2), p[1:].reshape(-1, 2)])
        direction = np.concatenate([np.repeat(self.along, n_across - 1), np.tile(self.across, n_along - 1)])
        owner = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
        backward = (direction < 0)[:, None]
        start, end = np.where(backward, end, start), np.where(backward, start, end)
        # Cars on the left of a one-way street face the direction of traffic, of a two-way street the opposite one.
        oneway = direction != 0
        kerb_start = np.concatenate([start, np.where(oneway[:, None], start, end)])
        kerb_end = np.concatenate([end, np.where(oneway[:, None], end, start)])
        on_left = np.concatenate([np.zeros(len(start), dtype=bool), oneway])
        half_width = np.tile(np.where(oneway, ONE_WAY_HALF_WIDTH, TWO_WAY_HALF_WIDTH), 2)
        used = np.hypot(*(kerb_end - kerb_start).T) > 2 * CROSSING_CLEARANCE
        kerb_start, kerb_end, on_left, half_width = (
            values[used] for values in (kerb_start, kerb_end, on_left, half_width)
        )
        tangent = kerb_end - kerb_start
        tangent /= np.hypot(*tangent.T)[:, None]
        outward = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1) * np.where(on_left, -1.0, 1.0)[:, None]
        shift = half_width[:, None] * outward
        slots, kerb = kerb_rows(
            kerb_start + CROSSING_CLEARANCE * tangent + shift,
            kerb_end - CROSSING_CLEARANCE * tangent + shift,
            on_left,
        )
        slots = slots[np.argsort(np.tile(owner, 2)[used][kerb], kind="stable")]
        edge = shapely.Polygon(np.concatenate([p[0], p[1:, -1], p[-1, -2::-1], p[-2:0:-1, 0]]))
        return slots if outer else slots[shapely.contains_xy(edge, slots.xy)]


def outlines(corners: FloatArray, setback: float) -> list[FloatArray]:
    """Return closed outlines, (k, 2) m each, of the polygons `corners`, (n, k, 2) m, shrunk by `setback` m."""
    shrunk = shapely.buffer(shapely.polygons(corners), -setback, join_style="mitre")
    return [shapely.get_coordinates(polygon) for polygon in np.asarray(shrunk) if not polygon.is_empty]


def slots_from_polygons(polygons: NDArray[np.object_], lanes: Sequence[Lane]) -> Slots:
    """Infer length, width, yaw and mouth of slots from their outlines, (n,) polygons with an area, m.

    A slot is the smallest rectangle around its polygon. A side faces a lane if the lane's nearest point is within 60°
    of the side's outward normal. A slot with a short side that faces a lane is perpendicular or angled, and entered by
    that side (the nearer one of two). If only a long side faces a lane, it is a kerbside slot, and the car faces the
    direction of traffic: that of a one-way lane, otherwise with the lane on its left. If no side faces a lane, the
    short side nearest to one counts.
    """
    boxes = shapely.normalize(shapely.minimum_rotated_rectangle(polygons))
    corners = shapely.get_coordinates(boxes).reshape(len(polygons), 5, 2)[:, :4]
    side_length = np.hypot(*np.moveaxis(np.roll(corners, -1, axis=1) - corners, 2, 0))
    # Make sides 0 and 2 the short ones.
    turn = (side_length[:, 0] > side_length[:, 1])[:, None, None]
    corners = np.where(turn, np.roll(corners, -1, axis=1), corners)
    middle = (corners + np.roll(corners, -1, axis=1)) / 2
    center = corners.mean(axis=1)
    outward = middle - center[:, None]
    half = np.hypot(outward[..., 0], outward[..., 1])
    outward /= half[..., None]

    nearest, tangent, oneway = nearest_on_lanes(lanes, middle.reshape(-1, 2))
    to_lane = nearest.reshape(middle.shape) - middle
    distance = np.hypot(to_lane[..., 0], to_lane[..., 1])
    faced = np.where((to_lane * outward).sum(axis=2) >= 0.5 * distance, distance, np.inf)
    # A lane that touches the side has no direction from it; the side counts as facing it.
    short_faced, long_faced = (np.isfinite(np.min(faced[:, sides], axis=1)) for sides in ([0, 2], [1, 3]))
    kerbside = np.asarray(~short_faced & long_faced)
    by = np.where(np.asarray(short_faced | long_faced)[:, None], faced, distance)
    side = np.where(kerbside, 1 + 2 * by[:, [1, 3]].argmin(axis=1), 2 * by[:, [0, 2]].argmin(axis=1))

    row = np.arange(len(polygons))
    mouthward = outward[row, side]
    # For a car with this heading the mouth is on the right, for the opposite heading on the left.
    along = np.stack([-mouthward[:, 1], mouthward[:, 0]], axis=1)
    with_lane = (along * tangent.reshape(middle.shape)[row, side]).sum(axis=1) > 0.0
    on_right = oneway.reshape(side_length.shape)[row, side] & with_lane
    heading = np.where(kerbside[:, None], np.where(on_right[:, None], along, -along), -mouthward)
    return Slots(
        xy=center,
        yaw=np.arctan2(heading[:, 1], heading[:, 0]),
        length=2 * half[:, 0],
        width=2 * half[:, 1],
        mouth=np.where(kerbside, np.where(on_right, Mouth.RIGHT, Mouth.LEFT), Mouth.REAR).astype(np.int8),
    )


def nearest_on_lanes(lanes: Sequence[Lane], xy: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the lane point nearest to each, (n, 2) m, or itself, the lane's direction, and whether it is one-way."""
    if not lanes or not len(xy):
        return xy, np.zeros_like(xy), np.zeros(len(xy), dtype=bool)
    start = np.concatenate([lane.points[:-1] for lane in lanes])
    step = np.concatenate([np.diff(lane.points, axis=0) for lane in lanes])
    oneway = np.repeat([lane.oneway for lane in lanes], [len(lane.points) - 1 for lane in lanes])
    tree = shapely.STRtree(np.asarray(shapely.linestrings(np.stack([start, start + step], axis=1))))
    leg = np.asarray(tree.nearest(np.asarray(shapely.points(xy))))
    start, step, oneway = start[leg], step[leg], oneway[leg]
    share = ((xy - start) * step).sum(axis=1) / (step**2).sum(axis=1)
    nearest = start + np.clip(share, 0.0, 1.0)[:, None] * step
    return nearest, step / np.hypot(step[:, 0], step[:, 1])[:, None], oneway
