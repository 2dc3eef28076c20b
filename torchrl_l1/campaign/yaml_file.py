"""YAML as Hydra's users write it: ``off`` and ``on`` are words, a key stands once."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]


class _Loader(yaml.SafeLoader):
    """The safe loader, with Hydra's idea of what a boolean is."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Refuse a key that stands twice: one of them would be lost without a word."""
        seen: set[str] = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key.value!r} stands twice", key.start_mark
                )
            seen.add(key.value)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


# YAML 1.1 takes yes, no, on and off for booleans, l1: [off, paper] for [False, 'paper'], and
# 1e-3 for a word.
_BOOL, _FLOAT = "tag:yaml.org,2002:bool", "tag:yaml.org,2002:float"
_Loader.yaml_implicit_resolvers = {
    letter: [entry for entry in entries if entry[0] not in (_BOOL, _FLOAT)]
    for letter, entries in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(_BOOL, re.compile(r"^(?:true|false)$", re.IGNORECASE), list("tTfF"))
_FLOAT_WORDS = re.compile(
    r"^[-+]?(?:\d+(?:\.\d*|(?=[eE]))|\.\d+)(?:[eE][-+]?\d+)?$|^[-+]?\.inf$|^\.nan$"
)
_Loader.add_implicit_resolver(_FLOAT, _FLOAT_WORDS, list("-+.0123456789"))


class _Dumper(yaml.SafeDumper):
    """Quotes the words that either kind of loader would take for something else."""


_Dumper.add_implicit_resolver(_FLOAT, _FLOAT_WORDS, list("-+.0123456789"))


def load_yaml(file: Path) -> Any:
    """The content of a YAML file.

    Raises:
        ValueError: if it cannot be read as YAML, with the place.
    """
    try:
        with file.open(encoding="utf-8") as handle:
            return yaml.load(handle, _Loader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} is not valid YAML: {error}") from error


def dump_yaml(content: Any) -> str:
    """YAML of plain lists, dictionaries and values, keys in their order.

    Examples:
        >>> print(dump_yaml({"l1": ["off", "paper"]}), end="")
        l1:
        - 'off'
        - paper
    """
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True))
