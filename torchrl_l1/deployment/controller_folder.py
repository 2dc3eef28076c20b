"""The folder of a robust controller: its files, and the environment and policy that it names."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_l1.atomic import write_atomically
from torchrl_l1.control import L1Config
from torchrl_l1.deployment.policies import Policy, is_run
from torchrl_l1.deployment.policy_files import FILE_KINDS
from torchrl_l1.envs import code_digests, file_digest
from torchrl_l1.experiment.checkpoints import kept_by
from torchrl_l1.experiment.files import read_text
from torchrl_l1.experiment.run_directory import RunDirectory, read_config
from torchrl_l1.experiment.settings import NAMING_KEYS

FILE, MODEL = "controller.json", "model.safetensors"
"""Names of its files: the settings and the model."""

FORMAT = 1
"""Format of the settings."""

_MOST_BYTES = 1_000_000
_WITH = " with "


def copied(
    file: Path, folder: Path, role: str, content: Callable[[Path], bytes] = Path.read_bytes
) -> str:
    """Copy a file into a folder, unless it is already there; returns its name there."""
    # The role is part of the name, since files from different folders may share a name.
    target = folder / (file.name if file.name.startswith(role) else f"{role}_{file.name}")
    if file.resolve() != target.resolve():
        write_atomically(target, content(file))
    return target.name


def read_controller(file: Path) -> tuple[dict[str, Any], dict[str, L1Config]]:
    """The contents of a controller's file, and its settings of L1.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged or of another version.
    """
    try:
        stored = json.loads(read_text(file, _MOST_BYTES))
        if stored["format"] == FORMAT:
            names = [stored[name] for name in ("environment", "policy", "preset")]
            names += [stored.get(name) for name in ("normalization", "weights")]
            names += stored.get("search_path") or ()
            for digests in (stored.get("files") or {}, stored.get("code") or {}):
                names += [*digests.keys(), *digests.values()]
            if not all(name is None or isinstance(name, str) for name in names):
                raise TypeError("a name in it is not text")
            configs = {name: L1Config(**values) for name, values in stored["configs"].items()}
            _ = configs[stored["preset"]]
            return stored, configs
    except (
        AttributeError, KeyError, OverflowError, RecursionError, TypeError, ValueError
    ) as error:  # fmt: skip
        raise ValueError(f"{file} is damaged ({error!r}): robustify the policy again") from error
    raise ValueError(
        f"{file} has the format {stored['format']!r}, but this version reads {FORMAT}: robustify "
        "the policy again"
    )


def check_files(folder: Path, digests: Mapping[str, str]) -> None:
    """Refuse files that are not the ones written with the settings.

    Raises:
        ValueError: naming the first such file.
    """
    for name, known in digests.items():
        file = folder / name
        if file.is_file() and file_digest(file) != known:
            raise ValueError(
                f"{file} is not the one that {FILE} was written with: robustify the policy again"
            )


def code_of(names: Iterable[object], search_path: Sequence[str]) -> dict[str, str]:
    """Digests of the files and modules that define environment and policy."""
    texts = (name for name in names if isinstance(name, str))
    return code_digests([n for n in texts if n.partition(":")[0] not in FILE_KINDS], search_path)


def check_replaces(
    folder: Path,
    environment: str,
    policy: str,
    normalization: str | None = None,
    weights: str | None = None,
) -> None:
    """Refuse a folder with the controller of another policy or environment.

    Raises:
        ValueError: naming what it holds.
    """
    try:
        stored, _ = read_controller(folder / FILE)
    except (FileNotFoundError, ValueError):  # nothing worth keeping
        return
    held = (stored["environment"], stored.get("given"))
    if held[1] is not None and held != (environment, given_by(policy, normalization, weights)):
        raise ValueError(
            f"{folder} holds the controller of {held[1]} in {held[0]}: give another --output, or "
            "remove it"
        )


def check_spares(origin: Mapping[str, Any], file: Path) -> None:
    """Refuse to replace a file that a policy comes from, or one in its run directory.

    Raises:
        ValueError: naming both files.
    """
    names = [origin.get(name) for name in ("policy", "normalization", "weights")]
    for name in filter(None, [*names, *str(origin.get("given") or "").split(_WITH)]):
        kind, _, rest = name.partition(":")
        source = Path(rest if kind in FILE_KINDS else name)
        place = kept_by(source) or source
        if file.exists() and file.resolve().is_relative_to(place.resolve()):
            raise ValueError(
                f"{file} exists, and the policy comes from {source}: name another file"
            )


def given_by(policy: str | None, *files: str | None) -> str | None:
    """The name of a policy, with the files that belong to it; ``None`` for an object."""
    named = [policy, *files] if policy else []
    return _WITH.join(_whole(name) for name in named if name) or None


def _whole(name: str) -> str:
    """A name with the absolute path of the file or folder in it."""
    for part in (name, *name.split(":", 1)):
        if part and Path(part).exists():
            return name.replace(part, str(Path(part).resolve()))
    return name


def check_runs_nothing(folder: Path, stored: dict[str, Any]) -> None:
    """Refuse a controller whose environment or policy is code or a pickle.

    Raises:
        ValueError: naming it.
    """
    _refuse_code(folder, [stored["environment"]])
    policy = placed(stored["policy"], folder)
    if policy and not is_run(policy):
        data = [name for name, kind in FILE_KINDS.items() if not kind.is_code]
        _refuse_code(folder, [stored["policy"]], data)
    check_run_names_nothing(policy)


def check_run_names_nothing(policy: Policy | None) -> None:
    """Refuse a run whose settings name code; anything that is not a run passes.

    Raises:
        ValueError: naming it.
    """
    settings = settings_of_run(policy)
    _refuse_code(policy, [settings.get(key) for key in NAMING_KEYS])


def _refuse_code(where: object, names: Iterable[object], data: Sequence[str] = ()) -> None:
    for name in map(str, names):
        if ":" in name and name.partition(":")[0] not in data:
            raise ValueError(
                f"{where} names {name!r}, which would be run: give --trust (trusted=True in "
                "Python) if the folder is yours"
            )


def settings_of_run(policy: Policy | None) -> dict[str, Any]:
    """The settings of the run that a policy comes from; empty if it comes from elsewhere."""
    run = Path(policy) if isinstance(policy, str) else None
    config = None if run is None else RunDirectory(kept_by(run) or run).config_file
    return {} if config is None or not config.is_file() else read_config(config)


def placed(name: str | None, folder: Path) -> str | None:
    """The path of a file that a controller names."""
    kind, colon, file = (name or "").rpartition(":")
    return f"{kind}{colon}{folder / file}" if name and (folder / file).is_file() else name
