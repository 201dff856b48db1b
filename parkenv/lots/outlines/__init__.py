"""Lots from the outlines of parking spaces alone: rows, aisles, connections, entries and goals are inferred."""
