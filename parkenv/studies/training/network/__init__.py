"""Training of the agent `network`."""
