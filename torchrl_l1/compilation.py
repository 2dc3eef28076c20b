"""Optional compilation of a pure function."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FunctionType
from typing import Any, Literal

import torch

CompileMode = bool | Literal["auto"]


def check_mode(mode: object, name: str = "compile") -> CompileMode:
    """The mode itself, refused if it is none.

    Args:
        mode: what a setting says.
        name: of the setting, for the error.

    Raises:
        ValueError: if it is neither a truth value nor ``"auto"``; 0 and 1 are numbers.
    """
    if isinstance(mode, bool) or mode == "auto":
        return mode
    raise ValueError(f"{name} must be True, False or 'auto', got {mode!r}")


def compiled(
    function: FunctionType, mode: CompileMode, *, dynamic: bool | None, notice: str = ""
) -> Callable[..., Any]:
    """The function, compiled as one graph or not.

    Args:
        function: a pure function of tensors.
        mode: ``False`` returns the function itself; ``True`` compiles it and lets a failing
            compiler raise; ``"auto"`` compiles it and falls back to the function, for good, where
            there is no working compiler. Errors of another kind are raised in every mode.
        dynamic: which sizes a graph leaves open, see :func:`torch.compile`.
        notice: what a warning says when ``"auto"`` falls back, before the cause; no warning if
            empty.

    Raises:
        ValueError: for any other mode.
    """
    if check_mode(mode) is False:
        return function
    return _Compiled(function, mode == "auto", dynamic, notice)


class _Compiled:
    """A compiled function which, if so asked, becomes the plain one once compiling fails."""

    def __init__(
        self, function: FunctionType, fall_back: bool, dynamic: bool | None, notice: str
    ) -> None:
        self._function = function
        self._fall_back = fall_back
        self._notice = notice
        self._compiled: Callable[..., Any] | None = torch.compile(
            _with_own_code(function), fullgraph=True, dynamic=dynamic
        )
        self._called = False

    def __call__(self, *args: Any) -> Any:
        if self._compiled is None:
            return self._function(*args)
        if self._called and not self._fall_back:
            return self._compiled(*args)
        try:
            if self._called:
                return self._compiled(*args)
            with _quiet(silence_errors=self._fall_back):
                result = self._compiled(*args)
            self._called = True
            return result
        except Exception as error:
            if not (self._fall_back and _is_of_the_compiler(error)):
                raise
            cause = str(error).strip().partition("\n")[0]
        # If the arguments are at fault, this raises the function's own, clearer error.
        result = self._function(*args)
        self._compiled = None
        if self._notice:
            warnings.warn(f"{self._notice}: {cause}", RuntimeWarning, stacklevel=2)
        return result


def _is_of_the_compiler(error: Exception) -> bool:
    # Imported by then: torch wraps in the first of these whatever its backends raise.
    from torch._dynamo.exc import FailOnRecompileLimitHit, TorchDynamoException

    return isinstance(error, (TorchDynamoException, FailOnRecompileLimitHit))


def _with_own_code(function: FunctionType) -> FunctionType:
    # torch keeps compiled graphs, eight at most, by code object, and closures made by the same
    # definition share theirs: the ninth controller of a process would fail to compile.
    return FunctionType(
        function.__code__.replace(),
        function.__globals__,
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )


@contextmanager
def _quiet(silence_errors: bool) -> Iterator[None]:
    # The first use of the compiler imports modules of torch that warn of their own deprecation,
    # and without a C++ compiler it logs at length; falling back is no news.
    disabled = logging.root.manager.disable
    try:
        if silence_errors:
            logging.disable(logging.ERROR)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)
