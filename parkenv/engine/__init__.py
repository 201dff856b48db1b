"""The searches of one car and of many: records and compiled kernels."""
