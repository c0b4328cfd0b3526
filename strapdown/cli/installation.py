"""Versions and processor features."""

from __future__ import annotations

from strapdown.cli.terminal import command, console


@command
def info() -> None:
    """Print the versions and the processor features used by compiled code."""
    import strapdown
    from strapdown.kernels.machine import describe

    console.print(f"strapdown {strapdown.__version__}")
    for name, value in describe().items():
        console.print(f"{name}: {value}")
