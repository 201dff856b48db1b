"""Parametric vehicles: bodies, cabins, parts."""
