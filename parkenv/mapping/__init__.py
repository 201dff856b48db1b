"""Maps of what stands where and how often, from drives past all slots (T §3.3)."""
