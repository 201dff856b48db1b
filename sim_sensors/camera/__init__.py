"""The camera: projection, rasteriser, shading, weather, image sensor."""
