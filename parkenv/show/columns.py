"""Columns of result rows that figures and pages know."""

from __future__ import annotations

SETTING_AXES = ("failure_cost_s", "v_walk_kmh", "v_drive_kmh")
"""Columns of a setting of costs and speeds."""
