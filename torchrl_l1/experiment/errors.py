"""The errors that are the request's fault: told in one line, without a traceback."""

from __future__ import annotations

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException


class RecipeError(Exception):
    """No such recipe; the message lists those that exist."""


class RunDirectoryError(Exception):
    """The run directory cannot be used as asked; the message says why and what to do."""


class RunDirectoryInUse(RunDirectoryError):
    """Another process is running in the run directory."""


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
