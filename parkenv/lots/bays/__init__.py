"""A city's register of bays: its file, its rules, and its bays as slots at the kerbs of streets."""
