"""The ``fus3dmaps`` command, its sub-commands and the client."""
