"""Planning and tracking the motion of the car."""
