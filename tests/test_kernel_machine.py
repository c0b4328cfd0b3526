"""Compiling kernels: what is compiled, what is refused, and a disk cache that is never stale."""

import ast
import hashlib
import math
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
import plain_kernels
import pytest
from measured import series_of

import strapdown
from strapdown import estimation
from strapdown.estimation import forward, schedule
from strapdown.estimation.model import assemble
from strapdown.kernels import (
    algebra,
    gate,
    gated_update,
    layout,
    likelihood,
    machine,
    six_states,
    update,
)
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.walk import walk
from strapdown.records import ImuRecord

PACKAGE = Path(strapdown.__file__).parent


def foreign(code: FunctionType, **names: object) -> FunctionType:
    """A function that claims to live among the kernels, with globals of its own."""
    function = FunctionType(code.__code__, names, "foreign")
    function.__module__ = "strapdown.kernels.foreign"
    return function


# ---------------------------------------------------------------------------------------------------- refusals


def test_functions_from_elsewhere_are_refused():
    for function in (lambda x: x, math.sqrt, estimation.initial_state):
        with pytest.raises(TypeError, match=r"does not live in strapdown\.kernels; move it there"):
            machine.compiled(function)


def test_a_kernel_that_names_a_module_is_refused():
    with pytest.raises(TypeError, match="names module algebra; import its functions by name"):
        machine.compiled(foreign(lambda v: algebra.dot(v, v), algebra=algebra))


# ---------------------------------------------------------------------------------------------------- compiling


def test_compiled_once_and_the_function_stays_plain():
    assert machine.compiled(walk, six_states) is machine.compiled(walk, six_states)
    assert machine.helper(algebra.dot) is machine.helper(algebra.dot)
    assert all(isinstance(function, FunctionType) for function in (algebra.dot, walk, six_states.predict))


def is_nan(x):
    return math.isnan(x)


def test_nan_and_infinity_survive_compilation():
    """Full fastmath would let the compiler assume there are none."""
    dot = plain_kernels.called(algebra.dot)
    assert math.isnan(dot((1.0, 2.0, 3.0), (0.0, math.nan, 0.0)))
    assert math.isinf(dot((1.0, 2.0, 3.0), (0.0, math.inf, 0.0)))
    watch = plain_kernels.called(foreign(is_nan, math=math))
    assert watch(math.nan)
    assert not watch(1.0)


def test_compiled_loop_equals_plain_python(monkeypatch):
    """The whole filter over a record with every kind of measurement and an interval that is split into sub-steps."""
    random = np.random.default_rng(3)
    edges = np.cumsum(np.r_[0.0, 0.01 + 0.002 * random.random(40)])
    increments = 0.05 * random.standard_normal((40, 3))
    increments[7] = [0.4, -0.9, 0.2]
    vectors = []
    for kind in ("direction", "vector", "heading"):
        time = np.sort(random.uniform(edges[0], edges[-1], 10))
        measured = [1.0, 0.0, 0.0] + 0.05 * random.standard_normal((10, 3))
        measured /= np.linalg.norm(measured, axis=1, keepdims=True)
        reference = np.array([1.0, 0.0, 0.0])
        vectors.append(series_of(kind, kind, time, measured, reference, 0.01))
    record = ImuRecord(time=edges, increments=increments, vectors=tuple(vectors))
    noise = estimation.ProcessNoise(angle_random_walk=1e-3, rate_random_walk=1e-4)
    initial = estimation.initial_state([1.0, 0.0, 0.0, 0.0], attitude_sigma=0.1, bias_sigma=0.01)
    fast = estimation.run(record, noise, initial, full_covariance=True)
    plain_calls = []

    def uncompiled(function, *parts):
        plain_calls.append(plain_kernels.plain(function, *parts))
        return plain_calls[-1]

    for module in (forward, schedule):
        monkeypatch.setattr(module, "compiled", uncompiled)
    plain = estimation.run(record, noise, initial, full_covariance=True)
    assert {function.__name__ for function in plain_calls} == {"walk", "merge_order"}
    assert all(isinstance(function, FunctionType) for function in plain_calls)
    for name in ("attitude", "bias", "variance", "covariance"):
        slow_result, fast_result = getattr(plain, name), getattr(fast, name)
        np.testing.assert_allclose(fast_result, slow_result, rtol=1e-11, atol=1e-13 * np.abs(slow_result).max())
    for sensor, innovations in plain.innovations.items():
        np.testing.assert_allclose(fast.innovations[sensor].whitened, innovations.whitened, rtol=1e-9, atol=1e-11)


# ---------------------------------------------------------------------------------------------------- functions left open


def module_of(name: str, source: str) -> ModuleType:
    """A module that claims to live among the kernels."""
    module = ModuleType(f"strapdown.kernels.{name}")
    exec(source, module.__dict__)
    return module


LOOP = """
OPEN = ("begin", "step")
def begin(body):
    pass
def step(state, body):
    pass
def repeated(n, body):
    state = begin(body)
    for _ in range(n):
        state = step(state, body)
    return state
"""
ADDS = """
def begin(body):
    return 0.0 * body
def step(state, body):
    return state + body
"""
DOUBLES = """
def step(state, body):
    return 2.0 * state
"""


def test_a_module_leaves_functions_open_for_others_to_define():
    loop, adds, doubles = module_of("loop", LOOP), module_of("adds", ADDS), module_of("doubles", DOUBLES)
    ones = module_of("ones", "def begin(body):\n    return 1.0\n")
    for call in (plain_kernels.called, lambda function, parts: plain_kernels.plain(function, *parts)):
        assert call(loop.repeated, (adds,))(5, 0.25) == 1.25
        # The first module that has a function defines it.
        assert call(loop.repeated, (doubles, ones))(5, 0.25) == 32.0
        assert call(loop.repeated, (doubles, adds))(5, 0.25) == 0.0
        assert call(loop.repeated, (ones, adds))(5, 0.25) == 2.25


def test_a_part_may_leave_functions_open_in_its_turn():
    """As the gate does around a form; a stub of the same name defines nothing."""
    loop = module_of("loop", LOOP)
    outer = module_of(
        "outer",
        "OPEN = ('inner', 'step')\n"
        "def inner(body):\n    pass\n"
        "def step(state, body):\n    pass\n"
        "def begin(body):\n    return inner(body) + 1.0\n",
    )
    inner = module_of(
        "inner", "def inner(body):\n    return 10.0 * body\ndef step(state, body):\n    return state + 100.0\n"
    )
    assert plain_kernels.called(loop.repeated, (outer, inner))(2, 0.5) == 206.0


def test_a_missing_definition_is_refused_by_its_name():
    loop, doubles = module_of("loop", LOOP), module_of("doubles", DOUBLES)
    with pytest.raises(
        TypeError, match=r"^strapdown\.kernels\.loop leaves begin open, and strapdown\.kernels\.doubles does not"
    ):
        machine.helper(loop.repeated, (doubles,))
    with pytest.raises(TypeError, match=r"^strapdown\.kernels\.loop leaves begin open"):
        machine.compiled(loop.repeated)
    with pytest.raises(TypeError, match=r"walk leaves \w+ open, and strapdown\.kernels\.algebra does not define it"):
        machine.compiled(walk, algebra)


SENSORS = {"star": "direction", "field": "vector", "compass": "heading", "tracker": "attitude"}
STRUCTURE = assemble((), SENSORS).structure
SEVERAL: dict[str, Any] = {"LANES": WIDTH}


def instance(module: ModuleType, **lanes: Any) -> ModuleType:
    return machine.instance(module, STRUCTURE=STRUCTURE, **lanes)


def test_an_instance_imports_copies_of_templates_with_its_constants_and_all_else_as_it_is():
    gated, several, plain = instance(gate), instance(likelihood, **SEVERAL), instance(likelihood)
    assert instance(gate) is gated
    assert gated.update is not gate.update
    assert gated.judge is instance(gated_update).judge is not gated_update.judge
    assert gated.judge.__globals__["apply_gains"] is instance(update).apply_gains
    assert (several.take, plain.take) == (instance(update, **SEVERAL).take, instance(update).take)
    assert instance(update, **SEVERAL).LANES == instance(layout, **SEVERAL).LANES == WIDTH
    assert (layout.N, instance(layout).STRUCTURE, update.STRUCTURE.n) == (6, STRUCTURE, 6)
    for name in ("judge_filter", "degrees_of_freedom", "Filter"):
        assert getattr(gated, name) is getattr(gate, name)


def test_a_literal_argument_compiles_no_helper_twice():
    module = module_of(
        "literals",
        "def product(n, x):\n    return n * x if x > 0.0 else x\n"
        "def both(n, x):\n    return product(3, x) + product(n, x) + product(n=4, x=x)\n",
    )
    assert plain_kernels.called(module.both)(5, 1.5) == 18.0
    assert len(machine.helper(module.product, ()).formula.plain.signatures) == 1


FORMULAS = """
import math
from typing import NamedTuple

class Pair(NamedTuple):
    first: float
    second: float

def product(a, b):
    return a * b, -b, 2.0 / a

def formula(a, i, row):
    both = Pair(first=product(b=i, a=a)[0], second=math.sqrt(abs(a)))
    row[i, 0], row[0, 1] = both
    below = row[0, 1] < a
    return (both, row[i, 0] + math.cos(0.0)), below

def branch(a):
    return a if a > 0.0 else product(a, a)[0]

def loop(a, n):
    for _ in range(n):
        a = a + 1.0
    return a

def part(row, i):
    return row[i]

def power(a):
    return 2.0 ** a

def everything(a, n, row):
    (both, more), below = formula(a, 1, row)
    return both.second, more, below, branch(a), loop(a, n), power(a), part(row, 1)[0]
"""


def test_formulas_are_traced_and_what_decides_or_repeats_is_compiled():
    module = module_of("formulas", FORMULAS)
    here, there = np.zeros((2, 2)), np.zeros((2, 2))
    for a in (2.25, -0.5):
        assert plain_kernels.called(module.everything)(a, 3, here) == module.everything(a, 3, there)
        np.testing.assert_array_equal(here, there)
    for name in ("product", "formula", "part"):
        assert not machine.helper(getattr(module, name), ()).formula.plain.signatures
    for name in ("branch", "loop", "power"):
        assert len(machine.helper(getattr(module, name), ()).formula.plain.signatures) == 1


ARRAYS = """
def longer(row):
    return len(row), row.shape[0]

def inner(a, i, j):
    later, column = a[1, i:], a[:, i]
    return a[1, i, j] + 10.0 * a[i, j, 0] + len(later) + 100.0 * later[1, j] + 1000.0 * column[1, j]

def elements(a, flags, words, rows, thin):
    words[0] = 7
    flags[words[1]] = True
    a[words[1], 0, 2] += inner(a, 1, 2)
    a[0, 1] = 0.5
    return longer(a[1, 2]), longer(thin), thin[1], a.shape, rows[1, 0], flags[0], flags[1], words[0], len(a)

def behind(row):
    return row[-1]
"""


def test_elements_rows_and_shapes_of_arrays_are_what_they_are_in_plain_python():
    module = module_of("arrays", ARRAYS)
    results = []
    for function in (module.elements, plain_kernels.called(module.elements)):
        a = np.arange(24.0).reshape(2, 3, 4)
        flags, words = np.zeros(2, bool), np.array([0, 1], np.int32)
        rows = machine.read_only(np.arange(6, dtype=np.float32).reshape(3, 2))
        results.append(
            (function(a, flags, words, rows, np.arange(12.0)[::3]), a.tolist(), flags.tolist(), words.tolist())
        )
    assert results[0] == results[1]
    with pytest.raises(Exception, match="counts from the front"):
        plain_kernels.called(module.behind)(np.zeros(3))


# ---------------------------------------------------------------------------------------------------- what it runs on


def test_describe():
    info = machine.describe()
    assert {"machine", "cpu", "numba", "llvm"} <= set(info)
    assert all(isinstance(value, str) and value for value in info.values())


# ---------------------------------------------------------------------------------------------------- the disk cache


PROBE = """
from strapdown.kernels.probe_constants import FACTOR
from strapdown.kernels.probe_helpers import lifted


def run(x):
    return FACTOR * lifted(x)
"""

ASK = """
from strapdown.kernels import machine, probe
fast = machine.compiled(probe.run)
answer = {"value": fast(1.0), "hits": sum(fast.stats.cache_hits.values())}
"""


LOADED = """
import sys
from strapdown.kernels import machine, probe
fast = machine.compiled(probe.run)
fast(1.0)
print(*fast.stats.cache_hits.values(), *{"strapdown.kernels.tracing", "numba.np.arrayobj", "scipy.linalg"} & set(sys.modules))
"""


def _answer(pipe: Connection, root: Path, code: str, arguments: tuple[str, ...]) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "strapdown"]:
        del sys.modules[name]
    sys.path.insert(0, str(root))
    # Python would use the bytecode for a source of the same length that is written in the same second.
    sys.dont_write_bytecode = True
    numba.config.CACHE_DIR = str(root / "cache")
    names = {"arguments": arguments}
    exec(code, names)
    assert names["machine"].__file__.startswith(str(root))
    pipe.send(names["answer"])


def in_a_new_process(root: Path, code: str, *arguments: str) -> Any:
    """What ``answer`` is after code that imports the package copied to ``root``, in a fork: that spares it the start of numba."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    child = context.Process(target=_answer, args=(there, root, code, arguments))
    child.start()
    there.close()
    try:
        return here.recv()
    finally:
        child.join()


@pytest.fixture
def copied_kernels(tmp_path):
    """A copy of the kernels with a probe, a constant in one module and a helper in another."""
    kernels = tmp_path / "strapdown" / "kernels"
    shutil.copytree(PACKAGE / "kernels", kernels, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(PACKAGE / "__init__.py", tmp_path / "strapdown")
    (kernels / "probe.py").write_text(PROBE)
    (kernels / "probe_constants.py").write_text("FACTOR = 2.0\n")
    (kernels / "probe_helpers.py").write_text("def lifted(x):\n    return x + 1.0\n")
    return kernels


def edit(path: Path, text: str) -> None:
    """Write other text of the same length and keep the time stamp: neither may be what the cache goes by."""
    stamp = path.stat()
    assert len(text) == stamp.st_size
    path.write_text(text)
    os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    shutil.rmtree(path.parent / "__pycache__", ignore_errors=True)  # Python's own bytecode does go by them


def test_a_kernel_from_the_cache_needs_nothing_that_only_compiles(copied_kernels):
    root = copied_kernels.parent.parent
    environment = {**os.environ, "PYTHONPATH": str(root), "NUMBA_CACHE_DIR": str(root / "cache")}
    first, again = (
        subprocess.run(
            [sys.executable, "-c", LOADED], cwd=root, env=environment, check=True, capture_output=True, text=True
        )
        for _ in range(2)
    )
    assert len(first.stdout.split()) == 3  # without hits
    assert again.stdout.split() == ["1"]


def test_cache_is_used_and_notices_edited_constants_and_helpers(copied_kernels):
    kernels = copied_kernels
    ask = partial(in_a_new_process, kernels.parent.parent, ASK)
    first, again = ask(), ask()
    assert (first["value"], first["hits"]) == (4.0, 0)
    assert (again["value"], again["hits"]) == (4.0, 1)
    edit(kernels / "probe_constants.py", "FACTOR = 3.0\n")
    changed = ask()
    assert (changed["value"], changed["hits"]) == (6.0, 0)
    edit(kernels / "probe_helpers.py", "def lifted(x):\n    return x + 9.0\n")
    changed = ask()
    assert (changed["value"], changed["hits"]) == (30.0, 0)


ASK_WARNED = """
import warnings
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    from strapdown.kernels import machine, probe
    fast = machine.compiled(probe.run)
    values = fast(1.0), fast(1), fast(True)
answer = values, sum(fast.stats.cache_hits.values()), [f"{warning.category.__name__}: {warning.message}" for warning in caught]
"""


def flipped(content: bytes, place: float) -> bytes:
    k = int(place * (len(content) - 1))
    return content[:k] + bytes([content[k] ^ 4]) + content[k + 1 :]


DAMAGES = [
    lambda content: b"",
    lambda content: content[:20],
    lambda content: content[: len(content) // 2],
    lambda content: bytes(len(content)),
    lambda content: content + b"x",
    *(partial(flipped, place=place) for place in (0.0, 0.5, 1.0)),
    lambda content: hashlib.sha256(b"no pickle").digest() + b"no pickle",
]


def test_damaged_entries_of_the_cache_are_compiled_again_with_one_warning(copied_kernels):
    root = copied_kernels.parent.parent
    ask = partial(in_a_new_process, root, ASK_WARNED)
    values = (4.0, 4.0, 4.0)
    assert ask() == (values, 0, [])
    for damages in zip(*[iter(DAMAGES)] * 3, strict=True):
        entries = [path for path in (root / "cache").rglob("*") if path.is_file()]
        for entry, damage in zip(entries, damages, strict=True):
            entry.write_bytes(damage(entry.read_bytes()))
        again, hits, (warned,) = ask()
        assert (again, hits) == (values, 0)
        assert re.match(r"CacheWarning: a compiled kernel in .* is damaged: it is discarded and compiled again", warned)
    assert ask() == (values, 3, [])


LIMITED = """
import resource, signal
resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.RLIM_INFINITY))
"""


@pytest.mark.parametrize("fault", ["full disk", "a file for the folder", "no folder", "deleted meanwhile"])
def test_a_cache_that_cannot_be_written_ends_no_run(copied_kernels, fault):
    root = copied_kernels.parent.parent
    code, values = ASK_WARNED, (4.0, 4.0, 4.0)
    if fault == "full disk":
        code = LIMITED + code
    elif fault == "a file for the folder":
        (root / "cache").write_text("")
        copied_kernels.joinpath("__pycache__").write_text("")
    elif fault == "no folder":
        code = f"import numba; numba.config.CACHE_DIR = {os.devnull!r}\n" + code
    else:
        code = code.replace("values =", "import shutil; shutil.rmtree(fast._cache.cache_path)\n    values =")
    computed, _, warned = in_a_new_process(root, code)
    assert computed == values
    assert len(warned) == (fault == "full disk")
    assert all("compiled kernels cannot be stored" in words for words in warned)


def test_entries_of_earlier_sources_are_deleted(copied_kernels):
    root = copied_kernels.parent.parent
    for factor in ("2.0", "3.0", "4.0"):
        (copied_kernels / "probe_constants.py").write_text(f"FACTOR = {factor}\n")
        assert in_a_new_process(root, ASK)["value"] == 2.0 * float(factor)
    assert len([path for path in (root / "cache").rglob("*") if path.is_file()]) == 1


OPEN_PROBE = """
OPEN = ("term",)


def term(x):
    pass


def run(x):
    return 2.0 * term(x)
"""

ASK_PARTS = """
import importlib
from strapdown.kernels import machine, open_probe
answer = []
for names in arguments:
    fast = machine.compiled(open_probe.run, *map(importlib.import_module, names.split(",")))
    answer.append((fast(1.0), sum(fast.stats.cache_hits.values())))
"""


@pytest.fixture
def two_bodies(copied_kernels):
    """A kernel that leaves a function open, and the names of two modules that define it."""
    (copied_kernels / "open_probe.py").write_text(OPEN_PROBE)
    for number in (3, 7):
        (copied_kernels / f"term_{number}.py").write_text(f"def term(x):\n    return {number}.0 * x\n")
    return copied_kernels.parent.parent, *(f"strapdown.kernels.term_{number}" for number in (3, 7))


def test_cache_distinguishes_what_open_functions_are_bound_to(two_bodies):
    """One loop, two bodies of the same types: neither may be taken for the other, whichever was compiled first."""
    root, three, seven = two_bodies
    ask = partial(in_a_new_process, root, ASK_PARTS)  # value and hits of each body
    own = root / "own.py"  # a body of one's own, outside the package
    own.write_text("def term(x):\n    return 3.0 * x\n")
    assert ask(three, seven, "own") == [(6.0, 0), (14.0, 0), (6.0, 0)]
    assert ask(f"{seven},{three}", three, "own") == [(14.0, 0), (6.0, 1), (6.0, 1)]
    edit(own, "def term(x):\n    return 5.0 * x\n")
    assert ask("own") == [(10.0, 0)]


ASK_ADDRESSES = """
import ctypes, importlib
from strapdown.kernels import machine, open_probe
fast = [machine.compiled(open_probe.run, importlib.import_module(name)) for name in arguments]
hits = [(f(1.0), sum(f.stats.cache_hits.values())) for f in fast]
double, pointer = ctypes.c_double, ctypes.c_void_p
call = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.POINTER(double), ctypes.POINTER(pointer), double)  # numba's convention
answer = []
for f in fast:
    result = double()
    call(machine.address_of(f, (1.0,)))(ctypes.byref(result), ctypes.byref(pointer()), 1.0)
    answer.append(result.value)
answer = answer, hits
"""


def test_addresses_are_those_of_each_body_whichever_process_compiled_it(two_bodies):
    """numba numbers functions from the start of each process: without the body in their names, two symbols would be one."""
    root, three, seven = two_bodies
    ask = partial(in_a_new_process, root, ASK_ADDRESSES)
    assert ask(three) == ([6.0], [(6.0, 0)])
    assert ask(seven) == ([14.0], [(14.0, 0)])
    assert ask(three, seven) == ([6.0, 14.0], [(6.0, 1), (14.0, 1)])


ASK_DIGESTS = """
from pathlib import Path
from strapdown.kernels import machine
answer = {path.stem: machine.sources_digest(str(path)) for path in Path(machine.__file__).parent.glob("*.py")}
"""


def imports_of(path: Path) -> set[str]:
    """Return the kernel modules that a file imports anywhere, by its syntax tree."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "strapdown.kernels":
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("strapdown.kernels."):
            names.add((node.module or "").rpartition(".")[2])
    return names


def test_a_digest_depends_on_the_sources_used_and_on_no_others(copied_kernels):
    imports = {path.stem: imports_of(path) for path in copied_kernels.glob("*.py")}
    users = {name: {name} for name in imports}
    for _ in imports:  # until it no longer grows
        users = {name: those.union(*(users[k] for k in imports if imports[k] & those)) for name, those in users.items()}
    ask = partial(in_a_new_process, copied_kernels.parent.parent, ASK_DIGESTS)
    before = ask()
    for edited in ("algebra", "gate", "probe_constants", "compiler"):
        path = copied_kernels / f"{edited}.py"
        path.write_text(path.read_text() + "# edited")
        after = ask()
        changed = {name for name in before if before[name] != after[name]}
        assert changed == (set(imports) if edited == "compiler" else users[edited]), edited
        before = after


def test_a_digest_depends_on_a_file_outside_that_is_named_as_one_inside(tmp_path):
    own = tmp_path / "walk.py"
    files = str(PACKAGE / "kernels" / "walk.py"), str(own)
    own.write_text("a = 1\n")
    before = machine.sources_digest(*files)
    own.write_text("a = 2\n")
    machine.sources_digest.cache_clear()
    assert machine.sources_digest(*files) != before


EDITED = """
from pathlib import Path
from strapdown.kernels import machine
path = Path(machine.__file__).with_name("probe.py")
path.write_text(path.read_text() + "# edited")
answer = machine.sources_digest(str(path))
"""


def test_a_source_edited_while_a_process_runs_does_not_count_for_it(copied_kernels):
    """Otherwise its code would be stored as that of the edited source, and loaded with other arrays by the next process."""
    ask = partial(in_a_new_process, copied_kernels.parent.parent)
    before = ask(EDITED.replace('path.write_text(path.read_text() + "# edited")', ""))
    assert ask(EDITED) == before
    assert ask(EDITED) != before
