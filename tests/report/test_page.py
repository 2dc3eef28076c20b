from __future__ import annotations

import csv
from pathlib import Path

from torchrl_l1.experiment.files import write_table
from torchrl_l1.report.page import markdown


def test_markdown_drops_columns_that_say_nothing() -> None:
    rows = [{"a": "1", "b": "", "c": "–"}, {"a": "2", "b": "", "c": "3"}]
    assert markdown(rows) == "| a | c |\n|---|---|\n| 1 | – |\n| 2 | 3 |"


def test_markdown_without_rows_is_empty() -> None:
    assert markdown([]) == ""


def test_csv_keeps_full_precision_and_all_columns(tmp_path: Path) -> None:
    write_table(tmp_path / "table.csv", [{"a": 1 / 3}, {"a": 2.0, "b": "x, y"}])
    with (tmp_path / "table.csv").open() as file:
        first, second = csv.DictReader(file)
    assert float(first["a"]) == 1 / 3
    assert (first["b"], second["b"]) == ("", "x, y")
