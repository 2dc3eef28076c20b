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


def message(error: BaseException) -> str:
    """The error's own words; ``KeyError`` would quote them like a key."""
    return str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
