from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from torchrl_l1.dynamics import read_csv, read_npz

from .conftest import KEYS, write


@pytest.mark.parametrize("name", ["done", "Terminals", "timeouts", "truncations", "is_terminal"])
def test_ends_of_episodes_are_not_passed_over(tmp_path: Path, name: str) -> None:
    """Read as one episode, the step from its end to the next start would be the plant's."""
    ends = np.array([0, 0, 1, 0, 0, 1])
    columns = {"angle": [0.0, 1, 2, 9, 8, 7], "rate": np.ones(6), "torque": np.ones(6)}
    rows = [",".join(map(str, row)) for row in zip(*columns.values(), ends, strict=True)]
    table = write(tmp_path / "log.csv", f"angle,rate,torque,{name}", *rows)
    np.savez(
        tmp_path / "log.npz", **columns, **{name: ends.astype(bool)}, number=ends.cumsum() - ends
    )
    message = rf"'{name}' shows 1 episodes that end before the last row"
    for read, file in ((read_csv, table), (read_npz, tmp_path / "log.npz")):
        with pytest.raises(ValueError, match=message):
            read(file, **KEYS)
    assert len(read_npz(tmp_path / "log.npz", **KEYS, episode="number")) == 4
    # One that only says that the log ends is no hindrance.
    rows[2] = rows[2][:-1] + "False"
    assert len(read_csv(write(table, f"angle,rate,torque,{name}", *rows), **KEYS)) == 5


@pytest.mark.parametrize("options", [{"time": "t"}, {"episode": "day"}, {"episode": "late"}])
def test_ends_within_an_episode_are_not_passed_over(
    tmp_path: Path, options: dict[str, str]
) -> None:
    """Time that goes on over resets, a number of something else, a count that is one row late."""
    ends = np.array([0, 0, 1, 0, 0, 1])
    columns = {"angle": [0.0, 1, 2, 9, 8, 7], "rate": np.ones(6), "torque": np.ones(6)}
    columns |= {"t": np.arange(6), "day": np.zeros(6), "late": ends.cumsum(), "done": ends}
    rows = [",".join(map(str, row)) for row in zip(*columns.values(), strict=True)]
    table = write(tmp_path / "log.csv", ",".join(columns), *rows)
    np.savez(tmp_path / "log.npz", **columns)
    for read, file in ((read_csv, table), (read_npz, tmp_path / "log.npz")):
        with pytest.raises(ValueError, match="'done' shows 1 ends within"):
            read(file, **KEYS, **options)


TELLING = {
    "is_first": [1, 0, 0, 1, 0, 0],
    "Reset": [0, 0, 0, 1, 0, 0],
    "episode_starts": [True, False, False, True, False, False],
    "new_episode": ["yes", "no", "no", "yes", "no", "no"],
    "episode": [3, 3, 3, 5, 5, 5],
    "run": ["a", "a", "a", "b", "b", "b"],
    "traj_id": [0, 0, 0, 1, 1, 1],
    "time": [0.1, 0.2, 0.31, 0.1, 0.2, 0.3],
    "timestamp": [1, 2, 3, 104, 105, 106],
}


@pytest.mark.parametrize("name", TELLING)
def test_what_else_tells_of_episodes_is_not_passed_over(tmp_path: Path, name: str) -> None:
    """Flags of starts, numbers of episodes and times that nobody has named."""
    columns = {"angle": [0.0, 1, 2, 9, 8, 7], "rate": np.ones(6), "torque": np.ones(6)}
    columns |= {"clock": np.arange(6.0), "number": [0, 0, 0, 1, 1, 1], name: TELLING[name]}
    rows = [",".join(map(str, row)) for row in zip(*columns.values(), strict=True)]
    table = write(tmp_path / "log.csv", ",".join(columns), *rows)
    np.savez(tmp_path / "log.npz", **columns)
    for read, file in ((read_csv, table), (read_npz, tmp_path / "log.npz")):
        with pytest.raises(ValueError, match=f"'{name}' shows 1 episodes that end before"):
            read(file, **KEYS)
        with pytest.raises(ValueError, match=f"'{name}' shows 1 ends within"):
            read(file, **KEYS, time="clock")
        assert len(read(file, **KEYS, episode="number")) == 4


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("time", [0.0, 0.1, 0.2, 0.5, 0.6, 0.7]),  # a gap or two, which only a named time begins by
        ("time", [f"2026-01-01 00:00:0{second}" for second in range(6)]),
        ("time", ["0.1", "", "", "", "", ""]),
        ("episode", [7] * 6),
        ("reset", [1, 0, 0, 0, 0, 0]),
        ("running", [0, 1, 0, 1, 0, 1]),
        ("trajectory", [0, 1, 2, 3, 4, 5]),
    ],
)
def test_what_tells_of_one_episode_is_no_hindrance(
    tmp_path: Path, name: str, values: list[object]
) -> None:
    lines = [f"{row},0,1,{value}" for row, value in enumerate(values)]
    assert (
        len(read_csv(write(tmp_path / "a.csv", f"angle,rate,torque,{name}", *lines), **KEYS)) == 5
    )


def test_arrays_of_another_length_number_no_rows(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", x=np.arange(6.0), u=np.ones(6), run=["a", "b"], time=[0, 9, 1])
    assert len(read_npz(tmp_path / "log.npz", observation="x", action="u")) == 5


def test_an_end_may_have_its_last_observation_behind_it(tmp_path: Path) -> None:
    lines = [f"{x},0,1,{run},{end}" for run in "ab" for x, end in ((0, 0), (1, 1), (2, 0))]
    file = write(tmp_path / "log.csv", "angle,rate,torque,run,terminated", *lines)
    data = read_csv(file, **KEYS, episode="run")
    assert data["next", "observation"][:, 0].tolist() == [1, 2, 1, 2]


@pytest.mark.parametrize("no", ["0", "0.00", "0.000000000000000000e+00", "F", "None", "nan"])
def test_flags_that_are_not_set_are_none_however_they_are_written(tmp_path: Path, no: str) -> None:
    """As ``numpy.savetxt`` writes nought, among others."""
    lines = [f"{x},0,1,{run},{no}" for run in "ab" for x in range(4)]
    file = write(tmp_path / "log.csv", "angle,rate,torque,run,done", *lines)
    assert len(read_csv(file, **KEYS, episode="run")) == 6


def test_arrays_of_flags_may_lie_on_their_side_and_have_the_name_of_a_measurement(
    tmp_path: Path,
) -> None:
    ends = np.array([0, 0, 1, 0, 0, 1])
    columns = {"angle": np.arange(6.0), "torque": np.ones(6), "part": ends.cumsum() - ends}
    file = tmp_path / "log.npz"
    np.savez(file, **columns, terminal=np.ones(6), done=ends[None])
    keys = {"observation": ["angle", "terminal"], "action": "torque"}
    assert len(read_npz(file, **keys, episode="part")) == 4
    with pytest.raises(ValueError, match="'done' shows 1 episodes that end before the last"):
        read_npz(file, **keys)
    np.savez(file, **columns, done=np.where(ends == 1, 1.0, np.nan))
    assert len(read_npz(file, observation="angle", action="torque", episode="part")) == 4


def buffer(order: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two episodes as a replay buffer has them: observations, what followed, and numbers."""
    x = np.random.default_rng(0).normal(size=(2, 21, 2)).cumsum(1)
    rows = x[:, :-1].reshape(-1, 2), x[:, 1:].reshape(-1, 2), np.arange(2).repeat(20)
    return rows[0][order], rows[1][order], rows[2][order]


IN_ORDER = np.arange(40)
SHUFFLED = np.random.default_rng(1).permutation(40)


@pytest.mark.parametrize(
    ("order", "episode", "count"),
    [(SHUFFLED, None, 39), (SHUFFLED, "number", 38), (IN_ORDER[::2], "number", 18)],
)
@pytest.mark.parametrize("name", ["next_observations", "next_obs", "observation_next"])
def test_rows_that_do_not_follow_each_other_are_no_transitions(
    tmp_path: Path, order: np.ndarray, episode: str | None, count: int, name: str
) -> None:
    """A replay buffer's, shuffled or thinned out: between two of them lies no step of the plant."""
    x, following, number = buffer(order)
    u = np.ones(len(x))
    rows = [f"{a},{b},1,{c},{n}" for (a, b), (c, _), n in zip(x, following, number, strict=True)]
    table = write(tmp_path / "log.csv", "angle,rate,torque,next_angle,number", *rows)
    arrays = {"observation": x, "action": u, "angle": x[:, 0], "rate": x[:, 1], "number": number}
    np.savez(tmp_path / "log.npz", **arrays, **{name: following})
    whole = {"observation": "observation", "action": "action"}
    parts = {"observation": ["angle", "rate"], "action": "action"}
    for read, file, keys in (
        (read_csv, table, KEYS),
        (read_npz, tmp_path / "log.npz", whole),
        (read_npz, tmp_path / "log.npz", parts),
    ):
        with pytest.raises(
            ValueError, match=rf"which differs from the next row \d+ times out of {count}:"
        ):
            read(file, **keys, episode=episode)


def test_what_followed_may_stand_beside_rows_in_order(tmp_path: Path) -> None:
    """Also rounded, unknown, in the last row of an episode, or one row short."""
    x, following, number = buffer(IN_ORDER)
    rows = [
        f"{a!r},{b!r},1,{'' if i == 3 else repr(c)},{n}"
        for i, ((a, b), (c, _), n) in enumerate(
            zip(x.tolist(), following.tolist(), number, strict=True)
        )
    ]
    table = write(tmp_path / "log.csv", "angle,rate,torque,next_angle,number", *rows)
    assert len(read_csv(table, **KEYS, episode="number")) == 38
    np.savez(
        tmp_path / "log.npz",
        observations=x[:20],
        action=np.ones(19),
        next_observations=following[:19].astype(np.float32),
    )
    assert len(read_npz(tmp_path / "log.npz", observation="observations", action="action")) == 19
    with pytest.raises(
        ValueError, match=r"'next_angle', which differs .* 1 times out of 39: .*episode"
    ):
        read_csv(table, **KEYS)
