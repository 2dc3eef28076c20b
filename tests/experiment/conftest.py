from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch

from torchrl_l1.envs import BatchedMujocoEnv
from torchrl_l1.experiment.episodes import Episode, split_episodes


@pytest.fixture
def episodes() -> list[Episode]:
    torch.manual_seed(0)
    env = BatchedMujocoEnv("inverted_pendulum", 3, max_steps=20, seed=0)
    return split_episodes(env.rollout(50, break_when_any_done=False))


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open() as handle:
        return list(csv.DictReader(handle))
