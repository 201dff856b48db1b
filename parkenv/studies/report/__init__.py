"""A self-contained HTML page on the results of a command, with replays of its searches and drives."""
