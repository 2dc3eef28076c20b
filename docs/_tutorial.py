"""Scripts in cells as pages: each is run when the documentation is built, and shows what it gave.

    python docs/_tutorial.py SCRIPT FOLDER

A line that begins with `# %%` starts a cell; after `# %% [markdown]` it is text. Below a cell of
code stands what it printed, and every picture (PNG) that it wrote to the working folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).parents[1] / "torchrl_l1"


def write(script: Path, folder: Path) -> None:
    """Run a script in a process of its own and write ``folder/NAME.md``, unless nothing changed."""
    page = folder / f"{script.stem}.md"
    mark = f"% of {digest(script)}\n"
    if page.exists() and page.read_text().startswith(mark):
        return
    folder.mkdir(exist_ok=True)
    given = os.environ | {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    command = [sys.executable, __file__, str(script.resolve()), str(folder.resolve())]
    subprocess.run(command, env=given, check=True, cwd=folder)
    page.write_text(mark + page.read_text())


def digest(script: Path) -> str:
    """Of all that the page depends on but the versions of other packages."""
    found = hashlib.sha256()
    for file in (Path(__file__), script, *sorted(PACKAGE.rglob("*.py"))):
        found.update(file.read_bytes())
    return found.hexdigest()[:16]


def cells(text: str) -> list[tuple[bool, str]]:
    """Whether each cell is code, and its text; what stands before the first is none."""
    found = []
    for cell in re.split(r"^# %%", text, flags=re.MULTILINE)[1:]:
        head, _, body = cell.partition("\n")
        is_code = "[markdown]" not in head
        if not is_code:
            body = re.sub(r"^# ?", "", body, flags=re.MULTILINE)
        found.append((is_code, body.strip("\n")))
    return found


def render(text: str, folder: Path, source: str) -> str:
    """Run the cells in turn in the working folder ``folder``: the page, Markdown."""
    names: dict[str, Any] = {"__name__": "__main__"}
    parts = []
    for is_code, body in cells(text):
        if not is_code:
            parts.append(body)
            continue
        before = {file: file.stat().st_mtime_ns for file in folder.glob("*.png")}
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(body, source, "exec"), names)
        parts.append(f"```python\n{body}\n```")
        if shown := printed.getvalue().strip():
            is_table = all(line.startswith("|") for line in shown.splitlines())
            parts.append(shown if is_table else f"```text\n{shown}\n```")
        for file in sorted(folder.glob("*.png")):
            if before.get(file) != file.stat().st_mtime_ns:
                parts.append(f"![{file.stem}]({folder.name}/{file.name})")
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    own, output = Path(sys.argv[1]), Path(sys.argv[2])
    rendered = render(own.read_text(), output, own.name)
    (output / f"{own.stem}.md").write_text(rendered)
