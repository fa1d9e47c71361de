"""The page on map files says what the code writes."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
from core.saved_maps.saved_maps import ARRAYS, INFO, array_file, filled_map
from reference.variants import DTYPES

from fus3dmaps_core.config.schema import fields
from fus3dmaps_core.saved_maps.directory import MAX_NAME_BYTES
from fus3dmaps_core.saved_maps.manifest import DIGITS_IN_NAME, FORMAT, ArrayFile, Manifest
from fus3dmaps_core.saved_maps.storage import FORMAT_VERSION, SavedMap, save_map

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "map_files.md").read_text()
JSON_TYPES = {"string": str, "integer": int, "number": float, "object": dict}


def table(heading: str) -> list[list[str]]:
    """Cells of the rows of the table under a heading, without back quotes."""
    section = PAGE.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (`\w+` .*)\|$", section, re.MULTILINE)
    return [[cell.strip().strip("`") for cell in row.split(" | ")] for row in rows]


@pytest.fixture(scope="module", params=DTYPES)
def saved(request, tmp_path_factory) -> Path:
    directory = tmp_path_factory.mktemp("format") / "m"
    save_map(directory, SavedMap(filled_map(np.random.default_rng(6), request.param), INFO))
    return directory


def test_the_manifest_has_the_keys_of_the_page_in_this_order(saved: Path):
    manifest = json.loads((saved / "manifest.json").read_text())
    assert [row[0] for row in table("Manifest")] == list(manifest) == list(Manifest.model_fields)
    for key, kind, *_ in table("Manifest"):
        assert isinstance(manifest[key], JSON_TYPES[kind]), key
    assert manifest["config"].keys() == fields().keys()
    for name, entry in manifest["arrays"].items():
        assert list(entry) == list(ArrayFile.model_fields), name
        assert all(f"`{key}`" in PAGE for key in entry)


def test_version_format_and_limits_are_those_of_the_page(saved: Path):
    manifest = json.loads((saved / "manifest.json").read_text())
    assert f"Format version: {FORMAT_VERSION}." in PAGE
    assert f"always `{FORMAT}`" in PAGE
    assert (manifest["format"], manifest["version"]) == (FORMAT, FORMAT_VERSION)
    assert f"first {DIGITS_IN_NAME} digits" in PAGE
    assert f"at most {MAX_NAME_BYTES} bytes" in PAGE


def test_arrays_have_the_dtypes_and_shapes_of_the_page(saved: Path):
    manifest = json.loads((saved / "manifest.json").read_text())
    rows = {name: (dtypes, shape) for name, dtypes, shape, *_ in table("Arrays")}
    assert rows.keys() == {*ARRAYS, "dense_scale"}
    assert manifest["arrays"].keys() | {"dense_scale"} == rows.keys()
    dtype = manifest["arrays"]["dense_embedding"]["dtype"]
    assert ("dense_scale" in manifest["arrays"]) == (dtype == "int8")

    sizes = {"d": 6, "K": 3, "3": 3, "4": 4}
    for name, entry in manifest["arrays"].items():
        array = np.load(array_file(saved, name), allow_pickle=False)
        dtypes, shape = rows[name]
        assert str(array.dtype) in re.split(", | or ", dtypes), name
        symbols = [symbol for symbol in shape.strip("()").split(", ") if symbol]
        assert len(symbols) == array.ndim, name
        for symbol, size in zip(symbols, array.shape, strict=True):
            assert sizes.setdefault(symbol, size) == size, (name, symbol)
        assert (entry["dtype"], entry["shape"]) == (str(array.dtype), list(array.shape))
    assert set(sizes) == {"n", "m", "i", "k", "d", "K", "3", "4"}


def test_checksums_are_computed_as_the_page_says(saved: Path):
    content = (saved / "manifest.json").read_bytes()
    manifest = json.loads(content)
    blank = content.replace(manifest["sha256"].encode(), b"0" * 64)
    assert hashlib.sha256(blank).hexdigest() == manifest["sha256"]
    for name, entry in manifest["arrays"].items():
        file = (saved / f"{name}.{entry['sha256'][:16]}.npy").read_bytes()
        assert (hashlib.sha256(file).hexdigest(), len(file)) == (entry["sha256"], entry["size_bytes"])


def test_the_embeddings_mean_what_the_page_says():
    assert re.search(r"`dense_scale` .* only with int8: factor of each row's values", PAGE)
    # Rows are unit vectors where a voxel was seen once from one patch, whatever the storage type.
    for dtype, tolerance in (("float32", 1e-6), ("float16", 1e-3), ("int8", 1e-2)):
        semantic_map = filled_map(np.random.default_rng(6), dtype, frames=1)
        state = semantic_map.export_state()
        values = state["dense_embedding"].astype(np.float64)
        if "dense_scale" in state:
            values *= state["dense_scale"][:, None]
        once = state["dense_weight"] == 1
        assert once.any()
        np.testing.assert_allclose(np.linalg.norm(values[once], axis=1), 1, atol=tolerance)
