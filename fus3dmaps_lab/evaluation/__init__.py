"""Evaluation of maps: protocol, metrics, experiments and their report."""
