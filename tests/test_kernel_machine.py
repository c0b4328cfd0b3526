"""Compiling kernels: what is compiled, what is refused, and a disk cache that is never stale."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import FunctionType

import numpy as np
import pytest

import strapdown
from strapdown import estimation
from strapdown.estimation.states import running, scheduling
from strapdown.kernels import algebra, filter_loop, machine
from strapdown.records import ImuRecord
from strapdown.vectors import VectorMeasurements

PACKAGE = Path(strapdown.__file__).parent


def foreign(code: FunctionType, **names: object) -> FunctionType:
    """A function that claims to live among the kernels, with globals of its own."""
    function = FunctionType(code.__code__, names, "foreign")
    function.__module__ = "strapdown.kernels.foreign"
    return function


# ---------------------------------------------------------------------------------------------------- refusals


def test_functions_from_elsewhere_are_refused():
    with pytest.raises(TypeError, match=r"does not live in strapdown\.kernels; move it there"):
        machine.compiled(lambda x: x)
    with pytest.raises(TypeError, match="does not live in"):
        machine.compiled(math.sqrt)
    with pytest.raises(TypeError, match="does not live in"):
        machine.compiled(estimation.initial_state)


def test_a_kernel_that_names_a_module_is_refused():
    with pytest.raises(TypeError, match="names module algebra; import its functions by name"):
        machine.compiled(foreign(lambda v: algebra.dot(v, v), algebra=algebra))


# ---------------------------------------------------------------------------------------------------- compiling


def test_compiled_once():
    assert machine.compiled(filter_loop.run_filter) is machine.compiled(filter_loop.run_filter)
    assert machine.helper(algebra.dot) is machine.helper(algebra.dot)


def test_the_plain_function_stays_plain():
    machine.helper(algebra.dot)
    assert isinstance(algebra.dot, FunctionType)
    assert isinstance(filter_loop.run_filter, FunctionType)


def is_nan(x):
    return math.isnan(x)


def test_nan_and_infinity_survive_compilation():
    """Full fastmath would let the compiler assume there are none."""
    dot = machine.helper(algebra.dot)
    assert math.isnan(dot((1.0, 2.0, 3.0), (0.0, math.nan, 0.0)))
    assert math.isinf(dot((1.0, 2.0, 3.0), (0.0, math.inf, 0.0)))
    watch = machine.helper(foreign(is_nan, math=math))
    assert watch(math.nan)
    assert not watch(1.0)


def test_compiled_loop_equals_plain_python(monkeypatch):
    """The whole filter over a record with every kind of measurement and an interval that is taken in sub-steps."""
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
        vectors.append(
            VectorMeasurements(sensor=kind, kind=kind, time=time, vector_b=measured, reference_f=reference, sigma=0.01)
        )
    record = ImuRecord(time=edges, increments=increments, vectors=tuple(vectors))
    noise = estimation.ProcessNoise(angle_random_walk=1e-3, rate_random_walk=1e-4)
    initial = estimation.initial_state([1.0, 0.0, 0.0, 0.0], attitude_sigma=0.1, bias_sigma=0.01)
    fast = estimation.run(record, noise, initial, full_covariance=True)
    plain_calls = []
    for module in (running, scheduling):
        monkeypatch.setattr(module, "compiled", lambda function: plain_calls.append(function) or function)
    plain = estimation.run(record, noise, initial, full_covariance=True)
    assert all(isinstance(function, FunctionType) for function in plain_calls)
    assert plain_calls
    for name in ("attitude", "bias", "variance", "covariance"):
        slow_result, fast_result = getattr(plain, name), getattr(fast, name)
        np.testing.assert_allclose(fast_result, slow_result, rtol=1e-11, atol=1e-13 * np.abs(slow_result).max())
    for sensor, innovations in plain.innovations.items():
        np.testing.assert_allclose(fast.innovations[sensor].whitened, innovations.whitened, rtol=1e-9, atol=1e-11)


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
import json
from strapdown.kernels import machine, probe
fast = machine.compiled(probe.run)
print(json.dumps({"value": fast(1.0), "hits": sum(fast.stats.cache_hits.values()), "file": machine.__file__}))
"""


@pytest.fixture
def copied_kernels(tmp_path):
    """A copy of the kernels with a probe, a constant in one module and a helper in another, and a way to ask it in a new process."""
    kernels = tmp_path / "strapdown" / "kernels"
    shutil.copytree(PACKAGE / "kernels", kernels, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(PACKAGE / "__init__.py", tmp_path / "strapdown")
    (kernels / "probe.py").write_text(PROBE)
    (kernels / "probe_constants.py").write_text("FACTOR = 2.0\n")
    (kernels / "probe_helpers.py").write_text("def lifted(x):\n    return x + 1.0\n")

    def ask() -> dict:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        done = subprocess.run(
            [sys.executable, "-c", ASK], env=environment, cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        answer = json.loads(done.stdout)
        assert answer["file"].startswith(str(tmp_path))
        return answer

    return kernels, ask


def edit(path: Path, text: str) -> None:
    """Write other text of the same length and keep the time stamp: neither may be what the cache goes by."""
    stamp = path.stat()
    assert len(text) == stamp.st_size
    path.write_text(text)
    os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    shutil.rmtree(path.parent / "__pycache__", ignore_errors=True)  # Python's own bytecode does go by them


def test_cache_is_used_and_notices_edited_constants_and_helpers(copied_kernels):
    kernels, ask = copied_kernels
    first, again = ask(), ask()
    assert (first["value"], first["hits"]) == (4.0, 0)
    assert (again["value"], again["hits"]) == (4.0, 1)
    edit(kernels / "probe_constants.py", "FACTOR = 3.0\n")
    changed = ask()
    assert (changed["value"], changed["hits"]) == (6.0, 0)
    edit(kernels / "probe_helpers.py", "def lifted(x):\n    return x + 9.0\n")
    changed = ask()
    assert (changed["value"], changed["hits"]) == (30.0, 0)
    assert ask()["hits"] == 1


def test_digest_depends_on_every_kernel_source(monkeypatch, tmp_path):
    copy = tmp_path / "kernels"
    shutil.copytree(PACKAGE / "kernels", copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(machine, "__file__", str(copy / "machine.py"))
    digest = machine.sources_digest.__wrapped__
    seen = {digest()}
    for path in sorted(copy.glob("*.py")):
        path.write_text(path.read_text() + "\n# edited\n")
        seen.add(digest())
    assert len(seen) == 1 + len(list(copy.glob("*.py")))
