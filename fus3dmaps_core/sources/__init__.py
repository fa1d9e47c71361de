"""Sources of posed frames: recordings and simulated scenes; datasets become recordings."""
