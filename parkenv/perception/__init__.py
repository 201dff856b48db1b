"""Detect cars in images and measure their distance (T §3.2)."""
