"""The Dockerfiles, which are not built here: what they copy exists, and what they install is what the package declares."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
DOCKER = ROOT / "docker"
DOCKERFILES = sorted(path for path in DOCKER.glob("Dockerfile.*") if path.suffix != ".dockerignore")
dockerfiles = pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)


def instructions(path: Path) -> list[tuple[str, str]]:
    """Keyword and the rest of every instruction, continued lines joined, the build's arguments filled in."""
    lines = [line for line in path.read_text().splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines))
    found = [(keyword, rest) for keyword, _, rest in (line.partition(" ") for line in joined.splitlines()) if keyword]
    for name, value in (rest.split("=", 1) for keyword, rest in found if keyword == "ARG"):
        found = [(keyword, rest.replace(f"${name}", value)) for keyword, rest in found]
    return found


def copied(path: Path) -> list[str]:
    return [source for keyword, rest in instructions(path) if keyword == "COPY" for source in shlex.split(rest)[:-1]]


def requirements(path: Path) -> list[Requirement]:
    """What pip is told to install."""
    found: list[Requirement] = []
    for keyword, rest in instructions(path):
        for command in rest.split("&&") if keyword == "RUN" else []:
            words = iter(shlex.split(command))
            if next(words, "") != "pip" or next(words, "") != "install":
                continue
            for word in words:
                if word in ("--index-url", "--extra-index-url"):
                    next(words)
                elif not word.startswith("-"):
                    found.append(Requirement(word))
    return found


def declared(distribution) -> dict[str, Requirement]:
    lines = distribution.install_requires + distribution.extras_require["lite"]
    names = {canonicalize_name(Requirement(line).name): Requirement(line) for line in lines}
    # setup.py asks for the build without CUDA where it finds no GPU: one package under two names.
    open3d = next(requirement for name, requirement in names.items() if name.startswith("open3d"))
    return names | {"open3d": open3d}


def test_there_is_one_for_either_machine() -> None:
    assert [path.name for path in DOCKERFILES] == ["Dockerfile.cuda", "Dockerfile.jetson"]


@dockerfiles
def test_the_base_is_a_release_by_name(path) -> None:
    (base,) = [rest for keyword, rest in instructions(path) if keyword == "FROM"]
    _, _, tag = base.partition(":")
    assert "jazzy" in tag
    assert "latest" not in tag


@dockerfiles
def test_everything_copied_exists(path) -> None:
    assert [source for source in copied(path) if not (ROOT / source).exists()] == []


@dockerfiles
def test_everything_that_the_packages_are_built_from_is_copied(path, distribution) -> None:
    sources = copied(path)
    needed = {"package.xml", "setup.py", "setup.cfg", "colcon_defaults.yaml", "LICENSE"}
    needed |= {package.partition(".")[0] for package in distribution.packages}
    needed |= {Path(name).parts[0] for _, names in distribution.data_files for name in names}
    needed |= {
        base for base in yaml.safe_load((ROOT / "colcon_defaults.yaml").read_text())["build"]["base-paths"] if base != "."
    }
    assert needed <= set(sources)


@dockerfiles
def test_what_is_ignored_is_not_copied(path) -> None:
    ignored = (DOCKER / f"{path.name}.dockerignore").read_text().split()
    assert set(ignored) & {Path(source).parts[0] for source in copied(path)} == set()


@dockerfiles
def test_pip_installs_what_the_package_declares_in_the_releases_that_are_tested(path, distribution, pins) -> None:
    known = declared(distribution)
    for requirement in requirements(path):
        name = canonicalize_name(requirement.name)
        assert name in known, requirement
        exact = [part.version for part in requirement.specifier if part.operator == "=="]
        assert all(version in known[name].specifier for version in exact)
        # The Jetson's PyTorch is built elsewhere and follows later.
        if exact and not (name == "torch" and path.name == "Dockerfile.jetson"):
            assert exact == [pins[name]], requirement


@dockerfiles
def test_nothing_that_the_package_needs_is_missing(path, distribution, manifest) -> None:
    installed = {canonicalize_name(requirement.name) for requirement in requirements(path)}
    if any("rosdep install" in rest for _, rest in instructions(path)):
        apt = {dependency.name for dependency in manifest.exec_depends}
        renamed = {"python3-opencv": "opencv-python-headless", "python3-yaml": "pyyaml"}
        installed |= {renamed.get(name, name.removeprefix("python3-")) for name in apt}
    # Brought by what needs them, in the releases that fit it.
    indirect = {"annotated-types": "pydantic", "llvmlite": "numba"}
    installed |= {name for name, parent in indirect.items() if parent in installed}
    assert {canonicalize_name(Requirement(line).name) for line in distribution.install_requires} - installed <= {
        "open3d-cpu"
    }
    lite = {canonicalize_name(Requirement(line).name) for line in distribution.extras_require["lite"]}
    assert lite <= installed
    assert "open3d" in installed


@dockerfiles
def test_the_image_has_done_what_a_first_start_does(path) -> None:
    steps = instructions(path)
    entry = steps.index(("COPY", "docker/entrypoint.sh /"))
    # With -P it is the installed package that is prepared, not the sources in the working directory.
    assert ("RUN", "/bin/bash /entrypoint.sh python -P -m fus3dmaps_ros.commands.first_start") in steps[entry:]
    assert (ROOT / "fus3dmaps_ros" / "commands" / "first_start.py").is_file()


@dockerfiles
def test_the_image_starts_the_launch_file_with_arguments_that_it_has(path) -> None:
    (command,) = [yaml.safe_load(rest) for keyword, rest in instructions(path) if keyword == "CMD"]
    assert command[:4] == ["ros2", "launch", "fus3dmaps_ros", "fus3dmaps.launch.py"]
    text = (ROOT / "launch" / command[3]).read_text()
    assert all(f'"{argument.partition(":=")[0]}"' in text for argument in command[4:])
    (entry,) = [yaml.safe_load(rest) for keyword, rest in instructions(path) if keyword == "ENTRYPOINT"]
    assert entry[-1] == "/entrypoint.sh"
    variables = set(re.findall(r'\. "\$(\w+)"', (DOCKER / "entrypoint.sh").read_text()))
    assert variables == {"ROS_SETUP", "FUS3DMAPS_SETUP"}
    settings = " ".join(rest for keyword, rest in instructions(path) if keyword == "ENV")
    assert all(f"{variable}=/opt/" in settings for variable in variables)


def test_the_entry_point_sources_both_environments_and_runs_the_command(tmp_path) -> None:
    for name in ("ros", "own"):
        (tmp_path / f"{name}.bash").write_text(f"export {name.upper()}=sourced\n")
    run = subprocess.run(
        ["/bin/bash", str(DOCKER / "entrypoint.sh"), "/bin/sh", "-c", 'echo "$ROS $OWN $1"', "sh", "two words"],
        env={
            "ROS_SETUP": str(tmp_path / "ros.bash"),
            "FUS3DMAPS_SETUP": str(tmp_path / "own.bash"),
            "PATH": "/usr/bin:/bin",
        },
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout == "sourced sourced two words\n"


@dockerfiles
def test_the_readme_says_how_to_build_and_run_it(path) -> None:
    readme = (DOCKER / "README.md").read_text()
    assert f"docker build -f docker/{path.name}" in readme
    (base,) = [rest for keyword, rest in instructions(path) if keyword == "FROM"]
    assert f"`{base}`" in readme
    assert "--ipc host" in readme
    assert ("--runtime nvidia" if path.name == "Dockerfile.jetson" else "--gpus all") in readme
