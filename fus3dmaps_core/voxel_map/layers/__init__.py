"""The dense layer, the instance layer and their fusion."""
