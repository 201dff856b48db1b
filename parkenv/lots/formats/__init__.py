"""Files of lots: native GeoJSON, the Dragon Lake map, lists of slot centres."""
