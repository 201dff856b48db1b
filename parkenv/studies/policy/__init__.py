"""Search for a town's policy: prices, limits, permits, guidance and capacity for given aims."""
