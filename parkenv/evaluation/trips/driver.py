"""Who carries out the decisions of a search: what a driver does and tells, and the driver that knows only the graph."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from parkenv.world.occupancy import World
from parkenv.world.scenario import Scenario

if TYPE_CHECKING:
    from sim_sensors.movers import Movers

FloatArray = NDArray[np.float64]

ALONG, TURN, ROUND, ACROSS = "along", "turn", "round", "across"
EDGE_KINDS = (ALONG, TURN, ROUND, ACROSS)
"""Edges of the graph as they are driven: straight on; with a turn into another lane; with turning round; and across a
two-way lane, for which the car turns round only when it drives on from there, and not at all to park."""
TAKEN, NO_ROOM, NO_WAY = "taken", "too narrow", "no way in"
"""Why a slot was left again."""


class Leg(NamedTuple):
    """An edge of the graph as it was driven: its kind, its length in the graph, m, and what it took, s."""

    kind: str
    graph_m: float
    seconds: float


class Try(NamedTuple):
    """A try to park.

    Attributes:
        slot: its name.
        kind: how it lies to its lane.
        way: nose-in or back-in; empty where no way was found, and of parallel slots.
        seconds: from the decision until the car stands in the slot, or is back on the lane.
        reason: why it was left again; empty where the car is parked.
        onward_m: how far on from the slot's vertex the car is on the lane after a try that failed, m: that much of the
            next edges is driven already.
    """

    slot: str
    kind: str
    way: str
    seconds: float
    reason: str
    onward_m: float = 0.0


class Spot(NamedTuple):
    """Where the car was, and everybody else.

    Attributes:
        time: s since Monday 00:00.
        driven_m: m that it had driven.
        pose: (3,) x, y in m, yaw in rad, of its footprint's middle.
        clocks: (n,) s, of those who move, as `RoadUsers` has it.
    """

    time: float
    driven_m: float
    pose: FloatArray
    clocks: FloatArray


class Driver(Protocol):
    """Who carries out what is decided on the drive graph, and says how long that took.

    Attributes:
        track: where the car has been since the last decision, every 0.1 s; empty if it has not moved on in time, or if
            there is no car.
    """

    track: list[Spot]

    def begin(self, key: np.uint64, world: World, vertex: int, time: float) -> None:
        """Start at a vertex at a time, s, in the world of a key."""

    def drive(self, source: int, column: int) -> float:
        """Drive along an edge; s."""

    def park(self, slot: int, taken: bool) -> Try:
        """Try to park; a slot that is taken looks free until the car notices."""

    def wait(self, seconds: float) -> float:
        """Stay where it is; s."""

    def movers_at(self, spot: Spot) -> Movers | None:
        """Who else was where when the car was at a spot; None where nobody is about."""


class GraphDriver:
    """Drives as the graph has it: every edge at the speed limit, parking at once.

    Args:
        scenario: whose graph, speed and failure cost it is.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self.track: list[Spot] = []

    def begin(self, key: np.uint64, world: World, vertex: int, time: float) -> None:
        """Nothing to prepare."""

    def drive(self, source: int, column: int) -> float:
        """The edge's time, s."""
        return float(self._scenario.move_s[source, column])

    def park(self, slot: int, taken: bool) -> Try:
        """Parked at once, or the scenario's failure cost."""
        name = self._scenario.lot.slot_ids[slot]
        return Try(name, "", "", self._scenario.failure_s if taken else 0.0, TAKEN if taken else "")

    def wait(self, seconds: float) -> float:
        """As long as that, s."""
        return seconds

    def movers_at(self, spot: Spot) -> Movers | None:
        """Nobody."""
        del spot
        return None
