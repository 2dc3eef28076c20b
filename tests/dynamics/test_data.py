from __future__ import annotations

from pathlib import Path
from tempfile import mkdtemp
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_l1.dynamics import read_csv, read_minari, read_npz, read_transitions

from .conftest import KEYS, write


def table(file: Path, lengths: list[int], dt: float = 0.01, jitter: float = 0.0) -> np.ndarray:
    """A log of several runs, columns time, angle, torque, rate, run and one that is of no use."""
    random = np.random.default_rng(0)
    rows = []
    for run, length in enumerate(lengths):
        clock = dt * (np.arange(length) + jitter * random.uniform(-1, 1, length))
        rows += [(clock[i], *random.normal(size=3), run) for i in range(length)]
    values = np.array(rows)
    lines = [
        ",".join(f"{cell!r}" for cell in row[:4].tolist()) + f",run {int(row[4])},yes"
        for row in values
    ]
    write(file, "time, angle,torque,rate,run,valid", *lines)
    return values


def test_a_table_of_runs(tmp_path: Path) -> None:
    values = table(tmp_path / "log.csv", [5, 1, 4], jitter=0.04)
    data = read_csv(tmp_path / "log.csv", **KEYS, episode="run", time="time")
    rows = [0, 1, 2, 3, 6, 7, 8]
    x = torch.from_numpy(values[:, [1, 3]])
    assert data.shape == (7,) and data.names == ["time"]
    assert torch.equal(data["observation"], x[rows])
    assert torch.equal(data["next", "observation"], x[[row + 1 for row in rows]])
    assert torch.equal(data["action"], torch.from_numpy(values[rows, 2:3]))
    assert data["next", "truncated"].flatten().nonzero().flatten().tolist() == [3, 6]
    assert data["next", "done"].sum() == 2 and not data["next", "terminated"].any()
    ids = data["collector", "traj_ids"]
    assert (ids[:4] == ids[0]).all() and (ids[4:] == ids[4]).all() and ids[0] != ids[4]
    assert data["dt"].shape == (7, 1) and data["dt"][0].item() == pytest.approx(0.01, rel=0.1)
    read = read_transitions(data)
    assert (~read.joined).nonzero().flatten().tolist() == [3, 6] and read.dropped == 0


def test_a_time_that_goes_back_begins_an_episode(tmp_path: Path) -> None:
    table(tmp_path / "log.csv", [5, 4])
    data = read_csv(tmp_path / "log.csv", **KEYS, time="time")
    assert data.shape == (7,) and data["next", "done"].sum() == 2
    with pytest.raises(ValueError, match="'time' shows 1 episodes"):  # where it is not named
        read_csv(tmp_path / "log.csv", **KEYS)


def test_a_gap_is_told_and_not_bridged(tmp_path: Path) -> None:
    lines = [f"{t},{t},0,1" for t in (0.0, 0.1, 0.2, 0.3, 0.5, 0.6, 0.7)]
    file = write(tmp_path / "log.csv", "t,angle,rate,torque", *lines)
    with pytest.warns(UserWarning, match="1 time steps differ from 0.1 s"):
        data = read_csv(file, **KEYS, time="t")
    assert data["dt"][0].item() == pytest.approx(0.1)
    steps = data["next", "observation"][:, 0] - data["observation"][:, 0]
    assert len(data) == 5 and (steps < 0.11).all()


def test_rows_of_one_time_are_a_gap(tmp_path: Path) -> None:
    lines = [f"{t},{t},0,1" for t in (0.0, 0.1, 0.2, 0.2, 0.3, 0.4, 0.5)]
    file = write(tmp_path / "log.csv", "t,angle,rate,torque", *lines)
    with pytest.warns(UserWarning, match=r"1 time steps differ from 0\.1 s"):
        data = read_csv(file, **KEYS, time="t")
    assert len(data) == 5 and data["next", "done"].sum() == 2
    # A table in which every line stands twice would be left without any transition.
    file = write(tmp_path / "log.csv", "t,angle,rate,torque", *(2 * lines[:3]), *(2 * lines[4:]))
    doubled = sorted(file.read_text().splitlines()[1:])
    file = write(tmp_path / "log.csv", "t,angle,rate,torque", *doubled)
    with pytest.raises(ValueError, match=r"time steps from 0 to 0\.1 s: resample"):
        read_csv(file, **KEYS, time="t")


def test_episodes_may_be_interleaved(tmp_path: Path) -> None:
    lines = ["0,0,0,a", "10,0,0,b", "1,0,0,a", "11,0,0,b"]
    file = write(tmp_path / "log.csv", "angle,rate,torque,robot", *lines)
    data = read_csv(file, **KEYS, episode="robot")
    assert data["observation"][:, 0].tolist() == [0, 10]
    assert data["next", "observation"][:, 0].tolist() == [1, 11]


def test_empty_cells_and_other_habits(tmp_path: Path) -> None:
    file = write(tmp_path / "log.csv", "\ufeff# angle;rate;torque", "0;0;1", "", "1;;1", "2;2")
    data = read_csv(file, **KEYS, delimiter=";")
    assert data["next", "observation"].isnan().sum() == 1
    with pytest.warns(UserWarning, match="dropped 2 of 2 .* not finite"):
        assert read_transitions(data).dropped == 2


@pytest.mark.parametrize(
    ("delimiter", "lines"),
    [
        (" ", ["angle  rate   torque", " 0.1 2      3", "4   5e-1   6 "]),
        (",", ["", '"angle", "rate", "torque"', '"0.1", 2, 3', "4, 0.5, 6"]),
    ],
)
def test_columns_padded_with_spaces(tmp_path: Path, delimiter: str, lines: list[str]) -> None:
    data = read_csv(write(tmp_path / "log.csv", *lines), **KEYS, delimiter=delimiter)
    assert data["observation"].tolist() == [[0.1, 2.0]] and data["action"].tolist() == [[3.0]]
    assert data["next", "observation"].tolist() == [[4.0, 0.5]]


@pytest.mark.parametrize(
    ("lines", "options", "error", "message"),
    [
        (["angle,rate", "0,0"], {}, KeyError, "no column 'torque', only angle, rate"),
        (
            ["angle;rate;torque", "0;0;0"],
            {},
            KeyError,
            "only angle;rate;torque, with cells separated by ','; give delimiter=';'",
        ),
        (["PAR1\0\0\0"], {}, ValueError, "is not text: save the table as CSV"),
        ([], {}, KeyError, "no first line"),
        (
            ["angle,rate,torque", "0,0,0", "0,off,0"],
            {},
            ValueError,
            "line 3, column 'rate': 'off' is not a number; leave the cell empty if there is no",
        ),
        (
            ["angle;rate;torque", "0;0,5;0"],
            {"delimiter": ";"},
            ValueError,
            "line 2, column 'rate': '0,5' is not a number; use a point before the decimals",
        ),
        (
            ["angle,rate,torque,t", "0,0,0,2024-03-01T10:00:00"],
            {"time": "t"},
            ValueError,
            "column 't': '2024-03-01T10:00:00' is not a number; give times in seconds",
        ),
        (["angle,rate,torque", "0,1_000,0"], {}, ValueError, "'1_000' is not a number"),
        (
            # As R writes it, with the names of the rows; and with decimal commas.
            ["angle,rate,torque", "1,0,0,0", "2,0,0,0"],
            {},
            ValueError,
            "line 2 has 4 cells for 3 columns: there is a column without a name, or a ','",
        ),
        (["angle\trate\ttorque"], {"delimiter": "\\t"}, ValueError, "delimiter is one character"),
        (["angle,rate,torque,rate", "0,0,0,1"], {}, ValueError, "2 columns 'rate': rename them"),
        (
            ["angle,rate,torque", f"{10**6 * '0'}"],
            {},
            ValueError,
            "not a table of text: field larger",
        ),
        (["angle,rate,torque", "0,0,0"], {}, ValueError, "1 rows, none of which follows"),
        (
            ["angle,rate,torque,t", *(f"0,0,0,{t}" for t in (0, 1, 3, 4, 9, 11, 17))],
            {"time": "t"},
            ValueError,
            "time steps from 1 to 6 s: resample",
        ),
        (
            ["angle,rate,torque,t", "0,0,0,5", "0,0,0,5"],
            {"time": "t"},
            ValueError,
            "time never increases from one row to the next: sort the rows",
        ),
        (
            ["angle,rate,torque,t", *(f"0,0,0,{t}" for t in (3, 0, 4, 1, 6, 2, 9, 5))],
            {"time": "t"},
            ValueError,
            "the time goes back 4 times, sort the rows by it",
        ),
        (
            ["angle,rate,torque,run", *(f"0,0,0,{run}" for run in ("a", "a", "", "b", "", "nan"))],
            {"episode": "run"},
            ValueError,
            "3 of 6 rows name no episode, first row 3",
        ),
    ],
)
def test_errors_name_file_and_place(
    tmp_path: Path,
    lines: list[str],
    options: dict[str, str],
    error: type[Exception],
    message: str,
) -> None:
    file = write(tmp_path / "log.csv", *lines)
    with pytest.raises(error, match=message) as caught:
        read_csv(file, **KEYS, **options)
    assert "log.csv" in str(caught.value) and "\n" not in str(caught.value)


def test_other_encodings_are_named(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_bytes("angle,rate,torque,°C\n0,0,0,20\n".encode("cp1252"))
    with pytest.raises(ValueError, match=r"log\.csv is not text in UTF-8 .*: save it as such"):
        read_csv(file, **KEYS)


def test_names_of_episodes_that_come_back_begin_new_ones(tmp_path: Path) -> None:
    """Two files in one, of which each counts its episodes from nought."""
    lines = [f"{x},0,1,{run},{x}" for run in (0, 1, 0, 1) for x in range(5)]
    file = write(tmp_path / "log.csv", "angle,rate,torque,run,t", *lines)
    with pytest.warns(UserWarning, match="names of episodes come back 2 times"):
        data = read_csv(file, **KEYS, episode="run")
    assert ((data["next", "observation"] - data["observation"])[:, 0] == 1).all()
    assert len(data) == 16 and data["next", "done"].sum() == 4
    assert len(read_csv(file, **KEYS, episode="run", time="t")) == 16  # which needs no warning


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"log\.csv: no such file"):
        read_csv(tmp_path / "log.csv", **KEYS)
    with pytest.raises(FileNotFoundError, match=r"no such file, but a folder"):
        read_csv(tmp_path, **KEYS)
    with pytest.raises(FileNotFoundError, match=r"log\.npz: no such file"):
        read_npz(tmp_path / "log.npz", **KEYS)


def test_arrays_read_as_the_table_does(tmp_path: Path) -> None:
    values = table(tmp_path / "log.csv", [5, 1, 4])
    names = ("time", "angle", "torque", "rate", "run")
    np.savez(tmp_path / "log.npz", **dict(zip(names, values.T, strict=True)), x=values[:, [1, 3]])
    expected = read_csv(tmp_path / "log.csv", **KEYS, episode="run", time="time")
    for keys in (KEYS, {"observation": "x", "action": "torque"}):
        data = read_npz(tmp_path / "log.npz", **keys, episode="run", time="time")
        assert (data == expected).all()


def test_a_last_observation_without_an_action(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", x=np.arange(5.0), u=np.ones((4, 2)))
    data = read_npz(tmp_path / "log.npz", observation="x", action="u")
    assert data["next", "observation"].flatten().tolist() == [1, 2, 3, 4]
    assert data["action"].shape == (4, 2) and (data["action"] == 1).all()


@pytest.mark.parametrize(
    ("arrays", "error", "message"),
    [
        ({"x": np.zeros(3)}, KeyError, "no array 'u', only x"),
        ({"x": np.zeros((3, 2, 2)), "u": np.zeros(3)}, ValueError, r"'x' has shape \[3, 2, 2\]"),
        ({"x": np.array(["a", "b"]), "u": np.zeros(2)}, ValueError, "'x' has .* type <U1"),
        ({"x": np.zeros(3), "u": np.zeros(5)}, ValueError, "action has 5 rows, the observation 3"),
        ({"x": np.zeros((0, 2)), "u": np.zeros((0, 1))}, ValueError, "0 rows, none of which"),
        ({"x": np.zeros(3), "u": np.zeros(3), "t": np.ones((3, 2))}, ValueError, "'t' has 2 col"),
    ],
)
def test_arrays_that_do_not_fit(
    tmp_path: Path, arrays: dict[str, np.ndarray], error: type[Exception], message: str
) -> None:
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(error, match=message):
        time = "t" if "t" in arrays else None
        read_npz(tmp_path / "log.npz", observation="x", action="u", time=time)


def test_other_files_are_no_archives_of_arrays(tmp_path: Path) -> None:
    write(tmp_path / "log.npz", "angle,rate")
    with pytest.raises(
        ValueError, match=r"log.npz is not a readable .npz file: numpy.savez did not w"
    ):
        read_npz(tmp_path / "log.npz", observation="x", action="u")
    ragged = np.array([np.zeros(2), np.zeros(3)], dtype=object)
    np.savez(tmp_path / "ragged.npz", x=ragged, u=ragged)
    with pytest.raises(ValueError, match=r"arrays of objects, .* an array that numbers them"):
        read_npz(tmp_path / "ragged.npz", observation="x", action="u")
    np.save(tmp_path / "log.npy", np.zeros(3))
    with pytest.raises(ValueError, match=r"single array; save several by name with numpy.savez"):
        read_npz(tmp_path / "log.npy", observation="x", action="u")


class Split(gymnasium.ObservationWrapper):
    """The observation as a dictionary of two."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        box = env.observation_space
        parts = {"pose": slice(0, 2), "rates": slice(2, 4)}
        self.parts = parts
        self.observation_space = gymnasium.spaces.Dict(
            {
                name: gymnasium.spaces.Box(box.low[part], box.high[part], dtype=box.dtype)
                for name, part in parts.items()
            }
        )

    def observation(self, observation: np.ndarray) -> dict[str, np.ndarray]:
        return {name: observation[part] for name, part in self.parts.items()}


def collect(env: gymnasium.Env, name: str, episodes: int = 4) -> tuple[list[tuple], str]:
    """A dataset of random actions, and what the environment said meanwhile."""
    import minari
    from minari.data_collector.episode_buffer import EpisodeBuffer

    env.action_space.seed(0)
    said, buffers = [], []
    for episode in range(episodes):
        seen, _ = env.reset(seed=episode)
        steps, done = [], False
        while not done:
            action = env.action_space.sample()
            following, reward, terminated, truncated, _ = env.step(action)
            steps.append((seen, action, following, reward, terminated, truncated, episode))
            seen, done = following, terminated or truncated
        columns = [list(column) for column in zip(*steps, strict=True)]
        every = [*columns[0], seen]
        if isinstance(seen, dict):
            every = {key: [one[key] for one in every] for key in seen}
        buffers.append(EpisodeBuffer(episode, None, None, every, *columns[1:2], *columns[3:6], {}))
        said += steps
    minari.create_dataset_from_buffers(name, buffers, env=env, algorithm_name="random")
    return said, name


@pytest.fixture
def minari_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    # Minari leaves its temporary folders to the end of the process, with warnings.
    folders = SimpleNamespace(
        TemporaryDirectory=lambda dir: SimpleNamespace(name=mkdtemp(dir=dir), cleanup=list)
    )
    monkeypatch.setattr("minari.data_collector.data_collector.tempfile", folders)


# What Minari says of metadata that a test has no use for.
QUIET = pytest.mark.filterwarnings("ignore::UserWarning:minari", "ignore::DeprecationWarning")


@QUIET
@pytest.mark.usefixtures("minari_home")
def test_a_minari_dataset() -> None:
    import minari

    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=8)
    said, name = collect(env, "pendulum/random-v0")
    data = read_minari(name)
    x, u, after, reward, terminated, truncated, episode = (
        torch.as_tensor(np.array(column)) for column in zip(*said, strict=True)
    )
    assert terminated.any() and truncated.any()
    assert torch.equal(data["observation"], x)
    assert torch.equal(data["action"], u)
    assert torch.equal(data["next", "observation"], after)
    assert torch.equal(data["next", "reward"].flatten(), reward)
    assert torch.equal(data["next", "terminated"].flatten(), terminated)
    assert torch.equal(data["next", "truncated"].flatten(), truncated)
    assert torch.equal(data["next", "done"].flatten(), terminated | truncated)
    assert torch.equal(data["collector", "traj_ids"], episode)
    assert not data["done"].any()
    read = read_transitions(data)
    assert read.dropped == 0 and int((~read.joined).sum()) == 4
    part = minari.load_dataset(name).filter_episodes(lambda one: one.id == 2)
    assert torch.equal(read_minari(part)["observation"], x[episode == 2])


@QUIET
@pytest.mark.usefixtures("minari_home")
def test_a_dataset_of_minari_s_own_collector() -> None:
    pytest.importorskip("jax")
    import minari

    recorder = minari.DataCollector(gymnasium.make("Pendulum-v1", max_episode_steps=5))
    seen = []
    for episode in range(2):
        seen.append(recorder.reset(seed=episode)[0])
        for _ in range(5):
            seen.append(recorder.step(np.array([1.0], dtype=np.float32))[0])
    recorder.create_dataset("pendulum/constant-v0", algorithm_name="constant")
    recorder.close()
    data, x = read_minari("pendulum/constant-v0"), torch.from_numpy(np.array(seen)).view(2, 6, 3)
    assert torch.equal(data["observation"].view(2, 5, 3), x[:, :-1])
    assert torch.equal(data["next", "observation"].view(2, 5, 3), x[:, 1:])


@QUIET
@pytest.mark.usefixtures("minari_home")
def test_a_minari_dataset_of_dictionaries() -> None:
    said, name = collect(Split(gymnasium.make("InvertedPendulum-v5")), "pendulum/split-v0")
    data = read_minari(name)
    assert data["pose"].shape == (len(said), 2)
    after = np.array([step[2]["rates"] for step in said])
    assert torch.equal(data["next", "rates"], torch.from_numpy(after))
    assert isinstance(data, TensorDict)


@QUIET
@pytest.mark.usefixtures("minari_home")
def test_minari_datasets_that_are_of_no_use() -> None:
    with pytest.raises(FileNotFoundError, match="not found locally"):
        read_minari("pendulum/none-v0")
    _, name = collect(gymnasium.make("CartPole-v1"), "cartpole/random-v0", 1)
    with pytest.raises(TypeError, match=r"actions of Discrete\(2\): L1 needs vectors"):
        read_minari(name)


def test_without_minari_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "minari", None)
    with pytest.raises(ModuleNotFoundError, match=r"torchrl-l1\[minari\]"):
        read_minari("any/thing-v0")
