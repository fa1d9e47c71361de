"""Plain buildings of many rooms whose every surface is labelled."""
