"""Training of parking agents for `parkenv/Drive-v1`."""
