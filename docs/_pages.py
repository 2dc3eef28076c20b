"""Pages made from the package itself, so that they cannot fall behind it."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path
from typing import Any

from torchrl_l1.report.page import markdown

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
)


def metrics_table(module: str) -> str:
    """Every metric that an algorithm logs, as a Markdown table."""
    metrics = importlib.import_module(f"torchrl_l1.algorithms.{module}").METRICS
    rows = [{"Metric": f"`{name}`", "Meaning": meaning} for name, meaning in metrics.items()]
    return f"{markdown(rows)}\n"


def api_page(package: str) -> str:
    """An ``automodule`` section for each module of a sub-package, in alphabetical order."""
    name = f"torchrl_l1.{package}"
    modules = pkgutil.iter_modules(importlib.import_module(name).__path__)
    sections = [_section(f"{name}.{module.name}") for module in modules if module.name[0] != "_"]
    return "\n".join(sections)


def _section(module: str) -> str:
    directive = (
        f".. automodule:: {module}\n   :members:\n   :ignore-module-all:\n   :show-inheritance:"
    )
    return f"## {module}\n\n```{{eval-rst}}\n{directive}\n```\n"


def resolve_public_name(app: Any, env: Any, node: Any, contnode: Any) -> Any:
    """Link ``package.Name`` to ``package.module.Name``, under which the name is documented."""
    package, _, name = node.get("reftarget", "").rpartition(".")
    domain = env.get_domain("py")
    depth = package.count(".") + 2
    found = [
        full
        for full in domain.objects
        if full.startswith(f"{package}.") and full.endswith(f".{name}") and full.count(".") == depth
    ]
    if node.get("refdomain") != "py" or not package or len(found) != 1:
        return None
    where = node.get("refdoc", env.docname)
    return domain.resolve_xref(env, where, app.builder, "obj", found[0], node, contnode)


def write(folder: Path) -> None:
    """Write all generated pages; files that would not change are left alone."""
    pages = {f"api_{name}": api_page(name) for name in PACKAGES}
    pages["metrics"] = metrics_table("metrpo_metrics")
    pages["metrics_mbmf"] = metrics_table("mbmf_metrics")
    pages["metrics_pets"] = metrics_table("pets")
    folder.mkdir(exist_ok=True)
    for name, text in pages.items():
        path = folder / f"{name}.md"
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
