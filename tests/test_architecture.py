"""The house itself: which room imports which, whose packages these are, what a file may be."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("cachesim", "experiments", "kernels", "traces")
#: What each room may import of the others.
ALLOWED = {
    "traces": set(),
    "kernels": {"traces"},
    "cachesim": {"traces"},
    "experiments": {"traces", "kernels", "cachesim"},
}
TOP_LEVEL = {
    *ROOMS,
    *("tests", "examples", "docs", ".ci", ".github", ".gitignore", ".gitattributes"),
    *("README.md", "CHANGELOG.md", "DEVIATIONS.md", "GUIDE.md", "LICENSE"),
    *("pyproject.toml", "constraints.txt"),
}
MAX_FILE_BYTES = 1 << 20
SHAPELESS = re.compile(r"(^|_)(utils?|helpers?|managers?|misc|common_utils)\.", re.IGNORECASE)


def sources(room):
    return sorted((ROOT / room).rglob("*.py"))


def imported_packages(path):
    """Top-level names of every import of a file, those inside functions too."""
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            # A relative import stays in its room.
            yield node.module.split(".")[0] if not node.level else path.relative_to(ROOT).parts[0]


def repository_files():
    """What git tracks or would add; without git, everything outside hidden and built folders."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    try:
        listed = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout, so its files cannot be told from what was built in it")
    paths = [ROOT / name for name in listed.decode().split("\0") if name]
    return [path for path in paths if path.exists()]


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_the_rooms_below_it(room):
    for path in sources(room):
        above = (set(imported_packages(path)) & set(ROOMS)) - {room} - ALLOWED[room]
        assert not above, f"{path.relative_to(ROOT)} imports {sorted(above)}"


def test_only_kernels_imports_opencl():
    for room in set(ROOMS) - {"kernels"}:
        for path in sources(room):
            assert "pyopencl" not in imported_packages(path), path.relative_to(ROOT)


def test_a_trace_is_simulated_without_opencl_being_imported():
    code = "import sys, cachesim, traces; assert not {'pyopencl', 'kernels'} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("room", ROOMS)
def test_the_import_resolves_into_this_repository(room):
    file = importlib.import_module(room).__file__
    assert Path(file).resolve().parent == ROOT / room


def test_no_other_distribution_provides_our_packages():
    owners = importlib.metadata.packages_distributions()
    for room in ROOMS:
        others = {canonicalize_name(owner) for owner in owners.get(room, [])} - {"sss-cachesim"}
        assert not others, f"{sorted(others)} installs a package {room!r}: uninstall it"


def test_every_package_imported_is_a_declared_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = {canonicalize_name(Requirement(text).name) for text in project["dependencies"]}
    owners = importlib.metadata.packages_distributions()
    for room in ROOMS:
        for path in sources(room):
            for package in set(imported_packages(path)) - set(ROOMS) - sys.stdlib_module_names:
                # A distribution of one extension module has no entry there on Python 3.11: it is
                # named like its module.
                providers = {canonicalize_name(name) for name in owners.get(package, [package])}
                assert providers & declared, f"{path.relative_to(ROOT)} imports {package}"


def test_every_dependency_is_pinned_and_pycachesim_is_not_among_them():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lists = [project["dependencies"], *project["optional-dependencies"].values()]
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [Requirement(line) for line in lines if line and not line.startswith("#")]
    pinned = {canonicalize_name(pin.name) for pin in pins}
    assert all([spec.operator for spec in pin.specifier] == ["=="] for pin in pins)
    assert {canonicalize_name(Requirement(r).name) for rs in lists for r in rs} <= pinned
    assert "pycachesim" not in pinned


def test_every_package_folder_and_data_file_is_installed():
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    packages = [
        path.parent for room in ROOMS for path in sources(room) if path.name == "__init__.py"
    ]
    assert {".".join(p.relative_to(ROOT).parts) for p in packages} == set(setuptools["packages"])
    shipped = setuptools["package-data"]
    for path in repository_files():
        parts = path.relative_to(ROOT).parts
        if path.parent in packages and path.suffix not in (".py", ".md"):
            patterns = shipped.get(".".join(parts[:-1]), [])
            assert any(path.match(pattern) for pattern in patterns), path


def test_the_top_level_holds_only_what_belongs_there():
    found = {path.relative_to(ROOT).parts[0] for path in repository_files()}
    assert found <= TOP_LEVEL, sorted(found - TOP_LEVEL)


def test_no_file_is_larger_than_a_mebibyte():
    large = [path for path in repository_files() if path.stat().st_size > MAX_FILE_BYTES]
    assert not large


def test_no_file_has_a_name_that_says_nothing():
    shapeless = [path for path in repository_files() if SHAPELESS.search(path.name)]
    assert not shapeless
