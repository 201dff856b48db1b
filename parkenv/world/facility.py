"""Facilities: kerbs, car parks and garages that group slots, or that are counted instead of drawn."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, require_one_of
from parkenv.files.field_types import Name, NotNegative, Number, Validated, Whole
from parkenv.world.drive_graph import GraphError, GraphProblem, nearest_legs


class FacilityKind(NamedTuple):
    """What a kind of facility usually is, where a map does not say."""

    color: str  # in pictures
    gate_s: float = 0.0  # of a counted one, as in `Facility`
    inside_s: tuple[float, float] = (10.0, 30.0)
    known: str = "nothing"


FACILITY_KINDS = {
    "kerb": FacilityKind("#4477aa"),
    "lot": FacilityKind("#228833"),
    "garage": FacilityKind("#aa3377", gate_s=10.0, inside_s=(30.0, 120.0), known="sign"),
}
# What drivers know of a facility: what they find out by trying; a full sign in view; a live count everywhere.
KNOWN = ("nothing", "sign", "live")
FACILITY_REACH = 150.0  # greatest distance, m, of a counted facility's point from its lane
NOMINAL_SLOT = (5.0, 2.5)  # length and width, m, of the one slot that stands for a counted facility
KERB_DISTANCE = 3.0  # m, from the centre line of the lane to that slot


def _two_numbers(value: Any) -> Any:
    return tuple(value) if isinstance(value, list | np.ndarray) else value


@dataclass(frozen=True)
class Facility(Validated):
    """A kerb, a car park or a garage.

    It groups the slots of a lot that name it or, with a capacity, it is *counted*: one slot of the lot, at the lane
    nearest to its point, that is taken while the facility is full.
    """

    name: Annotated[Name, Field(min_length=1)]  # its name; of a counted one, also the id of its slot
    kind: str = "lot"  # `kerb`, `lot` (a car park) or `garage`
    zone: Name = ""  # zone of its slots that name none; empty: none
    # number of cars of a counted facility; 0: it groups drawn slots
    capacity: Annotated[Whole, Field(le=1_000_000)] = 0
    # m, where a counted facility is entered and people begin to walk
    xy: Annotated[tuple[Number, Number], BeforeValidator(_two_numbers)] | None = None
    # s that the barrier of a counted facility takes for each car; cars wait for each other
    gate_s: NotNegative = 0.0
    # s from the barrier to a space when a counted facility is empty and when it is full; linear between
    inside_s: Annotated[tuple[NotNegative, NotNegative], BeforeValidator(_two_numbers)] = (0.0, 0.0)
    known: str = "nothing"  # what drivers know of it: `nothing`, `sign` or `live`
    delay_s: NotNegative = 0.0  # s by which a live count lags behind

    def __post_init__(self) -> None:
        super().__post_init__()
        require_one_of("type", self.kind, FACILITY_KINDS)
        require_one_of("known", self.known, KNOWN)
        if self.is_counted and self.xy is None:
            raise InputError("xy is None, want where the counted facility is entered")

    @property
    def is_counted(self) -> bool:
        return self.capacity > 0


def nominal_slots(
    facilities: Sequence[Facility], lanes: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return centres, (n, 2) m, and yaws, (n,) rad, of the slots of counted facilities: beside the nearest lane.

    A slot stands at right angles to its lane, on the side of the facility's point, and is entered from its rear. A
    facility out of reach of all lanes is a GraphError.
    """
    legs = np.concatenate([np.stack([points[:-1], points[1:]], axis=1) for points in lanes])
    counted = [i for i, facility in enumerate(facilities) if facility.is_counted]
    points = np.array([facilities[i].xy for i in counted])
    leg, distance = nearest_legs(legs, points)
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
    assert facility.xy is not None
    return GraphProblem("facility", index, f"{facility.name!r:.40} {reason}", facility.xy)
