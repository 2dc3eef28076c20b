"""The processes that a campaign starts to train, to evaluate or to launch a sweep.

Not for users: they end when the campaign's own process, PARENT, ends in any way.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from typing import Any

_PR_SET_PDEATHSIG = 1


def end_with(parent: int) -> None:
    """Have the system kill this process when its parent ends. Linux only; elsewhere it continues.

    A run that continues keeps its run directory locked, and the campaign waits for it when
    started again. Nothing is lost either way: all files are replaced atomically.
    """
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # the parent ended before this took effect
        sys.exit("the campaign has ended")


def main(arguments: Sequence[str]) -> None:
    """Entry point of the process."""
    parent, command, *rest = arguments
    end_with(int(parent))
    if command == "train":
        train(json.loads(rest[0]))
    elif command == "evaluate":
        from torchrl_l1.campaign.evaluation import evaluate_run

        run_dir, evaluations = rest
        for name, settings in json.loads(evaluations).items():
            print(f"Evaluated: {evaluate_run(run_dir, name, settings)}", flush=True)
    else:
        from torchrl_l1.experiment.launch import launch

        recipe, *overrides = rest
        launch(recipe, overrides)


def train(settings: Mapping[str, Any]) -> None:
    """Train or resume as planned by the campaign, even if the recipe has changed since.

    Exits with the status ``TAKEN`` if another process is running in the run directory.
    """
    from omegaconf import DictConfig, OmegaConf

    from torchrl_l1.campaign.workers import TAKEN
    from torchrl_l1.experiment.errors import USER_ERRORS, RunDirectoryInUse, message
    from torchrl_l1.experiment.run import run
    from torchrl_l1.experiment.settings import schema_of
    from torchrl_l1.experiment.shutdown import orderly_end

    config = OmegaConf.merge(OmegaConf.structured(schema_of(settings)), dict(settings))
    assert isinstance(config, DictConfig)
    try:
        with orderly_end():
            run(config)
    except RunDirectoryInUse as error:
        print(error, file=sys.stderr)
        sys.exit(TAKEN)
    except USER_ERRORS as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        sys.exit(message(error))


if __name__ == "__main__":
    main(sys.argv[1:])
