"""Encoders and a segmenter with stated statistics, which know the simulated truth."""
