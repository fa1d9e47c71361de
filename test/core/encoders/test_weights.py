"""Weight files: where they are looked for, and which are refused in which words."""

from __future__ import annotations

import functools
import hashlib
import http.server
import io
import socket
import threading
from pathlib import Path

import pytest
import torch
from safetensors.torch import save, save_file

from fus3dmaps_core.encoders.weights import (
    WeightFile,
    cache_directory,
    find_weights,
    locate,
    read_state,
)
from fus3dmaps_core.errors import EncoderError

CONTENT = b"what the authors published"
PUBLISHED = WeightFile(
    title="Some model (v2)",
    file_name="model.pt",
    url="http://127.0.0.1:9/model.pt",  # A port that nobody listens on.
    hub="",
    revision="",
    sha256=hashlib.sha256(CONTENT).hexdigest(),
    licence="MIT",
)


@pytest.fixture(autouse=True)
def own_caches(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    for name in ("http_proxy", "https_proxy", "all_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def server(tmp_path):
    """Serve the files of a folder at an address of this machine."""
    folder = tmp_path / "published"
    folder.mkdir()
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield folder, f"http://127.0.0.1:{running.server_port}"
        running.shutdown()
        thread.join()


def changed(**values: str) -> WeightFile:
    return WeightFile(**{**vars(PUBLISHED), **values})


def tensors() -> dict[str, torch.Tensor]:
    return {"weight": torch.arange(6.0).reshape(2, 3), "bias": torch.ones(2)}


def saved() -> bytes:
    buffer = io.BytesIO()
    torch.save(tensors(), buffer)
    return buffer.getvalue()


def put_into_hub_cache(root: Path, repository: str, commit: str, name: str, content: bytes) -> None:
    folder = root / "hub" / f"models--{repository.replace('/', '--')}"
    (folder / "snapshots" / commit).mkdir(parents=True)
    (folder / "snapshots" / commit / name).write_bytes(content)
    (folder / "refs").mkdir(parents=True)
    (folder / "refs" / "main").write_text(commit)


def test_a_path_is_the_file_or_the_directory_that_holds_it(tmp_path):
    path = tmp_path / "model.pt"
    path.write_bytes(CONTENT)
    assert find_weights("encoder.weights", str(path), PUBLISHED) == path
    assert find_weights("encoder.weights", str(tmp_path), PUBLISHED) == path


def test_a_file_of_ones_own_under_another_name_is_not_held_to_the_hash(tmp_path):
    path = tmp_path / "tuned.pt"
    path.write_bytes(saved())
    assert find_weights("encoder.weights", str(path), PUBLISHED) == path


@pytest.mark.parametrize("published", ["model.pt", "model.pth.tar"])
def test_a_directory_may_hold_a_converted_file(tmp_path, published):
    path = tmp_path / "model.safetensors"
    save_file(tensors(), path)
    assert find_weights("encoder.weights", str(tmp_path), changed(file_name=published)) == path


def test_an_altered_file_is_refused_with_where_to_get_it(tmp_path):
    (tmp_path / "model.pt").write_bytes(CONTENT[:-1])
    with pytest.raises(EncoderError) as refusal:
        find_weights("encoder.weights", str(tmp_path), PUBLISHED)
    message = str(refusal.value)
    for part in ("encoder.weights", str(tmp_path / "model.pt"), "sha256", PUBLISHED.sha256, PUBLISHED.url):
        assert part in message
    assert "\n" not in message


def test_a_file_of_a_git_repository_is_held_to_its_name_there(tmp_path):
    path = tmp_path / "model.pt"
    path.write_bytes(b"hello\n")
    file = changed(sha256="", git_blob="ce013625030ba8dba906f756967f9e9ca394464a")  # As `git hash-object` prints it.
    assert find_weights("encoder.weights", str(path), file) == path
    path.write_bytes(b"hallo\n")
    with pytest.raises(EncoderError, match="its git blob is"):
        find_weights("encoder.weights", str(path), file)


@pytest.mark.parametrize(
    "value", ["/no/such/model.pt", "models/model.pt", "model.safetensors", "./x", "~nobody_here/x", "x" * 5000]
)
def test_a_path_that_is_not_there_is_named(value):
    with pytest.raises(EncoderError, match="no file or directory") as refusal:
        find_weights("encoder.weights", value, PUBLISHED)
    assert value in str(refusal.value)
    assert PUBLISHED.url in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_directory_without_the_file_is_named(tmp_path):
    with pytest.raises(EncoderError, match=r"has no 'model\.pt'.*download http"):
        find_weights("encoder.weights", str(tmp_path), PUBLISHED)


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"
PAGE = b"\n<!DOCTYPE html><html>log in</html>"


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        *((name, b"", "is empty") for name in ("a.pt", "a.safetensors", "a.onnx", "tokenizer.json")),
        *((name, POINTER, "pointer of Git LFS") for name in ("a.pt", "a.safetensors", "a.onnx", "tokenizer.json")),
        *((name, PAGE, "web page") for name in ("a.pt", "a.safetensors", "a.onnx", "tokenizer.json")),
        ("a.pt", saved()[:-30], "cut short"),
        ("a.pth.tar", saved()[:100], "cut short"),
        ("a.bin", b"something", "not a weight file"),
        ("a.safetensors", save(tensors())[:-1], "cut short"),
        ("a.safetensors", save(tensors())[:20], "cut short"),
        ("a.safetensors", b"\0" * 3, "cut short"),
        ("a.safetensors", saved(), "not a weight file"),
        ("tokenizer.json", b'{"model": {"a"', "cut short"),
        ("tokenizer.json", b"[1]", "not a JSON object"),
    ],
)
def test_what_cannot_be_the_file_is_refused_with_where_to_get_it(tmp_path, name, content, said):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(EncoderError, match=said) as refusal:
        find_weights("encoder.weights", str(path), PUBLISHED)
    for part in ("encoder.weights", str(path), PUBLISHED.url, str(PUBLISHED.cached_path)):
        assert part in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("name", ["a.pt", "a.pth.tar", "a.ckpt"])
@pytest.mark.parametrize("layout", [{}, {"_use_new_zipfile_serialization": False}])
def test_both_layouts_of_torch_pass_the_look_at_their_ends(tmp_path, name, layout):
    torch.save(tensors(), tmp_path / name, **layout)
    assert find_weights("encoder.weights", str(tmp_path / name), PUBLISHED) == tmp_path / name
    assert read_state(tmp_path / name).keys() == tensors().keys()


@pytest.mark.parametrize(
    ("name", "content"), [("tokenizer.json", b' {"a": 1}\n'), ("a.onnx", b"\x08\x08"), ("a.engine", b"x")]
)
def test_files_of_other_kinds_are_left_to_who_reads_them(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    assert find_weights("encoder.weights", str(tmp_path / name), PUBLISHED) == tmp_path / name


def test_what_is_neither_a_file_nor_a_directory_is_said_to_be():
    with pytest.raises(EncoderError, match=r"'/dev/null' is neither a file nor a directory; download"):
        find_weights("encoder.weights", "/dev/null", PUBLISHED)


@pytest.mark.parametrize("value", ["a\0b", "-x/y", "a--b/c", "a/b..c", "a/b/c", "a/b@", "a b/c"])
def test_what_is_no_name_of_a_repository_is_taken_for_a_path(value):
    with pytest.raises(EncoderError, match="no file or directory"):
        find_weights("encoder.weights", value, PUBLISHED)
    assert locate(value, PUBLISHED) is None


def deny(monkeypatch, method: str, denied: Path) -> None:
    """Refuse as another user's files do; a test may run as root, whom nothing is denied."""
    whole = getattr(Path, method)

    def refusing(path, *arguments, **options):
        if path == denied:
            raise PermissionError(13, "Permission denied", str(path))
        return whole(path, *arguments, **options)

    monkeypatch.setattr(Path, method, refusing)


@pytest.mark.parametrize("value", [".", "model.pt"])
@pytest.mark.parametrize(("method", "there"), [("is_file", False), ("open", True)])
def test_what_may_not_be_read_is_refused_in_one_line(tmp_path, monkeypatch, value, method, there):
    (tmp_path / "model.pt").write_bytes(CONTENT)
    deny(monkeypatch, method, tmp_path / "model.pt")
    with pytest.raises(EncoderError, match=r"Permission denied.*model\.pt'; download http") as refusal:
        find_weights("encoder.weights", str(tmp_path / value), PUBLISHED)
    assert "\n" not in str(refusal.value)
    assert (locate(str(tmp_path / value), PUBLISHED) is not None) == there  # What it holds is not looked at.


def test_an_own_cache_that_may_not_be_written_is_named(monkeypatch, server):
    folder, address = server
    (folder / "model.pt").write_bytes(CONTENT)
    file = changed(url=f"{address}/model.pt")
    deny(monkeypatch, "mkdir", file.cached_path.parent)
    with pytest.raises(EncoderError, match=r"cannot be downloaded \(.*Permission denied") as refusal:
        find_weights("encoder.weights", "", file)
    assert "\n" not in str(refusal.value)


def test_an_empty_file_in_the_own_cache_is_downloaded_anew(server):
    folder, address = server
    (folder / "model.pt").write_bytes(CONTENT)
    file = changed(url=f"{address}/model.pt")
    file.cached_path.parent.mkdir(parents=True)
    file.cached_path.touch()
    assert locate("", file) is None
    assert find_weights("encoder.weights", "", file).read_bytes() == CONTENT


def test_an_empty_file_in_the_hubs_cache_is_passed_over(tmp_path):
    on_hub = changed(hub="some/model", revision="c" * 40)
    put_into_hub_cache(tmp_path, "some/model", "c" * 40, "model.pt", b"")
    assert locate("", on_hub) is None
    on_hub.cached_path.parent.mkdir(parents=True)
    on_hub.cached_path.write_bytes(CONTENT)
    assert locate("", on_hub) == on_hub.cached_path == find_weights("encoder.weights", "", on_hub)


def test_a_hub_that_does_not_answer_is_given_up_soon(monkeypatch):
    asked = []

    def no_answer(address, timeout):
        asked.append((address, timeout))
        raise TimeoutError("timed out")

    monkeypatch.setattr(socket, "create_connection", no_answer)
    with pytest.raises(EncoderError, match=r"'mine/model' is no directory here.*timed out.*download http"):
        find_weights("encoder.weights", "mine/model", PUBLISHED)
    assert asked == [(("huggingface.co", 443), 5.0)]


@pytest.mark.parametrize("value", ["", "model.pt", ".", "some/model", "mine/model", "mine/model@main", "/no/such"])
def test_a_file_is_located_where_it_would_be_found(tmp_path, monkeypatch, value):
    monkeypatch.chdir(tmp_path)
    on_hub = changed(hub="some/model", sha256="")

    def found() -> Path | None:
        try:
            return find_weights("encoder.weights", value, on_hub)
        except EncoderError:
            return None

    assert locate(value, on_hub) == found() is None
    (tmp_path / "model.pt").write_bytes(saved())
    for repository in ("some/model", "mine/model"):
        put_into_hub_cache(tmp_path, repository, "c" * 40, "model.pt", saved())
    assert locate(value, on_hub) == found()
    assert (found() is None) == (value == "/no/such")


def test_without_a_value_the_own_cache_is_looked_at(tmp_path):
    assert cache_directory() == tmp_path / "cache" / "fus3dmaps"
    assert PUBLISHED.cached_path == tmp_path / "cache/fus3dmaps/some-model-v2/model.pt"
    PUBLISHED.cached_path.parent.mkdir(parents=True)
    PUBLISHED.cached_path.write_bytes(CONTENT)
    assert find_weights("encoder.weights", "", PUBLISHED) == PUBLISHED.cached_path


def test_without_a_value_the_hubs_cache_is_looked_at(tmp_path):
    put_into_hub_cache(tmp_path, "some/model", "c" * 40, "model.pt", CONTENT)
    on_hub = changed(hub="some/model", revision="c" * 40)
    for value in ("", "some/model", f"some/model@{'c' * 40}"):
        assert find_weights("encoder.weights", value, on_hub).read_bytes() == CONTENT


def test_another_repository_is_not_held_to_the_hash(tmp_path):
    put_into_hub_cache(tmp_path, "mine/model", "d" * 40, "model.pt", saved())
    for value in ("mine/model", "mine/model@main", f"mine/model@{'d' * 40}"):
        assert find_weights("encoder.weights", value, changed(hub="some/model")).name == "model.pt"


def test_what_is_nowhere_and_cannot_be_fetched_says_what_to_do():
    with pytest.raises(EncoderError, match="cannot be downloaded") as refusal:
        find_weights("encoder.weights", "", changed(hub="some/model"))
    message = str(refusal.value)
    for part in ("encoder.weights", "Some model (v2)", "some/model", PUBLISHED.url, str(PUBLISHED.cached_path)):
        assert part in message
    assert "\n" not in message


def test_what_may_be_a_directory_or_a_repository_is_said_to_be_neither():
    with pytest.raises(EncoderError, match=r"'my/weights' is no directory here") as refusal:
        find_weights("encoder.weights", "my/weights", PUBLISHED)
    assert "\n" not in str(refusal.value)


def test_a_file_of_the_hub_alone_is_fetched_from_there():
    with pytest.raises(EncoderError, match=r"download https://huggingface\.co/some/model/resolve/v2/model\.pt "):
        find_weights("encoder.weights", "", changed(hub="some/model", revision="v2", url=""))


def test_a_download_lands_in_the_cache_whole(server):
    folder, address = server
    (folder / "model.pt").write_bytes(CONTENT)
    file = changed(url=f"{address}/model.pt")
    assert find_weights("encoder.weights", "", file) == file.cached_path
    assert file.cached_path.read_bytes() == CONTENT
    assert list(file.cached_path.parent.iterdir()) == [file.cached_path]


def test_a_download_that_is_not_there_leaves_nothing(server):
    _, address = server
    file = changed(url=f"{address}/model.pt")
    with pytest.raises(EncoderError, match="404"):
        find_weights("encoder.weights", "", file)
    assert list(file.cached_path.parent.iterdir()) == []


def test_a_download_of_something_else_is_refused(server):
    folder, address = server
    (folder / "model.pt").write_bytes(b"a page that asks to log in")
    with pytest.raises(EncoderError, match="sha256"):
        find_weights("encoder.weights", "", changed(url=f"{address}/model.pt"))
