from __future__ import annotations

import pytest

from torchrl_l1.experiment.settings import SCHEMAS
from torchrl_l1.experiment.stages import STAGES
from torchrl_l1.report.algorithms import ALGORITHMS, facts


def test_every_algorithm_is_known_with_its_ways_to_act() -> None:
    assert set(SCHEMAS) <= set(ALGORITHMS)
    expected = {"metrpo": True, "mbmf": True, "pets": False, "dets": False}
    assert {name: facts(name).samples for name in ALGORITHMS} == expected
    # In the order of the stages as users type them.
    assert [stage.name for stage in facts("mbmf").stages] == list(STAGES["mbmf"])
    assert {name: len(facts(name).stages) > 1 for name in STAGES} == {
        name: len(stages) > 1 for name, stages in STAGES.items()
    }
    with pytest.raises(ValueError, match="'nothing'; there are metrpo, mbmf, pets, dets"):
        facts("nothing")
