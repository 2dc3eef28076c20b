"""``torchrl-l1 campaign``: run a matrix of runs and their evaluations, or show their progress."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from torchrl_l1.campaign.description import (
    Campaign,
    CampaignError,
    dump_yaml,
    load_yaml,
    override_key,
    read_campaign,
)
from torchrl_l1.campaign.jobs import check_launcher, elsewhere, launch_runs, work_on_runs
from torchrl_l1.campaign.plan import check_machine, plan
from torchrl_l1.campaign.progress import overview
from torchrl_l1.campaign.reuse import copy_run, find_reusable
from torchrl_l1.campaign.workers import Stopped, available_cores
from torchrl_l1.experiment.files import locked, write_atomically


def campaign_command(options: argparse.Namespace, overrides: Sequence[str]) -> None:
    """``torchrl-l1 campaign``. Exits with a non-zero status if a run failed or it was stopped.

    Raises:
        CampaignError: if the campaign cannot run as requested; nothing is started in this case.
        RunDirectoryError: if a run directory holds a run of another configuration.
    """
    if options.workers is not None and options.workers < 1:
        raise CampaignError(f"--workers must be at least 1, got {options.workers}")
    for_hydra = [text for text in overrides if override_key(text).split(".")[0] == "hydra"]
    if for_hydra and not options.launcher:
        raise CampaignError(f"{for_hydra[0]} is for Hydra's launchers; also give --launcher")
    if options.launcher:
        check_launcher(options.launcher)
    ours = [text for text in overrides if text not in for_hydra]
    campaign = read_campaign(options.campaign, ours, trusted=options.trust)
    for_hydra += ["--trust"] if options.trust else []
    output = Path(options.output or f"runs/campaigns/{campaign.name}")
    try:
        output = output.resolve()
    except RuntimeError as error:  # OSError from Python 3.13 on
        raise OSError(
            f"{output} leads to itself through symbolic links: choose a folder"
        ) from error
    if "${" in str(output):
        raise CampaignError(
            f"{output}: ${{ in a path would be read as an interpolation in the runs' settings; "
            "choose another --output"
        )
    _check_owner(output, campaign)
    # Reused runs need no device and no dataset, which are checked once these runs are known.
    runs = plan(campaign, output, trusted=options.trust)
    begun = [run for run in runs if run.directory.config_file.exists()]
    changed = {n for run in begun for n in run.directory.changed_files(run.settings(), data=True)}
    for name in sorted(changed):
        print(
            f"{name} has changed since runs in {output} began, which are kept as they are; use "
            "another --output to train all again",
            file=sys.stderr,
        )
    reused = find_reusable(runs, output, [Path(folder) for folder in options.reuse])
    if not (options.launcher and elsewhere(options.launcher)):
        check_machine(campaign, [run for run in runs if run.directory.path not in reused])
    if options.list:
        print(overview(runs, reused))
        return
    output.mkdir(parents=True, exist_ok=True)
    failures = []
    with _hold(output):
        write_atomically(output / "campaign.yaml", dump_yaml(campaign.to_dict()))
        for run in runs:
            if source := reused.get(run.directory.path):
                copy_run(source, run)
                print(f"reused {run} from {source}", flush=True)
        try:
            if options.launcher:
                failures = launch_runs(
                    campaign, output, runs, options.launcher, options.workers, for_hydra
                )
                runs_here = [run for run in runs if run.problem() is None]
            else:
                runs_here = runs
            failures += work_on_runs(runs_here, options.workers or available_cores())
        except Stopped as stopped:
            print(f"{stopped}; the same command continues from there", file=sys.stderr)
            sys.exit(128 + stopped.signal_number)
    for failure in failures:
        print(failure, file=sys.stderr)
    if failures:
        print(f"{len(failures)} failed; the same command tries them again", file=sys.stderr)
        sys.exit(1)
    print(f"Finished: {len(runs)} runs in {output}")


def _check_owner(output: Path, campaign: Campaign) -> None:
    file = output / "campaign.yaml"
    if not file.exists():
        return
    content = load_yaml(file)
    name = str(content.get("name")) if isinstance(content, dict) else file.name
    if name != campaign.name:
        raise CampaignError(
            f"{output} belongs to another campaign, {name}; give {campaign.name} its own folder "
            "with --output"
        )


@contextmanager
def _hold(output: Path) -> Iterator[None]:
    with locked(output / ".lock") as ours:
        if not ours:
            raise CampaignError(
                f"another campaign is running in {output}; wait for it, or choose another --output"
            )
        yield
