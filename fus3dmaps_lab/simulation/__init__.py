"""Simulated places: textured scenes, a renderer, camera paths and a depth sensor's noise."""
