"""The method written out plainly: dictionaries, loops and float64, one voxel at a time.

Shares no code with the package, so that agreement of the two means something. Slow by design.
"""
