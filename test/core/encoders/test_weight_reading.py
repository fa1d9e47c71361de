"""What weight files hold: tensors come back, all else is refused in which words, and nothing of it runs."""

from __future__ import annotations

import argparse
import io
import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from fus3dmaps_core.encoders.weights import WeightFile, fit, read_state, saying_what_to_get
from fus3dmaps_core.errors import EncoderError

PUBLISHED = WeightFile(
    title="Some model (v2)",
    file_name="model.pt",
    url="http://127.0.0.1:9/model.pt",
    hub="",
    revision="",
    sha256="",
    licence="MIT",
)


def tensors() -> dict[str, torch.Tensor]:
    return {"weight": torch.arange(6.0).reshape(2, 3), "bias": torch.ones(2)}


def saved() -> bytes:
    buffer = io.BytesIO()
    torch.save(tensors(), buffer)
    return buffer.getvalue()


@pytest.mark.parametrize(
    "wrap",
    [
        lambda state: state,
        lambda state: {"epoch": 3, "model_state_dict": state},
        lambda state: {"state_dict": {f"module.{name}": value for name, value in state.items()}},
        lambda state: {"args": argparse.Namespace(rate=0.1, name="a"), "state_dict": state},
    ],
)
def test_tensors_come_back_from_what_torch_saves(tmp_path, wrap):
    torch.save(wrap(tensors()), tmp_path / "a.pt")
    state = read_state(tmp_path / "a.pt")
    assert state.keys() == tensors().keys()
    assert all(torch.equal(state[name], value) for name, value in tensors().items())


def test_tensors_come_back_from_safetensors(tmp_path):
    save_file(tensors(), tmp_path / "a.safetensors")
    state = read_state(tmp_path / "a.safetensors")
    assert all(torch.equal(state[name], value) for name, value in tensors().items())


class Harmful:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.parametrize("write", [torch.save, lambda value, path: path.write_bytes(pickle.dumps(value, 2))])
def test_a_file_with_code_in_it_is_refused_and_does_not_run(tmp_path, write):
    write({"weight": torch.ones(1), "x": Harmful(tmp_path / "ran")}, tmp_path / "bad.pt")
    with pytest.raises(EncoderError, match=r"bad\.pt'.*not loaded") as refusal:
        read_state(tmp_path / "bad.pt")
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_torchs_advice_to_run_what_a_file_holds_is_not_passed_on(tmp_path, protocol, recwarn):
    path = tmp_path / "bad.pt"
    path.write_bytes(pickle.dumps({"weight": torch.ones(1), "x": Harmful(tmp_path / "ran")}, protocol))
    with pytest.raises(EncoderError, match=r"Python objects.*not loaded") as refusal:
        read_state(path)
    for torchs in ("weights_only", "can still be loaded", "trust"):
        assert torchs not in str(refusal.value)
    assert not recwarn.list


def test_the_python_object_is_named(tmp_path):
    torch.save({"x": argparse.FileType()}, tmp_path / "bad.pt")
    with pytest.raises(
        EncoderError, match=r"bad\.pt': the file holds Python objects \(argparse\.FileType\), which are not loaded"
    ):
        read_state(tmp_path / "bad.pt")


@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch.jit")
def test_a_torchscript_program_is_refused_without_torchs_advice(tmp_path, recwarn):
    torch.jit.trace(nn.Linear(2, 2), torch.ones(1, 2)).save(str(tmp_path / "a.pt"))
    recwarn.clear()
    with pytest.raises(EncoderError, match=r"a\.pt': the file holds a TorchScript program, which is not loaded") as refusal:
        read_state(tmp_path / "a.pt")
    assert "weights_only" not in str(refusal.value)
    assert not recwarn.list


@pytest.mark.parametrize("name", ["a.pt", "a.safetensors"])
@pytest.mark.parametrize("damage", [lambda data: data[: len(data) // 2], lambda _: b"", lambda _: b"<html>log in</html>"])
def test_a_damaged_file_is_refused_in_one_line(tmp_path, name, damage):
    path = tmp_path / name
    if path.suffix == ".pt":
        torch.save({"weight": torch.ones(1000)}, path)
    else:
        save_file({"weight": torch.ones(1000)}, path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(EncoderError, match="not a weight file") as refusal:
        read_state(path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("content", [[torch.ones(1)], {"epoch": 3}, {}, 3.0])
def test_a_file_without_named_tensors_is_refused(tmp_path, content):
    torch.save(content, tmp_path / "a.pt")
    with pytest.raises(EncoderError, match=r"a\.pt'.*no named tensors"):
        read_state(tmp_path / "a.pt")


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(EncoderError, match=r"none\.pt"):
        read_state(tmp_path / "none.pt")


def test_weights_that_fit_are_copied():
    module = nn.Linear(3, 2)
    fit(module, tensors(), "weights 'a.pt'")
    assert torch.equal(module.weight, tensors()["weight"])
    assert torch.equal(module.bias, tensors()["bias"])


def test_another_architecture_is_refused_by_the_names_that_differ():
    module = nn.Linear(4, 2)
    before = {name: value.clone() for name, value in module.state_dict().items()}
    state = {"weight": torch.zeros(2, 3), **{f"extra{index}": torch.zeros(1) for index in range(9)}}
    with pytest.raises(EncoderError) as refusal:
        fit(module, state, "weights 'a.pt'")
    message = str(refusal.value)
    for part in ("weights 'a.pt'", "1 missing (bias)", "9 not expected (extra0, extra1, extra2, ...)", "(2, 3), not (2, 4)"):
        assert part in message
    assert "\n" not in message
    assert all(torch.equal(module.state_dict()[name], value) for name, value in before.items())


def test_a_graph_is_not_weights(tmp_path):
    (tmp_path / "a.onnx").write_bytes(b"\x08\x08")
    with pytest.raises(EncoderError, match=r"a\.onnx': an ONNX graph"):
        read_state(tmp_path / "a.onnx")


def test_another_architecture_is_refused_with_what_to_get():
    with pytest.raises(EncoderError) as refusal, saying_what_to_get("encoder.weights", PUBLISHED):
        fit(nn.Linear(4, 2), tensors(), "weights 'a.pt'")
    for part in ("weights 'a.pt'", "(2, 3), not (2, 4)", f"download {PUBLISHED.url}", str(PUBLISHED.cached_path)):
        assert part in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_other_errors_and_no_errors_pass():
    with saying_what_to_get("encoder.weights", PUBLISHED):
        fit(nn.Linear(3, 2), tensors(), "weights 'a.pt'")
    with pytest.raises(KeyError), saying_what_to_get("encoder.weights", PUBLISHED):
        raise KeyError
