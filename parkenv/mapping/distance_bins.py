"""Bins of distance in which detections of a survey are counted; tables are read without the survey itself."""

from __future__ import annotations

DISTANCE_ENDS = (4.0, 6.0, 8.0, 10.0, 12.0, 15.0)
"""m, from the camera to a car's centre: upper ends of the bins in which detections are counted."""
