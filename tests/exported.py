"""Exported filters for tests: the program in plain Python, and the compiled or executed code fed with the same samples."""

from __future__ import annotations

import ctypes
import json
import math
import shutil
import subprocess
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from strapdown.codegen import c, design, recording
from strapdown.codegen import program as body
from strapdown.kernels import machine

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror", "-pedantic", "-ffp-contract=off")


def compiler(language="C"):
    names = {"C": ("gcc", "cc"), "C++": ("g++", "c++")}[language]
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip(f"no {language} compiler on this machine")
    return path


missing = (0.0, 0.0, 0.0)


class PlainKernels:
    """Kernels in plain Python, with other helpers."""

    def __init__(self, module, helpers):
        self.module, self.made = module, {}
        self.helpers = helpers | {
            "value_at": lambda array, i, like: array[i],
            "put_at": lambda array, i, value: array.__setitem__(i, value),
        }

    def __getattr__(self, name):
        value = getattr(self.module, name)
        return self.bound(value) if isinstance(value, FunctionType) else value

    def bound(self, kernel):
        if kernel not in self.made:
            names = kernel.__globals__ | self.helpers
            self.made[kernel] = FunctionType(kernel.__code__, names, kernel.__name__, kernel.__defaults__)
            for name in machine._names(kernel.__code__):
                value = names.get(name)
                if name not in self.helpers and getattr(value, "__module__", "").startswith("strapdown.kernels"):
                    names[name] = self.bound(value) if isinstance(value, FunctionType) else value
        return self.made[kernel]


class LeftError(Exception):
    """A function of the filter has returned a status."""


class Plain:
    """The program on floats of Python: the machine of :mod:`strapdown.codegen.program` without code."""

    def __init__(self, program):
        self.program, n = program, program.n
        helpers = {
            "square_root": math.sqrt,
            "select": lambda condition, a, b: a if condition else b,
            "any_lane": self.turned_far,
        }
        self.kernels = PlainKernels(program.kernels, helpers)
        self.select, self.root, self.equal = helpers["select"], math.sqrt, lambda a, b: a == b
        self.whole, self.scratch = math.floor, dict
        self.f = SimpleNamespace(
            x=[0.0] * (n + 1),
            P=[0.0] * program.number_of_covariances,
            nis=[0.0] * len(program.sensors),
            coefficients=[0.0] * (16 * len(program.model.last)),
            dt=[0.0],
        )
        for a in () if program.recording is None else program.recording.arrays:
            setattr(self.f, a.name, np.zeros(a.shape, int if a.kind == "int" else float))
        self.kernel, self.lowest = lambda function, *arguments: function(*arguments), math.floor
        self.status, self.called, self.far_turns = 0, set(), 0

    def turned_far(self, condition):
        self.far_turns += bool(condition)
        return bool(condition)

    def run(self, function, *arguments):
        try:
            function(self, self.program, self.f, *arguments)
        except LeftError as left:
            bits = int(self.program.statuses[str(left)][0])
            self.status |= bits
            return bits
        return None

    def start(self):
        return self.run(recording.init)

    def take(self, time, *vectors):
        return self.run(recording.update, time, *(missing if v is None else tuple(v) for v in vectors))

    def init(self, attitude):
        return self.run(body.init, attitude)

    def predict(self, gyro, dt):
        return self.run(body.predict, tuple(gyro), dt)

    def update(self, i, value):
        return self.run(body.update, self.program.sensors[i], i, tuple(value))

    @property
    def numbers(self):
        return np.array([*self.f.x, *self.f.P, *self.f.nis])

    # The machine of the program.

    def branch(self, condition, then, otherwise=None):
        if condition:
            then()
        elif otherwise is not None:
            otherwise()

    def unless(self, condition, then):
        if not condition:
            then()

    def no(self, condition):
        return not condition

    def repeat(self, count, then):
        for _ in range(int(count)):
            then()

    def comment(self, text):
        pass

    def table(self, name, shape):
        return np.zeros(shape)

    def clear_status(self):
        self.status = 0

    def leave(self, status):
        raise LeftError(status)

    def work(self):
        self.space = [0.0] * body.work_size(self.kernels)
        return self.space

    def call(self, name, *arguments, result=None):
        self.called.add(name)
        given = tuple(self.space if isinstance(argument, str) else argument for argument in arguments)
        sensor = [one for one in enumerate(self.program.sensors) if name == f"update_{one[1].name}"]
        if sensor:
            index, one = sensor[0]
            return self.run(body.update, one, index, *given)
        return self.run(getattr(body, name, None) or getattr(recording, name), *given)


class Compiled:
    """The filter in C, compiled into a library: once for a program."""

    _sources: ClassVar[dict[Any, tuple[Any, dict[str, str]]]] = {}
    _libraries: ClassVar[dict[Any, ctypes.CDLL]] = {}

    def __init__(self, program, folder, *, single=False, flags=("-O1",)):
        folder = Path(folder)
        if (id(program), single) not in self._sources:
            self._sources[id(program), single] = program, c.files(program, "test", single=single)
        files = self._sources[id(program), single][1]
        flags = (*flags, "-Wdouble-promotion") if single else flags
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
        key = (*files.items(), *flags)
        if key not in self._libraries:
            library = folder / "filter.so"
            subprocess.run(
                [compiler(), *STRICT, *flags, "-shared", "-fPIC", "strapdown_filter.c", "-o", library.name, "-lm"],
                cwd=folder,
                check=True,
                capture_output=True,
                text=True,
            )
            self._libraries[key] = ctypes.CDLL(str(library.resolve()))
        self.real = ctypes.c_float if single else ctypes.c_double
        types = {"": self.real, "int": ctypes.c_int, "wide": ctypes.c_double}
        fields = [(name, types[kind] * size if size else types[kind]) for name, size, _, kind in c.members(program)]
        self.struct = type("Filter", (ctypes.Structure,), {"_fields_": [*fields, ("status", ctypes.c_uint)]})
        self.state, self.library, self.program = self.struct(), self._libraries[key], program

    def _call(self, name, *arguments):
        given = [a if not isinstance(a, float) else self.real(a) for a in arguments]
        given = [(self.real * len(a))(*a) if isinstance(a, list | tuple | np.ndarray) else a for a in given]
        return getattr(self.library, f"strapdown_{name}")(ctypes.byref(self.state), *given)

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


def program_of(setup, sensors, *, single=False):
    return design.program_of(setup, sensors, single=single)


def samples(record, kinds):
    """Rows of (None, gyro, dt) and (sensor, value, 0) of a record, in order of time."""
    rows = []
    order = []
    for i, series in enumerate(record.vectors):
        values = series.attitude if kinds[i] == "attitude" else series.vector_b
        order += [(t, i, v) for t, v in zip(series.time.tolist(), values.tolist(), strict=True)]
    order.sort(key=lambda one: one[:2])
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


def node():
    found = shutil.which("node")
    if found is None:
        pytest.skip("no node on this machine")
    return found


FEED = """
import * as filter from './strapdown_filter.mjs';
import fs from 'fs';
const {rows, start, names} = JSON.parse(fs.readFileSync('rows.json'));
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
    from strapdown.codegen import javascript

    folder = Path(folder)
    for name, text in javascript.files(program, "test").items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "feed.mjs").write_text(FEED, encoding="utf-8")
    given = {"rows": rows, "start": list(start), "names": [sensor.name for sensor in program.sensors]}
    (folder / "rows.json").write_text(json.dumps(given), encoding="utf-8")
    run = subprocess.run([node(), "feed.mjs"], cwd=folder, check=True, capture_output=True, text=True)
    numbers, statuses = json.loads(run.stdout)
    return np.array(numbers), statuses
