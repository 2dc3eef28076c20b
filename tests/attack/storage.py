"""Disks that are full, read-only, forbidden or in disorder, under every command that writes."""

from __future__ import annotations

import ctypes
import errno
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tests.attack.kills import METRPO_TINY
from tests.attack.outcome import Attack, Row, Said, changes, command, contents
from torchrl_l1.campaign.description import dump_yaml

RECIPE = "metrpo/inverted_pendulum"
OVERRIDES = [*METRPO_TINY, "outer_iterations=2", "fit.max_epochs=2"]

# The lines of a shell that does nothing but start the command, with its output somewhere.
SHELL = [sys.executable, "-m", "torchrl_l1.cli"]

NAMES = {"disk": "a full one, of a few kB", "disk full": "full from some file on"}


@dataclass
class Writer:
    """A command that writes below a folder, which may not be there yet.

    Attributes:
        name: of the command.
        make: its arguments, from the folder.
        told: where the command names the trouble in words of its own.
    """

    name: str
    make: Callable[[Path], list[str]]
    told: str = ""

    @property
    def refusal(self) -> str:
        return self.told


def writers(folder: Path) -> list[Writer]:
    """Every command that writes, and a finished run and a campaign to begin with."""
    source = folder / "run"
    said = command(["run", RECIPE, *OVERRIDES, f"run_dir={source}"], folder / "run.log")
    assert said.status == 0, said.text
    matrix = {"recipe": RECIPE, "overrides": OVERRIDES, "matrix": {"seed": [0]}}
    (folder / "one.yaml").write_text(dump_yaml({"runs": [matrix]}))
    evaluation = ["--l1", "off", "--bias", "0", "0.5", "1", "--episodes", "1"]
    robustify = ["--policy", str(source), "--steps", "60", "--episodes", "1", "--most-steps", "5"]
    training = ["run", RECIPE, *OVERRIDES, "--resume"]
    return [
        Writer("run", lambda at: [*training, f"run_dir='{at}/run'"]),
        Writer("campaign", lambda at: ["campaign", str(folder / "one.yaml"), "--output", str(at)]),
        Writer("evaluate", lambda at: ["evaluate", str(source), *evaluation, "--output", str(at)]),
        Writer("report", lambda at: ["report", str(source), "--output", str(at)]),
        Writer("robustify", lambda at: ["robustify", "inverted_pendulum", *robustify,
                                        "--output", str(at)]),
        Writer("export", lambda at: ["export", str(source), str(at / "policy.pt"), "--steps", "3"]),
        Writer("play", lambda at: ["play", str(source), "--steps", "3",
                                   "--output", str(at / "film.gif")]),
    ]  # fmt: skip


# What is done to a process before it is a command.


def obey_modes() -> None:
    """Root may write what nobody may: without these capabilities it may not."""
    if os.geteuid() != 0:
        return
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)  # the version of the structures, this process
    found = (ctypes.c_uint32 * 6)()
    libc.capget(header, found)
    for part in (0, 1):  # effective and permitted
        found[part] &= ~(1 << 1 | 1 << 2)  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
    if libc.capset(header, found) != 0:
        raise OSError(ctypes.get_errno(), "capset")


def fail_writing(at: int) -> None:
    """From its n-th file on this process and its children find the disk full, only just."""
    sync, count = os.fsync, iter(range(10**9))

    def failing(handle: int) -> None:
        if next(count) >= at:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(handle)

    os.fsync = failing


def _private_mounts() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    namespace = 0x00020000  # CLONE_NEWNS
    if libc.unshare(namespace) != 0:
        raise OSError(ctypes.get_errno(), "unshare")
    subprocess.run(["mount", "--make-rprivate", "/"], check=True, capture_output=True)


def mount_tiny(at: Path, size: int) -> None:
    """A disk of so many bytes, which only this process and its children see."""
    _private_mounts()
    options = ["-t", "tmpfs", "-o", f"size={size}", "none", str(at)]
    subprocess.run(["mount", *options], check=True, capture_output=True)


def mount_read_only(at: Path) -> None:
    """The folder as a read-only file system."""
    _private_mounts()
    for options in (["--bind"], ["-o", "remount,ro,bind"]):
        subprocess.run(["mount", *options, str(at), str(at)], check=True, capture_output=True)


def may_mount() -> str | None:
    """``None`` if this process may, else why not."""
    if not sys.platform.startswith("linux") or shutil.which("unshare") is None:
        return "needs Linux with unshare"
    tried = subprocess.run(
        ["unshare", "-m", "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True, text=True
    )
    return tried.stderr.strip() or "may not mount" if tried.returncode else None


@dataclass
class Fault:
    """What is wrong with a disk.

    Attributes:
        name: for the table.
        words: what the line says of it, besides the path.
        prepare: what is done to the process, from the folder; ``None`` for nothing.
        spoil: what is done to the folder before; it gives the folder to write to.
        stays: whether what is written stays, so that the command can go on later.
    """

    name: str
    words: str
    prepare: Callable[[Path], Callable[[], object] | None] = lambda folder: None
    spoil: Callable[[Path], Path] = lambda folder: folder
    stays: bool = False


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _file_in_the_way(folder: Path) -> Path:
    folder.write_text("years of work")
    return folder


def _below_a_file(folder: Path) -> Path:
    folder.write_text("years of work")
    return folder / "below"


def _too_long(folder: Path) -> Path:
    return folder / ("x" * 300)


def _link_to_itself(folder: Path) -> Path:
    folder.symlink_to(folder)
    return folder / "below"


def faults() -> list[Fault]:
    full = "free some space"
    sizes = (4096, 16384, 40960)
    return [
        *(
            Fault(f"disk of {size // 1024} kB", full, partial(_tiny, size=size), _made)
            for size in sizes
        ),
        *(
            Fault(f"disk full from file {at} on", full, partial(_failing, at=at), _made, stays=True)
            for at in (0, 2, 5)
        ),
        Fault("read-only file system", "can be written to", partial(_partial, mount_read_only),
              _made),
        Fault("no permission", "permissions", lambda folder: obey_modes, _forbidden, stays=True),
        Fault("a file in the way", "is a file|in the way|is not empty", spoil=_file_in_the_way),
        Fault("below a file", "in the way|is a file", spoil=_below_a_file),
        Fault("name too long", "shorter name", spoil=_too_long),
        Fault("a link to itself", "link", spoil=_link_to_itself),
    ]  # fmt: skip


def _tiny(folder: Path, size: int) -> Callable[[], object]:
    return partial(mount_tiny, folder, size)


def _failing(folder: Path, at: int) -> Callable[[], object]:
    return partial(fail_writing, at)


def _partial(function: Callable[[Path], object], folder: Path) -> Callable[[], object]:
    return partial(function, folder)


def rows(attack: Attack) -> list[Row]:
    """Every fault under every command, and outputs that are closed or full."""
    every = writers(attack.folder)
    if attack.quick:
        every = [writer for writer in every if writer.name in ("run", "report")]
    mounts = may_mount()
    found: dict[str, Row] = {}
    before = contents(attack.folder / "run")
    for fault in faults():
        if attack.match not in fault.name:
            continue
        kind = re.sub(r" (of \d+ kB|from file \d+ on)$", "", fault.name)
        row = found.setdefault(kind, Row(f"disk: {NAMES.get(kind, kind)}"))
        if kind in ("disk", "read-only file system") and mounts:
            row.skipped.append(mounts)
            continue
        for writer in every:
            under(row, writer, fault, attack.folder, before)
    rest = [] if attack.match else [outputs(attack), links(attack)]
    return [*found.values(), *rest]


def _forbidden(folder: Path) -> Path:
    folder.mkdir(mode=0o555)
    return folder


def under(row: Row, writer: Writer, fault: Fault, place: Path, before: dict[str, bytes]) -> None:
    """One command under one fault: told in a line, nothing else changed, and it goes on after."""
    what = f"{writer.name}, {fault.name}"
    folder = place / what.replace(" ", "_").replace("/", "_")
    at = fault.spoil(folder)
    log = folder.with_name(folder.name + ".log")
    said = command(writer.make(at), log, fault.prepare(folder))
    problem = _told(said, writer, fault, folder)
    lost = changes(before, contents(place / "run"))
    if folder.is_file() and folder.read_text() != "years of work":
        lost = "the file in the way"
    if not problem and fault.stays:
        folder.chmod(0o755)
        again = command(writer.make(at), log)
        if problem := again.problem():
            problem = f"does not go on: {problem}"
        elif writer.name == "run" and not _same_metrics(at / "run", place / "run"):
            lost = "the run that went on differs"
    row.add(what, problem, lost)


def _same_metrics(one: Path, other: Path) -> bool:
    return (one / "metrics.csv").read_bytes() == (other / "metrics.csv").read_bytes()


def _told(said: Said, writer: Writer, fault: Fault, folder: Path) -> str | None:
    """A command that could not write says where and what to do; one that could is well, too."""
    if said.status == 0 and not fault.name.startswith("disk"):
        return "it went on as if nothing had been wrong"
    if said.status == 0:
        return said.problem()
    if writer.name == "campaign" and "failed" in said.text:
        if problem := said.problem((1,)):
            return problem
        named = RECIPE in said.text and str(folder) in said.text
        told = any(word in said.text for word in fault.words.split("|"))
        return None if named and told else f"no run, place or remedy: {said.text[-300:]}"
    return said.refusal(re.escape(str(folder)), fault.words)


def outputs(attack: Attack) -> Row:
    """Standard output that nobody reads, or that leads to a full device."""
    row = Row("output: a closed pipe, /dev/full")
    run = str(attack.folder / "run")
    report = ["report", run, "--output", str(attack.folder / "outputs")]
    shown = [["recipes"], ["verify", "--help"], ["run", RECIPE, "--cfg", "job"], report]
    for arguments in shown[: attack.some(len(shown), 2)]:
        row.add(f"{arguments[0]} | closed", _closed(arguments))
        if Path("/dev/full").exists():
            row.add(f"{arguments[0]} > /dev/full", _full(arguments))
    return row


def _options() -> dict[str, Any]:
    # ``argparse`` says nothing where its help cannot be written at once.
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    return {"stderr": subprocess.PIPE, "text": True, "env": environment}


def _closed(arguments: Sequence[str]) -> str | None:
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run([*SHELL, *arguments], stdout=write, **_options())
    os.close(write)
    return _one_line(ended)


def _full(arguments: Sequence[str]) -> str | None:
    with open("/dev/full", "w") as full:
        ended = subprocess.run([*SHELL, *arguments], stdout=full, **_options())
    return _one_line(ended)


def _one_line(ended: subprocess.CompletedProcess[str]) -> str | None:
    lines = [line for line in ended.stderr.splitlines() if line.strip()]
    if ended.returncode != 1 or len(lines) != 1 or "Traceback" in ended.stderr:
        return f"status {ended.returncode}: {ended.stderr[-300:]}"
    return None


def links(attack: Attack) -> Row:
    """Links in the place of files and folders of a run: what they lead to stays as it was."""
    row = Row("links in run directories and results")
    names = [
        *(".lock", "metrics.csv.tmp", "checkpoint.pt.tmp", "checksums.json.tmp", "model.pt.tmp"),
        *("checkpoint_previous.pt.tmp", "config.yaml.tmp", "versions.json.tmp", "timing.csv.tmp"),
        *("diverged.txt", "metrics.csv", "checkpoint.pt", "policy.pt", "timing.csv"),
    ]
    for name in names[: attack.some(len(names), 2)]:
        _link(row, attack, name, ["run"])
    for name, which in (
        ("evaluation", "evaluate"), ("evaluation/evaluation.csv", "evaluate"),
        ("evaluation/robustness.png", "evaluate"), ("report", "report"),
        ("report/report.md", "report"), ("report/runs.csv.tmp", "report"),
        ("report/curves.png", "report"), ("wandb", "run"),
        ("controller/model.safetensors", "robustify"),
        ("controller/model.safetensors.tmp", "robustify"),
        ("controller/controller.json", "robustify"), ("evaluation.png", "robustify"),
        ("README.md", "robustify"), ("policy.pt", "export"), ("film.gif", "play"),
    )[: attack.some(20, 2)]:  # fmt: skip
        _link(row, attack, name, [which])
    return row


def _link(row: Row, attack: Attack, name: str, which: list[str]) -> None:
    """Put a link into a copy of the run, to a file or a folder outside, and let it be written."""
    place = attack.folder / f"link_{which[0]}_{name.replace('/', '_')}"
    run, outside = place / "run", place / "outside"
    shutil.copytree(attack.folder / "run", run)
    outside.mkdir()
    (outside / "thesis.tex").write_text("years of work")
    folder = name in ("evaluation", "report", "wandb")
    target = outside if folder else outside / "thesis.tex"
    link = run / name
    link.parent.mkdir(exist_ok=True)
    link.unlink(missing_ok=True)
    link.symlink_to(target)
    arguments = {
        "run": ["run", RECIPE, *OVERRIDES, "outer_iterations=3", f"run_dir={run}", "--resume"],
        "evaluate": ["evaluate", str(run), "--l1", "off", "--bias", "0", "1", "--episodes", "1"],
        "report": ["report", str(run)],
        "robustify": ["robustify", "inverted_pendulum", "--policy", str(attack.folder / "run"),
                      "--steps", "60", "--episodes", "1", "--most-steps", "5",
                      "--output", str(run)],
        "export": ["export", str(attack.folder / "run"), str(link), "--steps", "3"],
        "play": ["play", str(attack.folder / "run"), "--steps", "3", "--output", str(link)],
    }[which[0]]  # fmt: skip
    if name == "wandb":
        arguments.append("wandb.mode=offline")
    said = command(arguments, place / "log")
    untouched = contents(outside) == {"thesis.tex": b"years of work"}
    lost = None if untouched else f"written through the link: {sorted(contents(outside))}"
    row.add(f"{which[0]}, {name}", said.problem((0, 1)), lost)
