"""The belief about the slots: forecast, observations, decay."""
