"""Scenario files (TOML) and the packaged scenarios."""
