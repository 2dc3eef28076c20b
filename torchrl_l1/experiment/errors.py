"""The errors that are the request's fault: told in one line, without a traceback."""

from __future__ import annotations

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from torchrl_l1.experiment.recipes import RecipeError
from torchrl_l1.experiment.run_directory import RunDirectoryError

USER_ERRORS = (
    FileNotFoundError,
    HydraException,
    KeyError,
    OmegaConfBaseException,
    RecipeError,
    RunDirectoryError,
    ValueError,
)
