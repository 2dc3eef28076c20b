"""Names of what users bring along: ``MODULE:NAME`` and ``FILE.py:NAME``."""

from __future__ import annotations

import importlib.util
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any


def load_attribute(name: str) -> Any:
    """What ``MODULE:NAME`` or ``FILE.py:NAME`` names.

    Raises:
        ValueError: if there is none.

    Examples:
        >>> load_attribute("math:pi")
        3.141592653589793
    """
    module, _, attribute = name.partition(":")
    found = getattr(load_module(module), attribute, None)
    if found is None:
        raise ValueError(f"{module} has no {attribute!r}")
    return found


def load_module(name: str) -> ModuleType:
    """A module by its name, or by its file if that ends in ``.py``.

    Raises:
        ValueError: if there is none.
    """
    if not name.endswith(".py"):
        try:
            return import_module(name)
        except (ImportError, TypeError, ValueError) as error:
            raise ValueError(f"there is no module {name!r} ({error})") from None
    file = Path(name).resolve()
    if not file.exists():
        raise ValueError(f"there is no file {name}")
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # As of an import: what the file defines may look its own module up.
    sys.modules.setdefault(file.stem, module)
    spec.loader.exec_module(module)
    return module
