"""Facilities: kerbs, car parks and garages that group slots, or that are counted instead of drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, require_number, require_one_of, require_whole
from parkenv.files.file_names import is_plain
from parkenv.world.drive_graph import GraphError, GraphProblem, linestrings

FACILITY_KINDS = ("kerb", "lot", "garage")
KNOWN = ("nothing", "sign", "live")
"""What drivers know of a facility: what they find out by trying; a full sign in view; a live count everywhere."""
FACILITY_REACH = 150.0  # greatest distance, m, of a counted facility's point from its lane
NOMINAL_SLOT = (5.0, 2.5)  # length and width, m, of the one slot that stands for a counted facility
KERB_DISTANCE = 3.0  # m, from the centre line of the lane to that slot


@dataclass(frozen=True)
class Facility:
    """A kerb, a car park or a garage.

    It groups the slots of a lot that name it or, with a capacity, it is *counted*: one slot of the lot, at the lane
    nearest to its point, that is taken while the facility is full.

    Args:
        name: its name; of a counted one, also the id of its slot.
        kind: `kerb`, `lot` (a car park) or `garage`.
        zone: zone of its slots that name none; empty: none.
        capacity: number of cars of a counted facility; 0: it groups drawn slots.
        xy: m, where a counted facility is entered and people begin to walk.
        gate_s: s that the barrier of a counted facility takes for each car; cars wait for each other.
        inside_s: s from the barrier to a space when a counted facility is empty and when it is full; linear between.
        known: what drivers know of it: `nothing`, `sign` or `live`.
        delay_s: s by which a live count lags behind.
    """

    name: str
    kind: str = "lot"
    zone: str = ""
    capacity: int = 0
    xy: tuple[float, float] | None = None
    gate_s: float = 0.0
    inside_s: tuple[float, float] = (0.0, 0.0)
    known: str = "nothing"
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name or not is_plain(self.name):
            raise InputError(f"name is {self.name!a:.40}, want a text")
        require_one_of("type", self.kind, FACILITY_KINDS)
        if not isinstance(self.zone, str) or not is_plain(self.zone):
            raise InputError(f"zone is {self.zone!a:.40}, want a name")
        require_whole("capacity", self.capacity, most=1_000_000)
        if self.is_counted and self.xy is None:
            raise InputError("xy is None, want where the counted facility is entered")
        require_number("gate_s", self.gate_s, least=0.0)
        if not isinstance(self.inside_s, Sequence) or len(self.inside_s) != 2:
            raise InputError(f"inside_s is {self.inside_s!r:.40}, want two numbers: when empty, when full")
        for seconds in self.inside_s:
            require_number("inside_s", seconds, least=0.0)
        object.__setattr__(self, "inside_s", tuple(map(float, self.inside_s)))
        require_one_of("known", self.known, KNOWN)
        require_number("delay_s", self.delay_s, least=0.0)
        if self.xy is not None:
            if not isinstance(self.xy, Sequence | np.ndarray) or len(self.xy) != 2:
                raise InputError(f"xy is {self.xy!r:.40}, want two numbers, in m")
            for coordinate in self.xy:
                require_number("xy", coordinate)
            object.__setattr__(self, "xy", tuple(map(float, self.xy)))

    @property
    def is_counted(self) -> bool:
        """Whether its cars are counted, not its slots drawn."""
        return self.capacity > 0


def nominal_slots(
    facilities: Sequence[Facility], lanes: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return centres, (n, 2) m, and yaws, (n,) rad, of the slots of counted facilities: beside the nearest lane.

    A slot stands at right angles to its lane, on the side of the facility's point, and is entered from its rear.

    Args:
        facilities: those of a lot; only the counted ones have such a slot.
        lanes: (k, 2) m, centre lines.

    Raises:
        GraphError: a facility out of reach of all lanes; the message names it.
    """
    legs = np.concatenate([np.stack([points[:-1], points[1:]], axis=1) for points in lanes])
    tree = shapely.STRtree(linestrings(list(legs)))
    counted = [i for i, facility in enumerate(facilities) if facility.is_counted]
    points = np.array([facilities[i].xy for i in counted])
    (found, leg), distance = tree.query_nearest(
        shapely.points(points), all_matches=False, return_distance=True
    )
    order = np.argsort(found)
    leg, distance = leg[order], distance[order]
    far = [
        facility_problem(
            facilities[i], i, f"is {d:.0f} m from the nearest lane, want at most {FACILITY_REACH:g} m"
        )
        for i, d in zip(counted, distance.tolist(), strict=True)
        if d > FACILITY_REACH
    ]
    if far:
        raise GraphError(far)
    start, step = legs[leg, 0], legs[leg, 1] - legs[leg, 0]
    along = np.clip(((points - start) * step).sum(axis=1) / (step**2).sum(axis=1), 0.0, 1.0)
    left = np.stack([-step[:, 1], step[:, 0]], axis=1) / np.hypot(step[:, 0], step[:, 1])[:, None]
    # Right of the lane where the point is on it.
    outward = np.where(((points - start) * left).sum(axis=1) > 0.0, 1.0, -1.0)[:, None] * left
    xy = start + along[:, None] * step + (KERB_DISTANCE + NOMINAL_SLOT[0] / 2) * outward
    return xy, np.arctan2(outward[:, 1], outward[:, 0])


def facility_problem(facility: Facility, index: int, reason: str) -> GraphProblem:
    """Return what keeps cars from a counted facility, by its name."""
    assert facility.xy is not None
    return GraphProblem("facility", index, f"{facility.name!r:.40} {reason}", facility.xy)
