"""The mapper as a process of its own, as anyone starts it but for random weights."""

from __future__ import annotations

import sys

from weights_cache import expect_random_weights

from fus3dmaps_ros.mapper_node import main

if __name__ == "__main__":
    expect_random_weights()
    sys.exit(main())
