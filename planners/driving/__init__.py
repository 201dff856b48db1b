"""Motion planning and path tracking for the car."""
