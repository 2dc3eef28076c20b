"""Pages made from the package itself, so that they cannot fall behind it."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import pkgutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from torchrl_l1.experiment.settings import SCHEMAS

PACKAGES = (
    "control",
    "dynamics",
    "planning",
    "envs",
    "objectives",
    "algorithms",
    "experiment",
    "campaign",
    "report",
    "deployment",
)

# What a package documents beside its exports: by name, wherever in the package it stands.
UNEXPORTED = {
    "experiment": (
        *("RunSettings", "L1Settings", "WandbSettings", "CheckpointSettings", "METRPORecipe"),
        *("PETSRecipe", "MBMFRecipe", "final_return"),
        *("OfflineRecipe", "read_dataset", "write_dataset", "Episode", "record", "Recording"),
        *("SCHEMAS", "l1_config", "launch", "compose", "run", "RunDirectory", "RunDirectoryError"),
        *("RunDirectoryInUse", "versions", "Condition", "TrainedRun", "load_run", "conditions"),
        *("evaluate", "RecipeError", "available_recipes", "available_campaigns", "group_setting"),
        *("verify_traces",),
    ),
}

# Pages of what the algorithms log, with the algorithm of each.
METRICS = {f"metrics_{name}": name for name in SCHEMAS}


def metrics_table(algorithm: str) -> str:
    """Every metric that an algorithm logs, as a Markdown table."""
    metrics = SCHEMAS[algorithm].builds.facts.metrics
    rows = [f"| `{name}` | {meaning} |" for name, meaning in metrics.items()]
    return "\n".join(["| Metric | Meaning |", "|---|---|", *rows, ""])


def api_page(package: str) -> str:
    """A section for each public name of a sub-package, in alphabetical order."""
    return "\n".join(_section(full, *found) for full, found in _documented(package).items())


@cache
def public_names() -> dict[str, str]:
    """Under which name a function or class is documented, by the name that it was defined with."""
    names = {}
    for package in PACKAGES:
        for full, (module, name) in _documented(package).items():
            names[f"{module.__name__}.{name}"] = full
    return names


@cache
def _documented(package: str) -> dict[str, tuple[ModuleType, str]]:
    """Public names with the module and the name that each is defined by."""
    home = importlib.import_module(f"torchrl_l1.{package}")
    found = {}
    for name in getattr(home, "__all__", ()):
        module, original = _origin(home, name)
        if _inside(home, module) or not _exported(module, original):  # else documented there
            found[f"{home.__name__}.{name}"] = (module, original)
    for name in UNEXPORTED.get(package, ()):
        module = _defining(home, name)
        found[f"{module.__name__}.{name}"] = (module, name)
    return dict(sorted(found.items(), key=lambda item: item[0].rpartition(".")[2].lower()))


def _inside(home: ModuleType, module: ModuleType) -> bool:
    return f"{module.__name__}.".startswith(f"{home.__name__}.")


def _exported(module: ModuleType, name: str) -> bool:
    """Whether the package that a module is in exports a name of it."""
    package = importlib.import_module(module.__name__.rpartition(".")[0])
    return any(_origin(package, one) == (module, name) for one in getattr(package, "__all__", ()))


def _origin(module: ModuleType, name: str) -> tuple[ModuleType, str]:
    """Module and name of a definition, behind the imports that pass it on."""
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("torchrl"):
            for alias in node.names:
                if name == (alias.asname or alias.name):
                    return _origin(importlib.import_module(node.module), alias.name)
    return module, name


def _defining(home: ModuleType, name: str) -> ModuleType:
    """The module of a package that defines a name."""
    for module in _modules(home):
        if name in vars(module) and _origin(module, name) == (module, name):
            return module
    raise LookupError(f"docs/_pages.py: no module of {home.__name__} defines {name}")


def _modules(home: ModuleType) -> Iterator[ModuleType]:
    for module in pkgutil.iter_modules(home.__path__):
        yield importlib.import_module(f"{home.__name__}.{module.name}")


def _section(full: str, module: ModuleType, original: str) -> str:
    value = getattr(module, original)
    if inspect.isclass(value):
        directive = f".. autoclass:: {full}\n   :members:\n   :show-inheritance:"
    elif inspect.isroutine(value):
        directive = f".. autofunction:: {full}"
    else:
        text = _text_below(module, original).replace("\n", "\n   ")
        directive = f".. py:data:: {full}\n\n   {text}"
    name = full.rpartition(".")[2]
    return f"## {name}\n\n```{{eval-rst}}\n{directive}\n```\n"


def _text_below(module: ModuleType, name: str) -> str:
    """The string that follows the assignment of a constant, else its value."""
    body = ast.parse(inspect.getsource(module)).body
    for node, after in zip(body, [*body[1:], None], strict=True):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        found = any(isinstance(target, ast.Name) and target.id == name for target in targets)
        if found and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            return inspect.cleandoc(str(after.value.value))
    return f"``{getattr(module, name)!r}``"


def resolve_public_name(app: Any, env: Any, node: Any, contnode: Any) -> Any:
    """Link ``package.module.Name`` to ``package.Name``, under which the name is documented.

    In the reference a name that is there but not public stays plain text.
    """
    target = node.get("reftarget", "")
    if node.get("refdomain") != "py" or not target.startswith("torchrl_l1."):
        return None
    where = node.get("refdoc", env.docname)
    owner, member = target, ""
    while owner and owner not in public_names():
        owner, _, last = owner.rpartition(".")
        member = f".{last}{member}"
    if not owner:
        return contnode if where.startswith("api/") and _exists(target) else None
    full = public_names()[owner] + member
    return env.get_domain("py").resolve_xref(env, where, app.builder, "obj", full, node, contnode)


def _exists(target: str) -> bool:
    module, _, name = target.rpartition(".")
    return importlib.util.find_spec(module) is not None and hasattr(
        importlib.import_module(module), name
    )


def write(folder: Path) -> None:
    """Write all generated pages; files that would not change are left alone."""
    pages = {f"api_{name}": api_page(name) for name in PACKAGES}
    pages |= {page: metrics_table(name) for page, name in METRICS.items()}
    folder.mkdir(exist_ok=True)
    for name, text in pages.items():
        path = folder / f"{name}.md"
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
