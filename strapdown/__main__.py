"""The program: ``strapdown``, or ``python -m strapdown``."""

from __future__ import annotations

import gc
import sys

COLLECTED = (50_000, 20, 20)
"""Thresholds of garbage collection: at Python's own, 700 new objects, the imports of a command are searched again and again for garbage."""


def main() -> None:
    """Run the command line; Ctrl-C while it is still being loaded ends like any other."""
    gc.set_threshold(*COLLECTED)
    try:
        from strapdown import cli

        cli.main()
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        sys.exit(130)
    finally:
        gc.freeze()  # the interpreter would search all modules for garbage once more before it ends, 0.15 s


if __name__ == "__main__":
    main()
