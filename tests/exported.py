"""Exported filters for tests: the program in plain Python, and the compiled or executed code fed with the same samples."""

from __future__ import annotations

import ctypes
import functools
import json
import math
import shutil
import subprocess
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from strapdown.codegen import c, javascript, recording, target
from strapdown.codegen import program as body
from strapdown.codegen.interpreted import FORMULAS
from strapdown.kernels import machine

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror", "-pedantic", "-ffp-contract=off")
STRICT += ("-Wdouble-promotion",)


def compiler(language="C"):
    names = {"C": ("gcc", "cc"), "C++": ("g++", "c++")}[language]
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip(f"no {language} compiler on this machine")
    return path


missing = (0.0, 0.0, 0.0)


class PlainModule:
    """A module of the filter's functions in plain Python, with others in place of some."""

    def __init__(self, module, replaced, called):
        self.module, self.made, self.called = module, {}, called
        self.replaced = replaced | {
            "value_at": lambda array, i, like: array[i],
            "put_at": lambda array, i, value: array.__setitem__(i, value),
        }

    def __getattr__(self, name):
        return self.bound(getattr(self.module, name))

    def bound(self, value):
        if isinstance(value, ModuleType) and value.__name__.startswith(FORMULAS):
            module = PlainModule(value, self.replaced, self.called)
            module.made = self.made
            return module
        if not isinstance(value, FunctionType) or not value.__module__.startswith(FORMULAS):
            return value
        if value not in self.made:
            names = dict(value.__globals__)
            function = FunctionType(value.__code__, names, value.__name__, value.__defaults__)
            self.made[value] = self.recorded(function) if value in target.OWN else function
            for name in machine.names_of(value.__code__):
                if name in self.replaced or name in names:
                    names[name] = self.bound(self.replaced.get(name, names.get(name)))
        return self.made[value]

    def recorded(self, function):
        def call(*arguments):
            sensors = [x.name for x in arguments if isinstance(x, body.Sensor)]
            self.called.add("_".join([function.__name__, *sensors]))
            return function(*arguments)

        return call


class Plain:
    """The filter on floats of Python."""

    def __init__(self, program):
        self.program, n = program, program.n
        self.called, self.far_turns, self.status = set(), 0, 0
        replaced = {
            "square_root": math.sqrt,
            "select": lambda condition, a, b: a if condition else b,
            "any_lane": self.turned_far,
        }
        self.f = f = SimpleNamespace(
            program=program,
            kernels=PlainModule(program.kernels, replaced, self.called),
            prediction=PlainModule(program.prediction, replaced, self.called),
            x=[0.0] * (n + 1),
            P=[0.0] * program.number_of_covariances,
            nis=[0.0] * len(program.sensors),
            coefficients=[0.0] * (16 * len(program.model.last)),
            dt=[0.0],
            status=[0],
            work=[0.0] * body.work_size(program.kernels),
        )
        replaced = recording.REPLACED | {"call": lambda kernel, arguments, like: self.body.bound(kernel)(*arguments)}
        self.body = PlainModule(body if program.recording is None else recording, replaced, self.called)
        if program.recording is not None:
            for a in program.recording.arrays:
                setattr(f, a.name, np.zeros(a.shape, int if a.kind == "int" else float))
            f.imu = recording.imu_of(f, lambda name, shape: np.zeros(shape), np.zeros_like)

    def turned_far(self, condition):
        self.far_turns += bool(condition)
        return bool(condition)

    def run(self, function, *arguments):
        self.f.status[0] = self.status
        status = function(self.f, *arguments)
        self.status = self.f.status[0] | status
        return status

    def start(self):
        return self.run(self.body.init)

    def take(self, time, *vectors):
        return self.run(self.body.update, time, *(missing if v is None else tuple(v) for v in vectors))

    def init(self, attitude):
        return self.run(self.body.init, attitude)

    def predict(self, gyro, dt):
        return self.run(self.body.predict, tuple(gyro), dt)

    def update(self, i, value):
        return self.run(self.body.update, self.program.sensors[i], tuple(value))

    @property
    def numbers(self):
        return np.array([*self.f.x, *self.f.P, *self.f.nis])


functions_of = functools.cache(target.traced)
"""Functions of a program, traced once for C, JavaScript and sanitizers."""


def c_files(program, *, single=False):
    return c.files(program, functions_of(program), "test", single=single)


def write(files, folder):
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")


class Compiled:
    """The filter in C, compiled into a library: once for a program. An optimising compiler takes three times as long."""

    _libraries: ClassVar[dict[Any, ctypes.CDLL]] = {}

    def __init__(self, program, folder, *, single=False, flags=("-O0",)):
        key = program, single, flags
        if key not in self._libraries:
            write(c_files(program, single=single), folder)
            build = [compiler(), *STRICT, *flags, "-shared", "-fPIC", "strapdown_filter.c", "-o", "filter.so", "-lm"]
            subprocess.run(build, cwd=folder, check=True, capture_output=True, text=True)
            self._libraries[key] = ctypes.CDLL(str(folder / "filter.so"))
        self.real = ctypes.c_float if single else ctypes.c_double
        types = {"": self.real, "int": ctypes.c_int, "wide": ctypes.c_double}
        fields = [(name, types[kind] * size if size else types[kind]) for name, size, _, kind in c.members(program)]
        self.struct = type("Filter", (ctypes.Structure,), {"_fields_": [*fields, ("status", ctypes.c_uint)]})
        self.state, self.library, self.program = self.struct(), self._libraries[key], program

    def _call(self, name, *arguments):
        values = [a if not isinstance(a, float) else self.real(a) for a in arguments]
        values = [(self.real * len(a))(*a) if isinstance(a, list | tuple | np.ndarray) else a for a in values]
        return getattr(self.library, f"strapdown_{name}")(ctypes.byref(self.state), *values)

    def init(self, attitude):
        return self._call("init", attitude)

    def predict(self, gyro, dt):
        return self._call("predict", gyro, float(dt))

    def start(self):
        return self._call("init")

    def take(self, time, *vectors):
        return self._call("update", ctypes.c_double(time), *vectors)

    def update(self, i, value):
        return self._call(f"update_{self.program.sensors[i].name}", value)

    @property
    def status(self):
        return self.state.status

    @property
    def numbers(self):
        names = ["attitude", "bias", *(["states"] if self.program.n > 6 else []), "P", "nis"]
        return np.concatenate([np.asarray(getattr(self.state, name)[:], float) for name in names])

    def sigma(self):
        out = (self.real * self.program.n)()
        self.library.strapdown_sigma(ctypes.byref(self.state), out)
        return np.array(out[:])


def run_sanitized(files, folder):
    """Run a program with the checks of addresses and of undefined behaviour; it must end well."""
    write(files, folder)
    sanitize = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-Wno-conversion"]
    build = [compiler(), *STRICT, *sanitize, "main.c", "strapdown_filter.c", "-o", "run", "-lm"]
    done = subprocess.run(build, cwd=folder, capture_output=True, text=True, check=False)
    if "cannot find" in done.stderr:
        pytest.skip(f"no sanitizers: {done.stderr.splitlines()[0]}")
    assert done.returncode == 0, done.stderr
    run = subprocess.run(["./run"], cwd=folder, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")


def samples(record, kinds):
    """Rows of (None, gyro, dt) and (sensor, value, 0) of a record, in order of time."""
    rows = []
    order = []
    for i, series in enumerate(record.vectors):
        values = series.attitude if kinds[i] == "attitude" else series.vector_b
        order += [(t, i, v) for t, v in zip(series.time.tolist(), values.tolist(), strict=True)]
    order.sort(key=lambda entry: entry[:2])
    k = 0
    for edge, before, increment in zip(
        record.time[1:].tolist(), record.time.tolist(), record.increments.tolist(), strict=False
    ):
        dt = edge - before
        rows.append((None, [x / dt for x in increment], dt))
        while k < len(order) and order[k][0] <= edge + 1e-9:
            rows.append((order[k][1], order[k][2], 0.0))
            k += 1
    return rows


def fed(f, rows, start):
    """Feed a filter; return its numbers and the statuses after each row."""
    f.init(list(start))
    numbers, statuses = [], []
    for sensor, value, dt in rows:
        statuses.append(f.predict(value, dt) if sensor is None else f.update(sensor, value))
        numbers.append(f.numbers)
    return np.array(numbers), statuses


def by_node(program, feed, inputs, folder):
    """Return what a script that feeds the ES module with inputs prints, as JSON."""
    path = shutil.which("node")
    if path is None:
        pytest.skip("no node on this machine")
    files = javascript.files(program, functions_of(program), "test")
    write({**files, "feed.mjs": feed, "inputs.json": json.dumps(inputs)}, folder)
    run = subprocess.run([path, "feed.mjs"], cwd=folder, check=True, capture_output=True, text=True)
    return json.loads(run.stdout)


FEED = """
import * as filter from './strapdown_filter.mjs';
import fs from 'fs';
const {rows, start, names} = JSON.parse(fs.readFileSync('inputs.json'));
const f = filter.create();
filter.init(f, start);
const numbers = [], statuses = [];
for (const [sensor, value, dt] of rows) {
    statuses.push(sensor === null ? filter.predict(f, value, dt) : filter[`update_${names[sensor]}`](f, value));
    numbers.push([...f.attitude, ...f.bias, ...(f.states ?? []), ...f.P, ...f.nis]);
}
console.log(JSON.stringify([numbers, statuses]));
"""


def fed_javascript(program, folder, rows, start):
    """Feed the ES module, by node."""
    inputs = {"rows": rows, "start": list(start), "names": [sensor.name for sensor in program.sensors]}
    numbers, statuses = by_node(program, FEED, inputs, folder)
    return np.array(numbers), statuses
