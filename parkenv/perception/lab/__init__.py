"""The laboratory of detectors: training, test sets and scores; nothing of it runs in a car."""
