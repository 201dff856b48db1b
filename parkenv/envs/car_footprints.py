"""The footprints of parked cars in a batch of searches, compiled: one scan plane per search, changed car by car.

They are those of `LotScenes`: equal worlds have equal cars in equal poses, to rounding.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled import numpy_streams
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from sim_sensors.laser.footprints import FAR, LANES, Cells, ScanPlane
from sim_sensors.slot_scenes import NOSE_GAP_M, SlotLot

plain = compiled(error_model="numpy", _nrt=False)


class CarLibrary(NamedTuple):
    """What a car depends on that is parked in a slot, and the places of the slots in a table of obstacles.

    Attributes:
        seed: seed of the lot's cars.
        slots: (n_slots, 6) float64: x, y in m, yaw in rad, length, width in m, 1 for a kerbside slot.
        fit_start, fit: the models that fit slot s are `fit[fit_start[s]:fit_start[s + 1]]`.
        size: (n_models, 2) float64, m, length and width.
        manners: (4,) float64: standard deviations across, along (m), of the heading (rad); fraction in reverse.
        outline: (n_models, k, 2) float64, m, corners from their centre, vehicle frame; the last one is repeated.
        circle: (n_models, 3) float64, m, that centre and the radius around it.
        place: (n_slots,) int64, place of each slot's car in the table.
    """

    seed: int
    slots: FloatArray
    fit_start: IntArray
    fit: IntArray
    size: FloatArray
    manners: FloatArray
    outline: FloatArray
    circle: FloatArray
    place: IntArray

    @classmethod
    def of(cls, lot: SlotLot) -> tuple[Self, Cells, Cells]:
        """Return the library of a lot, and its obstacles: those with up to four corners, and the others, without cars.

        In the second table every slot has a place, in the cell of its own middle.
        """
        xy, fitting = np.asarray(lot.slot_xy), lot.fitting
        columns = [np.asarray(getattr(lot, name)) for name in ("slot_yaw", "slot_length", "slot_width")]
        full = lot.scene(np.ones(len(xy), dtype=np.bool_))
        outlines, counts = ScanPlane(*lot.fleet.outlines).footprints
        k = full.scan_plane.cells[1].k
        last = np.minimum(np.arange(k), counts[:, None] - 1)
        used = np.arange(outlines.shape[1]) < counts[:, None]
        centre = (outlines * used[..., None]).sum(axis=1) / counts[:, None]
        relative = np.take_along_axis(outlines, last[..., None], axis=1) - centre[:, None]
        radius = np.hypot(relative[..., 0], relative[..., 1]).max(axis=1)
        quads, others, place = full.scan_plane.without_footprints(len(xy))
        manners = lot.manners
        library = cls(
            int(lot.seed),
            np.column_stack([xy, *columns, np.asarray(lot.kerbside, dtype=np.float64)]),
            np.cumsum([0, *map(len, fitting)]),
            np.concatenate(fitting).astype(np.int64),
            np.ascontiguousarray(lot.fleet.sizes[:, :2]),
            np.array([manners.lateral_m, manners.along_m, manners.yaw_rad, manners.nose_out]),
            np.ascontiguousarray(relative),
            np.column_stack([centre, radius]),
            place,
        )
        return library, quads, others


class Scratch(NamedTuple):
    """Work arrays of the functions below."""

    words: NDArray[np.uint32]
    pool: NDArray[np.uint32]
    state: NDArray[np.uint64]
    car: FloatArray  # (3,) x, y, yaw


@plain
def draw_car(library: CarLibrary, slot: int, number: int, work: Scratch) -> int:
    """Write the pose of an arrival into `work.car` and return its model, as `SlotLot.arrival` does."""
    n = numpy_streams.append_words(work.words, 0, np.uint64(library.seed))
    n = numpy_streams.append_words(work.words, n, np.uint64(slot))
    n = numpy_streams.append_words(work.words, n, np.uint64(number))
    numpy_streams.fill_pool(work.words, n, work.pool)
    numpy_streams.start(work.pool, work.state)
    first = library.fit_start[slot]
    model = library.fit[first + numpy_streams.integer_below(work.state, library.fit_start[slot + 1] - first)]
    side = min(max(numpy_streams.normal(work.state), -3.0), 3.0)
    along = min(max(numpy_streams.normal(work.state), -3.0), 3.0)
    turn = min(max(numpy_streams.normal(work.state), -3.0), 3.0) * library.manners[2]
    x, y, yaw = library.slots[slot, 0], library.slots[slot, 1], library.slots[slot, 2]
    reverse = numpy_streams.unit(work.state) < library.manners[3] and library.slots[slot, 5] == 0.0
    length, width = library.size[model, 0], library.size[model, 1]
    broad = width * math.cos(turn) + length * abs(math.sin(turn))
    long = length * math.cos(turn) + width * abs(math.sin(turn))
    room = max(0.5 * (library.slots[slot, 4] - broad), 0.0)
    side = min(max(side * library.manners[0], -room), room)
    ahead = 0.5 * (library.slots[slot, 3] - long) - NOSE_GAP_M
    along = min(max(along * library.manners[1], -abs(ahead)), ahead)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    work.car[0] = x + along * cosine - side * sine
    work.car[1] = y + along * sine + side * cosine
    work.car[2] = yaw + turn + (math.pi if reverse else 0.0)
    return int(model)


@plain
def put_car(
    library: CarLibrary,
    slot: int,
    model: int,
    car: FloatArray,
    corners: NDArray[np.float32],
    x: FloatArray,
    y: FloatArray,
    radius: NDArray[np.float32],
) -> None:
    """Write the footprint of a slot's car into a table of obstacles."""
    place = library.place[slot]
    cosine, sine = math.cos(car[2]), math.sin(car[2])
    from_x, from_y = library.circle[model, 0], library.circle[model, 1]
    x[place] = car[0] + cosine * from_x - sine * from_y
    y[place] = car[1] + sine * from_x + cosine * from_y
    radius[place] = library.circle[model, 2]
    k = library.outline.shape[1]
    base = place // LANES * (k * 2 * LANES) + place % LANES
    for i in range(k):
        out_x, out_y = library.outline[model, i, 0], library.outline[model, i, 1]
        corners[base + 2 * i * LANES] = cosine * out_x - sine * out_y
        corners[base + (2 * i + 1) * LANES] = sine * out_x + cosine * out_y


@plain
def remove_car(library: CarLibrary, slot: int, x: FloatArray, y: FloatArray) -> None:
    """Remove the footprint of a slot's car from a table of obstacles."""
    x[library.place[slot]] = y[library.place[slot]] = FAR
