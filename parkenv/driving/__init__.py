"""Vehicle dynamics: the car, the obstacles around it, other road users, and tasks of parking in a slot."""
