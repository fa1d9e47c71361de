"""Packages that are missing or broken are refused by the parameter that needs them."""

from __future__ import annotations

import sys

import pytest

from fus3dmaps_core.encoders.optional_packages import EXTRA, import_optional
from fus3dmaps_core.errors import EncoderError


@pytest.mark.parametrize("kind", ["encoder", "segmenter"])
def test_a_missing_package_is_named_with_the_parameter_that_needs_it(kind):
    with pytest.raises(EncoderError) as refusal:
        import_optional("no_such_package.part", "some", kind)
    assert str(refusal.value) == (
        f"parameter '{kind}.name': {kind} 'some' needs 'no_such_package', which is not installed; use {EXTRA}"
    )


def test_a_package_that_does_not_fit_is_refused_in_one_line(tmp_path, monkeypatch):
    (tmp_path / "misfit.py").write_text("raise RuntimeError('operator nms does not exist\\nlong story')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(EncoderError) as refusal:
        import_optional("misfit", "some")
    assert str(refusal.value).startswith("parameter 'encoder.name': encoder 'some': cannot import 'misfit' (operator nms")
    assert "\n" not in str(refusal.value)


def test_a_module_that_is_there_is_imported():
    assert import_optional("json.decoder", "some") is sys.modules["json.decoder"]
