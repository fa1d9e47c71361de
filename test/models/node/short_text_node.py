"""The mapper as a process of its own, as anyone starts it but for the depth of SigLIP's text towers."""

from __future__ import annotations

import sys

from weights_cache import shorten_text_towers

from fus3dmaps_ros.mapper_node import main

if __name__ == "__main__":
    shorten_text_towers()
    sys.exit(main())
