"""Vision-language encoders: Protocols, a registry and one module or folder per trio."""
