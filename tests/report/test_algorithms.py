from __future__ import annotations

import pytest

from torchrl_l1.experiment.settings import SCHEMAS
from torchrl_l1.report.algorithms import ALGORITHMS, facts


def test_every_algorithm_is_known_with_its_ways_to_act() -> None:
    assert set(SCHEMAS) <= set(ALGORITHMS)
    expected = {"metrpo": True, "mbmf": True, "pets": False, "dets": False}
    assert {name: facts(name).samples for name in ALGORITHMS} == expected
    stages = {name: [stage.name for stage in facts(name).named_stages] for name in SCHEMAS}
    # In the order of the stages as users type them.
    assert stages == {
        "metrpo": [], "pets": [], "mbmf": ["shooting", "cloning", "fine_tuning"],
    }  # fmt: skip
    with pytest.raises(ValueError, match="'nothing'; there are metrpo, mbmf, pets, dets"):
        facts("nothing")
