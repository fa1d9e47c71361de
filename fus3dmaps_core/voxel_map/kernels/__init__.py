"""The inner loops of the map, once in plain torch for any device and once compiled for the CPU."""
