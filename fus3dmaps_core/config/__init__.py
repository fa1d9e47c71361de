"""Parameters: one schema, with units, ranges and words."""
