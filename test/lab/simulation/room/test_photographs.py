import numpy as np
import pytest

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_lab.simulation.room import photographs


@pytest.mark.parametrize("name", photographs.FILES)
def test_every_photograph_is_in_the_wheel(name):
    image = photographs.photograph(name)
    assert image.dtype == np.uint8
    assert image.shape[2] == 3
    assert min(image.shape[:2]) >= 300
    assert image.std() > 20


def test_the_espresso_is_red_not_blue():
    red, _, blue = photographs.photograph("coffee").mean(axis=(0, 1))
    assert red > blue + 50


def test_a_missing_package_or_file_is_named(monkeypatch):
    monkeypatch.setitem(photographs.FILES, "cat", "no_such_file.png")
    with pytest.raises(RecordingError, match=r"no_such_file\.png"):
        photographs.photograph("cat")
    monkeypatch.setattr(photographs, "find_spec", lambda name: None)
    with pytest.raises(RecordingError, match="'scikit-image', which is not installed"):
        photographs.photograph("cat")
