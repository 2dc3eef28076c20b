from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_l1.dynamics import read_transitions
from torchrl_l1.envs import BatchedMujocoEnv, get_task
from torchrl_l1.experiment.datasets import is_minari_name, read_dataset
from torchrl_l1.experiment.episodes import Episode, check_output, split_episodes, write_dataset

pytestmark = pytest.mark.usefixtures("own_folder")

QUIET = pytest.mark.filterwarnings("ignore::UserWarning:minari", "ignore::DeprecationWarning")


def joined(episodes: list[Episode]) -> dict[str, np.ndarray]:
    return {
        "observation": np.concatenate([e.observations[:-1] for e in episodes]),
        "action": np.concatenate([e.actions for e in episodes]),
        "next": np.concatenate([e.observations[1:] for e in episodes]),
    }


def test_episodes_are_those_of_the_environments() -> None:
    torch.manual_seed(0)
    data = BatchedMujocoEnv("walker", 2, max_steps=30, seed=0).rollout(
        50, break_when_any_done=False
    )
    found = split_episodes(data)
    assert sum(map(len, found)) == 100
    done = data["next", "done"].sum() + (~data["next", "done"][:, -1]).sum()
    assert len(found) == int(done) > 3
    rewards = np.concatenate([episode.rewards for episode in found])
    assert np.array_equal(rewards, data["next", "reward"].flatten().numpy())
    for episode in found:
        ends = episode.terminations | episode.truncations
        assert ends[-1] and not ends[:-1].any()
        assert episode.observations.dtype == np.float32
    assert any(episode.terminations[-1] for episode in found)


def test_a_step_that_did_not_happen_is_left_out() -> None:
    torch.manual_seed(0)
    data = BatchedMujocoEnv("inverted_pendulum", 1, max_steps=8, seed=0).rollout(8)
    data["next", "non_finite"][0, -1] = True
    (episode,) = split_episodes(data)
    assert len(episode) == 7 and episode.truncations[-1]
    assert np.array_equal(episode.observations[-1], data["observation"][0, 7].numpy())


@QUIET
@pytest.mark.parametrize("output", ["deep/data.npz", "folder", "pendulum/random-v0"])
def test_what_is_written_is_read_again(output: str, episodes: list[Episode]) -> None:
    if output.endswith("-v0"):
        pytest.importorskip("minari")
        pytest.importorskip("h5py")
    task = get_task("inverted_pendulum")
    assert write_dataset(output, episodes, task, "random") == output
    data = read_dataset(output)
    read, expected = read_transitions(data, dtype=torch.float32), joined(episodes)
    assert read.dropped == 0
    assert np.array_equal(read.data["observation"], expected["observation"])
    assert np.array_equal(read.data["action"], expected["action"])
    assert np.array_equal(read.data["next", "observation"], expected["next"])
    # Episodes stay apart: 50 steps of 20 are three of them in each environment.
    assert int((~read.joined).sum()) == len(episodes) == 9
    with pytest.raises(ValueError, match="already"):
        write_dataset(output, episodes, task, "random")
    if not output.endswith(".npz"):
        terminated = np.concatenate([episode.terminations for episode in episodes])
        assert np.array_equal(data["next", "terminated"].flatten(), terminated)
        truncated = np.concatenate([episode.truncations for episode in episodes])
        assert np.array_equal(data["next", "truncated"].flatten(), truncated)
        assert data["next", "reward"].dtype in (torch.float32, torch.float64)
    else:
        arrays = np.load(output)
        assert arrays["observation"].dtype == arrays["reward"].dtype == np.float32
        assert arrays["truncated"].sum() == 9 and not arrays["terminated"].any()


@pytest.mark.parametrize("output", ["{}/hopper-v0", "t/x-v0", "./data/hopper-v0"])
def test_a_path_is_a_folder_although_it_ends_in_a_version(
    output: str, episodes: list[Episode], tmp_path: Path
) -> None:
    """Names of Minari's begin with no slash, and have two letters before one."""
    output = output.format(tmp_path / "deep")
    with pytest.raises(FileNotFoundError, match="no such dataset"):
        read_dataset(output)
    write_dataset(output, episodes, get_task("inverted_pendulum"), "random")
    assert (Path(output) / "meta.json").is_file() and not Path("minari").exists()
    assert len(read_dataset(output)) == sum(map(len, episodes))


def test_names_of_datasets_are_those_that_minari_takes() -> None:
    pattern = pytest.importorskip("minari.dataset.minari_dataset").DATASET_ID_RE
    for name in ("a-v0", "ab/c-v1", "a/b/c-v0", "d4rl_x/hop-per/medium-v2", "a/b-v0", "/ab/c-v0",
                 "ab//c-v0", "a.b-v0", "ab/c/", "ab/c-v0\n"):  # fmt: skip
        assert is_minari_name(name) == bool(pattern.fullmatch(name)), name


def test_what_has_words_in_place_of_a_number_keeps_them(
    episodes: list[Episode], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As h5py's errors do."""

    def torn(*_: Any, **__: Any) -> None:
        raise OSError("Can't write data (file write failed)")

    monkeypatch.setattr(TensorDict, "memmap", torn)
    with pytest.raises(OSError, match=r"^folder cannot be written: Can't write data \(file"):
        write_dataset("folder", episodes, get_task("inverted_pendulum"), "random")


def test_the_place_of_a_dataset_says_what_it_is_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "minari", None)
    with pytest.raises(ValueError, match=r"torchrl-l1\[minari\]'?, or choose a .npz file"):
        check_output("hopper/medium-v0")
    with pytest.raises(ValueError, match=r"datasets are \.npz files"):
        check_output("data.h5")


@QUIET
@pytest.mark.parametrize("output", ["data.npz", "folder", "pendulum/random-v0"])
def test_what_cannot_be_written_whole_is_not_there(
    output: str, episodes: list[Episode], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def torn(*arguments: Any, **options: Any) -> None:
        raise full

    task = get_task("inverted_pendulum")
    with monkeypatch.context() as full_disk:
        if output.endswith("-v0"):
            minari = pytest.importorskip("minari")
            pytest.importorskip("h5py")
            full_disk.setattr(minari.utils, "MinariDataset", torn)  # all is written by then
        elif output == "folder":
            full_disk.setattr(torch.Tensor, "copy_", torn)
        full_disk.setattr(os, "fsync", torn)
        with pytest.raises(OSError, match="No space left"):
            write_dataset(output, episodes, task, "random")
    assert not [file for file in tmp_path.rglob("*") if file.is_file()]
    assert write_dataset(output, episodes, task, "random") == output
