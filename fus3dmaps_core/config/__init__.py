"""The parameters: one schema with defaults, units, ranges and descriptions."""
