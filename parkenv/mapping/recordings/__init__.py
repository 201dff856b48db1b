"""Recorded drives of real cars: readers that yield timed captures and poses, and the map of a drive."""
