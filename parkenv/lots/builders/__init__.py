"""Programs that developers run to make the packaged data."""
