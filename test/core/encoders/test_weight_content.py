"""What a look at a file's ends tells: whole files pass, and wherever a file of tensors was cut short, it is told."""

from __future__ import annotations

import hashlib
import io
import subprocess

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import save

from fus3dmaps_core.encoders.weight_content import TORCH_SUFFIXES, content_problem, hash_problem


def zipped() -> bytes:
    buffer = io.BytesIO()
    torch.save({"weight": torch.arange(40.0)}, buffer)
    return buffer.getvalue()


WHOLE = {"a.safetensors": save({"weight": torch.arange(40.0)}), **{f"a{suffix}": zipped() for suffix in TORCH_SUFFIXES}}


@pytest.mark.parametrize("name", WHOLE)
def test_whole_files_pass(tmp_path, name):
    (tmp_path / name).write_bytes(WHOLE[name])
    assert content_problem(tmp_path / name) == ""


@pytest.mark.parametrize("name", ["a.safetensors", "a.pt"])
@given(data=st.data())
def test_wherever_a_file_is_cut_it_is_told(tmp_path_factory, name, data):
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(WHOLE[name][: data.draw(st.integers(0, len(WHOLE[name]) - 1))])
    assert content_problem(path)


@given(content=st.binary(max_size=600), at=st.integers(0, 599))
def test_hashes_are_the_ones_of_sha256sum_and_of_git(tmp_path_factory, content, at):
    path = tmp_path_factory.getbasetemp() / "hashed"
    path.write_bytes(content)
    sha256 = hashlib.sha256(content).hexdigest()
    blob = hashlib.sha1(b"blob %d\0%b" % (len(content), content)).hexdigest()
    assert hash_problem(path, sha256, blob) == hash_problem(path, sha256, "") == hash_problem(path, "", blob) == ""
    changed = content[:at] + b"x" + content[at:]
    path.write_bytes(changed)
    assert hash_problem(path, sha256, "").endswith(f"its sha256 is {hashlib.sha256(changed).hexdigest()}, not {sha256}")
    assert blob in hash_problem(path, "", blob)


def test_a_blobs_name_is_gits(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(WHOLE["a.pt"])
    named = subprocess.run(["git", "hash-object", str(path)], capture_output=True, text=True, check=True).stdout.strip()
    assert hash_problem(path, "", named) == ""
