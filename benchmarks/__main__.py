"""``python -m benchmarks [NAME ...]``: run the tables, print them and write them to files."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks import (
    collection,
    env_stepping,
    fitting,
    imagination,
    jacobian,
    l1_controllers,
    l1_scaling,
    l1_single,
    metrpo_iteration,
    planning,
    planning_precision,
    shooting,
    startup,
    trpo,
)
from benchmarks.tables import Table

RESULTS = Path(__file__).parent / "results"


# Name: (threads, default repetitions, measurement).
BENCHMARKS: dict[str, tuple[int, int, Callable[[int], Table]]] = {
    "jacobian": (jacobian.THREADS, 21, jacobian.table),
    "l1_scaling": (l1_scaling.THREADS, 9, l1_scaling.table),
    "l1_single": (l1_single.THREADS, 15, l1_single.table),
    "l1_controllers": (l1_controllers.THREADS, 15, l1_controllers.table),
    "env_stepping": (env_stepping.THREADS, 9, env_stepping.table),
    "collection": (collection.THREADS, 7, collection.table),
    "planning": (planning.THREADS, 9, planning.table),
    "planning_precision": (planning_precision.THREADS, 4, planning_precision.table),
    "shooting": (shooting.THREADS, 9, shooting.table),
    "fitting": (fitting.THREADS, 9, fitting.table),
    "imagination": (imagination.THREADS, 9, imagination.table),
    "trpo": (trpo.THREADS, 15, trpo.table),
    "metrpo_iteration": (metrpo_iteration.THREADS, 5, metrpo_iteration.table),
    "startup": (startup.THREADS, 3, startup.table),
}


def main() -> None:
    """Run what the command line names, all by default."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(BENCHMARKS))
    parser.add_argument("--repetitions", type=int, help="measurements of each case")
    parser.add_argument(
        "--quick", action="store_const", const=1, dest="repetitions", help="one of each"
    )
    parser.add_argument("--threads", type=int, help="threads of torch, for all tables")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder for the files")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(BENCHMARKS):
        parser.error(f"no benchmark {sorted(unknown)}; there are {', '.join(BENCHMARKS)}")
    if arguments.repetitions is not None and arguments.repetitions < 1:
        parser.error(f"--repetitions must be at least 1, got {arguments.repetitions}")
    for name in arguments.names or BENCHMARKS:
        threads, repetitions, measure = BENCHMARKS[name]
        torch.set_num_threads(arguments.threads or threads)
        table = measure(arguments.repetitions or repetitions)
        table.write(arguments.output)
        print(table.markdown(), flush=True)
    pages = [arguments.output / f"{name}.md" for name in BENCHMARKS]
    summary = "\n".join(page.read_text() for page in pages if page.exists())
    (arguments.output / "summary.md").write_text(summary)


if __name__ == "__main__":
    main()
