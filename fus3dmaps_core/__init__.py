"""Open-vocabulary 3D mapping: one voxel map, a dense and an instance layer, and their fusion. Imports no ROS."""

import os

__version__ = "0.1.0"

# Idle OpenMP threads spin by default. Beside SLAM or any other load they take the cores from the threads they wait for, and
# inference on the CPU becomes several times slower. Read when torch is first imported, hence here; the user's own setting
# stands.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
