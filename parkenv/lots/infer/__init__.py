"""Infer rows, aisles, lanes and entries from the rectangles of parking spaces."""
