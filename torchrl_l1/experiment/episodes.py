"""Episodes of environments, and writing them as datasets."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_l1.atomic import write_through
from torchrl_l1.envs import AnyTask, action_bounds
from torchrl_l1.experiment.datasets import is_minari_name
from torchrl_l1.registration import EPISODE_STEPS, gymnasium_id

_MINARI_FOLDER = "MINARI_DATASETS_PATH"


@dataclass(frozen=True)
class Episode:
    """An episode of L steps, float32.

    Attributes:
        observations: ``(L + 1, n)``, the last one included.
        actions: ``(L, m)``.
        rewards: ``(L,)``.
        terminations: ``(L,)``, bool.
        truncations: ``(L,)``, bool; the last is true if nothing else ended the episode.
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray

    def __len__(self) -> int:
        return len(self.rewards)


def split_episodes(data: TensorDictBase) -> list[Episode]:
    """The episodes in ``[N, T]`` steps of environments, in order.

    An episode cut off by the end of the data is truncated there. A step that the simulator could
    not take is dropped, and the episode is truncated before it.
    """
    columns = {
        "action": data["action"].float(),
        "reward": data["next", "reward"].float().squeeze(-1),
        "terminated": data["next", "terminated"].squeeze(-1),
        "truncated": data["next", "truncated"].squeeze(-1),
    }
    before, after = data["observation"].float(), data["next", "observation"].float()
    bad = data.get(("next", "non_finite"), torch.zeros_like(data["next", "done"])).squeeze(-1)
    done = data["next", "done"].squeeze(-1)
    episodes = []
    for row in range(data.shape[0]):
        ends = [int(end) + 1 for end in done[row].nonzero()]
        for first, last in zip([0, *ends], [*ends, data.shape[1]], strict=True):
            last -= int(bad[row, first:last].any())
            if last <= first:
                continue
            part = {name: value[row, first:last].numpy() for name, value in columns.items()}
            truncated = part["truncated"].copy()
            truncated[-1] |= not part["terminated"][-1]
            seen = torch.cat([before[row, first:last], after[row, last - 1 : last]]).numpy()
            episodes.append(
                Episode(seen, part["action"], part["reward"], part["terminated"], truncated)
            )
    return episodes


def write_dataset(output: str, episodes: Sequence[Episode], task: AnyTask, algorithm: str) -> str:
    """Write episodes as a dataset for :func:`~torchrl_l1.experiment.datasets.read_dataset`.

    Args:
        output: a ``.npz`` file; a name with a version, such as ``hopper/medium-v0``, for a Minari
            dataset, which needs the extra ``minari``; or a folder for a memory-mapped tensordict.
        episodes: at least one.
        task: their task.
        algorithm: name of the algorithm that made them, for Minari.

    Returns:
        the value to give as ``dataset``.

    Raises:
        ValueError: if the output already exists, or needs Minari, which is not installed.
    """
    path = Path(output)
    check_output(output)
    if path.suffix == ".npz":
        path.parent.mkdir(parents=True, exist_ok=True)
        rows: dict[str, Any] = _rows(episodes)
        write_through(path, lambda buffer: np.savez_compressed(buffer, **rows))
    elif is_minari_name(output):
        _write_minari(output, episodes, task, algorithm)
    else:
        _write_folder(path, _transitions(episodes))
    return output


def _write_folder(path: Path, data: TensorDictBase) -> None:
    """Write a memory-mapped tensordict completely or not at all."""
    with _beside(path) as temporary:
        try:
            data.memmap(temporary)
        except RuntimeError as error:  # what torch raises when the disk is full
            raise ValueError(f"{path} cannot be written: {error}") from error


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """A folder to write to, moved to its place once the block has succeeded."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        if temporary.is_symlink():
            temporary.unlink()
        shutil.rmtree(temporary, ignore_errors=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is None:  # from h5py, without an error number
            raise OSError(f"{path} cannot be written: {error}") from error
        raise type(error)(error.errno, error.strerror, str(path)) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_output(output: str) -> None:
    """Refuse an unusable output before the dataset is made.

    Raises:
        ValueError: if it already exists, or needs Minari, which is not installed.
    """
    path = Path(output)
    if path.exists():
        raise ValueError(f"{output} already exists: choose another place, or remove it")
    if path.suffix == ".npz":
        return
    if path.suffix and not is_minari_name(output):
        raise ValueError(f"{output}: datasets are .npz files, folders or Minari datasets (name-v0)")
    if is_minari_name(output):
        try:
            import minari

            import_module("h5py")  # with which Minari stores its data
        except ModuleNotFoundError:
            raise ValueError(
                f"{output} is the name of a Minari dataset, which needs Minari: pip install "
                "'torchrl-l1[minari]', or choose a .npz file"
            ) from None
        if output in minari.list_local_datasets():
            raise ValueError(f"Minari already has a dataset {output}: choose another name")


def _rows(episodes: Sequence[Episode]) -> dict[str, np.ndarray]:
    """One row per sampling instant; the last one of each episode has no action."""

    def column(name: str) -> np.ndarray:
        parts = []
        for episode in episodes:
            values = getattr(episode, name)
            parts += [values, np.zeros_like(values[:1])]
        return np.concatenate(parts)

    return {
        "observation": np.concatenate([episode.observations for episode in episodes]),
        "action": column("actions"),
        "reward": column("rewards"),
        "terminated": column("terminations"),
        "truncated": column("truncations"),
        "episode": np.repeat(np.arange(len(episodes)), [len(episode) + 1 for episode in episodes]),
    }


def _transitions(episodes: Sequence[Episode]) -> TensorDict:
    """Episodes one after the other, as TorchRL's collectors return them."""

    def column(name: str) -> torch.Tensor:
        return torch.from_numpy(np.concatenate([getattr(episode, name) for episode in episodes]))

    terminated, truncated = column("terminations")[:, None], column("truncations")[:, None]
    lengths = [len(episode) for episode in episodes]
    none = torch.zeros_like(terminated)
    return TensorDict(
        {
            "observation": torch.cat([torch.from_numpy(e.observations[:-1]) for e in episodes]),
            "action": column("actions"),
            "done": none,
            "terminated": none.clone(),
            "truncated": none.clone(),
            "next": {
                "observation": torch.cat([torch.from_numpy(e.observations[1:]) for e in episodes]),
                "reward": column("rewards")[:, None],
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
            "collector": {
                "traj_ids": torch.arange(len(episodes)).repeat_interleave(torch.tensor(lengths))
            },
        },
        batch_size=[sum(lengths)],
    )


def _write_minari(name: str, episodes: Sequence[Episode], task: AnyTask, algorithm: str) -> None:
    import minari
    from gymnasium.spaces import Box
    from minari.data_collector.episode_buffer import EpisodeBuffer
    from minari.storage.datasets_root_dir import get_dataset_path

    buffers = [
        EpisodeBuffer(
            id=number,
            observations=list(episode.observations),
            actions=list(episode.actions),
            rewards=list(episode.rewards),
            terminations=list(episode.terminations),
            truncations=list(episode.truncations),
            infos={},
        )
        for number, episode in enumerate(episodes)
    ]
    low, high = (bound.numpy() for bound in action_bounds(task))
    # Minari writes file by file; a kill would leave an incomplete dataset under the final name.
    with _beside(get_dataset_path(name)) as temporary, _minari_in(temporary):
        minari.create_dataset_from_buffers(
            name,
            buffers,
            env=gymnasium_id(task.name) if task.name in EPISODE_STEPS else None,
            observation_space=Box(-np.inf, np.inf, (task.observation_dim,), np.float32),
            action_space=Box(low, high, dtype=np.float32),
            algorithm_name=algorithm,
        )
        for part in (temporary / name).iterdir():
            part.rename(temporary / part.name)
        shutil.rmtree(temporary / name.split("/")[0])


@contextmanager
def _minari_in(folder: Path) -> Iterator[None]:
    """Make Minari use a folder as the root of all datasets."""
    before = os.environ.get(_MINARI_FOLDER)
    os.environ[_MINARI_FOLDER] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ[_MINARI_FOLDER]
        else:
            os.environ[_MINARI_FOLDER] = before
