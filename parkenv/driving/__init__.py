"""Driving for real: the car, what it may run into, and the tasks of getting it into a slot."""
