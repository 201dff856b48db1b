"""Figures, made of plain rows, lots and values (Matplotlib)."""
