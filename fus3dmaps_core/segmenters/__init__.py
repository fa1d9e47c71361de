"""Class-agnostic segmenters: a Protocol, a registry and one module per method."""
