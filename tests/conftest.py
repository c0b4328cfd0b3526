"""Options and fixtures that several test files use."""

import base64
import functools
import gc
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
"""Read when NumPy is imported: each worker has one core, for which threads of BLAS would compete, at ten times the CPU time."""

import hypothesis
import numpy as np
import pytest
import typer.main

from strapdown import cli

hypothesis.settings.register_profile("fixed", derandomize=True)
hypothesis.settings.load_profile("fixed")  # the same examples in every run

gc.set_threshold(50_000, 20, 20)
"""Compiled kernels and figures have many long-lived objects: with Python's default of 700, 10, 10 the collector takes 7 % of the time."""
gc.disable()  # until collection of the tests ends: objects of modules are permanent

cli.register()
typer.main.get_command = functools.cache(typer.main.get_command)
"""Each call of the program rebuilds the parsers of all commands, 16 ms; testing this once is enough."""

BROAD = Path(__file__).resolve().parents[1] / ".." / "shared" / "data" / "broad"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--slow", action="store_true", help="run statistical studies and further variants too")
    parser.addoption("--attack-files", type=int, help="number of damaged files that tests/attack makes")
    parser.addoption("--attack-seed", type=int, default=1, help="seed of the damage")
    parser.addoption("--soak", type=int, help="steps of the filter that tests/attack/test_soak.py takes")
    parser.addoption("--attack-log", help="file for the results of the damaged files")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    # Workers process file after file. Neighbouring files share kernels: in this order two workers seldom compile the same ones at once,
    # and the second finds them in the cache.
    files = list(dict.fromkeys(item.path for item in items))
    place = {path: (k % 10, k) for k, path in enumerate(files)}
    items.sort(key=lambda item: place[item.path])
    if not config.getoption("--slow"):
        # By the marker, because keywords include the names of folders.
        slow = [item for item in items if item.get_closest_marker("slow")]
        config.hook.pytest_deselected(items=slow)
        items[:] = [item for item in items if not item.get_closest_marker("slow")]


def pytest_collection_finish() -> None:
    gc.freeze()  # objects of modules are permanent
    gc.enable()


@pytest.fixture(scope="module", autouse=True)
def what_is_compiled_is_not_collected() -> Iterator[None]:
    """Exclude the objects compiled by a module from garbage collection, which otherwise takes seconds after many compilations."""
    yield
    gc.collect(1)
    gc.freeze()


def pytest_sessionfinish() -> None:
    gc.freeze()  # at its end pytest runs five collections: ten seconds after many compilations


PIXEL = base64.b64decode("iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR42mP4DwABAQEAHLCMmQAAAABJRU5ErkJggg==")
"""A PNG."""


@pytest.fixture(scope="session")
def blank() -> Callable[..., None]:
    """Return a replacement of ``Figure.savefig`` for tests that do not depend on the pixels: drawing a figure takes half a second."""
    from matplotlib.figure import Figure

    draw = Figure.savefig

    def savefig(figure: Figure, target: Any, **options: Any) -> None:
        if hasattr(target, "write"):
            target.write(PIXEL)
        elif Path(target).suffix == ".png":
            Path(target).write_bytes(PIXEL)
        else:
            draw(figure, target, **options)

    return savefig


@pytest.fixture(autouse=True)
def figures_are_blank(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, blank: Callable[..., None]
) -> None:
    """Save blank figures in tests without the mark ``draws``; figures saved by fixtures of a module are drawn."""
    if not request.node.get_closest_marker("draws"):
        monkeypatch.setattr("matplotlib.figure.Figure.savefig", blank)


@pytest.fixture(scope="session")
def broad() -> Path:
    """Folder of the BROAD trials."""
    if not any(BROAD.glob("*.hdf5")):
        pytest.skip(f"no BROAD trials in {BROAD}; see doi 10.3390/data6070072 for them")
    return BROAD.resolve()


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., tuple[int, str, str]]:
    """Run ``strapdown ARGUMENTS`` in an empty folder; return exit status, standard output and standard error."""
    from strapdown.cli import terminal

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        terminal, "_quiet", True
    )  # standard error then contains only errors, even if kernels are compiled first

    def command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["strapdown", *map(str, arguments)])
        status = 0
        try:
            cli.main()
        except SystemExit as end:
            status = int(end.code or 0)
        said = capsys.readouterr()
        return status, said.out, said.err

    return command


@pytest.fixture
def succeeds(run: Callable[..., tuple[int, str, str]]) -> Callable[..., str]:
    """Run ``strapdown ARGUMENTS``, which must end well and without an error; return what it said."""

    def command(*arguments: object) -> str:
        status, said, error = run(*arguments)
        assert (status, error) == (0, ""), error
        return said

    return command


@pytest.fixture
def refusal(run: Callable[..., tuple[int, str, str]]) -> Callable[..., str]:
    """Run ``strapdown ARGUMENTS``, which must be refused; return the error."""

    def command(*arguments: object) -> str:
        status, _, error = run(*arguments)
        assert status == 2, error
        return error

    return command


@pytest.fixture(scope="session")
def rotation_vectors() -> Callable[..., np.ndarray]:
    """Return a function that draws rotation vectors (n, 3) with random direction and log-uniform angle between two bounds."""

    def draw(n: int, smallest: float = 1e-12, largest: float = np.pi, seed: int = 7) -> np.ndarray:
        random = np.random.default_rng(seed)
        direction = random.standard_normal((n, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return direction * np.exp(random.uniform(np.log(smallest), np.log(largest), (n, 1)))

    return draw
