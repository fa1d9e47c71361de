"""constraints.txt pins everything that set-up installs, constraints-models.txt what the extra "models" takes besides."""

from __future__ import annotations

import importlib.metadata

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

# Asked for by a package of weights, used by nothing here: set-up leaves it out.
LEFT_OUT = {"sentence-transformers"}
# Goes into an environment of its own.
APART = {"models"}


def requirements_of(distribution, extras: set[str]) -> list[Requirement]:
    lines = distribution.install_requires + [line for extra in sorted(extras) for line in distribution.extras_require[extra]]
    return [Requirement(line) for line in lines]


def base_extras(distribution) -> set[str]:
    return set(distribution.extras_require) - APART


def test_every_requirement_has_a_pin_that_satisfies_it(distribution, pins):
    for requirement in requirements_of(distribution, base_extras(distribution)):
        assert pins.get(canonicalize_name(requirement.name), "") in requirement.specifier, requirement


def test_every_requirement_of_the_models_has_a_pin_that_satisfies_it(distribution, pins, pins_of_models):
    for requirement in requirements_of(distribution, {"models"}):
        pin = (pins | pins_of_models).get(canonicalize_name(requirement.name), "")
        assert pin in requirement.specifier, requirement


def test_the_models_stand_beside_the_base_in_all_but_torch(pins, pins_of_models):
    """The environment of the models is laid over the base: two releases of a C extension's ABI would meet in a process."""
    other = {name for name in pins_of_models if name in pins}
    assert all(pins[name] != pins_of_models[name] for name in other)
    assert other <= {"torch", "triton"} | {name for name in other if name.startswith("nvidia-")}


def test_both_builds_of_open3d_have_the_same_pin(pins):
    assert pins["open3d"] == pins["open3d-cpu"]


def test_everything_installed_on_behalf_of_the_package_is_the_pinned_release(distribution, pins):
    wanted = requirements_of(distribution, base_extras(distribution))
    waiting = list(wanted)
    seen: set[tuple[str, str]] = set()
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        if name in LEFT_OUT or (name, str(requirement.extras)) in seen:
            continue
        seen.add((name, str(requirement.extras)))
        installed = importlib.metadata.distribution(name)
        assert Version(installed.version).public == pins.get(name), f"{name} {installed.version}"
        for line in installed.requires or []:
            dependency = Requirement(line)
            extras = requirement.extras or {""}
            if dependency.marker is None or any(dependency.marker.evaluate({"extra": extra}) for extra in extras):
                waiting.append(dependency)
    assert len(seen) > len(wanted)
