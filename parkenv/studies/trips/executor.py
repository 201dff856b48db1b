"""What passes between a search on the drive graph and the car that executes its decisions."""

from __future__ import annotations

from typing import NamedTuple

from parkenv.compiled.arrays import FloatArray

ALONG, TURN, ROUND, ACROSS = "along", "turn", "round", "across"
OBSERVED, UNOBSERVED = "observed", "unobserved"
"""Whether the agent observes slots from the lane, in the column `slots` of trips."""
EDGE_KINDS = (ALONG, TURN, ROUND, ACROSS)
"""Kinds of edges: straight on; with a turn into another lane; with a U-turn; across a two-way lane, where the car turns
round only if it drives on afterwards, not if it parks."""
TAKEN, NO_ROOM, NO_WAY = "taken", "too narrow", "no way in"  # reasons of failed attempts


class Leg(NamedTuple):
    """A driven edge: its kind, its length in the graph, m, and its duration, s."""

    kind: str
    graph_m: float
    seconds: float


class ParkingAttempt(NamedTuple):
    """An attempt to park."""

    slot: str
    kind: str  # orientation of the slot to its lane
    way: str  # nose-in or back-in; empty for parallel slots and if no path was found
    seconds: float  # from the decision until the car stands in the slot, or is back on the lane
    reason: str  # reason of the failure; empty if the car parked
    # distance of the car on the lane beyond the slot's vertex after a failed attempt, m; this part of the next edges
    # is already driven
    onward_m: float = 0.0


class TrackPoint(NamedTuple):
    """Positions of the car and all road users at one time."""

    time: float  # s since Monday 00:00
    driven_m: float  # distance driven so far, m
    pose: FloatArray  # (3,) x, y in m, yaw in rad, of the middle of the car's footprint
    clocks: FloatArray  # (n,) s, clocks of the moving road users, see `RoadUsers`
