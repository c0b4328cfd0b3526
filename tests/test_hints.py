"""Library text names the arguments of Python; only the command line names options."""

import functools
import re
from pathlib import Path

import pytest
import typer

import strapdown
from strapdown.checks import Hint
from strapdown.cli import register
from strapdown.cli.terminal import app, option

PACKAGE = Path(strapdown.__file__).parent


@functools.cache
def options() -> set[str]:
    register()
    commands = typer.main.get_command(app).commands.values()
    return {name for command in commands for part in command.params for name in (*part.opts, *part.secondary_opts)}


@functools.cache
def library() -> dict[str, str]:
    """The sources outside of the command line by their paths."""
    paths = (path for path in PACKAGE.rglob("*.py") if "cli" not in path.relative_to(PACKAGE).parts)
    return {str(path.relative_to(PACKAGE)): path.read_text(encoding="utf-8") for path in paths}


def test_no_text_of_the_library_names_an_option():
    flags = {(path, flag) for path, text in library().items() for flag in re.findall(r"(?<![\w-])--[a-z][a-z-]*", text)}
    assert {(path, flag) for path, flag in flags if flag in options()} == set()


def test_every_hint_has_an_option():
    arguments = {name for text in library().values() for name in re.findall(r"\bHint\([\"'](\w+)[\"']", text)}
    assert len(arguments) > 15
    shown = {flag for name in arguments for flag in option(Hint(name)).split(" or ")}
    assert shown <= options() | {"--units"}  # one option for each unit


@pytest.mark.parametrize(
    ("hint", "in_python", "on_the_command_line"),
    [
        (Hint("latency"), "`latency=`", "--latency"),
        (Hint("resume", True), "`resume=True`", "--resume"),
        (Hint("states", False), "`states=False`", "--no-states"),
        (Hint("error_frame", "body"), "`error_frame='body'`", "--error-frame body"),
        (Hint("axes", {"gyro": "y,x,-z"}), "`axes={'gyro': 'y,x,-z'}`", "--axes gyro=y,x,-z"),
        (Hint("units", {"time": "ms"}), "`units={'time': 'ms'}`", "--time-unit ms"),
        (Hint("columns", {"gx": "X [dps]"}), "`columns={'gx': 'X [dps]'}`", "--columns 'gx=X [dps]'"),  # for a shell
        (Hint("initial"), "`initial=`", "--attitude or --from-truth"),
    ],
)
def test_a_hint_in_both_faces(hint, in_python, on_the_command_line):
    assert str(hint) == in_python
    assert Hint.replaced(f"try {hint}, or not", option) == f"try {on_the_command_line}, or not"


@pytest.mark.parametrize("text", ["`x=1+`", "`strapdown tune`", "a=`b`", "`y=__import__('os')`"])
def test_other_text_between_backticks_stays(text):
    assert Hint.replaced(text, option) == text
