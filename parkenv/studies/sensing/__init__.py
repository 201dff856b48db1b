"""Surveys, detector studies and fits of sensor models."""
