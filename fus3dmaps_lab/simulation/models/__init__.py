"""Simulated encoders and a simulated segmenter: they know the ground truth and err with stated statistics."""
