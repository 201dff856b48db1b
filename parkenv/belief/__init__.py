"""What the car knows of the slots: forecast, observations, decay."""
