"""Bounds on the performance of any agent: the clairvoyant bound, the oracle, and an information relaxation."""
