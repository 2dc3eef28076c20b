from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchrl_l1.deployment import RobustController, environment_source
from torchrl_l1.deployment.controller_folder import check_replaces, check_runs_nothing


@pytest.mark.parametrize("content", ["[]", "3", "{}", '{"format": 1}', "{", '{"format": 7}', ""])
def test_a_damaged_controller_is_named(content, tmp_path):
    (tmp_path / "controller.json").write_text(content)
    with pytest.raises(ValueError, match=r"controller\.json (is damaged|has the format)"):
        RobustController.load(tmp_path)


def test_other_weights_make_another_policy(robust, policy_file, tmp_path, monkeypatch):
    for name in ("a.pt", "b.pt"):
        torch.save({"weight": torch.ones(1, 4), "bias": torch.ones(1)}, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    source = environment_source("inverted_pendulum")
    origin = {"policy": "own_policy.py:network", "weights": "a.pt"}
    replace(robust, source=source, origin=origin).save("controller")
    folder, name = Path("controller"), "own_policy.py:network"
    check_replaces(folder, "inverted_pendulum", name, None, str(tmp_path / "a.pt"))
    for weights in ("b.pt", None):
        with pytest.raises(ValueError, match=r"holds .*own_policy\.py:network with"):
            check_replaces(folder, "inverted_pendulum", name, None, weights)
    RobustController.load("controller").save("again")
    check_replaces(Path("again"), "inverted_pendulum", name, None, "a.pt")


def test_a_colon_in_the_path_of_a_run_is_no_code(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("2026-12-01_04:30/run", "sb3:model.zip"):
        Path(name).mkdir(parents=True)
    for run in ("2026-12-01_04:30/run", str(tmp_path / "2026-12-01_04:30/run")):
        check_runs_nothing(tmp_path, {"environment": "inverted_pendulum", "policy": run})
    # A folder of that name does not hide that the pickle would be read.
    for code in ("2026-12-01_04:30/none", "own.py:balance", "sb3:model.zip"):
        with pytest.raises(ValueError, match="give --trust"):
            check_runs_nothing(tmp_path, {"environment": "inverted_pendulum", "policy": code})
