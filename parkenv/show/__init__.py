"""Pictures of lots, cars and searches."""
