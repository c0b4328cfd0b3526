"""Reference of the command line, generated from the commands themselves.

``markdown()`` returns every command with its arguments, options, defaults and examples, for ``commands.md``.
"""

from __future__ import annotations

import html
import typing
from pathlib import Path
from typing import Any

from typer.main import get_command

from strapdown import cli


def commands() -> dict[str, list[Any]]:
    """Return the commands by group, in the order of ``--help``."""
    cli.register()
    groups: dict[str, list[Any]] = {}
    for command in get_command(cli.app).commands.values():  # type: ignore[attr-defined]
        groups.setdefault(str(command.rich_help_panel), []).append(command)
    return groups


def markdown() -> str:
    """Return the reference as MyST Markdown: a section for each group, a subsection for each command."""
    return "\n\n".join("\n\n".join([f"## {title}", *map(_section, members)]) for title, members in commands().items())


def _section(command: Any) -> str:
    hints = {**dict.fromkeys(parameter.name for parameter in command.params), **command.callback.__annotations__}
    arguments = [parameter for parameter in command.params if parameter.param_type_name == "argument"]
    options = [
        parameter for parameter in command.params if parameter.param_type_name == "option" and not parameter.hidden
    ]
    names = [(argument.metavar or argument.name.upper()) + "..." * (argument.nargs < 0) for argument in arguments]
    places = [name if argument.required else f"[{name}]" for name, argument in zip(names, arguments, strict=True)]
    usage = " ".join(["strapdown", command.name, *places, "[options]"])
    parts = [f"### strapdown {command.name}", _text(command.help), f"```sh\n{usage}\n```"]
    if command.epilog:
        examples = [line.strip() for line in command.epilog.splitlines() if line.strip().startswith("strapdown")]
        parts.append("Examples:\n\n```sh\n" + "\n".join(examples) + "\n```")
    panels: dict[str, list[Any]] = {"argument": arguments}
    for option in options:
        panels.setdefault(getattr(option, "rich_help_panel", None) or "option", []).append(option)
    for title, members in panels.items():
        if members:
            rows = [
                f"| {_name(option, hints[option.name])} | {_default(option)} | {_text(option.help or '')} |"
                for option in members
            ]
            parts.append("\n".join([f"| {title} | default | meaning |", "|---|---|---|", *rows]))
    return "\n\n".join(parts)


def _name(parameter: Any, hint: Any) -> str:
    if parameter.param_type_name == "argument":
        return _key(parameter.metavar or parameter.name.upper())
    names = ", ".join([*parameter.opts, *parameter.secondary_opts])
    return _key(names if parameter.is_flag else f"{names} {parameter.metavar or _value(hint)}")


def _key(text: str) -> str:
    """Return the first cell of a row, which is a row of its own on a phone."""
    return f'<code class="key">{html.escape(text)}</code>'


def _value(hint: Any) -> str:
    """Return the placeholder of a value of an annotated type, of the only type of a union, or of the elements of a list."""
    inner = [kind for kind in typing.get_args(hint) if isinstance(kind, type) and kind is not type(None)]
    if inner and not isinstance(hint, type):
        return _value(inner[0])
    if typing.get_origin(hint) is typing.Literal:
        return "\\|".join(typing.get_args(hint))
    if typing.get_args(hint):
        return _value(typing.get_args(hint)[0])
    return {str: "TEXT", Path: "FILE", float: "NUMBER", int: "N"}.get(hint, "VALUE")


def _default(parameter: Any) -> str:
    if parameter.required:
        return "required"
    default = parameter.default
    if default is None or default is False or default in ((), []) or callable(default):
        return ""
    return "yes" if default is True else f"`{getattr(default, 'value', default)}`"


def _text(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")
