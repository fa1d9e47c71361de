"""Open-vocabulary 3D mapping: one voxel map, a dense and an instance layer, and their fusion. Imports no ROS."""

import os

__version__ = "0.1.0"

# Idle OpenMP threads spin for milliseconds by default. Beside SLAM or any other load they take the cores from the very
# threads they wait for, and inference on the CPU becomes several times slower; a short spin costs next to nothing on an idle
# machine. Read when torch is first imported, hence here. Whatever the user has set stands.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
