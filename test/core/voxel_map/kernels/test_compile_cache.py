"""Compiled loops come from a cache only where that is right and safe, and run without one wherever it fails."""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

pytest.importorskip("numba")

import fus3dmaps_core
from fus3dmaps_core.voxel_map.kernels import cache_folders, compile_cache
from fus3dmaps_core.voxel_map.kernels.loop_sources import source_files

KERNELS = "fus3dmaps_core.voxel_map.kernels"

# A loop in a copy of the package: it takes a constant, a function that is inlined, an intrinsic and another cached loop from
# other files, directly and through one another.
LOOP = f"""
from {KERNELS}.compile_cache import njit
from {KERNELS}.probe_parts import called, inlined, made

@njit(cache=True)
def probe(value):
    return called(value) + inlined(value) + made()
"""
PARTS = f"""
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from {KERNELS}.compile_cache import njit
from fus3dmaps_core.voxel_map.rows.probe_constants import CONSTANT

MADE = 1000

@njit(cache=True)
def called(value):
    return value + CONSTANT

@njit(inline="always")
def inlined(value):
    return 100

@intrinsic
def made(typing_context):
    def generate(context, builder, signature, arguments):
        return ir.Constant(ir.IntType(64), MADE)
    return types.int64(), generate
"""
RUN = f"""
import logging
logging.basicConfig(format="%(levelname)s %(message)s")
from {KERNELS}.numba_probe import probe
print(probe(0), sum(probe.stats.cache_hits.values()))
"""


@dataclass
class Copy:
    """A copy of the package in a folder of its own, and processes that run the loop in it."""

    folder: Path
    environment: dict[str, str] = field(default_factory=dict)

    @property
    def package(self) -> Path:
        return self.folder / "fus3dmaps_core"

    @property
    def kernels(self) -> Path:
        return self.package / "voxel_map" / "kernels"

    @property
    def beside(self) -> Path:
        """Where what Python compiles is kept beside the source."""
        return self.kernels / "__pycache__"

    def edit(self, path: str, old: str, new: str) -> None:
        text = (self.package / path).read_text()
        assert old in text
        (self.package / path).write_text(text.replace(old, new))

    def start(self) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-B", "-c", RUN],
            cwd=self.folder,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self) -> tuple[int, bool, list[str]]:
        """What the loop returns in a new process, whether it came from the cache, and lines of the log."""
        return outcome(self.start())


def outcome(process: subprocess.Popen[str]) -> tuple[int, bool, list[str]]:
    output, log = process.communicate(timeout=120)
    assert process.returncode == 0, log
    value, hits = output.split()
    return int(value), hits == "1", log.splitlines()


def files_under(folder: Path) -> list[Path]:
    """Files of machine code under a folder."""
    return sorted(folder.glob("loops-*/*.bin"))


@pytest.fixture
def copy(tmp_path) -> Copy:
    folder = tmp_path / "copy"
    source = Path(fus3dmaps_core.__file__).parent
    shutil.copytree(source, folder / source.name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("home", "temporary"):
        (tmp_path / name).mkdir(mode=0o700)
    environment = {
        "PATH": os.environ["PATH"],
        "HOME": str(tmp_path / "home"),
        "TMPDIR": str(tmp_path / "temporary"),
        "PYTHONPATH": str(folder),
    }
    made = Copy(folder, environment)
    (made.kernels / "numba_probe.py").write_text(LOOP)
    (made.kernels / "probe_parts.py").write_text(PARTS)
    (made.package / "voxel_map" / "rows" / "probe_constants.py").write_text("CONSTANT = 1\n")
    return made


def test_the_sources_of_the_real_loops_are_found_through_their_imports():
    names = {f"{path.parent.name}/{path.name}" for path in source_files()}
    loops = {f"kernels/{path.name}" for path in Path(cache_folders.__file__).parent.glob("numba_*.py")}
    assert loops | {"kernels/protocols.py", "kernels/keys.py", "rows/rounding.py", "rows/row_pool.py"} <= names
    assert "kernels/torch_kernels.py" not in names
    assert "voxel_map/semantic_map.py" not in names


def test_a_change_in_any_file_that_a_loop_is_made_of_is_never_answered_from_the_cache(copy, tmp_path):
    assert copy.run() == (1101, False, [])
    copy.edit("voxel_map/kernels/probe_parts.py", "value + CONSTANT", "value + 2 * CONSTANT")  # A loop that it calls.
    assert copy.run() == (1102, False, [])
    copy.edit("voxel_map/kernels/probe_parts.py", "return 100", "return 200")  # A function that is inlined.
    assert copy.run() == (1202, False, [])
    copy.edit("voxel_map/kernels/probe_parts.py", "MADE = 1000", "MADE = 2000")  # An intrinsic.
    assert copy.run() == (2202, False, [])
    copy.edit("voxel_map/rows/probe_constants.py", "CONSTANT = 1", "CONSTANT = 5")
    assert copy.run() == (2210, False, [])
    # What it is not made of changes nothing, nor do dates.
    copy.edit("voxel_map/semantic_map.py", "from __future__", "# changed\nfrom __future__")
    os.utime(copy.kernels / "numba_probe.py", (1, 1))
    assert copy.run() == (2210, True, [])
    copy.edit("voxel_map/rows/probe_constants.py", "CONSTANT = 5", "CONSTANT = 1")
    assert copy.run() == (2202, True, [])
    assert len(files_under(copy.beside)) == 2 * 5
    assert not any((tmp_path / "home").iterdir())


def test_without_any_folder_the_loop_is_compiled_and_one_warning_says_what_to_set(copy, tmp_path):
    for path in (copy.beside, tmp_path / "temporary" / f"fus3dmaps-{os.getuid()}"):
        path.write_text("in the way")  # Stops root too, whom no permission stops.
    copy.environment["HOME"] = str(copy.beside)
    value, cached, log = copy.run()
    assert (value, cached) == (1101, False)
    (line,) = log
    assert line.startswith("WARNING")
    assert "NUMBA_CACHE_DIR" in line


def test_processes_that_start_together_do_not_disturb_one_another(copy):
    assert {outcome(process)[0] for process in [copy.start() for _ in range(3)]} == {1101}
    assert not list(copy.beside.glob("*/*.tmp"))
    assert copy.run() == (1101, True, [])


@dataclass
class Places:
    """Every folder that this process may use, all below one."""

    folder: Path

    @property
    def beside(self) -> Path:
        return self.folder / "kernels" / "__pycache__"

    @property
    def home(self) -> Path:
        return self.folder / "home"

    @property
    def temporary(self) -> Path:
        return self.folder / "temporary" / f"fus3dmaps-{os.getuid()}"

    def is_cached(self) -> bool:
        """Call a loop as at the start of a process, and tell whether it came from the cache."""
        compile_cache._folders.cache_clear()
        loop = compile_cache.njit(cache=True)(add_one)
        assert loop(1) == 2
        return sum(loop.stats.cache_hits.values()) == 1

    def used(self) -> list[Path]:
        """The folders that hold machine code."""
        return sorted(file.parent.parent for file in self.folder.rglob("*.bin"))


def add_one(value):
    return value + 1


@pytest.fixture
def places(tmp_path, monkeypatch) -> Iterator[Places]:
    made = Places(tmp_path)
    for name in ("kernels", "home", "temporary"):
        (tmp_path / name).mkdir(mode=0o700)
    (tmp_path / "kernels" / "cache_folders.py").touch()
    monkeypatch.setattr(cache_folders, "__file__", str(tmp_path / "kernels" / "cache_folders.py"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    monkeypatch.setenv("HOME", str(made.home))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    yield made
    compile_cache._folders.cache_clear()
    compile_cache._warn_once.cache_clear()


@pytest.fixture
def blocked(places) -> Places:
    """Without room beside the source, not even for root."""
    places.beside.write_text("in the way")
    return places


def test_machine_code_is_kept_beside_the_source(places):
    assert [places.is_cached(), places.is_cached()] == [False, True]
    assert places.used() == [places.beside]


def test_where_the_source_is_read_only_the_users_cache_is_taken(blocked, monkeypatch, tmp_path):
    assert [blocked.is_cached(), blocked.is_cached()] == [False, True]
    assert blocked.used() == [blocked.home / ".cache" / "fus3dmaps"]
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "settings" / "cache"))
    assert [blocked.is_cached(), blocked.is_cached()] == [False, True]
    assert tmp_path / "settings" / "cache" / "fus3dmaps" in blocked.used()


@pytest.mark.parametrize("home", ["nowhere", "a file", "a file/below"])
def test_without_a_home_to_write_to_a_private_folder_for_temporary_files_is_taken(blocked, monkeypatch, home):
    (blocked.folder / "a file").touch()
    monkeypatch.setenv("HOME", str(blocked.folder / home))
    assert [blocked.is_cached(), blocked.is_cached()] == [False, True]
    assert blocked.used() == [blocked.temporary]
    assert blocked.temporary.stat().st_mode & 0o777 == 0o700
    assert not (blocked.folder / "nowhere").exists()


def test_a_user_without_home_or_temporary_files_is_warned_once(blocked, monkeypatch, caplog):
    def missing(*_: object) -> None:
        raise RuntimeError

    monkeypatch.setattr(Path, "home", missing)
    blocked.temporary.touch()
    assert [blocked.is_cached(), blocked.is_cached()] == [False, False]
    (record,) = caplog.records
    assert "NUMBA_CACHE_DIR" in record.getMessage()


def test_the_folder_that_the_user_names_comes_first(places, monkeypatch, tmp_path):
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "named"))
    assert [places.is_cached(), places.is_cached()] == [False, True]
    assert places.used() == [tmp_path / "named" / "fus3dmaps"]


def test_what_somebody_else_filled_is_used_where_nothing_can_be_written(places, monkeypatch, caplog):
    assert not places.is_cached()

    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(cache_folders, "make", refuse)
    assert places.is_cached()
    assert not caplog.records


def test_nothing_is_loaded_from_a_folder_that_others_can_write_to(places):
    places.is_cached()
    (file,) = files_under(places.beside)
    file.parent.chmod(0o777)
    assert [places.is_cached(), places.is_cached()] == [False, True]
    assert places.used() == [places.home / ".cache" / "fus3dmaps", places.beside]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
@pytest.mark.parametrize("given", ["the folder", "the one above"])
def test_nothing_is_loaded_from_a_folder_of_another_user(blocked, monkeypatch, given):
    monkeypatch.setenv("HOME", str(blocked.folder / "nowhere"))
    blocked.is_cached()
    (folder,) = blocked.temporary.iterdir()
    os.chown(folder if given == "the folder" else blocked.temporary, 65534, 65534)
    assert [blocked.is_cached(), blocked.is_cached()] == [False, False]


def test_a_folder_below_one_that_others_can_change_is_not_safe(tmp_path):
    folder = tmp_path / "open" / "inner" / "loops-0"
    folder.mkdir(parents=True)
    folder.chmod(0o755)
    assert cache_folders.is_safe(folder)
    (tmp_path / "open").chmod(0o777)
    assert not cache_folders.is_safe(folder)
    (tmp_path / "open").chmod(0o1777)
    assert cache_folders.is_safe(folder)
    with pytest.raises(FileNotFoundError):
        cache_folders.is_safe(tmp_path / "none")


@pytest.mark.parametrize("damage", ["empty", "cut", "flipped", "zeros"])
def test_a_damaged_file_is_compiled_anew_and_replaced(places, damage):
    places.is_cached()
    (file,) = files_under(places.beside)
    content = file.read_bytes()
    half = len(content) // 2
    flipped = content[:half] + bytes([content[half] ^ 1]) + content[half + 1 :]
    file.write_bytes({"empty": b"", "cut": content[:half], "flipped": flipped, "zeros": bytes(len(content))}[damage])
    assert [places.is_cached(), places.is_cached()] == [False, True]


def test_code_that_numba_refuses_is_compiled_anew_with_a_warning(places, caplog):
    places.is_cached()
    (file,) = files_under(places.beside)
    code = pickle.dumps(("not", "what", "numba", "wrote"))
    file.write_bytes(hashlib.sha256(code).digest() + code)
    assert [places.is_cached(), places.is_cached()] == [False, True]
    (record,) = caplog.records
    assert str(file) in record.getMessage()


def test_nobody_else_can_write_to_machine_code_whatever_the_umask(places):
    before = os.umask(0)
    try:
        places.is_cached()
    finally:
        os.umask(before)
    (file,) = files_under(places.beside)
    assert file.stat().st_mode & 0o777 == 0o644
    assert file.parent.stat().st_mode & 0o777 == 0o755


def test_a_file_that_cannot_be_read_or_replaced_is_kept_elsewhere(places):
    places.is_cached()
    (file,) = files_under(places.beside)
    file.unlink()
    file.mkdir()
    assert [places.is_cached(), places.is_cached()] == [False, True]
    assert len(files_under(places.home / ".cache" / "fus3dmaps")) == 1


def test_few_folders_of_earlier_contents_stay(tmp_path):
    for age in range(9):
        folder = tmp_path / f"loops-{age}"
        cache_folders.make(folder)
        cache_folders.write(folder / "code.bin", b"code")
        os.utime(folder, (age, age))
    (tmp_path / "numba_points.cpython.pyc").touch()
    cache_folders.make(tmp_path / "loops-new")
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"loops-5", "loops-6", "loops-7", "loops-8", "loops-new", "numba_points.cpython.pyc"}
