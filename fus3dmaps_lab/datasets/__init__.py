"""Readers of published datasets: posed frames with their labels, each dataset in its own folder layout."""
