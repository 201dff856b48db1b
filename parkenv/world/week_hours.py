"""Hours of the scenario's week, for compiled code."""

import numpy as np

from parkenv.compiled.jit import compiled
from parkenv.world.week import HOUR_S, WEEK_HOURS, WEEK_S


@compiled(error_model="numpy")
def hour_of_week(time: float) -> tuple[float, int, float]:
    """Return week, hour of the week and second of the hour of a time, s since Monday 00:00."""
    week = np.floor(time / WEEK_S)
    second = time - week * WEEK_S
    hour = min(int(second // HOUR_S), WEEK_HOURS - 1)
    return week, hour, second - hour * HOUR_S
