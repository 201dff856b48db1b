"""Throughput benchmarks of each part against peers."""
