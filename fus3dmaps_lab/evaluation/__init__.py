"""How good a map is: protocol, metrics, experiments and their report."""
