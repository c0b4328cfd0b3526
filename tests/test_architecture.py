"""The house: imports run downwards, faces stay on the top floor, and what is heavy loads when it is first needed."""

import ast
import graphlib
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import strapdown

PACKAGE = Path(strapdown.__file__).parent

TABLE = (
    (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8").partition("| layer |")[2].partition("\n\n")[0]
)
FLOORS = tuple(tuple(re.findall(r"`(\w+)`", row)) for row in reversed(TABLE.splitlines()[2:]))
"""Modules and sub-packages of ``strapdown`` by floor, from the ground up, as in the README: imports go down or stay on their floor."""

STRANGERS = (("motion", "coning"),)
"""Pairs that never import each other: the closed-form truth and the integrator, so that neither can hide the other's fault."""

DRAWING = ("plots", "report")
PRINTING = ("cli", "__main__")
MACHINES = (
    "kernels.machine",
    "kernels.addresses",
    "kernels.cache",
    "kernels.lanes",
    "kernels.packed",
    "kernels.compiler",
    "kernels.tracing",
)
"""Kernel modules that know of compilers; all others are plain Python."""


def floor(unit: str) -> int:
    for k, units in enumerate(FLOORS):
        if unit in units:
            return k
    pytest.fail(f"strapdown/{unit} is in no layer; add it to the README's table")


@cache
def sources() -> dict[str, ast.Module]:
    """Parsed source of every module by its name without ``strapdown.``; the package itself is ``""``."""
    parsed = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        parsed[".".join(part for part in parts if part != "__init__")] = ast.parse(
            path.read_text(encoding="utf-8"), str(path)
        )
    return parsed


def only_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


@cache
def imports(tree: ast.Module) -> tuple[str, ...]:
    """Full names that a module imports, inside functions too, without those for type checking alone."""
    return tuple(imported(tree))


def imported(tree: ast.AST) -> Iterator[str]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: import by the full name, not relatively"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.stmt | ast.ExceptHandler | ast.match_case) and not only_for_types(node):
            yield from imported(node)


def internal(name: str) -> str | None:
    """The module of the package that an imported name belongs to, dotted and without ``strapdown.``; None: from outside."""
    first, _, rest = name.partition(".")
    if first != "strapdown":
        return None
    while rest not in sources():
        rest = rest.rpartition(".")[0]
    return rest


def unit(module: str) -> str:
    return module.partition(".")[0]


def test_every_module_stands_on_one_floor():
    listed = [name for units in FLOORS for name in units]
    assert len(set(listed)) == len(listed)
    for module in filter(None, sources()):
        floor(unit(module))


def test_imports_run_downwards():
    for module, tree in sources().items():
        for name in imports(tree):
            other = internal(name)
            if other is None or not other or unit(other) == unit(module):
                continue
            assert module, f"strapdown/__init__.py imports {other}; the front door loads nothing"
            assert floor(unit(other)) <= floor(unit(module)), f"{module} imports {other}, on a higher floor"


@pytest.mark.parametrize("node", [unit, str], ids=["packages", "modules"])
def test_no_circle_of_imports(node):
    graph: dict[str, set[str]] = {}
    for module, tree in sources().items():
        others = {node(other) for name in imports(tree) if (other := internal(name))}
        graph.setdefault(node(module), set()).update(others - {node(module)})
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError and names the circle


@pytest.mark.parametrize(("stranger", "other"), STRANGERS)
def test_strangers_never_meet(stranger, other):
    for module, tree in sources().items():
        units = {unit(target) for name in imports(tree) if (target := internal(name))}
        if unit(module) in (stranger, other):
            assert not units & ({stranger, other} - {unit(module)}), f"{module} imports its stranger"


PARSERS = ("np.load", "np.loadtxt", "np.genfromtxt", "np.fromfile", "tomllib.load", "tomllib.loads")
PARSERS += ("json.load", "json.loads", "pickle.load")
READERS = ("open", "io.open", "os.open", "h5py.File", *PARSERS)
OF_A_PATH = (".read_text", ".read_bytes", ".open")
NOT_OF_THE_USER = ("kernels.machine", "kernels.cache", "montecarlo.engine", "report.page")
"""They read files of the package itself."""


@cache
def nodes() -> list[tuple[str, ast.Call | ast.Attribute]]:
    """Every call and attribute of the package, with its module."""
    every = ((module, node) for module, tree in sources().items() for node in ast.walk(tree))
    return [(module, node) for module, node in every if isinstance(node, ast.Call | ast.Attribute)]


@cache
def calls() -> list[tuple[str, ast.Call, str]]:
    """Every call of the package: its module, itself and the words of what is called."""
    return [(module, node, ast.unparse(node.func)) for module, node in nodes() if isinstance(node, ast.Call)]


def test_every_file_passes_the_reading_layer():
    """Nobody else opens a file to read it, or parses one: limits, names of files and digests are in one place."""
    for module, node, call in calls():
        if module in ("files.reading", *NOT_OF_THE_USER):
            continue
        if call in READERS or call.endswith(OF_A_PATH):
            words = ast.unparse(node)
            writes = any(mode in words for mode in ("'w'", "'wb'", "'r+b'", "os.O_CREAT")) or "reading.opened" in words
            own = module == "montecarlo.campaign" and "temporary.open('rb')" in words  # to have it on the disk
            assert writes or own, f"{module} line {node.lineno}: {words}"


def top_names(tree: ast.AST) -> set[str]:
    return {name.partition(".")[0] for name in imports(tree)}


def test_only_the_drawing_modules_import_matplotlib():
    for module, tree in sources().items():
        if unit(module) not in DRAWING:
            assert not top_names(tree) & {"matplotlib", "mpl_toolkits"}, module


def test_only_the_command_line_prints():
    for module, tree in sources().items():
        if unit(module) not in PRINTING:
            assert not top_names(tree) & {"rich", "typer", "click", "logging"}, module
    for module, node, call in calls():
        if unit(module) not in PRINTING:
            assert call != "print", f"{module} line {node.lineno} prints"
            assert not call.startswith(("sys.stdout", "sys.stderr")), f"{module} line {node.lineno} prints"


def test_kernels_are_plain_python():
    """They import one another, by name, and nothing but ``math`` and NumPy's number types; the machine knows numba, when asked."""
    for module, tree in sources().items():
        if unit(module) != "kernels":
            continue
        for name in imports(tree):
            other = internal(name)
            assert other is None or unit(other) == "kernels", f"{module} imports {other}"
            if module in MACHINES:
                continue
            assert other not in MACHINES, f"{module} imports {other}; kernels do not know what compiles them"
            assert other is None or name != f"strapdown.{other}", (
                f"{module} imports the module {name}; import its functions by name"
            )
        if module not in MACHINES:
            assert top_names(tree) <= {"__future__", "math", "numpy", "strapdown", "typing"}, module


RANDOM = ("default_rng", "Generator", "BitGenerator", "SeedSequence", "PCG64", "PCG64DXSM", "Philox", "SFC64")


def test_global_random_numbers_are_not_used():
    """Randomness is an argument."""
    for module, tree in sources().items():
        assert "random" not in top_names(tree), module
    for module, node in nodes():
        if isinstance(node, ast.Attribute) and getattr(node.value, "attr", "") == "random":
            assert ast.unparse(node.value) not in ("np.random", "numpy.random") or node.attr in RANDOM, (
                f"{module} line {node.lineno}: {ast.unparse(node)}"
            )
    for module, node, call in calls():
        if call.endswith(("default_rng", "SeedSequence")):
            assert node.args or node.keywords, f"{module} line {node.lineno}: {ast.unparse(node)} without a seed"


def loaded_by(code: str) -> set[str]:
    """Top-level modules in memory after running some code in a new process."""
    script = (
        f"import sys\n{code}\nsys.stderr.write('\\n' + ' '.join(sorted({{m.partition('.')[0] for m in sys.modules}})))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return set(done.stderr.splitlines()[-1].split())


HELP = """
from strapdown import (cli)
sys.argv = ["strapdown", {!r}]
try:
    cli.main()
except SystemExit as end:
    assert not end.code
"""

EACH = """
import importlib
for name in {!r}:
    importlib.import_module("strapdown." + name)
    assert not {{"numba", "matplotlib"}} & set(sys.modules), name
"""


def test_help_loads_neither_compiler_nor_plots():
    assert not loaded_by(HELP.format("--help")) & {"numba", "llvmlite", "matplotlib", "scipy", "h5py", "filterpy"}


def test_modules_load_neither_compiler_nor_plots():
    """All but the drawing ones, in one process: numba and matplotlib come when first needed."""
    extends_the_compiler = {*MACHINES} - {"kernels.machine"}  # loaded by that one, when a kernel is compiled
    names = sorted(n for n in sources() if n and unit(n) not in DRAWING and n not in extends_the_compiler)
    assert not loaded_by(EACH.format(names)) & {"numba", "llvmlite", "matplotlib", "pandas", "dask", "distributed"}
