"""The layout of ``--help``: commands in the order of the work with an example each, and options in the same groups in every command."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperCommand

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

OPTIONS = {
    "Reading the file": "gyro_unit accelerometer_unit magnetometer_unit time_unit columns topic truth_topic sensor",
    "Axes, signs and frames": "axes invert align error_frame",
    "Model and filter": "filter_file gyro states state gate robust motion latency calibration temperature integration algorithm",
    "Start": "attitude from_truth attitude_sigma bias_sigma",
    "Computing": "runs seed run threads machine float32 chunk workers cluster resume overwrite replay starts smooth every observability",
    "Output": "out to euler frame full_covariance figures form tables json kalibr px4 matlab show",
}
"""Options of all commands by group; what is in none stands first, under "Options"."""


class Command(TyperCommand):
    """A command whose options are shown in groups."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        group = {name: title for title, names in OPTIONS.items() for name in names.split()}
        order = list(OPTIONS)
        for one in self.params:
            if getattr(one, "name", None) in group and one.param_type_name == "option":
                one.rich_help_panel = group[one.name]  # type: ignore[attr-defined, index]
        self.params.sort(key=lambda one: order.index(group[one.name]) if one.name in group else -1)


def lay_out(app: typer.Typer) -> None:
    """Put the commands of an application in order and in groups, each with its examples."""
    places = {name: title for title, names in COMMANDS.items() for name in names}
    order = list(places)
    name_of = lambda one: one.name or one.callback.__name__  # noqa: E731
    app.registered_commands.sort(key=lambda one: order.index(name_of(one)))
    for one in app.registered_commands:
        one.cls = Command
        one.rich_help_panel = places[name_of(one)]
        examples = COMMANDS[places[name_of(one)]][name_of(one)]
        one.epilog = "\n\n".join(("Examples:", *(f"  {line}" for line in examples))) if examples else None
