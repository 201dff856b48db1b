"""What the simulated sensors raise."""


class SensorError(ValueError):
    """A scene, a sensor or a pose that cannot be simulated as it was given."""
