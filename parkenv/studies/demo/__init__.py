"""The demo: a survey, and searches on other days with its map."""
