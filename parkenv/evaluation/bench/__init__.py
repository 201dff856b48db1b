"""Throughput of every part beside its peers."""
