"""Tensors that grow: columns, and pools of embedding rows in the precision of choice."""
