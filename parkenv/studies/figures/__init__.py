"""Figures for commands and reports."""
