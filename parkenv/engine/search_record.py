"""The record of a search: what was known, decided and seen, for tables, pictures, films, replays and logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import SlotBelief
from parkenv.world.occupancy.process import Arrival, World
from parkenv.world.scenario import Scenario

if TYPE_CHECKING:
    from parkenv.perception.pipeline import PerceptionResult


class Moment(NamedTuple):
    """The arrival, or the end of a step."""

    time: float  # s since Monday 00:00
    vertex: int  # where the car is
    belief: SlotBelief  # what it knows
    action: int = -1  # that led here
    plan: Sequence[int] = ()  # the vertices that the agent intended to drive along when it chose the action
    info: Mapping[str, Any] = {}  # `info` of the step
    captures: Sequence[PerceptionResult] = ()  # what simulated sensors have seen on the way


@dataclass
class SearchRecord:
    """One search."""

    scenario: Scenario
    agent: str
    seed: int
    arrival: Arrival
    world: World  # the true occupancy
    path: list[int]  # vertices in the order driven, the entry first
    occupied: NDArray[np.bool_]  # (n_slots,) bool, the true occupancy at the arrival
    forecast: NDArray[np.float64]  # (n_slots,) float64, the occupancy forecast at the arrival
    # (n_vertices,) int64, the plan at the first decision; None for agents without a policy
    policy: NDArray[np.int64] | None
    metrics: Mapping[str, Any]  # `info` at the end of the episode, and the number of replans
    truncated: bool  # whether the step limit ended the search
    bound_s: float  # clairvoyant lower bound of the total time, s
    decision_s: Sequence[float]  # wall time of each decision, s
    moments: Sequence[Moment] = ()  # the arrival and each step, if they are kept

    @property
    def slot(self) -> str:
        return self.scenario.lot.slot_ids[self.path[-1]] if self.metrics["parked"] else ""

    @property
    def row(self) -> dict[str, Any]:
        """The row of `episodes.csv`, without the columns that identify agent and setting, and without wall times."""
        return {
            "seed": self.seed,
            "day": self.arrival.day,
            "arrival_s": round(self.arrival.time, 3),
            "occupancy": float(self.occupied.mean()),
            "slot": self.slot,
            **self.metrics,
            "steps": len(self.decision_s),
            "truncated": self.truncated,
            "bound_s": self.bound_s,
        }
