"""Columns of result rows that figures and pages know: settings, learning curves."""

from __future__ import annotations

SETTING_AXES = ("failure_cost_s", "v_walk_kmh", "v_drive_kmh")
"""Columns of a setting of costs and speeds."""


def columns_of(measure: str) -> tuple[str, str, str]:
    """Return the column names of the interval's ends and the median of a measure."""
    unit = "_s" if measure.endswith("_s") else ""
    return f"low{unit}", f"high{unit}", f"median{unit}"
