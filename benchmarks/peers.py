"""Other libraries to compare with, in an environment of their own and a process of their own."""

from __future__ import annotations

import json
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path
from typing import Any

import torch

ENVIRONMENT = Path(__file__).parents[1] / "build" / "peers"
"""Where the environment is made."""

MBRL = "mbrl==0.2.0"
NEEDS = ("hydra-core", "omegaconf", "gymnasium", "tqdm", "matplotlib", "termcolor", "imageio")
"""What mbrl needs. It names versions of them that no longer run, so it is installed without."""

_WORKER = Path(__file__).with_name("mbrl_worker.py")


class PeersUnavailableError(RuntimeError):
    """The environment could not be made, or what runs in it failed."""


def environment() -> Path:
    """The interpreter of the peers' environment, which is made if need be.

    Torch and all that is there already come from the environment that runs: the same torch on
    both sides, and little to download.

    Raises:
        PeersUnavailableError: with the remedy.
    """
    here = sysconfig.get_paths()["purelib"]
    stamp, contents = ENVIRONMENT / ".installed", "\n".join([MBRL, *NEEDS, here])
    python = ENVIRONMENT / "bin" / "python"
    if stamp.exists() and stamp.read_text() == contents:
        return python
    print(f"making the peers' environment in {ENVIRONMENT}", file=sys.stderr)
    try:
        venv.create(ENVIRONMENT, clear=True, with_pip=True)
        variables = {"base": str(ENVIRONMENT), "platbase": str(ENVIRONMENT)}
        own = Path(sysconfig.get_path("purelib", "venv", variables))
        (own / "_running_environment.pth").write_text(f"{here}\n")
        for arguments in (["--no-deps", MBRL], list(NEEDS)):
            command = [str(python), "-m", "pip", "install", "--quiet", *arguments]
            subprocess.run(command, check=True, capture_output=True, text=True)
    except (subprocess.CalledProcessError, OSError) as error:
        reason = str(getattr(error, "stderr", None) or error).strip().splitlines()[-1:]
        raise PeersUnavailableError(
            f"cannot install {MBRL} and {', '.join(NEEDS)} into {ENVIRONMENT}: "
            f"{' '.join(reason)}. Connect to a package index and run `make bench` again"
        ) from error
    stamp.write_text(contents)
    return python


class Peer:
    """mbrl-lib in a process that does one thing per line that it is sent.

    Args:
        threads: of torch.

    Raises:
        PeersUnavailableError: if there is no such process to be had.
    """

    def __init__(self, threads: int) -> None:
        self._process = subprocess.Popen(
            [str(environment()), "-W", "ignore", str(_WORKER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        found = self.call("start", threads=threads)
        if found["torch"] != torch.__version__:
            self.close()
            raise PeersUnavailableError(
                f"the peers' environment has torch {found['torch']}, this one {torch.__version__}; "
                f"remove {ENVIRONMENT} and run `make bench` again"
            )

    def call(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Send a command, wait for its answer.

        Raises:
            PeersUnavailableError: if the process ends instead of answering.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps({"command": command, **arguments}) + "\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            self.close()
            raise PeersUnavailableError(
                f"mbrl-lib failed in {command!r}, see above; if a package is missing or too new "
                f"for it, remove {ENVIRONMENT} and run `make bench` again"
            )
        return json.loads(answer)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()


def peer(threads: int) -> Peer | None:
    """mbrl-lib if it can be had; otherwise why not is printed, and how to get it."""
    try:
        return Peer(threads)
    except PeersUnavailableError as error:
        print(f"without mbrl-lib: {error}", file=sys.stderr)
        return None
