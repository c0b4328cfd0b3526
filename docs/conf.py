"""Configuration of the documentation: ``pip install '.[docs]' && sphinx-build -W -b html docs docs/_build``.

Every page is executed when it is built, in an empty folder, and nothing is fetched from the network, neither by the build nor by the pages.
"""

import functools
import html
import importlib
import inspect
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any, ClassVar

import jupyter_client
import traitlets
from docutils import nodes
from docutils.utils.math import MathError, latex2mathml
from jinja2 import Template
from jinja2.sandbox import SandboxedEnvironment
from nbclient import NotebookClient
from numpydoc import docscrape_sphinx
from sphinx.errors import ExtensionError

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS.parent), str(DOCS)]

import command_server  # noqa: E402
import formula_font  # noqa: E402
from coning_page import bundle  # noqa: E402

import strapdown  # noqa: E402

project = "strapdown"
author = "The strapdown founders"
copyright = "The strapdown founders, MIT licence"
version = release = strapdown.__version__

shutil.rmtree(DOCS / "api/generated", ignore_errors=True)  # pages of modules that are no more would be read too

extensions = [
    "presentation",
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build", "jupyter_execute", "_data", "_templates", "**.ipynb_checkpoints"]
templates_path = ["_templates"]

# What a page's kernel needs: the program and the package of this build, one thread, tables of one width, and the way back to the docs.
_programs = tempfile.TemporaryDirectory()
os.environ["PATH"] = os.pathsep.join([_programs.name, str(Path(sys.executable).parent), os.environ["PATH"]])
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(DOCS.parent), os.environ.get("PYTHONPATH", "")]))
os.environ.update(
    JUPYTER_PATH=_programs.name,
    STRAPDOWN_DOCS=str(DOCS),
    COLUMNS="96",
    NO_COLOR="1",
    TERM="dumb",
    TTY_COMPATIBLE="0",
    OMP_NUM_THREADS="1",
    OPENBLAS_NUM_THREADS="1",
)
os.environ.pop("MPLBACKEND", None)  # pages draw inline
command_server.start(Path(_programs.name))
_profile = tempfile.TemporaryDirectory()
os.environ["IPYTHONDIR"] = _profile.name
(Path(_profile.name) / "profile_default").mkdir()
(Path(_profile.name) / "profile_default/ipython_kernel_config.py").write_text(
    "c.IPKernelApp.log_level = 40\n"
    f"import sys; sys.path.insert(0, {str(DOCS)!r})\n"
    "c.InteractiveShellApp.extensions = ['shell_cells']\n"
    "c.InlineBackend.figure_formats = {'svg'}\n"
    "c.InlineBackend.rc = {'figure.figsize': (6.4, 3.6), 'font.size': 9.0, 'svg.fonttype': 'path'}\n"
)


class _KernelManager(jupyter_client.AsyncKernelManager):
    """Kernels of pages listen on files: a TCP port that was free may be taken by another connection before the kernel listens on it."""

    transport = traitlets.Unicode("ipc")
    ip = traitlets.Unicode()

    @traitlets.default("ip")
    def _files(self) -> str:
        return os.path.join(tempfile.mkdtemp(dir=_profile.name), "kernel")


NotebookClient._kernel_manager_class_default = lambda _: _KernelManager

nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 900  # a cell may compile a filter
nb_merge_streams = True
nb_render_markdown_format = "myst"
nb_output_stderr = "remove"  # progress bars; an error still stops the build
myst_enable_extensions = ["amsmath", "dollarmath", "deflist", "attrs_inline", "colon_fence"]
myst_heading_anchors = 3
smartquotes_action = "qe"  # quotes and ellipses: two hyphens begin an option


class _OneTemplate(SandboxedEnvironment):
    """numpydoc's templates, of which it would compile its one for each of 850 docstrings: a seventh of Sphinx's time."""

    _read: ClassVar[dict[str, Template]] = {}

    def get_template(self, name: Any, *arguments: Any, **options: Any) -> Template:
        """Return a template, compiled once."""
        if name not in self._read:
            self._read[name] = super().get_template(name, *arguments, **options)
        return self._read[name]


docscrape_sphinx.SandboxedEnvironment = _OneTemplate

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # numpydoc's parameters say it
nitpicky = True
autodoc_default_options = {"members": True}
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

html_theme = "furo"
html_title = f"strapdown {version}"
_scripts = tempfile.TemporaryDirectory()
bundle.write(Path(_scripts.name))
html_static_path = ["_static", _scripts.name]
html_css_files = ["strapdown.css"]
html_js_files = ["copy.js"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}


def _mathml(self: Any, node: nodes.Element, *, block: bool) -> None:
    """Write a formula as MathML, which browsers draw by themselves: no script and nothing to fetch."""
    try:
        markup = latex2mathml.tex2mathml(node.astext(), as_block=block)
    except MathError as error:
        raise ExtensionError(f"{node.source}:{node.line}: {error} in {node.astext()}") from error
    markup = _spaced(
        re.sub(r">ˉ</mo>", ">¯</mo>", re.sub(r'(<mo stretchy="false">)~', r"\1˜", markup))
    )  # accents that fonts have
    if missing := formula_font.missing(html.unescape(re.sub(r"<[^>]*>", "", markup))):
        raise ExtensionError(
            f"{node.source}:{node.line}: the font of formulas lacks {missing}; add them in formula_font.py"
        )
    if block:
        number = f'<span class="formula-number">({node["number"]})</span>' if node.get("number") else ""
        markup = f'<div class="math">{markup}{number}</div>\n'
    self.body.append(markup)
    raise nodes.SkipNode


_FUNCTION = r"<mi>[a-zA-Z]+</mi>\s*<mo>&ApplyFunction;</mo>"
_THIN = '<mspace width="0.17em"></mspace>'


def _spaced(markup: str) -> str:
    """Return MathML with TeX's spaces: thin ones about the name of a function, none about a slash or a bar."""
    markup = re.sub(rf"(</(?:mi|mn|mfrac|mrow|msup|msub)>)(\s*{_FUNCTION})", rf"\1{_THIN}\2", markup)
    markup = re.sub(rf"({_FUNCTION})(?!\s*(?:<mrow>\s*)?<mo[^>]*>[(\[])", rf"\1{_THIN}", markup)
    return re.sub(r"<mo[^>]*>([/|])</mo>", r'<mo lspace="0" rspace="0">\1</mo>', markup)


def _plain_marks(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Let docstrings be read as they are meant: |q| is an absolute value and no substitution, a literal may touch a sign, as in ``x``²."""
    role = re.compile(r":(?:func|class|meth|mod|data|attr|exc):`~?([\w.]+)`")
    for k, line in enumerate(lines):
        parts = re.split(r"(``.+?``)", role.sub(functools.partial(_linked, name), line))
        for i in range(0, len(parts), 2):  # the texts between literals
            parts[i] = parts[i].replace("|", r"\|")
            if i and re.match(r"[^\s.,;:!?'\")\]}>/-]", parts[i]):
                parts[i] = r"\ " + parts[i]
            if i + 1 < len(parts) and re.search(r"[^\s'\"(\[{</:-]$", parts[i]):
                parts[i] += r"\ "
        lines[k] = "".join(parts)


@functools.cache
def _documented() -> frozenset[str]:
    """Return the names that have an entry in the reference: modules, what their ``__all__`` lists, and members of classes."""
    names = {"strapdown.estimation.StepFilter", "strapdown.checks.InputError"}
    listed = re.findall(r"^   ([\w.]+)$", (DOCS / "api/index.md").read_text(encoding="utf-8"), re.MULTILINE)
    for module in (importlib.import_module(f"strapdown.{name}") for name in listed):
        names.add(module.__name__)
        for name in module.__all__:
            value = getattr(module, name)
            if inspect.isfunction(value) or inspect.isclass(value):
                names.add(f"{module.__name__}.{name}")
                names |= {f"{module.__name__}.{name}.{member}" for member in dir(value) if member[0] != "_"}
    return frozenset(names)


def _linked(place: str, role: re.Match[str]) -> str:
    """Return a role whose target has an entry in the reference, else its target as a literal."""
    target = role.group(1)
    parts = place.split(".")
    scopes = ["", "strapdown.", *(".".join(parts[:k]) + "." for k in range(1, len(parts) + 1))]
    linked = next((scope + target for scope in reversed(scopes) if scope + target in _documented()), "")
    return f":py:obj:`{target} <{linked}>`" if linked else f"``{target}``"


def _no_tree_beside_sources(app: Any, page: str, template: str, context: dict[str, Any], doctree: Any) -> None:
    """Leave the tree of all pages out beside listings of source: for these three pages in five it took a fifth of Sphinx's time."""
    if page.startswith("_modules/"):
        context.pop("toctree", None)


def setup(app: Any) -> None:
    """Register the writer of formulas, and what goes on when pages are read and written."""
    app.connect("autodoc-process-docstring", _plain_marks)
    app.connect("html-page-context", _no_tree_beside_sources, priority=400)  # before the theme's
    app.add_html_math_renderer(
        "mathml",
        (lambda self, node: _mathml(self, node, block=False), None),
        (lambda self, node: _mathml(self, node, block=True), None),
    )


html_math_renderer = "mathml"
