"""Curves: search time, walk, failed attempts and refusals of each zone as functions of occupancy and demand."""
