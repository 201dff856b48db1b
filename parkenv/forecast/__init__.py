"""Forecasting models: arrays of days, hours and slots in, logits with standard deviations out."""
