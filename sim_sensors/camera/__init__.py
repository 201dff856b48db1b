"""Pinhole and stereo cameras: projection, rasterizer, shading, weather, image sensor."""
