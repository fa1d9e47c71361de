"""The interfaces in the environment are those that clients of the mapper are promised."""

from __future__ import annotations

import re

import pytest

from fus3dmaps_msgs.msg import MapperStatus, SemanticInstance
from fus3dmaps_msgs.srv import Fuse, LabelMap, ListInstances, LoadMap, QueryImage, QueryText, SaveMap

PROMISED = {
    MapperStatus: {
        "header": "std_msgs/Header",
        "state": "string",
        "encoder": "string",
        "segmenter": "string",
        "topics": "sequence<string>",
        "rates_hz": "sequence<float>",
        "frames": "uint64",
        "not_keyframes": "uint64",
        "dense_keyframes": "uint64",
        "instance_keyframes": "uint64",
        "drop_reasons": "sequence<string>",
        "drop_counts": "sequence<uint64>",
        "queue_depth": "uint32",
        "queue_size": "uint32",
        "stages": "sequence<string>",
        "stage_mean_ms": "sequence<float>",
        "stage_max_ms": "sequence<float>",
        "voxels": "uint64",
        "dense_voxels": "uint64",
        "instances": "uint32",
        "parts": "sequence<string>",
        "part_bytes": "sequence<uint64>",
        "memory_budget_bytes": "uint64",
        "gpu_bytes": "uint64",
        "autosaves": "uint64",
        "failed_autosaves": "uint64",
        "problems": "sequence<string>",
    },
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
    QueryImage.Request: {
        "image": "sensor_msgs/Image",
        "negative_prompts": "sequence<string>",
        "layer": "string",
        "threshold": "float",
        "top_k": "uint32",
        "publish": "boolean",
    },
    QueryImage.Response: {
        "success": "boolean",
        "message": "string",
        "instances": "sequence<fus3dmaps_msgs/SemanticInstance>",
        "similarity": "sensor_msgs/PointCloud2",
    },
    LabelMap.Request: {"labels": "sequence<string>", "layer": "string", "publish": "boolean"},
    LabelMap.Response: {"success": "boolean", "message": "string", "cloud": "sensor_msgs/PointCloud2"},
    ListInstances.Request: {"min_voxels": "uint32"},
    ListInstances.Response: {
        "success": "boolean",
        "message": "string",
        "instances": "sequence<fus3dmaps_msgs/SemanticInstance>",
    },
    SaveMap.Request: {"name": "string"},
    SaveMap.Response: {"success": "boolean", "message": "string", "path": "string", "bytes": "uint64"},
    LoadMap.Request: {"name": "string"},
    LoadMap.Response: {"success": "boolean", "message": "string", "voxels": "uint64", "instances": "uint32"},
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
    assert len(files) == 9
    for path in files:
        assert f'"{path.relative_to(root / "fus3dmaps_msgs").as_posix()}"' in build
        explained = False
        for line in path.read_text().splitlines():
            if re.match(r"[a-zA-Z]", line):
                assert explained, f"{path.name}: nothing explains {line!r}"
            explained = line.startswith("#") or (explained and bool(line.strip()) and line != "---")
