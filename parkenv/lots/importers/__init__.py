"""Import lots of real places: OpenStreetMap files and lists of slots."""
