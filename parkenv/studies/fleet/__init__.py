"""Experiments with many cars in one lot: settings, days, measures, summary."""
