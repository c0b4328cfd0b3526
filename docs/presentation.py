"""Sphinx extension of the pages: cells as one would paste them, and text generated from the package.

- A cell of Bash is shown without its magic, a cell that writes a file as the file, with the file's name as caption.
- No line ends between a formula and the punctuation after it, nor between a quantity in the head of a table and its unit.
- ``{generated} module.function argument…`` inserts the Markdown that a function beside this file returns; its headings are the page's own.
"""

from __future__ import annotations

import importlib
import re
from pathlib import PurePath
from typing import Any

from docutils import nodes
from sphinx.util.docutils import SphinxDirective


class Generated(SphinxDirective):
    """The directive ``{generated}``."""

    required_arguments = 1
    optional_arguments = 99

    def run(self) -> list[nodes.Node]:
        """Return the nodes of the text."""
        name, *arguments = self.arguments
        module, _, function = name.rpartition(".")
        text = getattr(importlib.import_module(module), function)(*arguments)
        return self.parse_text_to_nodes(text, allow_section_headings=True)


def show_cells(app: Any, document: nodes.document) -> None:
    """Replace the magics of cells by what a reader needs: nothing, or the name of the file."""
    for block in list(document.findall(nodes.literal_block)):
        magic, _, content = block.astext().partition("\n")
        if magic.startswith("%%bash"):
            _replace(block, content, "bash")
        elif written := re.fullmatch(r"%%writefile (\S+)", magic):
            name = written.group(1)
            caption = nodes.container("", nodes.paragraph("", name), classes=["code-block-caption"])
            box = nodes.container("", caption, classes=["literal-block-wrapper"])
            block.replace_self(box)
            box += block
            _replace(block, content, {".csv": "text"}.get(PurePath(name).suffix, PurePath(name).suffix[1:]))


def keep_together(app: Any, document: nodes.document) -> None:
    """Let no line end between a formula and its punctuation, nor, in the head of a table, before a unit (a short last word)."""
    for formula in list(document.findall(nodes.math)):
        text = formula.next_node(descend=False, siblings=True)
        if isinstance(text, nodes.Text) and (mark := re.match(r"[.,;:)]+", text)):
            formula.replace_self(box := nodes.inline(classes=["nowrap"]))
            box += [formula, nodes.Text(mark.group())]
            text.parent.replace(text, nodes.Text(text[mark.end() :]))
    for head in list(document.findall(nodes.thead)):
        for text in list(head.findall(nodes.Text)):
            text.parent.replace(text, nodes.Text(re.sub(r", (?=\S{1,7}$)", ",\N{NO-BREAK SPACE}", text)))


def _replace(block: nodes.literal_block, content: str, language: str) -> None:
    block.clear()
    block += nodes.Text(content)
    block.rawsource, block["language"] = content, language


def setup(app: Any) -> dict[str, bool]:
    """Register the extension."""
    app.add_directive("generated", Generated)
    app.connect("doctree-read", show_cells)
    app.connect("doctree-read", keep_together)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
