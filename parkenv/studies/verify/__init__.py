"""Closed forms for parking searches, compared with the package's planners and worlds."""
