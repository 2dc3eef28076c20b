"""Mutations of every file that the commands read: ``python -m tests.fuzz [N] [SEED] [FILE ...]``.

Each file of a finished run, a campaign, a recipe, a controller and of data is changed at random, N
times: bits flipped, pieces cut, doubled, moved or replaced by what parsers stumble over. What reads
the file must read it or refuse it with one of the errors that commands tell in a line, within ten
seconds, and write nothing anywhere. What reads the file alone sees every mutation; what does more
with it, as a plan, an evaluation or a whole report, sees some.
"""

from __future__ import annotations

import contextlib
import io
import json
import random
import shutil
import signal
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import safetensors.torch

from tests.conftest import TINY
from torchrl_l1.campaign.description import dump_yaml, read_campaign
from torchrl_l1.campaign.evaluation import evaluate_run, is_evaluated
from torchrl_l1.campaign.plan import plan
from torchrl_l1.cli import main as command
from torchrl_l1.deployment import RobustController, robustify
from torchrl_l1.dynamics import EnsembleDynamics, FitConfig, read_csv, read_npz
from torchrl_l1.dynamics.storage import _digest
from torchrl_l1.experiment.checkpoints import read_checkpoint
from torchrl_l1.experiment.errors import USER_ERRORS, message
from torchrl_l1.experiment.evaluate import load_run
from torchrl_l1.experiment.launch import check_data, compose
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.run_directory import RunDirectory, read_config
from torchrl_l1.experiment.verify import verify_traces
from torchrl_l1.report.build import find_campaigns
from torchrl_l1.report.published import ReferenceCurves
from torchrl_l1.report.runs import find_readable_runs
from torchrl_l1.report.study import studies

LONGEST_SECONDS = 10.0
# One mutation in so many goes through what takes longer, and through a whole command.
SOME, WHOLE = 25, 400
NASTY = [
    *(
        b"",
        b"\x00",
        b"\xff\xfe",
        b"\r\n",
        b"\n\n\n",
        b"nan",
        b"inf",
        b"-1e400",
        b"1e99999",
        b"9" * 400,
    ),
    *(b"[" * 2000, b"{" * 50, b"&a [*a]", b"*b", b"<<: *c", b"!!python/name:os.system", b"!!set"),
    *(
        b"${oc.env:HOME}",
        b"${a}",
        b"${hydra:x}",
        b"???",
        b"null",
        b"true",
        b"- ",
        b": ",
        b"'",
        b'"',
    ),
    *(b"../../x", b"/etc/passwd", b"$x$", b"<b>", b"|", b"`", b"=1+1", b",,,,", b"PK\x03\x04"),
    *("é\u2028\U0001f600".encode(), b"2001-01-01", b"0x10", b"1_000", b"_target_: os.abort"),
]


def mutated(content: bytes, rng: random.Random) -> bytes:
    """One to four changes."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        size = len(content)
        start = rng.randrange(size + 1)
        end = min(size, start + rng.choice((1, 2, 8, 40, 200)))
        piece, kind = content[start:end], rng.randrange(8)
        if kind == 0 and piece:
            piece = bytes([piece[0] ^ 1 << rng.randrange(8)]) + piece[1:]
        elif kind == 1:
            piece = b""
        elif kind == 2:
            piece = piece * 2
        elif kind == 3:
            piece = rng.choice(NASTY)
        elif kind == 4:
            piece = rng.choice(NASTY) + piece
        elif kind == 5:
            content, piece, end = content[:start], b"", start
        elif kind == 6:
            piece = rng.randbytes(len(piece))
        else:
            other = rng.randrange(size + 1)
            piece = content[other : other + len(piece)]
        content = content[:start] + piece + content[end:]
    return content


def mutated_inside(content: bytes, rng: random.Random) -> bytes:
    """One part of a ZIP archive changed, and all checksums as they should be."""
    written = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(written, "w") as new:
        # Torch keeps all but the tensors' numbers in one part.
        names = [name for name in old.namelist() if name.endswith("data.pkl")] or old.namelist()
        chosen = rng.choice(names)
        for name in old.namelist():
            part = old.read(name)
            new.writestr(name, mutated(part, rng) if name == chosen else part)
    return written.getvalue()


def mutated_settings(content: bytes, rng: random.Random) -> bytes:
    """The settings in a model's file changed, and its checksum as it should be."""
    tensors = safetensors.torch.load(content)
    length = int.from_bytes(content[:8], "little")
    metadata = json.loads(content[8 : 8 + length])["__metadata__"]
    settings = mutated(metadata["settings"].encode(), rng).decode(errors="replace")
    digest = _digest(settings, tensors.items())
    return safetensors.torch.save(tensors, {**metadata, "settings": settings, "sha256": digest})


Mutator = Callable[[bytes, random.Random], bytes]
# Files are named with what of them is changed behind a comma.
MUTATORS: dict[str, Mutator] = {"inside": mutated_inside, "settings": mutated_settings}


@dataclass
class Result:
    """What came of the mutations of a file."""

    tried: int = 0
    refused: int = 0
    slowest: float = 0.0
    wrong: list[str] = field(default_factory=list)
    hit: set[int] = field(default_factory=set)


# What reads one file alone.


def read_run_of_report(folder: Path) -> None:
    found = find_readable_runs([folder / "run"])
    studies(found.runs)
    RunDirectory(folder / "run").iterations_done()


def read_older_run(folder: Path) -> None:
    studies(find_readable_runs([folder / "older"]).runs)
    RunDirectory(folder / "older").iterations_done()


def read_settings(folder: Path) -> None:
    directory = RunDirectory(folder / "run")
    directory.check_same(read_config(folder / "whole.yaml"))


def read_last_checkpoint(folder: Path) -> None:
    read_checkpoint(folder / "run/checkpoint.pt")


def read_campaign_file(folder: Path) -> None:
    read_campaign(str(folder / "mine.yaml"))


def read_campaign_of_report(folder: Path) -> None:
    errors: list[Exception] = []
    find_campaigns([folder / "study"], [], errors)  # type: ignore[arg-type]
    for error in errors:
        raise error


def read_described(folder: Path) -> None:
    (settings,) = read_campaign(str(folder / "whole_campaign.yaml")).evaluations
    is_evaluated(RunDirectory(folder / "run"), settings)


def read_recipe(folder: Path) -> None:
    check_data(folder / "own.yaml")


def read_traces(folder: Path) -> None:
    verify_traces(folder / "traces.npz")


def read_model(folder: Path) -> None:
    EnsembleDynamics.load(folder / "controller/model.safetensors")


def read_controller(folder: Path) -> None:
    RobustController.load(folder / "controller", trusted=False)


def read_drive(folder: Path) -> None:
    names = {"observation": ["angle", "rate"], "action": ["torque"]}
    read_csv(folder / "drive.csv", **names, time="time", episode="drive")


def read_arrays(folder: Path) -> None:
    read_npz(folder / "drive.npz", observation=["x", "v"], action="u", time="t")


def read_curves(folder: Path) -> None:
    ReferenceCurves(folder / "curves.csv")


# What does more with it.


def some_run(folder: Path) -> None:
    load_run(folder / "run")


def some_plan(folder: Path) -> None:
    plan(read_campaign(str(folder / "mine.yaml")), folder / "out")


def some_composition(folder: Path) -> None:
    command(["run", str(folder / "own.yaml"), "run_dir=nowhere", "--cfg", "job"])


def some_controller(folder: Path) -> None:
    RobustController.load(folder / "controller", trusted=False)


def whole_report(folder: Path) -> None:
    command(["report", str(folder / "run"), "--output", str(folder.parent / "report")])


def whole_report_of_older_run(folder: Path) -> None:
    command(["report", str(folder / "older"), "--output", str(folder.parent / "report")])


def whole_report_of_campaign(folder: Path) -> None:
    command(["report", str(folder), "--output", str(folder.parent / "report")])


def whole_report_with_curves(folder: Path) -> None:
    options = ["--output", str(folder.parent / "report"), "--reference-curves"]
    command(["report", str(folder / "run"), *options, str(folder / "curves.csv")])


def whole_evaluation(folder: Path) -> None:
    arguments = ["evaluate", str(folder / "run"), "--l1", "off", "--episodes", "1"]
    command([*arguments, "--output", str(folder.parent / "report")])


def whole_campaign(folder: Path) -> None:
    arguments = ["campaign", str(folder / "mine.yaml"), "--list", "--output"]
    command([*arguments, str(folder / "out")])


def whole_export(folder: Path) -> None:
    file = str(folder.parent / "report" / "policy.pt")
    command(["export", str(folder / "controller"), file, "--steps", "2"])


Reader = Callable[[Path], None]
FILES: dict[str, list[Reader]] = {
    "run/config.yaml": [read_run_of_report, read_settings, some_run, whole_report],
    "run/metrics.csv": [read_run_of_report, whole_report],
    "older/metrics.csv": [read_older_run, whole_report_of_older_run],
    "run/timing.csv": [read_run_of_report, whole_report],
    "run/checksums.json": [read_run_of_report, whole_report],
    "run/versions.json": [read_run_of_report, whole_report],
    "run/diverged.txt": [read_run_of_report, whole_report],
    "run/checkpoint.pt": [read_last_checkpoint, some_run, whole_evaluation],
    "run/checkpoint.pt, inside": [read_last_checkpoint, some_run, whole_evaluation],
    "run/evaluations/noisy.csv": [read_run_of_report, whole_report],
    "run/evaluations/episodes/noisy.csv": [read_run_of_report, whole_report],
    "run/evaluations/noisy.yaml": [read_described, whole_campaign],
    "study/campaign.yaml": [read_campaign_of_report, whole_report_of_campaign],
    "mine.yaml": [read_campaign_file, some_plan, whole_campaign],
    "own.yaml": [read_recipe, some_composition],
    "traces.npz": [read_traces],
    "traces.npz, inside": [read_traces],
    "controller/controller.json": [read_controller, whole_export],
    "controller/model.safetensors": [read_model, some_controller, whole_export],
    "controller/model.safetensors, settings": [read_model, some_controller, whole_export],
    "drive.csv": [read_drive],
    "drive.npz": [read_arrays],
    "drive.npz, inside": [read_arrays],
    "curves.csv": [read_curves, whole_report_with_curves],
}


def make(folder: Path) -> None:
    """A finished and evaluated run, a campaign, a recipe, traces, a controller and data."""
    directory = run(compose("metrpo/inverted_pendulum", [*TINY, f"run_dir={folder / 'run'}"]))
    shutil.copyfile(directory / "config.yaml", folder / "whole.yaml")
    (directory / "diverged.txt").write_text("training diverged in iteration 1, fit: a weight\n")
    # Of a version that wrote no checksums, so that all that is told is told by the table.
    shutil.copytree(directory, folder / "older")
    (folder / "older/checksums.json").unlink()
    evaluation = {"name": "noisy", "l1": ["off", "paper"], "noise": ["action"], "episodes": 2}
    evaluate_run(str(directory), "noisy", {k: v for k, v in evaluation.items() if k != "name"})
    matrix = {"l1": ["off"], "seed": [0, 1]}
    one = {"recipe": "metrpo/inverted_pendulum", "overrides": list(TINY), "matrix": matrix}
    content = {"name": "mine", "runs": [one], "evaluations": [evaluation]}
    (folder / "study").mkdir()
    for name in ("mine.yaml", "whole_campaign.yaml", "study/campaign.yaml"):
        (folder / name).write_text(dump_yaml(content))
    (folder / "own.yaml").write_text(
        "defaults: [metrpo_recipe, {l1: slow}, {noise: action}, {preset: cpu}, _self_]\n"
        "recipe: own\ntask: half_cheetah\nmodel: {hidden: [64]}\ndiscount: 0.9\n"
    )
    shapes = {"obs": (5, 2), "drift": (5, 2), "jac": (5, 2, 1), "x_hat": (5, 2), "switch": (5,)}
    shapes |= {"dt": (), "bound": (), **dict.fromkeys(("action", "u", "sigma_m"), (5, 1))}
    np.savez(folder / "traces.npz", **{f"a/b/{k}": np.ones(shape) for k, shape in shapes.items()})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # so few data make a poor model
        robust = robustify(
            "inverted_pendulum", str(directory), 60, model={"hidden": [8]},
            fit=FitConfig(max_epochs=2), progress=False,
        )  # fmt: skip
        settings = robust.save(folder / "controller") / "controller.json"
    # Digests of the other files would refuse all that is changed in these.
    content = {**json.loads(settings.read_text()), "files": {"policy.zip": "0" * 16}}
    settings.write_text(json.dumps(content))
    rows = [f"{t // 5},{0.1 * t:.1f},{t % 3},{t % 4},{t % 2}" for t in range(20)]
    (folder / "drive.csv").write_text("\n".join(["drive,time,angle,rate,torque", *rows]) + "\n")
    clock = np.arange(9) * 0.1
    np.savez(folder / "drive.npz", x=np.ones((9, 2)), v=clock**2, u=np.ones(9), t=clock)
    curves = ["arm,setting,seed,iteration,total_train_samples,average_return"]
    curves += [f"L1_OFF,Halfcheetah,{s},{i},{100 * i},{7 * i}" for s in (1, 2) for i in (1, 2)]
    (folder / "curves.csv").write_text("\n".join(curves) + "\n")


def listing(folder: Path, but: Path) -> dict[str, bytes]:
    """All files below a folder but one; reports go beside it."""
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file() and file != but and "__pycache__" not in file.parts
    }


@contextlib.contextmanager
def time_limit(seconds: int) -> Iterator[None]:
    """End what hangs, where the system has alarms."""

    def ring(*_: object) -> None:
        raise TimeoutError(f"still at it after {seconds} s")

    if not hasattr(signal, "SIGALRM"):
        yield
        return
    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def attempt(reader: Reader, folder: Path, result: Result, what: str) -> None:
    start = time.process_time()
    said = io.StringIO()

    def note(problem: str) -> None:
        result.wrong.append(f"{what}: {problem}")
        result.hit.add(result.tried)

    try:
        with (
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(said),
            warnings.catch_warnings(),
            time_limit(60),
        ):
            warnings.simplefilter("ignore")
            reader(folder)
    except SystemExit as error:
        result.refused += bool(error.code)
        if "Traceback" in said.getvalue():
            note(said.getvalue()[-300:])
    except TimeoutError as error:
        note(str(error))
    except USER_ERRORS as error:
        result.refused += 1
        if "\n" in message(error):
            note(f"several lines: {message(error)[:200]}")
    except BaseException as error:
        note(f"{type(error).__name__}: {str(error)[:200]}")
    seconds = time.process_time() - start
    result.slowest = max(result.slowest, seconds)
    if seconds > LONGEST_SECONDS:
        note(f"{seconds:.0f} s")


def fuzz(number: int, seed: int, root: Path, names: Sequence[str] = ()) -> dict[str, Result]:
    """Mutate each file so many times, or those of some names."""
    folder, elsewhere = root / "here", root / "elsewhere"
    folder.mkdir()
    elsewhere.mkdir()
    make(folder)
    results = {}
    with contextlib.chdir(elsewhere):
        for name, readers in FILES.items():
            if not names or name in names:
                results[name] = _fuzz_one(
                    folder, number, random.Random(f"{seed} {name}"), name, readers
                )
                if any(elsewhere.iterdir()):
                    results[name].wrong.append(f"{name}: files were written where it was called")
                lines = [row(name, results[name]), *results[name].wrong[:20]]
                print("\n".join(lines), file=sys.stderr, flush=True)
    return results


def _fuzz_one(
    folder: Path, number: int, rng: random.Random, name: str, readers: Sequence[Reader]
) -> Result:
    place, _, part = name.partition(", ")
    file, result, mutate = folder / place, Result(), MUTATORS.get(part, mutated)
    whole = file.read_bytes()
    before = listing(folder, file)
    periods = {"some": SOME, "whole": WHOLE}
    for count in range(number):
        file.write_bytes(mutate(whole, rng))
        for reader in readers:
            if count % periods.get(reader.__name__.partition("_")[0], 1) == 0:
                attempt(reader, folder, result, f"{name} #{count} {reader.__name__}")
        result.tried += 1
    file.write_bytes(whole)
    beside = {path.name for path in folder.parent.iterdir()} - {"here", "report", "elsewhere"}
    if listing(folder, file) != before or beside:
        result.wrong.append(f"{name}: files were changed")
    return result


def row(name: str, result: Result) -> str:
    survived = result.tried - len(result.hit)
    return f"| `{name}` | {result.tried} | {survived} | {result.refused} | {result.slowest:.1f} |"


def table(results: dict[str, Result]) -> str:
    """Refusals are of calls: some files have two readers."""
    head = ["| file | tried | survived | refusals | slowest, s |", "|---|---|---|---|---|"]
    return "\n".join([*head, *(row(name, result) for name, result in results.items())])


def main() -> None:
    given = dict(enumerate(sys.argv[1:]))
    number, seed = int(given.get(0, "2000")), int(given.get(1, "0"))
    with tempfile.TemporaryDirectory() as root, contextlib.redirect_stdout(io.StringIO()):
        results = fuzz(number, seed, Path(root).resolve(), sys.argv[3:])
    print(table(results))
    wrong = [line for result in results.values() for line in result.wrong]
    print("\n".join(wrong[:40]))
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
