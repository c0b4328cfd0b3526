"""The layout of ``--help``: commands in groups, in the order of use, each with examples."""

from __future__ import annotations

import importlib

from strapdown.cli.terminal import app

COMMANDS: dict[str, dict[str, tuple[str, ...]]] = {
    "Simulate, estimate, judge": {
        "scenarios": ("sensors",),
        "keys": ("sensors", "sensors", "coning"),
        "simulate": ("sensors", "two-stars", "satellite.toml --seed 2 --out flight.h5"),
        "estimate": (
            "estimation",
            "two-stars.h5",
            "walk.csv --gyro-unit deg/s --accelerometer-unit g --to angles.csv",
        ),
        "check": ("judgement", "estimate-results/estimate.h5", "other.csv --truth flight.h5"),
        "report": ("judgement", "estimate-results/estimate.h5"),
        "montecarlo": ("campaigns", "satellite.toml --runs 400", "satellite.toml --filter mine.py:run"),
        "covariance": ("studies", "satellite.toml --consider scale_factor=300"),
    },
    "Noise and tuning": {
        "allan": ("allan", "rest.csv --gyro-unit deg/s"),
        "tune": ("tuning", "one.h5 two.h5 --filter guess.toml --holdout 0.4"),
    },
    "Recordings": {
        "doctor": ("recordings", "walk.csv --gyro-unit deg/s --accelerometer-unit g"),
        "calibrate": (
            "recordings",
            "turned.csv --gyro-unit deg/s --accelerometer-unit g",
            "slow.h5 fast.h5 --out calibration.toml",
        ),
        "convert": ("recordings", "walk.bag walk.csv"),
    },
    "Integration of the gyro": {
        "coning": ("studies", "", "--algorithm mine.toml --runs 20"),
        "integrate": ("studies", "flight.h5 --algorithm three-sample"),
        "algorithms": ("studies",),
        "coning-budget": ("studies", "--psd psd.csv --rate 200"),
    },
    "On a microcontroller": {"export": ("exporting", "filter.toml satellite.toml --precision single --out firmware")},
    "This installation": {"info": ("exporting",)},
}
"""Commands by group: the module that registers each, and arguments of examples."""


def register(command: str | None = None) -> None:
    """Register one command and import only its module; register all if there is none of that name, for ``--help`` and errors."""
    places = {name: (title, *place) for title, group in COMMANDS.items() for name, place in group.items()}
    for module in dict.fromkeys(place[1] for name, place in places.items() if name == command or command not in places):
        importlib.import_module(f"strapdown.cli.{module}")
    name_of = lambda one: one.callback.__name__.replace("_", "-")  # noqa: E731
    app.registered_commands.sort(key=lambda one: list(places).index(name_of(one)))
    for one in app.registered_commands:
        name = name_of(one)
        one.rich_help_panel, _, *examples = places[name]
        lines = (f"  strapdown {name} {arguments}".rstrip() for arguments in examples)
        one.epilog = "\n\n".join(("Examples:", *lines)) if examples else None
