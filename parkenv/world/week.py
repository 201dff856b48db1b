"""Time within the scenario's week."""

HOUR_S = 3600.0
DAY_S = 86_400.0
WEEK_S = 604_800.0
WEEK_HOURS = 168
DAY_HOURS = 24
PERIOD_S = 1800.0  # resolution of forecasts from recorded days
DAY_PERIODS = 48
