"""The trace of one search, from which its pictures are drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.world.scenario import Scenario


@dataclass
class SearchTrace:
    """Trace of one search, for pictures."""

    scenario: Scenario
    agent: str
    path: list[int]  # vertices in the order driven, the entry first
    occupied: NDArray[np.bool_]  # (n_slots,) bool, the true occupancy at the arrival
    forecast: NDArray[np.float64]  # (n_slots,) float64, the occupancy forecast at the arrival
    # (n_vertices,) int64, the plan at the first decision; None for agents without a policy
    policy: NDArray[np.int64] | None
    metrics: dict[str, Any]  # `info` at the end of the episode
