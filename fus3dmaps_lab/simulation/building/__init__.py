"""Simulated buildings of many rooms, made of boxes, with a label for every surface."""
