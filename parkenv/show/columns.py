"""Columns of result rows that figures and pages know: settings, parts of the total time, learning curves."""

from __future__ import annotations

SETTING_AXES = ("failure_cost_s", "v_walk_kmh", "v_drive_kmh")
"""Columns of a setting of costs and speeds."""
TIME_COLORS = {
    "drive_s": ("drive", "#0072b2"),
    "failed_s": ("failed attempts", "#d55e00"),
    "walk_s": ("walk", "#a6cfe8"),
    "parking_cost_s": ("parking cost", "#cc79a7"),
    "gave_up_s": ("give-up penalty", "#8c8c8c"),
}
"""Names and colours of the parts of the total time."""
OPTIONAL_TIMES = ("parking_cost_s", "gave_up_s")
"""Parts that are shown only if they are not 0."""


def columns_of(measure: str) -> tuple[str, str, str]:
    """Return the column names of the interval's ends and the median of a measure."""
    unit = "_s" if measure.endswith("_s") else ""
    return f"low{unit}", f"high{unit}", f"median{unit}"
