"""Scenario files: what a search takes place in, as TOML, and the packaged scenarios."""
