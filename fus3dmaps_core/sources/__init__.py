"""Sources of posed frames: recordings, datasets and simulated scenes."""
