"""What a town should do: prices, limits, permits, guidance and capacity for an aim."""
