"""Compiled loops come from a cache only where that is right and safe, and run without one wherever it fails."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

pytest.importorskip("numba")

import fus3dmaps_core
from fus3dmaps_core.voxel_map.kernels import cache_folders
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
    return sorted(folder.glob("loops-*/numba_probe.*"))


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


@pytest.fixture
def blocked(copy) -> Copy:
    """A copy that has no room beside its source, not even for root."""
    copy.beside.write_text("in the way")
    return copy


def test_the_sources_of_the_real_loops_are_found_through_their_imports():
    names = {f"{path.parent.name}/{path.name}" for path in source_files()}
    loops = {f"kernels/{path.name}" for path in Path(cache_folders.__file__).parent.glob("numba_*.py")}
    assert loops | {"kernels/protocols.py", "kernels/keys.py", "rows/rounding.py", "rows/rows.py"} <= names
    assert "kernels/torch_kernels.py" not in names
    assert "voxel_map/semantic_map.py" not in names


def test_a_second_process_takes_the_loop_from_the_cache_beside_the_source(copy):
    assert copy.run() == (1101, False, [])
    assert copy.run() == (1101, True, [])
    assert len(files_under(copy.beside)) == 1
    assert not any((copy.folder.parent / "home").iterdir())


@pytest.mark.parametrize(
    ("path", "old", "new", "value"),
    [
        ("voxel_map/kernels/probe_parts.py", "value + CONSTANT", "value + 2 * CONSTANT", 1102),
        ("voxel_map/kernels/probe_parts.py", "return 100", "return 200", 1201),
        ("voxel_map/kernels/probe_parts.py", "MADE = 1000", "MADE = 2000", 2101),
        ("voxel_map/rows/probe_constants.py", "CONSTANT = 1", "CONSTANT = 5", 1105),
    ],
    ids=["a called loop", "an inlined function", "an intrinsic", "a constant"],
)
def test_a_change_in_another_file_is_never_answered_from_the_cache(copy, path, old, new, value):
    copy.run()
    copy.edit(path, old, new)
    assert copy.run() == (value, False, [])
    copy.edit(path, new, old)
    assert copy.run() == (1101, True, [])


def test_what_loops_are_not_made_of_leaves_the_cache_as_it_is(copy):
    copy.run()
    copy.edit("voxel_map/semantic_map.py", "from __future__", "# changed\nfrom __future__")
    os.utime(copy.kernels / "numba_probe.py", (1, 1))
    assert copy.run() == (1101, True, [])


def test_where_the_source_is_read_only_the_users_cache_is_taken(blocked, tmp_path):
    assert blocked.run() == (1101, False, [])
    assert blocked.run() == (1101, True, [])
    assert len(files_under(tmp_path / "home" / ".cache" / "fus3dmaps")) == 1
    blocked.environment["XDG_CACHE_HOME"] = str(tmp_path / "settings" / "cache")
    assert blocked.run() == (1101, False, [])
    assert len(files_under(tmp_path / "settings" / "cache" / "fus3dmaps")) == 1


def test_a_read_only_home_leaves_a_private_folder_for_temporary_files(blocked, tmp_path):
    for home in (tmp_path / "nowhere", blocked.beside, blocked.beside / "below a file"):
        blocked.environment["HOME"] = str(home)
        blocked.run()
        assert blocked.run() == (1101, True, [])
    assert not (tmp_path / "nowhere").exists()
    (folder,) = (tmp_path / "temporary").iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert len(files_under(folder)) == 1


def test_without_any_folder_the_loop_is_compiled_and_one_warning_says_what_to_set(blocked, tmp_path):
    blocked.environment["HOME"] = str(blocked.beside)
    (tmp_path / "temporary" / f"fus3dmaps-{os.getuid()}").write_text("in the way")
    value, cached, log = blocked.run()
    assert (value, cached) == (1101, False)
    (line,) = log
    assert line.startswith("WARNING")
    assert "NUMBA_CACHE_DIR" in line


def test_the_folder_that_the_user_names_comes_first(copy, tmp_path):
    copy.environment["NUMBA_CACHE_DIR"] = str(tmp_path / "named")
    assert copy.run() == (1101, False, [])
    assert copy.run() == (1101, True, [])
    assert len(files_under(tmp_path / "named" / "fus3dmaps")) == 1
    assert files_under(copy.beside) == []


def test_nothing_is_loaded_from_a_folder_that_others_can_write_to(blocked, tmp_path):
    blocked.environment["NUMBA_CACHE_DIR"] = str(tmp_path / "named")
    blocked.run()
    (file,) = files_under(tmp_path / "named" / "fus3dmaps")
    file.parent.chmod(0o777)
    assert blocked.run() == (1101, False, [])
    assert blocked.run() == (1101, True, [])  # From the user's own cache.
    assert len(files_under(tmp_path / "home" / ".cache" / "fus3dmaps")) == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_nothing_is_loaded_from_a_folder_of_another_user(blocked, tmp_path):
    blocked.environment["HOME"] = str(tmp_path / "nowhere")
    blocked.run()
    (file,) = files_under(tmp_path / "temporary" / f"fus3dmaps-{os.getuid()}")
    os.chown(file.parent, 65534, 65534)
    assert not cache_folders.is_safe(file.parent)
    value, cached, log = blocked.run()
    assert (value, cached, len(log)) == (1101, False, 1)
    os.chown(file.parent, 0, 0)
    os.chown(file.parent.parent, 65534, 65534)
    assert not cache_folders.is_safe(file.parent)


def test_a_folder_below_one_that_others_can_change_is_not_safe(tmp_path):
    folder = tmp_path / "open" / "inner" / "loops-0"
    folder.mkdir(parents=True, mode=0o755)
    assert cache_folders.is_safe(folder)
    (tmp_path / "open").chmod(0o777)
    assert not cache_folders.is_safe(folder)
    (tmp_path / "open").chmod(0o1777)
    assert cache_folders.is_safe(folder)
    with pytest.raises(FileNotFoundError):
        cache_folders.is_safe(tmp_path / "none")


@pytest.mark.parametrize("damage", ["empty", "cut", "flipped", "zeros"])
def test_a_damaged_file_is_compiled_anew_and_replaced(copy, damage):
    copy.run()
    (file,) = files_under(copy.beside)
    content = file.read_bytes()
    half = len(content) // 2
    flipped = content[:half] + bytes([content[half] ^ 1]) + content[half + 1 :]
    file.write_bytes({"empty": b"", "cut": content[:half], "flipped": flipped, "zeros": bytes(len(content))}[damage])
    assert copy.run() == (1101, False, [])
    assert copy.run() == (1101, True, [])


def test_a_file_that_cannot_be_read_or_replaced_is_kept_elsewhere(copy, tmp_path):
    copy.run()
    (file,) = files_under(copy.beside)
    file.unlink()
    file.mkdir()
    assert copy.run() == (1101, False, [])
    assert copy.run() == (1101, True, [])
    assert len(files_under(tmp_path / "home" / ".cache" / "fus3dmaps")) == 1


def test_processes_that_start_together_do_not_disturb_one_another(copy):
    assert {outcome(process)[0] for process in [copy.start() for _ in range(3)]} == {1101}
    assert not list(copy.beside.glob("*/*.tmp"))
    assert copy.run() == (1101, True, [])


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
