"""Library text names the arguments of Python; only the command line names options."""

import ast
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
def outside_of_the_command_line():
    """Texts, and calls of functions by their names: (file, node)."""
    return [
        (path.relative_to(PACKAGE), node)
        for path in sorted(PACKAGE.rglob("*.py"))
        if "cli" not in path.relative_to(PACKAGE).parts
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant | ast.Call)
    ]


def test_no_text_of_the_library_names_an_option():
    known = options()
    named = [
        f"{path}:{node.lineno}: {flag}"
        for path, node in outside_of_the_command_line()
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        for flag in re.findall(r"(?<![\w-])--[a-z][a-z-]*", node.value)
        if flag in known
    ]
    assert not named


def test_every_hint_has_an_option():
    calls = [
        node
        for _, node in outside_of_the_command_line()
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Hint"
    ]
    shown = [option(Hint(node.args[0].value)) for node in calls if isinstance(node.args[0], ast.Constant)]
    known = options() | {"--units"}  # one option for each unit
    assert len(shown) > 20
    assert {flag for text in shown for flag in text.split(" or ")} <= known


@pytest.mark.parametrize(
    ("hint", "in_python", "on_the_command_line"),
    [
        (Hint("latency"), "`latency=`", "--latency"),
        (Hint("resume", True), "`resume=True`", "--resume"),
        (Hint("states", False), "`states=False`", "--no-states"),
        (Hint("error_frame", "body"), "`error_frame='body'`", "--error-frame body"),
        (Hint("axes", {"gyro": "y,x,-z"}), "`axes={'gyro': 'y,x,-z'}`", "--axes gyro=y,x,-z"),
        (Hint("units", {"time": "ms"}), "`units={'time': 'ms'}`", "--time-unit ms"),
        (Hint("initial"), "`initial=`", "--attitude or --from-truth"),
    ],
)
def test_a_hint_in_both_faces(hint, in_python, on_the_command_line):
    assert str(hint) == in_python
    assert Hint.replaced(f"try {hint}, or not", option) == f"try {on_the_command_line}, or not"


@pytest.mark.parametrize("text", ["`x=1+`", "`strapdown tune`", "a=`b`", "`y=__import__('os')`"])
def test_other_text_between_backticks_stays(text):
    assert Hint.replaced(text, option) == text
