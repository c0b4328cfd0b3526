"""Reference of the scenario file as Markdown, of :mod:`strapdown.scenarios.keys`."""

from __future__ import annotations

from dataclasses import replace

from strapdown.scenarios.keys import Section, sections


def markdown(group: str) -> str:
    """Return the sections of one group (``top``, ``motion``, ``gyro``, ``sensors``) as MyST Markdown, keys that all sensors share once."""
    of_group = [section for section in sections() if section.group == group]
    if group == "sensors":
        typed = [section for section in of_group if section.type]
        shared = set.intersection(*({key.name for key in section.keys} for section in typed))
        first = tuple(key for key in typed[0].keys if key.name in shared)
        own = [
            replace(section, keys=tuple(key for key in section.keys if not (section.type and key.name in shared)))
            for section in of_group
        ]
        of_group = [replace(typed[0], type="", summary="Keys of every type of sensor.", keys=first), *own]
    return "\n\n".join(_section(section) for section in of_group)


def _section(section: Section) -> str:
    type_line = f', `type = "{section.type}"`' if section.type else ""
    summary = f"{section.summary[:1].upper()}{section.summary[1:]}"
    head = summary if section.group == "top" else f"### `{section.header}`{type_line}\n\n{summary}"
    rows = ["| key | unit | value | default | meaning |", "|---|---|---|---|---|"]
    for key in section.keys:
        names = "<br>or ".join(_broken(name) for name in (key.name, *key.others))
        meaning = key.meaning.replace("|", "\\|")
        rows.append(f"| {names} | {key.unit} | {key.type} | {key.default} | {meaning} |")
    return "\n".join([head, "", *(rows if section.keys else [])])


def _broken(name: str) -> str:
    """Return a key as HTML that may break after its underscores, as 43 letters in a column must."""
    broken = name.replace("_", "_<wbr>") if len(name) > 20 else name
    return f'<code class="key">{broken}</code>'
