"""How far a whole day differs from its forecast, on the logit scale.

On a day with level L ~ N(0, level²) and slope S ~ N(0, slope²), slot i is taken with the probability
`sigmoid(centre_i + L + S·nearness_i)`. The centre is chosen such that the mean over days is the forecast p_i:
`centre_i = centred_logits(p_i, sqrt(level² + (slope·nearness_i)²))`.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ConfigDict, Field

from parkenv.compiled.arrays import FloatArray
from parkenv.files.field_types import NotNegative, Validated

MAX_LOGITS = 5.0  # largest standard deviation of a level or slope; days then are almost empty or almost full
Deviation = Annotated[NotNegative, Field(le=MAX_LOGITS)]


@dataclass(frozen=True)
class DayError(Validated):
    """Standard deviations over days of a forecast's error, logits."""

    __pydantic_config__ = ConfigDict(extra="forbid", strict=False)  # as a table of a scenario file

    level: Deviation = 0.0  # of the shift of all slots at once
    # of the additional rise from the middle of the lot to the goal, with a fall of the same size to the far end; see
    # `nearness`
    slope: Deviation = 0.0

    def __bool__(self) -> bool:
        return self.level > 0.0 or self.slope > 0.0

    def deviations(self, nearness: ArrayLike) -> FloatArray:
        """(n,) standard deviation of each slot's logit over days; `nearness` is (n,), from -1 to 1."""
        return np.hypot(self.level, self.slope * np.asarray(nearness, np.float64))


EXACT = DayError()  # the day error of a forecast that is right on every day


def nearness(walk: ArrayLike) -> FloatArray:
    """Rank slots by their walk to the goal, (n,), in any unit: from 1, the nearest, to -1, the farthest."""
    rank = np.argsort(np.argsort(walk, kind="stable"), kind="stable")
    return np.asarray(1.0 - 2.0 * rank / max(rank.size - 1, 1))
