"""The world: lot, drive graph, occupancy, sensor model, scenario."""
