"""Benchmark suites: fixed scenarios, seeds and metrics."""
