"""A simulated furnished room with real photographs on its walls."""
