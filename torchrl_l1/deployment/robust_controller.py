"""A policy with L1 around it: its environments, its evaluation and its files."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TransformedEnv
from tqdm import tqdm

from torchrl_l1.atomic import write_atomically
from torchrl_l1.checks import check_choice, check_count
from torchrl_l1.control import L1Config, L1Transform
from torchrl_l1.deployment.assessment import Assessment, Disturbances, assess
from torchrl_l1.deployment.controller_folder import (
    FILE,
    FORMAT,
    MODEL,
    check_files,
    check_run_names_nothing,
    check_runs_nothing,
    code_of,
    copied,
    given_by,
    placed,
    read_controller,
    settings_of_run,
)
from torchrl_l1.deployment.learning import policy_transforms
from torchrl_l1.deployment.policies import Policy, load_policy
from torchrl_l1.deployment.policy_files import FILE_KINDS
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import EnvironmentSource, environment_source, vector_environment
from torchrl_l1.envs.references import folders_of
from torchrl_l1.envs.sources import MakeEnv
from torchrl_l1.experiment.checkpoints import kept_by
from torchrl_l1.experiment.evaluate import load_run
from torchrl_l1.experiment.files import digest
from torchrl_l1.experiment.l1_options import OFF, closest_option, l1_option
from torchrl_l1.experiment.settings import l1_config

PRESETS = ("robust", "paper")
"""Presets of L1 for a policy, the default first."""


@dataclass
class RobustController:
    """A policy with a model of its environment and L1 around it; made by :func:`robustify`.

    Attributes:
        source: makes its environments.
        policy: reads ``observation`` and writes ``action``.
        model: the learned dynamics.
        configs: settings of L1 by preset, bounds of the action included.
        preset: the default preset.
        origin: how to find the policy again, with ``search_path``, the folders of the code that
            policy and environment name, and ``code``, its digests.
    """

    source: EnvironmentSource
    policy: TensorDictModuleBase
    model: EnsembleDynamics
    configs: dict[str, L1Config]
    preset: str = PRESETS[0]
    origin: dict[str, Any] = field(default_factory=dict)

    @property
    def config(self) -> L1Config:
        """The default settings of L1."""
        return self.configs[self.preset]

    def wrap(self, env: EnvBase, preset: str | None = None) -> TransformedEnv:
        """An environment with L1 between it and the policy.

        Args:
            env: the one given to :func:`robustify`, or one with disturbances, batched or not.
            preset: the settings; the default preset if ``None``.

        Returns:
            the environment with an ``L1Transform`` as its last transform:
            ``env.rollout(1000, robust.policy)``.
        """
        config = self.settings(preset)
        env = TransformedEnv(self._joined(env), auto_unwrap=True)
        for transform in [
            *policy_transforms(self.policy, lambda: env),
            L1Transform(self.model, config),
        ]:
            env.append_transform(transform)
        return env

    def _joined(self, env: EnvBase) -> EnvBase:
        """Join the parts of the observation in the policy's order, if that is not done yet."""
        there = getattr(env, "full_observation_spec", {}).get("observation", None)
        is_whole = there is not None and there.shape[-1] == self.model.observation_dim
        return vector_environment(env, () if is_whole else self.source.observation_keys)

    def settings(self, preset: str | None) -> L1Config:
        """The settings of a preset; of the default preset if ``None``.

        Raises:
            ValueError: for an unknown preset, or if there is no L1.
        """
        if not self.configs:
            raise ValueError("a policy in an environment has no L1: robustify it first")
        name = self.preset if preset is None else preset
        check_choice("preset", name, tuple(self.configs))
        return self.configs[name]

    def evaluate(
        self,
        disturbances: Disturbances,
        *,
        episodes: int = 10,
        most_steps: int = 1000,
        seed: int = 0,
        progress: bool | None = None,
    ) -> Assessment:
        """Test the policy under disturbances: L1 off, each preset, and the oracle.

        All see the same resets. The oracle, which is told the disturbance, is tested where
        disturbances are matched, and shows what is possible.

        Args:
            disturbances: values by name, ``{"bias": [0.5, 1.0]}``, or a suite, ``"quick"``; see
                :data:`~torchrl_l1.envs.DISTURBANCES`.
            episodes: number of episodes per cell.
            most_steps: number of steps after which an episode is cut off.
            seed: seed of resets and random disturbances.
            progress: whether to show a bar; if ``None``, only on a terminal.

        Raises:
            ValueError: for a disturbance that is unknown or cannot act on the environment.
        """
        check_count("episodes", episodes)
        check_count("most_steps", most_steps)
        name = self.source.name
        heading = f"{name.removeprefix('gymnasium/')}: L1 off and on" if name else "L1 off and on"
        with private_randomness(), progress_bar("evaluate", "cell", progress) as bar:

            def advance(total: int) -> None:
                bar.total = total
                bar.update()

            return assess(
                self.source, self.policy, self.model, self.configs, disturbances, episodes,
                most_steps, seed, advance, heading,
            )  # fmt: skip

    def save(self, folder: str | Path) -> Path:
        """Write model, settings and, if the policy came from a file, that file to a folder.

        The files written for L1 contain no pickles; the policy's own files are copied as they are.

        Returns:
            the folder.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        given = (self.origin.get(name) for name in ("policy", "normalization", "weights"))
        origin = {"given": given_by(*given), **self.origin}
        files = [MODEL]
        kind, _, file = str(origin.get("policy") or "").partition(":")
        if kind in FILE_KINDS:
            files.append(copied(Path(file), folder, "policy", FILE_KINDS[kind].content))
            origin["policy"] = f"{kind}:{files[-1]}"
        named = [name for name in (self.source.name, origin.get("policy")) if name]
        folders = [*(origin.get("search_path") or ()), *folders_of(named, [Path.cwd()])]
        origin["search_path"] = list(dict.fromkeys(folders))
        if origin.get("policy") and Path(origin["policy"]).exists():  # a run directory
            origin["policy"] = str(Path(origin["policy"]).resolve())
        for name in ("normalization", "weights"):
            if origin.get(name) and Path(origin[name]).is_file():
                origin[name] = copied(Path(origin[name]), folder, name)
                files.append(origin[name])
        self.model.save(folder / MODEL)
        stored = {
            "format": FORMAT,
            "environment": self.source.name,
            **origin,
            "files": {name: digest((folder / name).read_bytes()) for name in files},
            "preset": self.preset,
            "configs": {name: asdict(config) for name, config in self.configs.items()},
        }
        write_atomically(folder / FILE, json.dumps(stored, indent=2) + "\n")
        return folder

    @classmethod
    def load(
        cls,
        folder: str | Path,
        make_env: MakeEnv | None = None,
        policy: Policy | None = None,
        trusted: bool = True,
    ) -> RobustController:
        """Read what :meth:`save` wrote.

        Args:
            folder: the folder.
            make_env: the environment; the one of the folder if ``None``.
            policy: the policy, likewise.
            trusted: whether functions and pickles that the folder names may be run.

        Raises:
            FileNotFoundError: if there is no such folder.
            ValueError: for a file that is damaged or of another version, or an untrusted folder
                that names code to run.
            ValueError: if environment or policy were given as objects, which no folder holds, and
                are not given again.
            ValueError: for a file that was not saved with the settings, as after an interrupted
                ``save``.

        Warns:
            UserWarning: if code that the folder names has changed since.
        """
        folder = Path(folder)
        if not (folder / FILE).exists():
            raise FileNotFoundError(f"{folder} holds no controller: there is no {FILE}")
        stored, configs = read_controller(folder / FILE)
        if not trusted:
            check_runs_nothing(folder, stored)
        check_files(folder, stored.get("files") or {})
        for what, value in (("make_env", make_env), ("policy", policy)):
            if value is None and not stored["environment" if what == "make_env" else what]:
                raise ValueError(
                    f"{folder} does not name the {what}, which was an object: give it again"
                )
        # Newly given names are looked up here first.
        anew = [name for name in (make_env, policy) if isinstance(name, str)]
        search_path = [*folders_of(anew, [Path.cwd()]), *(stored.get("search_path") or ())]
        names = {key: stored.get(key) for key in ("policy", "normalization", "weights")}
        origin: dict[str, Any] = {"search_path": list(dict.fromkeys(search_path))}
        if policy is None:
            found = {key: placed(value, folder) for key, value in names.items()}
            policy, given = found.pop("policy"), found
            origin["given"] = stored.get("given")
        else:
            given = {"normalization": None, "weights": None}
        assert policy is not None
        named = stored["environment"] if make_env is None else make_env
        origin["code"] = code_of((named, policy), search_path)
        before = stored.get("code") or {}
        changed = [name for name, code in origin["code"].items() if before.get(name, code) != code]
        if changed:
            warnings.warn(
                f"{', '.join(changed)} changed since the controller {folder} was made: robustify "
                "the policy again if it acts differently now",
                stacklevel=2,
            )
        source = source_for(named, policy, search_path)
        return cls(
            source,
            load_policy(policy, source.one(), **given, search_path=search_path),
            EnsembleDynamics.load(folder / MODEL),
            configs,
            stored["preset"],
            {"policy": policy if isinstance(policy, str) else None, **given, **origin},
        )


def source_for(
    make_env: MakeEnv, policy: Policy, search_path: Sequence[str] = ()
) -> EnvironmentSource:
    """The environment, with the parts of its observation in the order that a run's policy reads."""
    settings = settings_of_run(policy)
    if make_env != settings.get("task"):
        return environment_source(make_env, search_path)
    source = environment_source(make_env, settings.get("search_path") or ())
    return replace(source, observation_keys=tuple(settings.get("observation_keys") or ()))


def load_target(
    target: str,
    policy: str | None = None,
    normalization: str | None = None,
    weights: str | None = None,
    trusted: bool = False,
) -> RobustController:
    """Load the target of a command: a controller, a run, or a policy in its environment.

    Args:
        target: a folder written by ``torchrl-l1 robustify`` or :meth:`RobustController.save`, a
            run directory, whose own model and settings are used, or an environment by name.
        policy: the policy in that environment, which then has no L1.
        normalization: see :func:`load_policy`.
        weights: likewise.
        trusted: whether functions and pickles named in a folder, or in the settings of a run, may
            be run; those named in the arguments are always run.

    Raises:
        ValueError: if the target is none of these, a policy or one of its files is given beside a
            folder, or an untrusted folder names code to run.
    """
    folder = Path(target)
    if folder.is_dir() or (kept_by(folder) and folder.is_file()):
        given = {"policy": policy, "normalization": normalization, "weights": weights}
        for name, value in given.items():
            if value is not None:
                raise ValueError(f"{target} has its own policy: leave --{name} out")
        for place in (folder, folder / "controller"):
            if (place / FILE).exists():
                return RobustController.load(place, trusted=trusted)
        if not trusted:
            check_run_names_nothing(target)
        return _of_run(folder)
    if policy is None:
        raise ValueError(
            f"there is no folder {target}; give a controller, a run directory, or an environment "
            "with --policy"
        )
    if not trusted:
        check_run_names_nothing(policy)
    source = source_for(target, policy)
    acting = load_policy(policy, source.one(), normalization, weights)
    return RobustController(source, acting, EnsembleDynamics(1, 1, hidden=()), {}, OFF)


def _of_run(folder: Path) -> RobustController:
    """A trained run with its own model and, where it has one of a preset's kind, its own L1."""
    run = load_run(folder)
    own, task = run.recipe.l1, run.algorithm.task
    trained_with = closest_option(own, task)
    configs = {}
    for name in reversed(PRESETS):
        settings = own
        if trained_with != name:
            settings = replace(l1_option(name), epsilon=own.epsilon)
        config = l1_config(settings, task)
        assert config is not None
        configs[name] = config
    policy = list(run.algorithm.policies.values())[-1]
    model = run.algorithm.acting_dynamics
    search_path = list(run.recipe.search_path)
    code = code_of([run.recipe.task], search_path)
    origin = {"policy": str(folder), "search_path": search_path, "code": code}
    source = environment_source(run.recipe.task, run.recipe.search_path)
    source = replace(source, observation_keys=tuple(run.recipe.observation_keys))
    preset = trained_with if trained_with in PRESETS else PRESETS[0]
    return RobustController(source, policy, model, configs, preset, origin)


@contextmanager
def private_randomness() -> Iterator[None]:
    """Leave torch's global generator untouched by random draws inside."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


def progress_bar(words: str, unit: str, progress: bool | None) -> tqdm:
    """A progress bar, or none; if ``None``, one only on a terminal."""
    disable = None if progress is None else not progress
    return tqdm(desc=words, unit=unit, disable=disable)
