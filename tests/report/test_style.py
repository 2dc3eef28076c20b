from __future__ import annotations

from pathlib import Path

import matplotlib
from matplotlib.text import Text

from torchrl_l1.report.style import color, grid, legend_below, looks, save


def test_names_between_dollars_are_no_formulas_and_other_figures_have_theirs(
    tmp_path: Path,
) -> None:
    assert matplotlib.rcParams["text.parse_math"], "the user's own figures"
    figure, axes = grid(2, 2, 4.0, 3.0)
    axes[0].bar(["a$_{$", "b"], [1, 2])  # as a formula it could not even be drawn
    axes[0].plot([0, 1], [1, 2], label="$_{$")
    axes[0].text(0, 1, "$_{$")
    axes[1].set_xscale("log")
    axes[1].plot([1, 1000], [1, 2])
    axes[1].set_title("$_{$")
    legend_below(figure, axes)
    assert save(figure, tmp_path / "figure.png").stat().st_size > 0
    texts = [text for text in figure.findobj(Text) if text.get_text()]
    assert sum("$" in text.get_text() for text in texts) >= 4
    assert not any(text.get_parse_math() for text in texts)
    assert matplotlib.rcParams["text.parse_math"]


def test_arms_have_their_colours_to_themselves_and_no_two_lines_look_the_same() -> None:
    names = ["oracle", *(f"line {number}" for number in range(20)), "off"]
    drawn_as = looks(names)
    assert drawn_as.keys() == set(names)
    assert [drawn_as[arm].color for arm in ("oracle", "off")] == [color(0, "oracle"), color(0)]
    others = [drawn_as[name] for name in names[1:-1]]
    assert not {look.color for look in others} & {color(0, "oracle"), color(0)}
    for differing in ("style", "marker"):
        assert len({(look.color, str(getattr(look, differing))) for look in others}) == 20
