from __future__ import annotations

import csv
import json
import math
import pickle
import shlex
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import DictConfig
from safetensors.torch import save_file
from tensordict import TensorDict, lazy_stack
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer

from torchrl_l1.algorithms import DatasetColumns
from torchrl_l1.cli import main
from torchrl_l1.dynamics import read_transitions
from torchrl_l1.envs import BatchedMujocoEnv, get_task
from torchrl_l1.experiment.datasets import read_dataset
from torchrl_l1.experiment.episodes import Episode, split_episodes, write_dataset
from torchrl_l1.experiment.errors import RunDirectoryError
from torchrl_l1.experiment.evaluate import load_run
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.recording import MEDIUM, NoisyPolicy, record
from torchrl_l1.experiment.run import run

pytestmark = pytest.mark.usefixtures("own_folder")

QUIET = pytest.mark.filterwarnings("ignore::UserWarning:minari", "ignore::DeprecationWarning")

TINY = [
    *("outer_iterations=2", "horizon=15", "trpo_iterations=1", "evaluation_episodes=2"),
    *("imagined_steps=100", "imagined_horizon=10", "model.members=2", "model.hidden=[8]"),
    *("policy.hidden=[8]", "fit.batch_size=16", "fit.max_epochs=2", "cloning.max_epochs=2"),
    *("wandb.mode=disabled", "trpo.fisher_fraction=1.0"),
]


@QUIET
def test_a_minari_dataset_is_read_by_its_folder_too(episodes: list[Episode]) -> None:
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    write_dataset("pendulum/random-v0", episodes, get_task("inverted_pendulum"), "random")
    folder = Path("minari/pendulum/random-v0")
    assert torch.equal(
        read_dataset(str(folder))["observation"], read_dataset("pendulum/random-v0")["observation"]
    )
    dataset = minari.load_dataset("pendulum/random-v0")
    assert dataset.spec.env_spec.id == "torchrl_l1/InvertedPendulum-v0"
    assert dataset.observation_space.dtype == dataset.action_space.dtype == np.float32
    (folder / "data" / "metadata.json").write_text("{")
    with pytest.raises(ValueError, match="no Minari dataset that can be read"):
        read_dataset(str(folder))


def test_tensors_in_one_file(episodes: list[Episode]) -> None:
    write_dataset("folder", episodes, get_task("inverted_pendulum"), "random")
    data = read_dataset("folder").clone()  # not the file itself
    torch.save(data.to_dict(), "data.pt")
    flat = {".".join(key) if isinstance(key, tuple) else key: value.clone().contiguous()
            for key, value in data.items(True, True)}  # fmt: skip
    save_file(flat, "data.safetensors")
    for name in ("data.pt", "data.safetensors"):
        found = read_dataset(name)
        assert torch.equal(found["next", "observation"], data["next", "observation"]), name
        assert int((~read_transitions(found).joined).sum()) == 9, name
    torch.save({"x": data["observation"], "action": data["action"],
                "next": {"x": data["next", "observation"]}}, "named.pt")  # fmt: skip
    found = read_dataset("named.pt", DatasetColumns(observation=["x"]))
    assert torch.equal(found["next", "observation"], data["next", "observation"])


@pytest.mark.parametrize("source", ["data.pt", "data.safetensors", "folder"])
def test_what_columns_name_counts_beside_the_usual_names(source: str) -> None:
    rows = TensorDict({"observation": torch.zeros(4, 3), "state": torch.ones(4, 2)}, [4])
    rows.update({"action": torch.zeros(4, 1), "executed": torch.full((4, 1), 3.0)})
    rows["next"] = {"observation": torch.zeros(4, 3), "state": torch.ones(4, 2)}
    rows["next", "l1", "u_exec"] = torch.full((4, 1), 2.0)
    torch.save(rows.to_dict(), "data.pt")
    save_file({".".join(key) if isinstance(key, tuple) else key: value.clone()
               for key, value in rows.items(True, True)}, "data.safetensors")  # fmt: skip
    rows.memmap("folder")
    data = read_dataset(source, DatasetColumns(["state"], ["next.l1.u_exec"]))
    assert data["observation"].shape == data["next", "observation"].shape == (4, 2)
    assert (data["action"] == 2).all()
    assert "executed" not in set(data.keys()), "it would count in place of what is named"
    assert (read_dataset(source)["observation"] == 0).all()
    for columns, words in {
        "observation=[speed]": "'speed'|no speed, only action, executed, next.l1.u_exec",
        "action=[torque]": "no torque, only .*: name it, columns.action",
        "observation=[executed]": "no next.executed, what followed",
        "observation=[state.x]": "'state.x' of shape|no state.x, only [^\n]*$",
        "action=[action.u]": "no action.u, only [^\n]*$",
        "observation=[state,observation]": "have one observation, not state, observation",
        "episode=run": "columns.episode is of .csv and .npz files",
        "time=t": "columns.time is of .csv",
    }.items():
        key, _, value = columns.partition("=")
        names: Any = value[1:-1].split(",") if value.startswith("[") else value
        with pytest.raises((KeyError, ValueError), match=words):
            read_dataset(source, DatasetColumns(**{key: names}))


def test_trajectories_of_different_lengths_in_a_folder() -> None:
    def line(length: int) -> TensorDict:
        rows = TensorDict({"state": torch.arange(length + 1.0)[:-1, None]}, [length])
        rows["action"] = torch.zeros(length, 1)
        rows["next"] = TensorDict({"state": rows["state"] + 1}, [length])
        return rows

    lazy_stack([line(3), line(5)]).memmap("ragged")
    for part in (ragged := lazy_stack([line(3), line(5)])).tensordicts:
        part["observation"], part["next", "observation"] = part["state"], part["next", "state"]
    ragged.memmap("usual")
    for folder, columns in (("ragged", DatasetColumns(["state"])), ("usual", None)):
        read = read_transitions(read_dataset(folder, columns))
        assert read.data["observation"].flatten().tolist() == [0, 1, 2, 0, 1, 2, 3, 4]
    with pytest.raises(KeyError, match="ragged has no observation, only action"):
        read_dataset("ragged")


def steps(*shape: int) -> TensorDict:
    """Transitions of a plant that counts."""
    x = torch.arange(1.0, 1 + math.prod(shape)).reshape(*shape, 1)
    after = {"observation": x + 1, "done": torch.zeros_like(x, dtype=torch.bool)}
    return TensorDict({"observation": x, "action": -x, "next": after}, shape)


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
def test_of_a_replay_buffer_what_it_holds(storage: type[LazyTensorStorage]) -> None:
    buffer = TensorDictReplayBuffer(storage=storage(20))
    buffer.extend(steps(5))
    buffer.dumps("rb")
    for source in ("rb", "rb/storage"):
        found = read_dataset(source)
        assert found["observation"].flatten().tolist() == [1, 2, 3, 4, 5]
    buffer.extend(steps(18))  # five there, fifteen behind them, three in place of the first
    buffer.dumps("rb")
    found = read_dataset("rb")
    assert found["observation"].flatten().tolist() == [16, 17, 18, 4, 5, *range(1, 16)]
    Path("rb/storage/storage_metadata.json").write_text("{")
    with pytest.raises(ValueError, match="no tensordict that can be read"):
        read_dataset("rb")


@pytest.mark.parametrize("ndim", [1, 2])
def test_a_replay_buffer_of_batches_must_be_full(ndim: int) -> None:
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20, ndim=ndim))
    buffer.extend(steps(2, 5))
    buffer.dumps("rb")
    with pytest.raises(ValueError, match=r"buffer of batches.*buffer\[:\]\.memmap\(folder\)"):
        read_dataset("rb")
    buffer[:].memmap("all")
    assert read_dataset("all").shape == (2, 5)


def test_the_empty_rest_of_a_buffer_s_own_folder_is_told() -> None:
    buffer = TensorDictReplayBuffer(storage=LazyMemmapStorage(20, scratch_dir="scratch"))
    buffer.extend(steps(5))
    with pytest.warns(UserWarning, match=r"last 15 of 20 rows .* are zeros.*buffer\.dumps"):
        assert read_dataset("scratch").shape == (20,)


def test_a_table_needs_names() -> None:
    Path("drive.csv").write_text("t,a,b,u\n0,0,0,1\n0.1,1,0,1\n0.2,2,1,0\n")
    with pytest.raises(ValueError, match="say which columns are what"):
        read_dataset("drive.csv")
    columns = DatasetColumns(["a", "b"], ["u"], time="t")
    assert read_dataset("drive.csv", columns)["next", "observation"].tolist() == [[1, 0], [2, 1]]
    for mark in (";", "\t"):  # as spreadsheets write it where decimals have commas
        text = Path("drive.csv").read_text().replace(",", mark)
        Path("other.csv").write_text("\n" + text)
        assert (read_dataset("other.csv", columns) == read_dataset("drive.csv", columns)).all()
    for header in ("x,u,episode", ' "episode" , "x","u"'):  # as an array of this name in .npz files
        cells = [(x, 0, x // 3) if header[0] == "x" else (x // 3, x, 0) for x in range(6)]
        Path("runs.csv").write_text("\n".join([header, *(f"{a},{b},{c}" for a, b, c in cells)]))
        data = read_dataset("runs.csv", DatasetColumns(["x"], ["u"]))
        assert data["observation"].flatten().tolist() == [0, 1, 3, 4]
    arrays = {"x": np.arange(6.0), "u": np.zeros(6), "run": np.array([0, 0, 0, 1, 1, 1])}
    np.savez("drive.npz", **arrays)
    data = read_dataset("drive.npz", DatasetColumns(["x"], ["u"], episode="run"))
    assert data["observation"].flatten().tolist() == [0, 1, 3, 4]
    np.savez("buffer.npz", observations=np.array([0.0, 5, 2]), u=np.zeros(3), next_obs=np.arange(3))
    with pytest.raises(ValueError, match="has 'next_obs', which differs from the next"):
        read_dataset("buffer.npz", DatasetColumns(["observations"], ["u"]))


def test_a_run_s_real_transitions(tiny_recipe: Callable[..., DictConfig]) -> None:
    directory = run(tiny_recipe())
    algorithm = load_run(directory).algorithm
    data = read_dataset(str(directory))
    assert data.shape == (90,) and "executed" in set(data.keys())
    assert data["observation"].shape[-1] == algorithm.task.observation_dim
    (directory / "checkpoint.pt").write_bytes(b"torn")
    assert read_dataset(str(directory)).shape == (60,), "of the checkpoint before it"
    (directory / "checkpoint_previous.pt").unlink()
    with pytest.raises(ValueError, match="is a run without data"):
        read_dataset(str(directory))


class Bomb:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (Path.touch, (Path("exploded"),))  # type: ignore[return-value]


def test_what_is_no_dataset_is_refused_in_one_line(episodes: list[Episode]) -> None:
    Path("empty").mkdir()
    Path("data.txt").write_text("1 2 3")
    Path("torn.npz").write_bytes(b"PK")
    Path("torn.safetensors").write_bytes(b"PK")
    torch.save([1, 2], "list.pt")
    zeros = torch.zeros
    torch.save({"observation": zeros(3), "action": zeros(3)}, "flat.pt")
    torch.save({"observation": zeros(3, 2), "action": zeros(2, 1)}, "ragged.pt")
    save_file({"observation": zeros(3, 2), "next": zeros(3), "next.observation": zeros(3, 2)},
              "twice.safetensors")  # fmt: skip
    torch.save(TensorDict(a=Bomb()).to_dict(), "bomb.pt")
    write_dataset("pickled", episodes, get_task("inverted_pendulum"), "random")
    Path("pickled/other.pickle").write_bytes(pickle.dumps(Bomb()))
    for source, words in {
        "": "set dataset=",
        "nowhere": "torchrl-l1 dataset RUN_DIR nowhere makes one",
        "empty": "holds no dataset",
        "data.txt": "is no dataset: there are .csv",
        "torn.npz": "not a readable .npz file",
        "torn.safetensors": "damaged",
        "list.pt": "no dictionary of tensors",
        "flat.pt": r"with 'observation' of shape \[N, n\]",
        "ragged.pt": "not one row for each of 'observation'",
        "twice.safetensors": "'next' and 'next.observation' in it: leave one of them out",
        "bomb.pt": "cannot be read as plain tensors",
        "pickled": "is a pickle, which is not read",
    }.items():
        with pytest.raises((ValueError, FileNotFoundError, KeyError), match=words) as error:
            read_dataset(source)
        assert "\n" not in str(error.value.args[0]), source
    assert not Path("exploded").exists()


def test_names_of_minari_s_need_minari(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "minari", None)
    with pytest.raises(ValueError, match=r"torchrl-l1\[minari\]"):
        read_dataset("hopper/medium-v0")


def test_noise_is_added_and_clipped() -> None:
    task = get_task("inverted_pendulum")
    policy = NoisyPolicy(_constant(2.0), task, 0.5)
    torch.manual_seed(0)
    data = policy(TensorDict({"observation": torch.zeros(20_000, 4)}, batch_size=[20_000]))
    action = data["action"]
    assert action.max() == 3
    below = action[action < 2] - 2  # half of a normal distribution of standard deviation 1.5
    assert below.square().mean().sqrt() == pytest.approx(1.5, rel=0.05)


def _constant(value: float):
    from tensordict.nn import TensorDictModule

    return TensorDictModule(
        lambda x: torch.full((*x.shape[:-1], 1), value), ["observation"], ["action"]
    )


@pytest.fixture
def balanced(tiny_recipe: Callable[..., DictConfig], monkeypatch: pytest.MonkeyPatch):
    """A run, with a policy that balances in place of what it has learned."""
    from tensordict.nn import TensorDictModule

    trained = load_run(run(tiny_recipe("horizon=60", "outer_iterations=1")))
    gains = torch.tensor([[1.0], [10.0], [1.0], [2.0]])
    policy = TensorDictModule(
        lambda x: (x @ gains).clamp(-3, 3), in_keys=["observation"], out_keys=["action"]
    )
    monkeypatch.setattr(type(trained.algorithm), "policies", {"policy": policy})
    return trained


def test_three_qualities(balanced) -> None:
    lines: list[str] = []
    found = {q: record(balanced, q, 120, 0, lines.append) for q in ("random", "medium", "expert")}
    assert all(recording.transitions == 120 for recording in found.values())
    low, medium, high = (found[q].returns[1] for q in ("random", "medium", "expert"))
    assert low < medium < high
    assert found["expert"].noise == found["random"].noise == 0 < found["medium"].noise
    # The share is of other episodes than those that were recorded.
    last = float(lines[-2 if "mean returns" in lines[-1] else -1].split(": ")[1].split()[0])
    assert MEDIUM[0] - 0.01 <= last <= MEDIUM[1] + 0.01
    again = record(balanced, "medium", 120, 0)
    for one, other in zip(again.episodes, found["medium"].episodes, strict=True):
        assert np.array_equal(one.observations, other.observations)
    with pytest.raises(ValueError, match="quality must be one of random, medium, expert"):
        record(balanced, "good")
    with pytest.raises(ValueError, match="steps must be positive"):
        record(balanced, steps=0)


def test_from_a_run_to_a_dataset_to_a_policy_and_its_report(
    tiny_recipe: Callable[..., DictConfig], capsys: pytest.CaptureFixture[str]
) -> None:
    source = run(tiny_recipe())
    data = "l1=off, paper/random.npz"  # as run directories are named, which Hydra wants quoted
    main(["dataset", str(source), data, "--quality", "random", "--steps", "100"])
    printed = capsys.readouterr().out
    assert "105 transitions in 7 episodes" in printed
    (of_data,) = shlex.split(printed.partition("torchrl-l1 run offline/... ")[2])
    main(["run", "offline/inverted_pendulum", of_data, "run_dir=runs/a", *TINY])
    with Path("runs/a/metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["data/transitions"] for row in rows] == ["105", "105"]
    Path(data).unlink()  # it is in the checkpoint now
    main(["run", "offline/inverted_pendulum", of_data, "run_dir=runs/a", *TINY,
          "outer_iterations=3", "--resume"])  # fmt: skip
    main(["evaluate", "runs/a", "--l1", "off", "paper", "robust", "oracle", "--bias", "0", "1",
          "--episodes", "2", "--policy", "deterministic"])  # fmt: skip
    with Path("runs/a/evaluation/evaluation.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 8
    assert load_run("runs/a").algorithm.acting_dynamics.residuals.measured
    main(["report", "runs", "--output", "report"])
    page = Path("report/report.md").read_text()
    assert "Offline" in page and "inverted_pendulum" in page


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run_dir=x"], "datasets/inverted_pendulum/medium.npz: no such dataset"),
        (["run_dir=x", "dataset=wide.npz"], "the task inverted_pendulum of 4 and 1"),
        (["run_dir=x", "dataset=other"], "other: no such dataset"),
    ],
)
def test_nothing_is_begun_without_a_dataset_of_use(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez("wide.npz", observation=np.random.randn(9, 11), action=np.zeros((9, 3)))
    with pytest.raises(SystemExit) as exit_info:
        main(["run", "offline/inverted_pendulum", *TINY, *arguments])
    assert exit_info.value.code == 1
    (line,) = [one for one in capsys.readouterr().err.splitlines() if words in one]
    assert line.startswith("torchrl-l1 run: ")
    assert not Path("x").exists()


def test_what_a_command_refuses(
    tiny_recipe: Callable[..., DictConfig], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("there.npz").write_text("")
    for arguments, words in (
        (["nowhere", "a.npz"], "holds no run"),
        (["nowhere", "there.npz"], "is there already"),
    ):
        with pytest.raises(SystemExit):
            main(["dataset", *arguments])
        assert words in capsys.readouterr().err


@pytest.mark.parametrize("output", ["file/a.npz", "file/folder"])
def test_the_place_of_a_dataset_is_looked_at_before_work(
    output: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("file").touch()
    command = import_module("torchrl_l1.cli.dataset")
    monkeypatch.setattr(command, "load_run", lambda _: None)
    monkeypatch.setattr(command, "record", None)
    with pytest.raises(SystemExit):
        main(["dataset", "runs/a", output])
    assert "something is in the way" in capsys.readouterr().err


def test_kill_and_resume_leave_equal_metrics(tmp_path: Path) -> None:
    np.savez("data.npz", **_small())
    settings = [*TINY, "dataset=data.npz", "outer_iterations=3", "l1=robust", "penalty=morel"]
    whole = run(compose("offline/inverted_pendulum", [*settings, "run_dir=whole"]))
    killed = [*settings, "run_dir=killed"]
    run(compose("offline/inverted_pendulum", [*killed, "outer_iterations=1"]))
    run(compose("offline/inverted_pendulum", [*killed, "resume=true"]))
    text = (whole / "metrics.csv").read_text()
    assert (tmp_path / "killed/metrics.csv").read_text() == text
    with pytest.raises(RunDirectoryError, match=r"dataset: data.npz there, other.npz now"):
        run(compose("offline/inverted_pendulum", [*killed, "dataset=other.npz", "resume=true"]))
    assert json.loads((whole / "checksums.json").read_text())


def _small() -> dict[str, np.ndarray]:
    torch.manual_seed(0)
    env = BatchedMujocoEnv("inverted_pendulum", 2, max_steps=40, seed=0)
    (first, second) = split_episodes(env.rollout(40))
    return {
        "observation": np.concatenate([first.observations, second.observations]),
        "action": np.concatenate(
            [np.pad(one.actions, ((0, 1), (0, 0))) for one in (first, second)]
        ),
        "episode": np.repeat([0, 1], 41),
    }
