from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchrl_l1.deployment import RobustController, environment_source
from torchrl_l1.deployment.controller_folder import check_replaces


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
