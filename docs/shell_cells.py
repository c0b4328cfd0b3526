"""IPython extension of the documentation's pages: ``%%bash`` cells whose output comes in one piece, and that fail with their commands.

The cells look and act as in any notebook; ``%%bash --no-raise-error`` goes on whatever the exit status.
"""

from __future__ import annotations

import subprocess
from typing import Any


def bash(line: str, cell: str) -> None:
    """Run a cell in Bash until a command fails; print what it wrote."""
    options = [] if "--no-raise-error" in line else ["-e", "-o", "pipefail"]
    # stderr holds progress bars; cells that show an error redirect it.
    done = subprocess.run(["bash", *options, "-c", cell], capture_output=True, text=True, check=False)
    print("\n".join(row.rstrip() for row in done.stdout.splitlines()))
    if done.returncode and options:
        raise RuntimeError(f"exit status {done.returncode}: {done.stderr}")


def load_ipython_extension(shell: Any) -> None:
    """Register the magic."""
    shell.register_magic_function(bash, magic_kind="cell")
