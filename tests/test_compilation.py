from __future__ import annotations

import pytest
import torch
from torch._dynamo.exc import FailOnRecompileLimitHit

from torchrl_l1.compilation import compiled


def test_modes():
    def function(x):
        return x

    assert compiled(function, False, dynamic=None) is function
    with pytest.raises(ValueError, match="compile must be True, False or 'auto', got 'yes'"):
        compiled(function, "yes", dynamic=None)


def test_only_the_compilers_errors_make_auto_fall_back(monkeypatch):
    """A GPU that is full for a moment is no reason to do without compilation."""
    errors = [None, torch.OutOfMemoryError("full"), None, FailOnRecompileLimitHit("ninth\nshape")]

    def fake(function, **options):
        def call(x):
            if error := errors.pop(0):
                raise error
            return function(x)

        return call

    monkeypatch.setattr(torch, "compile", fake)
    double = compiled(lambda x: 2 * x, "auto", dynamic=None, notice="compiling failed")
    assert double(1) == 2
    with pytest.raises(torch.OutOfMemoryError, match="full"):
        double(2)
    assert double(3) == 6
    with pytest.warns(RuntimeWarning, match=r"^compiling failed: ninth$"):
        assert double(4) == 8
    # Neither tried nor mentioned again.
    assert (double(5), errors) == (10, [])
