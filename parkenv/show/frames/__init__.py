"""Frames of environments from above, for videos and windows: searches, manoeuvres and fleets."""
