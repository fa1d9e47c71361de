"""Stand-in for RADIO's code, where the real one is not on this machine: the same shape of network, under the same names."""
