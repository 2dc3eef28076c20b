"""What CONTRIBUTING.md says of the layout, read from the files themselves."""

from __future__ import annotations

import ast
import subprocess
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "torchrl_l1"
FILES = sorted(PACKAGE.rglob("*.py"))
MOST_FILES, MOST_LINES = 175, 500
PLACES = ("torchrl_l1", "tests", "docs", "benchmarks")

# Each may import from those before it.
ORDER = (
    *("control", "dynamics", "envs", "objectives", "planning", "algorithms"),
    *("experiment", "campaign", "report", "deployment", "cli"),
)


def module(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module(file): file for file in FILES}


def layer(name: str) -> str | None:
    """The package below ``torchrl_l1`` that a module is in; ``None`` for those at the top."""
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and (PACKAGE / parts[1]).is_dir() else None


def imported(file: Path) -> Iterator[str]:
    """Modules of ours that a file imports: when it is loaded, later, or for its types."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file} has a relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            while name and name not in MODULES:
                name = name.rpartition(".")[0]
            if name:
                yield name


def test_the_size_of_the_house() -> None:
    assert len(FILES) <= MOST_FILES, f"{len(FILES)} files"
    every = [file for place in PLACES for file in (ROOT / place).rglob("*.py")]
    long = {str(file): len(file.read_text(encoding="utf-8").splitlines()) for file in every}
    assert not {file: lines for file, lines in long.items() if lines > MOST_LINES}


def test_nothing_lies_about_that_is_no_part_of_the_project() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("no clone")
    command = ["git", "ls-files", "-z"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    files = [name for name in listed.split("\0") if name]
    folders = {"torchrl_l1", "recipes", "tests", "docs", "benchmarks", ".ci", ".github"}
    texts = {"README.md", "LICENSE", "CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff"}
    tools = {"pyproject.toml", "constraints.txt", "Makefile", ".pre-commit-config.yaml"}
    assert {name.split("/")[0] for name in files} <= folders | texts | tools | {".gitignore"}
    kinds = {Path(name).suffix for name in files if not name.startswith(".")}
    code, prose = {".py", ".typed"}, {".md", ".txt", ".cff", ""}
    assert kinds <= code | prose | {".csv", ".json", ".png", ".toml", ".xml", ".xz", ".yaml"}


def test_imports_point_one_way() -> None:
    assert {layer(name) for name in MODULES} == {None, *ORDER}
    wrong = [
        f"{name} imports {other}"
        for name, file in MODULES.items()
        for other in imported(file)
        if (here := layer(name)) and (there := layer(other))
        if ORDER.index(there) > ORDER.index(here)
    ]
    assert not wrong


def test_what_serves_all_imports_none_of_them() -> None:
    others = [name for name in MODULES if layer(name) is None and name != "torchrl_l1"]
    assert "torchrl_l1.compilation" in others
    for name in others:
        assert not list(imported(MODULES[name])), name


def test_modules_make_no_circle() -> None:
    graph = {
        name: {other for other in imported(file) if other not in (name, "torchrl_l1")}
        for name, file in MODULES.items()
    }
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        raise AssertionError(" <- ".join(error.args[1])) from None


def exported(package: str) -> set[str]:
    """What a package's ``__all__`` holds; nothing where there is none."""
    for node in ast.parse(MODULES[package].read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return set(ast.literal_eval(node.value))
    return set()


def test_every_name_has_one_import_path() -> None:
    public = {package: exported(f"torchrl_l1.{package}") for package in ORDER}
    wrong = []
    for name, file in MODULES.items():
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.ImportFrom) and node.module) or name == "torchrl_l1":
                continue
            home = layer(node.module)
            names = {alias.name for alias in node.names}
            if home is None and node.module == "torchrl_l1":
                # Looked up when first asked for, which would hide a circle.
                wrong += [f"{name}: {node.module}.{one}" for one in names - {"__version__"}]
            elif home == layer(name) and not file.name.startswith("__init__"):
                wrong += [f"{name}: its own package"] * (
                    node.module == f"torchrl_l1.{home}" and bool(names & public[home])
                )
            elif home and home != layer(name) and node.module != f"torchrl_l1.{home}":
                wrong += [f"{name}: {node.module}.{one}" for one in names & public[home]]
    assert not wrong


def test_only_packages_say_what_is_public() -> None:
    for name, file in MODULES.items():
        if file.name != "__init__.py":
            assert "__all__" not in file.read_text(encoding="utf-8"), name


def test_no_text_where_the_class_says_it_all() -> None:
    for name, file in MODULES.items():
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and node.name == "__post_init__":
                assert ast.get_docstring(node) is None, f"{name}, line {node.lineno}"


def test_nothing_needs_a_module_that_windows_lacks() -> None:
    lacking = {"fcntl", "grp", "pwd", "resource", "termios"}
    for name, file in MODULES.items():
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                assert not lacking & {alias.name for alias in node.names}, name
            elif isinstance(node, ast.ImportFrom):
                assert node.module not in lacking, name
