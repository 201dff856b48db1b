"""Whole trips with a driven car: executing a plan, calibration, sensor logs."""
