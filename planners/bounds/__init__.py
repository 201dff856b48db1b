"""Bounds on the performance of any agent: the clairvoyant oracle, and exact solutions for small lots."""
