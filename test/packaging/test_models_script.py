"""When scripts/test_models.sh makes its environment, and that runs at the same time share it; nothing is installed."""

from __future__ import annotations

import shutil
import subprocess
import time
from pathlib import Path

import pytest

# Stands in for the interpreters of both environments, and notes what it is asked to install and to test.
PYTHON = """\
#!/usr/bin/env bash
case "$*" in
    "-m venv "*) mkdir -p -- "${!#}/bin" && cp -- "$0" "${!#}/bin/python" && touch -- "${!#}/pyvenv.cfg" ;;
    "-m pip "*) sleep 0.5; echo "pip in $0" >>"$CALLS"; [[ -z ${FAIL:-} ]] ;;
    "-m pytest "*) echo "pytest ${*:3}" >>"$CALLS"; [[ -z ${HANG:-} ]] || exec sleep 3600 ;;
    "") cat >/dev/null; echo "timm>=1.0" ;;
    "-c import sysconfig;"*) echo "/packages" ;;
    "-c import open_clip,"* | "- "*) ;;
    *) echo "unforeseen: $*" >&2; exit 1 ;;
esac
"""


class Machine:
    """A copy of the script in a clone (with a space in its name) that is set up."""

    def __init__(self, folder: Path, root: Path) -> None:
        self.root, self.calls = folder / "a clone", folder / "calls"
        self.calls.touch()
        (self.root / "scripts").mkdir(parents=True)
        for name in ("test_models.sh", "isolate.sh"):
            shutil.copy(root / "scripts" / name, self.root / "scripts")
        (self.root / "scripts" / "setup.sh").write_text("")
        self.constraints = self.root / "constraints-models.txt"
        self.constraints.write_text("timm==1.0\n")
        (self.root / "constraints.txt").write_text("timm==0.9\nnumpy==2.0\n")
        self.stamp = self.root / ".venv" / ".fus3dmaps" / "dependencies"
        self.stamp.parent.mkdir(parents=True)
        self.stamp.write_text("these\n")
        python = self.root / ".venv" / "bin" / "python"
        python.parent.mkdir()
        python.write_text(PYTHON)
        python.chmod(0o755)

    def start(self, *arguments: str, **environment: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            ["bash", self.root / "scripts" / "test_models.sh", *arguments],
            env={"PATH": "/usr/bin:/bin", "CALLS": str(self.calls), **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def run(self, *arguments: str, **environment: str) -> tuple[int, str]:
        process = self.start(*arguments, **environment)
        output, _ = process.communicate(timeout=60)
        return process.returncode, output

    def noted(self, kind: str) -> list[str]:
        return [line for line in self.calls.read_text().splitlines() if line.startswith(kind)]


@pytest.fixture
def machine(tmp_path, root) -> Machine:
    return Machine(tmp_path, root)


def test_the_environment_is_made_once_and_arguments_go_to_pytest(machine):
    code, output = machine.run("-k", "a word")
    assert code == 0, output
    assert "environment made in" in output
    assert machine.noted("pytest") == ["pytest test/models -k a word"]
    assert machine.run() == (0, "")
    assert machine.noted("pytest")[1:] == ["pytest test/models -q"]
    assert machine.noted("pip") == [f"pip in {machine.root}/.venv-models/bin/python"]


def test_the_environment_alone_can_be_made(machine):
    code, output = machine.run("--environment-only")
    assert code == 0, output
    assert len(machine.noted("pip")) == 1
    assert not machine.noted("pytest")


def test_it_is_made_anew_for_other_pins_another_base_and_another_place(machine, tmp_path):
    machine.run()
    machine.constraints.write_text("timm==1.1\n")
    machine.run()
    machine.stamp.write_text("others\n")
    machine.run()
    machine.run(FUS3DMAPS_MODELS_VENV=str(tmp_path / "elsewhere"))
    moved = machine.root.with_name("moved")
    shutil.move(machine.root, moved)
    machine.root = moved
    machine.run()
    own = machine.noted("pip")
    assert [line.removeprefix(f"pip in {tmp_path}/") for line in own] == [
        *(3 * ["a clone/.venv-models/bin/python"]),
        "elsewhere/bin/python",
        "moved/.venv-models/bin/python",
    ]


def test_one_that_failed_is_made_over_and_runs_no_test(machine):
    code, _ = machine.run(FAIL="1")
    assert code != 0
    assert not machine.noted("pytest")
    assert machine.run()[0] == 0
    assert len(machine.noted("pip")) == 2


def test_a_folder_that_is_no_environment_is_left_alone(machine, tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "letter").touch()
    code, output = machine.run(FUS3DMAPS_MODELS_VENV=str(tmp_path / "home"))
    assert code == 1
    assert output.count("\n") == 1
    assert "is no environment of Python" in output
    assert (tmp_path / "home" / "letter").exists()
    assert not machine.noted("pip")


def test_two_runs_at_once_make_it_once(machine):
    runs = [machine.start() for _ in range(2)]
    outputs = [run.communicate(timeout=60)[0] for run in runs]
    assert [run.returncode for run in runs] == [0, 0], outputs
    assert len(machine.noted("pip")) == 1
    assert len(machine.noted("pytest")) == 2


def test_it_is_not_made_anew_under_tests_that_run(machine):
    machine.run()
    tests = machine.start(HANG="1")
    while len(machine.noted("pytest")) < 2:
        assert tests.poll() is None
        time.sleep(0.01)
    assert machine.run("beside")[0] == 0
    machine.constraints.write_text("timm==1.1\n")
    waiting = machine.start()
    with pytest.raises(subprocess.TimeoutExpired):
        waiting.wait(1)
    assert len(machine.noted("pip")) == 1
    tests.kill()
    assert waiting.wait(60) == 0
    assert len(machine.noted("pip")) == 2
    for process in (tests, waiting):
        process.communicate()
