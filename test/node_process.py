"""The mapper as a process of its own: how it is started, and how it ends well."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

from robot import RELIABLE_INPUTS, TIMEOUT_S

ROOT = Path(__file__).resolve().parents[1]
STAND_IN = [sys.executable, str(ROOT / "test" / "ros" / "stand_in_node.py")]
RELIABLE_ARGUMENTS = ["--ros-args", *(word for key in RELIABLE_INPUTS for word in ("-p", f"{key}:=reliable"))]


def start_process(command: list[str], **environment: str) -> subprocess.Popen[str]:
    """Start a command that finds the package and the tests' own modules; its output is one pipe."""
    paths = os.pathsep.join([str(ROOT), str(ROOT / "test"), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        command,
        env={**os.environ, "PYTHONPATH": paths, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def wait_for_line(process: subprocess.Popen[str], words: str) -> None:
    """Read what a process says until a line has these words; one that does not say them in time is killed."""
    assert process.stdout is not None
    timer = threading.Timer(TIMEOUT_S, process.kill)
    timer.start()
    try:
        assert any(words in line for line in iter(process.stdout.readline, "")), f"it never said '{words}'"
    finally:
        timer.cancel()


def end(process: subprocess.Popen[str], number: signal.Signals) -> str:
    """Signal a node, which must end well and say nothing untoward; what it said since anyone has read."""
    process.send_signal(number)
    output, _ = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, output
    assert "Traceback" not in output
    assert "exception" not in output.lower()
    return output
