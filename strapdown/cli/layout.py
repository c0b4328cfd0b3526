"""The layout of ``--help``: commands in groups, in the order of use, each with examples."""

from __future__ import annotations

import importlib

from strapdown.cli.terminal import app

COMMANDS: dict[str, dict[str, tuple[str, ...]]] = {
    "Simulate, estimate, judge": {
        "scenarios": ("sensors",),
        "keys": ("sensors", "strapdown keys sensors", "strapdown keys coning"),
        "simulate": (
            "sensors",
            "strapdown simulate two-stars",
            "strapdown simulate satellite.toml --seed 2 --out flight.h5",
        ),
        "estimate": (
            "estimation",
            "strapdown estimate two-stars.h5",
            "strapdown estimate walk.csv --gyro-unit deg/s --accelerometer-unit g --to angles.csv",
        ),
        "check": (
            "judgement",
            "strapdown check estimate-results/estimate.h5",
            "strapdown check other.csv --truth flight.h5",
        ),
        "report": ("reporting", "strapdown report estimate-results/estimate.h5"),
        "montecarlo": (
            "campaigns",
            "strapdown montecarlo satellite.toml --runs 400",
            "strapdown montecarlo satellite.toml --filter mine.py:run",
        ),
        "covariance": ("studies", "strapdown covariance satellite.toml --consider scale_factor=300"),
    },
    "Noise and tuning": {
        "allan": ("allan", "strapdown allan rest.csv --gyro-unit deg/s"),
        "tune": ("tuning", "strapdown tune one.h5 two.h5 --filter guess.toml --holdout 0.4"),
    },
    "Recordings": {
        "doctor": ("judgement", "strapdown doctor walk.csv --gyro-unit deg/s --accelerometer-unit g"),
        "calibrate": (
            "calibrating",
            "strapdown calibrate turned.csv --gyro-unit deg/s --accelerometer-unit g",
            "strapdown calibrate slow.h5 fast.h5 --out calibration.toml",
        ),
        "convert": ("conversion", "strapdown convert walk.bag walk.csv"),
    },
    "Integration of the gyro": {
        "coning": ("studies", "strapdown coning", "strapdown coning --algorithm mine.toml --runs 20"),
        "integrate": ("integration", "strapdown integrate flight.h5 --algorithm three-sample"),
        "algorithms": ("integration",),
        "coning-budget": ("integration", "strapdown coning-budget --psd psd.csv --rate 200"),
    },
    "On a microcontroller": {
        "export": ("exporting", "strapdown export filter.toml satellite.toml --precision single --out firmware"),
    },
    "This installation": {"info": ("exporting",)},
}
"""Commands by group: the module that registers each, and examples."""


def register(command: str | None = None) -> None:
    """Register one command and import only its module; register all if there is none of that name, for ``--help`` and errors."""
    places = {name: (title, *place) for title, group in COMMANDS.items() for name, place in group.items()}
    for module in dict.fromkeys(place[1] for name, place in places.items() if name == command or command not in places):
        importlib.import_module(f"strapdown.cli.{module}")
    name_of = lambda one: one.name or one.callback.__name__.replace("_", "-")  # noqa: E731
    app.registered_commands.sort(key=lambda one: list(places).index(name_of(one)))
    for one in app.registered_commands:
        one.rich_help_panel, _, *examples = places[name_of(one)]
        one.epilog = "\n\n".join(("Examples:", *(f"  {line}" for line in examples))) if examples else None
