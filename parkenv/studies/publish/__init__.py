"""Publishing trained models: their results beside planners, a film, and a model card."""
