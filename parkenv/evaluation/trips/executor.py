"""The interface of what carries out the decisions of a driven search."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from parkenv.world.occupancy import World

if TYPE_CHECKING:
    from sim_sensors.movers import Movers

FloatArray = NDArray[np.float64]

ALONG, TURN, ROUND, ACROSS = "along", "turn", "round", "across"
EDGE_KINDS = (ALONG, TURN, ROUND, ACROSS)
"""Kinds of edges by how they are driven: straight on; with a turn into another lane; with a turn-around; across a
two-way lane, where the car turns round only when it drives on, not to park."""
TAKEN, NO_ROOM, NO_WAY = "taken", "too narrow", "no way in"
"""Reasons of failed attempts."""


class Leg(NamedTuple):
    """A driven edge: its kind, its length in the graph, m, and its duration, s."""

    kind: str
    graph_m: float
    seconds: float


class ParkingAttempt(NamedTuple):
    """An attempt to park.

    Attributes:
        slot: its name.
        kind: how it lies to its lane.
        way: nose-in or back-in; empty where no path was found, and for parallel slots.
        seconds: from the decision until the car stands in the slot, or is back on the lane.
        reason: of the failure; empty where the car is parked.
        onward_m: m, how far beyond the slot's vertex the car is on the lane after a failed attempt: that much of the
            next edges is driven already.
    """

    slot: str
    kind: str
    way: str
    seconds: float
    reason: str
    onward_m: float = 0.0


class TrackPoint(NamedTuple):
    """Where the car and all road users were at a time.

    Attributes:
        time: s since Monday 00:00.
        driven_m: m driven so far.
        pose: (3,) x, y in m, yaw in rad, of the middle of the car's footprint.
        clocks: (n,) s, of the moving road users, see `RoadUsers`.
    """

    time: float
    driven_m: float
    pose: FloatArray
    clocks: FloatArray


class MotionExecutor(Protocol):
    """Carries out decisions on the drive graph, and reports how long they took.

    Attributes:
        track: where the car has been since the last decision, every 0.1 s; empty where no time passed, or without a
            car.
    """

    track: list[TrackPoint]

    def begin(self, key: np.uint64, world: World, vertex: int, time: float) -> None:
        """Start at a vertex at a time, s, in the world of a key."""

    def drive(self, source: int, column: int) -> float:
        """Drive along an edge; returns s."""

    def park(self, slot: int, taken: bool) -> ParkingAttempt:
        """Try to park; a taken slot looks free until the car notices."""

    def wait(self, seconds: float) -> float:
        """Stand still; returns s."""

    def movers_at(self, point: TrackPoint) -> Movers | None:
        """Return the road users at the time of a track point; None without traffic."""
