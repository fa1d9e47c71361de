"""constraints.txt pins everything that set-up installs, so that two machines get the same."""

from __future__ import annotations

import importlib.metadata

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

# Asked for by a package of weights, used by nothing here: set-up leaves it out.
LEFT_OUT = {"sentence-transformers"}


def requirements_of(distribution) -> list[Requirement]:
    lines = distribution.install_requires + [line for lines in distribution.extras_require.values() for line in lines]
    return [Requirement(line) for line in lines]


def test_every_requirement_has_a_pin_that_satisfies_it(distribution, pins):
    for requirement in requirements_of(distribution):
        assert pins.get(canonicalize_name(requirement.name), "") in requirement.specifier, requirement


def test_both_builds_of_open3d_have_the_same_pin(pins):
    assert pins["open3d"] == pins["open3d-cpu"]


def test_everything_installed_on_behalf_of_the_package_is_the_pinned_release(distribution, pins):
    waiting = requirements_of(distribution)
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
    assert len(seen) > len(requirements_of(distribution))
