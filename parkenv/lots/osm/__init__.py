"""Import lots from OpenStreetMap."""
