"""The laboratory: datasets, simulation and evaluation. It imports the core; the core never imports it."""
