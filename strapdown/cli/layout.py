"""The layout of ``--help``: commands in groups, in the order of the work, each with examples."""

from __future__ import annotations

import typer

COMMANDS: dict[str, dict[str, tuple[str, ...]]] = {
    "Simulate, estimate, judge": {
        "scenarios": (),
        "simulate": ("strapdown simulate two-stars", "strapdown simulate satellite.toml --seed 2 --out flight.h5"),
        "estimate": (
            "strapdown estimate two-stars.h5",
            "strapdown estimate walk.csv --gyro-unit deg/s --accelerometer-unit g --to angles.csv",
        ),
        "check": (
            "strapdown check estimate-results/estimate.h5",
            "strapdown check other.csv --truth flight.h5",
        ),
        "report": ("strapdown report estimate-results/estimate.h5",),
        "montecarlo": (
            "strapdown montecarlo satellite.toml --runs 400",
            "strapdown montecarlo satellite.toml --filter mine.py:run",
        ),
        "covariance": ("strapdown covariance satellite.toml --scale-factor 300",),
    },
    "Noise and tuning": {
        "allan": ("strapdown allan rest.csv --gyro-unit deg/s",),
        "tune": ("strapdown tune one.h5 two.h5 --filter guess.toml --holdout 0.4",),
    },
    "Recordings": {
        "doctor": ("strapdown doctor walk.csv --gyro-unit deg/s --accelerometer-unit g",),
        "convert": ("strapdown convert walk.bag walk.csv",),
    },
    "Integration of the gyro alone": {
        "coning": ("strapdown coning", "strapdown coning --algorithm mine.toml --runs 20"),
        "integrate": ("strapdown integrate flight.h5 --algorithm three-sample",),
        "algorithms": (),
        "coning-budget": ("strapdown coning-budget --psd psd.csv --rate 200",),
    },
    "This installation": {"info": ()},
}
"""Commands by group, each with its examples."""


def lay_out(app: typer.Typer) -> None:
    """Put the commands of an application in order and in groups, each with its examples."""
    places = {name: title for title, names in COMMANDS.items() for name in names}
    order = list(places)
    name_of = lambda one: one.name or one.callback.__name__.replace("_", "-")  # noqa: E731
    app.registered_commands.sort(key=lambda one: order.index(name_of(one)))
    for one in app.registered_commands:
        one.rich_help_panel = places[name_of(one)]
        examples = COMMANDS[places[name_of(one)]][name_of(one)]
        one.epilog = "\n\n".join(("Examples:", *(f"  {line}" for line in examples))) if examples else None
