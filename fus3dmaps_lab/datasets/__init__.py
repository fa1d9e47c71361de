"""Published datasets, each in its own folder layout, as posed frames with their labels."""
