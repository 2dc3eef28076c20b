"""Mutations of every file that the commands read: ``python -m tests.fuzz [N] [SEED] [FILE ...]``.

Each file of a finished run is changed at random, N times: bits flipped, pieces cut, doubled, moved
or replaced by what parsers stumble over. What reads the file must read it or refuse it with one of
the errors that commands tell in a line, within ten seconds of the
processor's time, and write nothing anywhere. A few of
the mutations go through the whole command.
"""

from __future__ import annotations

import contextlib
import io
import random
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.conftest import TINY
from torchrl_l1.campaign.description import dump_yaml, read_campaign
from torchrl_l1.campaign.evaluation import evaluate_run, is_evaluated
from torchrl_l1.campaign.plan import plan
from torchrl_l1.cli import main as command
from torchrl_l1.experiment.errors import USER_ERRORS, message
from torchrl_l1.experiment.evaluate import load_run
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.run_directory import RunDirectory
from torchrl_l1.experiment.verify import verify_traces
from torchrl_l1.report.runs import find_readable_runs
from torchrl_l1.report.study import studies

LONGEST_SECONDS = 10.0
# One mutation in so many goes through the command, which draws figures.
WHOLE = 200
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


@dataclass
class Result:
    """What came of the mutations of a file."""

    tried: int = 0
    refused: int = 0
    slowest: float = 0.0
    wrong: list[str] = field(default_factory=list)


def read_report(folder: Path) -> None:
    found = find_readable_runs([folder])
    studies(found.runs)
    RunDirectory(folder / "run").iterations_done()


def whole_report(folder: Path) -> None:
    command(["report", str(folder / "run"), "--output", str(folder.parent / "report")])


def read_run(folder: Path) -> None:
    load_run(folder / "run")


def whole_evaluation(folder: Path) -> None:
    arguments = ["evaluate", str(folder / "run"), "--l1", "off", "--episodes", "1"]
    command([*arguments, "--output", str(folder.parent / "report")])


def read_plan(folder: Path) -> None:
    plan(read_campaign(str(folder / "mine.yaml")), folder / "out")


def whole_campaign(folder: Path) -> None:
    arguments = ["campaign", str(folder / "mine.yaml"), "--list", "--output"]
    command([*arguments, str(folder / "out")])


def read_described(folder: Path) -> None:
    (settings,) = read_campaign(str(folder / "mine.yaml")).evaluations
    is_evaluated(RunDirectory(folder / "run"), settings)


def read_recipe(folder: Path) -> None:
    command(["run", str(folder / "own.yaml"), "run_dir=nowhere", "--cfg", "job"])


def read_traces(folder: Path) -> None:
    verify_traces(folder / "traces.npz")


Reader = Callable[[Path], None]
FILES: dict[str, list[Reader]] = {
    "run/config.yaml": [read_report, read_run, whole_report],
    "run/metrics.csv": [read_report, whole_report],
    "run/timing.csv": [read_report, whole_report],
    "run/checksums.json": [read_report, whole_report],
    "run/versions.json": [read_report, whole_report],
    "run/checkpoint.pt": [read_run, whole_evaluation],
    "run/evaluations/noisy.csv": [read_report, whole_report],
    "run/evaluations/episodes/noisy.csv": [read_report, whole_report],
    "run/evaluations/noisy.yaml": [read_described, whole_campaign],
    "mine.yaml": [read_plan, whole_campaign],
    "own.yaml": [read_recipe],
    "traces.npz": [read_traces],
}


def make(folder: Path) -> None:
    """A finished and evaluated run, a campaign, a recipe and traces."""
    directory = run(compose("metrpo/inverted_pendulum", [*TINY, f"run_dir={folder / 'run'}"]))
    evaluation = {"name": "noisy", "l1": ["off", "paper"], "noise": ["action"], "episodes": 2}
    evaluate_run(str(directory), "noisy", {k: v for k, v in evaluation.items() if k != "name"})
    matrix = {"l1": ["off"], "seed": [0, 1]}
    one = {"recipe": "metrpo/inverted_pendulum", "overrides": list(TINY), "matrix": matrix}
    content = {"name": "mine", "runs": [one], "evaluations": [evaluation]}
    (folder / "mine.yaml").write_text(dump_yaml(content))
    (folder / "own.yaml").write_text(
        "defaults: [metrpo_recipe, {l1: slow}, {noise: action}, {preset: cpu}, _self_]\n"
        "recipe: own\ntask: half_cheetah\nmodel: {hidden: [64]}\ndiscount: 0.9\n"
    )
    shapes = {"obs": (5, 2), "drift": (5, 2), "jac": (5, 2, 1), "x_hat": (5, 2), "switch": (5,)}
    shapes |= {"dt": (), "bound": (), **dict.fromkeys(("action", "u", "sigma_m"), (5, 1))}
    np.savez(folder / "traces.npz", **{f"a/b/{k}": np.ones(shape) for k, shape in shapes.items()})


def listing(folder: Path, but: Path) -> dict[str, bytes]:
    """All files below a folder but one; reports go beside it."""
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file() and file != but and "__pycache__" not in file.parts
    }


def attempt(reader: Reader, folder: Path, result: Result, what: str) -> None:
    start = time.process_time()
    said = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(said),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            reader(folder)
    except SystemExit as error:
        result.refused += bool(error.code)
        if "Traceback" in said.getvalue():
            result.wrong.append(f"{what}: {said.getvalue()[-300:]}")
    except USER_ERRORS as error:
        result.refused += 1
        if "\n" in message(error):
            result.wrong.append(f"{what}: several lines: {message(error)[:200]}")
    except BaseException as error:
        result.wrong.append(f"{what}: {type(error).__name__}: {str(error)[:200]}")
    seconds = time.process_time() - start
    result.slowest = max(result.slowest, seconds)
    if seconds > LONGEST_SECONDS:
        result.wrong.append(f"{what}: {seconds:.0f} s")


def fuzz(number: int, seed: int, root: Path, names: Sequence[str] = ()) -> dict[str, Result]:
    """Mutate each file so many times, or those of some names."""
    folder = root / "here"
    folder.mkdir()
    make(folder)
    results = {}
    for name, readers in FILES.items():
        if names and name not in names:
            continue
        rng = random.Random(f"{seed} {name}")
        file, result = folder / name, Result()
        whole = file.read_bytes()
        before = listing(folder, file)
        cheap = [reader for reader in readers if not reader.__name__.startswith("whole")]
        full = [reader for reader in readers if reader not in cheap]
        for count in range(number):
            file.write_bytes(mutated(whole, rng))
            for reader in [*cheap, *(full if count % WHOLE == 0 else ())]:
                attempt(reader, folder, result, f"{name} #{count} {reader.__name__}")
            result.tried += 1
        file.write_bytes(whole)
        if listing(folder, file) != before or {p.name for p in root.iterdir()} - {"here", "report"}:
            result.wrong.append(f"{name}: files were changed")
        results[name] = result
        print(row(name, result), file=sys.stderr, flush=True)
    return results


def row(name: str, result: Result) -> str:
    survived = result.tried - len(result.wrong)
    return f"| `{name}` | {result.tried} | {survived} | {result.refused} | {result.slowest:.1f} |"


def table(results: dict[str, Result]) -> str:
    """Refusals are of calls: some files have two readers."""
    head = ["| file | tried | survived | refusals | slowest, s |", "|---|---|---|---|---|"]
    return "\n".join([*head, *(row(name, result) for name, result in results.items())])


def main() -> None:
    given = dict(enumerate(sys.argv[1:]))
    number, seed = int(given.get(0, "2000")), int(given.get(1, "0"))
    with tempfile.TemporaryDirectory() as root, contextlib.redirect_stdout(io.StringIO()):
        results = fuzz(number, seed, Path(root), sys.argv[3:])
    print(table(results))
    wrong = [line for result in results.values() for line in result.wrong]
    print("\n".join(wrong[:40]))
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
