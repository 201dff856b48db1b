"""Planning in belief space: the path of the least expected total time."""
