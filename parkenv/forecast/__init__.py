"""Forecasts of how full car parks are, which state how sure they are: counts, models of days, scores."""
