"""Planning in belief space: the path with the least expected total time."""
