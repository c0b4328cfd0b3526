"""Reference of the scenario file as Markdown, of :mod:`strapdown.scenarios.keys`."""

from __future__ import annotations

from dataclasses import replace

from strapdown.scenarios.keys import Section, sections


def markdown(group: str) -> str:
    """Return the sections of one group (``top``, ``motion``, ``gyro``, ``sensors``) as MyST Markdown, keys that all sensors share once."""
    chosen = [one for one in sections() if one.group == group]
    if group == "sensors":
        typed = [one for one in chosen if one.type]
        shared = set.intersection(*({key.name for key in one.keys} for one in typed))
        first = tuple(key for key in typed[0].keys if key.name in shared)
        own = [
            replace(one, keys=tuple(key for key in one.keys if not (one.type and key.name in shared))) for one in chosen
        ]
        chosen = [replace(typed[0], type="", summary="Keys of every type of sensor.", keys=first), *own]
    return "\n\n".join(_section(one) for one in chosen)


def _section(section: Section) -> str:
    type_line = f', `type = "{section.type}"`' if section.type else ""
    summary = f"{section.summary[:1].upper()}{section.summary[1:]}"
    head = summary if section.group == "top" else f"### `{section.header}`{type_line}\n\n{summary}"
    rows = ["| key | unit | value | default | meaning |", "|---|---|---|---|---|"]
    for key in section.keys:
        names = "<br>or ".join(_broken(name) for name in (key.name, *key.others))
        rows.append(f"| {names} | {key.unit} | {key.type} | {key.default} | {key.meaning} |")
    return "\n".join([head, "", *(rows if section.keys else [])])


def _broken(name: str) -> str:
    """Return a key as HTML that may break after its underscores, as 43 letters in a column must."""
    broken = name.replace("_", "_<wbr>") if len(name) > 20 else name
    return f'<code class="key">{broken}</code>'
