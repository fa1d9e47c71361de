"""A process that forks savers on request, so that tests can kill them; started by tests, as a script.

Its argument is a .npz file for each content that a map may have. On each line of its input, a JSON object ``{"directory",
"first", "count", "savers", "file_limit_bytes"}``, it forks that many savers. Each saves ``count`` maps, number n with the
content n modulo the number of contents and the stamp n, and prints ``PID saving N``, then ``PID saved N`` or ``PID refused N
MESSAGE``. When all have ended, ``ended`` is printed.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from pathlib import Path

import numpy as np

from fus3dmaps_core.config.schema import Config, MapConfig
from fus3dmaps_core.errors import StorageError
from fus3dmaps_core.saved_maps.storage import MapInfo, SavedMap, save_map
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap


def say(line: str) -> None:
    os.write(1, f"{os.getpid()} {line}\n".encode())


def save_on(contents: list[dict[str, np.ndarray]], request: dict) -> None:
    """What a saver does, after the fork and with threads of nobody."""
    maps = []
    for state in contents:
        semantic_map = SemanticMap(6, MapConfig(backend="torch"), 2.0)
        semantic_map.import_state(state)
        maps.append(semantic_map)
    if request["file_limit_bytes"]:
        resource.setrlimit(resource.RLIMIT_FSIZE, (request["file_limit_bytes"],) * 2)
    for number in range(request["first"], request["first"] + request["count"]):
        info = MapInfo("lite", 1.0, "map", number, Config(), np.tile(np.eye(4) * number, (1 + number % 3, 1, 1)))
        say(f"saving {number}")
        try:
            save_map(Path(request["directory"]), SavedMap(maps[number % len(maps)], info))
        except StorageError as error:
            say(f"refused {number} {error}")
        else:
            say(f"saved {number}")


def main() -> None:
    contents = [dict(np.load(path)) for path in sys.argv[1:]]
    for line in sys.stdin:
        request = json.loads(line)
        savers = []
        for _ in range(request["savers"]):
            saver = os.fork()
            if not saver:
                try:
                    save_on(contents, request)
                finally:
                    os._exit(0)
            savers.append(saver)
        for saver in savers:
            os.waitpid(saver, 0)
        os.write(1, b"ended\n")


if __name__ == "__main__":
    main()
