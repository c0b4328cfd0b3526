"""IPython extension of the documentation's pages: ``%%bash`` cells whose output comes in one piece, and that fail with their commands.

The cells act as in any notebook; ``%%bash --no-raise-error`` goes on whatever the exit status. ``%%writefile`` writes in silence.
"""

from __future__ import annotations

import subprocess
import textwrap
from pathlib import Path
from typing import Any

WIDTH = 88
"""Characters that fit into a line of a page."""
CANNOT_TELL = 'strapdown() { command strapdown "$@" || [ $? -eq 3 ]; }\n'
"""A verdict that the data cannot tell is no failure of a cell."""


def bash(line: str, cell: str) -> None:
    """Run a cell in Bash until a command fails; print what it wrote."""
    options = [] if "--no-raise-error" in line else ["-e", "-o", "pipefail"]
    if options:
        cell = CANNOT_TELL + cell
    # stderr holds progress bars; cells that show an error redirect it.
    done = subprocess.run(["bash", *options, "-c", cell], capture_output=True, text=True, check=False)
    if done.stdout:  # else an empty box on the page
        print("\n".join(_wrapped(row.rstrip()) for row in done.stdout.splitlines()))
    if done.returncode and options:
        raise RuntimeError(f"exit status {done.returncode}: {done.stderr}")


def _wrapped(row: str) -> str:
    """Wrap a sentence as a terminal would, and leave rows of tables as they are."""
    if len(row) <= WIDTH or "  " in row.lstrip():
        return row
    indent = row[: len(row) - len(row.lstrip())]
    return textwrap.fill(row, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def writefile(line: str, cell: str) -> None:
    """Write a cell to a file."""
    Path(line.strip()).write_text(cell, encoding="utf-8")


def load_ipython_extension(shell: Any) -> None:
    """Register the magics."""
    shell.register_magic_function(bash, magic_kind="cell")
    shell.register_magic_function(writefile, magic_kind="cell")
