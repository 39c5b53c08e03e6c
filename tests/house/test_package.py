"""The package: its metadata, what it needs where, and what its wheel contains."""

import re
import tomllib
from itertools import chain

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import studies
from studies.config import TESTED
from tests import TOP

FILE = tomllib.loads((TOP / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = FILE["project"]
#: All that any use of the package needs, but itself.
REQUIREMENTS = [
    one
    for one in map(
        Requirement, chain(PROJECT["dependencies"], *PROJECT["optional-dependencies"].values())
    )
    if one.name != PROJECT["name"]
]
PYTHONS = ("3.11", "3.12", "3.13")


def locked(python):
    """Exact version of each package in constraints.txt on a version of Python."""
    lines = (TOP / "constraints.txt").read_text(encoding="utf-8").splitlines()
    found = {}
    for line in (line for line in lines if not line.startswith("#")):
        one = Requirement(line)
        if one.marker is None or one.marker.evaluate({"python_version": python}):
            assert re.fullmatch(r"==[\w.]+", str(one.specifier)), line
            name = canonicalize_name(one.name)
            assert name not in found, f"{name} twice on Python {python}"
            found[name] = str(one.specifier).removeprefix("==")
    return found


@pytest.mark.parametrize("python", PYTHONS)
def test_every_dependency_is_locked_within_its_bounds(python):
    versions = locked(python)
    assert len(REQUIREMENTS) > 20
    for one in REQUIREMENTS:
        assert versions[canonicalize_name(one.name)] in one.specifier, one


def test_the_citation_has_the_version_of_the_package():
    text = (TOP / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: (.+)$", text, re.MULTILINE)[1] == studies.__version__
    assert re.search(r"^license: (.+)$", text, re.MULTILINE)[1] == PROJECT["license"]
    assert re.search(r"^title: (.+)$", text, re.MULTILINE)[1] == PROJECT["name"]
    doi = re.search(r"^ +doi: (.+)$", text, re.MULTILINE)[1]
    assert PROJECT["urls"]["Paper"] == f"https://doi.org/{doi}"


def test_classifiers_name_the_supported_versions():
    words = "Programming Language :: Python :: "
    named = [x.removeprefix(words) for x in PROJECT["classifiers"] if x.startswith(words)]
    assert tuple(named) == PYTHONS == TESTED["python"]


@pytest.mark.parametrize(
    ("machine", "is_needed"),
    [("x86_64", True), ("AMD64", True), ("aarch64", True), ("arm64", True)]
    + [("ARM64", False), ("riscv64", False), ("ppc64le", False), ("i686", False)],
)
def test_llvmlite_is_needed_where_it_has_wheels(machine, is_needed):
    """Windows calls its 64-bit ARM machines ARM64, macOS arm64."""
    (one,) = (x for x in REQUIREMENTS if x.name == "llvmlite")
    assert one.marker.evaluate({"platform_machine": machine}) is is_needed


def test_every_file_of_the_packages_is_in_the_wheel():
    patterns = FILE["tool"]["setuptools"]["package-data"]
    for package, globs in patterns.items():
        folder = TOP / package
        taken = {path for pattern in globs for path in folder.glob(pattern)}
        files = {x for x in folder.rglob("*") if x.is_file() and "__pycache__" not in x.parts}
        left = {x for x in files - taken if x.suffix not in (".py", ".pyc")}
        assert left == set()
        for path in files - taken:
            assert (path.parent / "__init__.py").exists() or path.parent == folder, path
