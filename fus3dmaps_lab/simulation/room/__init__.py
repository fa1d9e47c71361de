"""A furnished room with photographs on its walls."""
