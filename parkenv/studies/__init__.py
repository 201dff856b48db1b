"""Studies: runs of agents, trips, surveys and trainings, with their results."""
