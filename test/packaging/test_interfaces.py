"""The interfaces in the environment are those that clients of the mapper are promised."""

from __future__ import annotations

import re

import pytest

from fus3dmaps_msgs.msg import SemanticInstance
from fus3dmaps_msgs.srv import Fuse, QueryText

PROMISED = {
    SemanticInstance: {
        "header": "std_msgs/Header",
        "id": "uint32",
        "prompt": "string",
        "score": "float",
        "weight": "float",
        "centroid": "geometry_msgs/Point",
        "box_min": "geometry_msgs/Point",
        "box_max": "geometry_msgs/Point",
        "voxels": "uint32",
    },
    QueryText.Request: {
        "prompts": "sequence<string>",
        "negative_prompts": "sequence<string>",
        "layer": "string",
        "threshold": "float",
        "top_k": "uint32",
        "publish": "boolean",
    },
    QueryText.Response: {
        "success": "boolean",
        "message": "string",
        "instances": "sequence<fus3dmaps_msgs/SemanticInstance>",
        "similarity": "sensor_msgs/PointCloud2",
    },
    Fuse.Request: {},
    Fuse.Response: {
        "success": "boolean",
        "message": "string",
        "instances": "uint32",
        "updated": "uint32",
        "voxels": "uint32",
        "duration": "builtin_interfaces/Duration",
    },
}


@pytest.mark.parametrize("interface", PROMISED, ids=lambda interface: interface.__name__)
def test_fields_are_those_promised(interface):
    assert interface.get_fields_and_field_types() == PROMISED[interface]


def test_every_interface_file_is_built_and_every_field_explained(root):
    build = (root / "fus3dmaps_msgs" / "CMakeLists.txt").read_text()
    files = [*(root / "fus3dmaps_msgs").rglob("*.msg"), *(root / "fus3dmaps_msgs").rglob("*.srv")]
    assert len(files) == 3
    for path in files:
        assert f'"{path.relative_to(root / "fus3dmaps_msgs").as_posix()}"' in build
        explained = False
        for line in path.read_text().splitlines():
            if re.match(r"[a-zA-Z]", line):
                assert explained, f"{path.name}: nothing explains {line!r}"
            explained = line.startswith("#") or (explained and bool(line.strip()) and line != "---")
