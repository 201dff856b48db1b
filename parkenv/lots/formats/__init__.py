"""Files of lots: native GeoJSON and what is in it."""
