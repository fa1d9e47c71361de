"""From messages of cameras and a localisation to posed frames, live and from recordings."""
