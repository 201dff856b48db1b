"""Agents compared: episodes, statistics, result folders and pictures."""
