"""Driving in a lot: vehicle model, obstacles, other road users, and parking tasks."""
