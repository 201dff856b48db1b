"""Time within the scenario's week."""

import numpy as np

from parkenv.compiled.jit import compiled

HOUR_S = 3600.0
DAY_S = 86_400.0
WEEK_S = 604_800.0
WEEK_HOURS = 168
DAY_HOURS = 24
PERIOD_S = 1800.0  # resolution of forecasts from recorded days
DAY_PERIODS = 48


@compiled(error_model="numpy")
def hour_of_week(time: float) -> tuple[float, int, float]:
    """Return week, hour of the week and second of the hour of a time, s since Monday 00:00."""
    week = np.floor(time / WEEK_S)
    second = time - week * WEEK_S
    hour = min(int(second // HOUR_S), WEEK_HOURS - 1)
    return week, hour, second - hour * HOUR_S
