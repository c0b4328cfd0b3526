"""User-defined filters: functions, or objects with a method ``run``, of a record and an initial state that return an estimate.

Such a filter can be given in place of a filter of this package: in :attr:`strapdown.estimation.setup.FilterSetup.estimator`, and so in
every Monte Carlo (threads, processes or Dask, resumed and replayed), and in :func:`strapdown.estimation.filters.compare`.

>>> import numpy as np
>>> from strapdown import quaternion
>>> from strapdown.records import Estimate
>>> def dead_reckoning(record, initial):
...     turns = quaternion.exp(record.increments - initial.bias * record.intervals[:, None])
...     attitude = [initial.attitude]
...     for turn in turns:
...         attitude.append(quaternion.normalize(quaternion.multiply(attitude[-1], turn)))
...     P = np.repeat(initial.covariance[None, :3, :3], len(attitude), axis=0)
...     return Estimate.from_arrays(record.time, attitude, P)
"""

from __future__ import annotations

import copy
import functools
import hashlib
import inspect
import json
import os
import sys
import traceback
import types
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from strapdown.checks import OF_YOUR_OWN, Array, Hint, InputError, array, increasing, instance
from strapdown.estimation.states import State
from strapdown.files import reading
from strapdown.records import Estimate, ImuRecord

DEFAULT_NAME = "estimator"
"""Default name of the filter in a Python file."""


class OwnFilter(Protocol):
    """Interface of a user-defined filter; a function of the same two arguments may be given instead."""

    def run(self, record: ImuRecord, initial: State) -> Estimate:
        """Return the estimate at all or some of the record's edges.

        Parameters
        ----------
        record : ImuRecord
            Gyro increments, rad, and measurements, without the truth. Its σ are those of the setup.
        initial : State
            Attitude, gyro bias (rad/s) and covariance (6, 6) of their errors at the first edge. A filter that finds its own initial state
            may ignore it.

        Returns
        -------
        Estimate
            Estimate, for example from :meth:`strapdown.records.Estimate.from_arrays`.
        """


@dataclass(frozen=True, eq=False)
class Own:
    """A user-defined filter with its description, from :func:`as_own`. Filters with the same description are equal.

    Each call works on a deep copy of an object, so that runs share no state and can proceed in several threads, in any order.

    Parameters
    ----------
    definition : callable, object with a method ``run``, or mapping
        Function or object, or the description of one that was read from a file, which cannot run.
    source : mapping, default empty
        For a filter read from a Python file: that file and its SHA-256, for the description.
    """

    definition: Any
    source: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the filter can be called."""
        if not isinstance(self.definition, Mapping):
            _function(self.definition)

    @property
    def name(self) -> str:
        """Attribute ``name`` of the filter if it has one, otherwise the name of the function or class."""
        return str(self.table["name"])

    @functools.cached_property
    def table(self) -> dict[str, Any]:
        """Identity in files: name, parameters, and the SHA-256 of the source if available."""
        if isinstance(self.definition, Mapping):
            return dict(self.definition)
        inner, parameters = self.definition, {}
        while isinstance(inner, functools.partial):
            parameters.update({**{str(k): v for k, v in enumerate(inner.args)}, **inner.keywords})
            inner = inner.func
        code: Any = inner if isinstance(inner, types.FunctionType | types.BuiltinFunctionType | type) else type(inner)
        if isinstance(inner, types.MethodType):
            code, inner = inner.__func__, inner.__self__
        if code is not inner:
            names = [f.name for f in fields(inner)] if is_dataclass(inner) else list(getattr(inner, "__dict__", {}))
            parameters.update({name: getattr(inner, name) for name in names})
        name = getattr(inner, "name", None)
        table: dict[str, Any] = {
            "name": name if isinstance(name, str) else getattr(code, "__name__", type(code).__name__)
        }
        plain = {key: _plain(value) for key, value in sorted(parameters.items()) if key != "name"}
        if plain:
            table["parameters"] = plain
        if self.source:
            return table | dict(self.source)
        try:
            table["source_sha256"] = hashlib.sha256(inspect.getsource(code).encode()).hexdigest()
        except (OSError, TypeError):  # interactive or compiled code
            table["module"] = str(getattr(code, "__module__", ""))
        return table

    def __eq__(self, other: object) -> bool:
        """Compare descriptions."""
        return isinstance(other, Own) and self.table == other.table

    def __hash__(self) -> int:
        """Return a hash of the description."""
        return hash(json.dumps(self.table, sort_keys=True, default=str))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the filter; its description is recomputed."""
        return Own, (self.definition, self.source)

    def __call__(self, record: ImuRecord, initial: State, *, times: Array | None = None) -> Estimate:
        """Run the filter over a record without its truth, and check the result; if ``times`` of edges are given, return only those."""
        if isinstance(self.definition, Mapping):
            file = self.table.get("file")
            again = Hint("estimator", file) if file else "replace(plan.setup, estimator=…)"
            raise InputError(
                f"{self.name} is a filter of your own, whose code is not in the result file; give it again, {again}"
            )
        function = _function(_copied(self.definition, self.name))
        try:
            estimate = function(replace(record, truth=None), initial)
        except Exception as error:
            error.add_note(f"{self.name}, {OF_YOUR_OWN}, failed")
            raise
        return _checked(self.name, estimate, record, times)


def as_own(filter_: Any) -> Own:
    """Return a user-defined filter, a function or an object with a method ``run`` (:class:`OwnFilter`), with its description."""
    return filter_ if isinstance(filter_, Own) else Own(filter_)


def read_filter(place: str | os.PathLike[str]) -> Own:
    """Return a user-defined filter from a Python file. The file is executed, with all that it imports.

    Parameters
    ----------
    place : path
        ``FILE.py:NAME``, or ``FILE.py`` for the name ``estimator``. During execution it can import modules of its folder.

    Returns
    -------
    Own
        Function or object of that name. The hash of the file is part of its description.

    Raises
    ------
    InputError
        If the file is missing or fails, or has no filter of that name.

    Examples
    --------
    >>> from strapdown.estimation.filters.own import read_filter
    >>> mine = read_filter("mine.py:textbook")  # doctest: +SKIP
    """
    file, _, name = str(place).rpartition(":") if not str(place).endswith(".py") else (str(place), "", DEFAULT_NAME)
    path = Path(file).resolve()
    if not file.endswith(".py") or not path.is_file():
        raise InputError(
            f"{file or place}: there is no such Python file; give FILE.py:NAME, or FILE.py for {DEFAULT_NAME}"
        )
    code = reading.content(path)
    module = types.ModuleType(path.stem)
    module.__file__ = str(path)
    # Registered under its name only during execution, as dataclasses need; so it is pickled to other processes by value.
    before = sys.modules.get(path.stem)
    sys.modules[path.stem] = module
    sys.path.insert(0, str(path.parent))
    try:
        exec(compile(code, str(path), "exec"), module.__dict__)
    except Exception as error:
        line = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)][-1:]
        at = f", line {line[0]}" if line else ""
        raise InputError(f"{file}{at} fails when it is executed: {type(error).__name__}: {error}") from error
    finally:
        sys.path.remove(str(path.parent))
        if before is None:
            sys.modules.pop(path.stem, None)
        else:
            sys.modules[path.stem] = before
    if name not in module.__dict__:
        raise InputError(f"{file} defines no {name}; give the name of the filter, {file}:NAME")
    return Own(
        getattr(module, name), {"file": f"{path.name}:{name}", "source_sha256": hashlib.sha256(code).hexdigest()}
    )


def _function(estimator: Any) -> Any:
    """Return the function to call: the method ``run`` of an object that has one, else the object itself."""
    if isinstance(estimator, type):
        raise InputError(f"{estimator.__name__} is a class; give an object of it, {estimator.__name__}(…)")
    function = getattr(estimator, "run", estimator)
    if not callable(function):
        raise InputError(
            f"{estimator!r} is no filter; give a function of (record, initial) that returns an Estimate, or an object with such a "
            "method run"
        )
    try:
        inspect.signature(function).bind(None, None)
    except TypeError:
        raise InputError(
            f"{getattr(function, '__qualname__', estimator)} cannot be called with (record, initial); give it these two arguments"
        ) from None
    except ValueError:  # a compiled function without a signature
        pass
    return function


def _copied(estimator: Any, name: str) -> Any:
    try:
        return copy.deepcopy(estimator)  # functions are returned unchanged
    except Exception as error:
        raise InputError(
            f"{name} cannot be copied for each run ({error}); give a function that creates the parts that cannot be copied"
        ) from None


def _checked(name: str, estimate: Any, record: ImuRecord, times: Array | None) -> Estimate:
    """Return an estimate at the wanted times only; raise an error if it cannot be compared with the record's truth."""
    instance(f"result of {name}", estimate, Estimate, "return Estimate.from_arrays(record.time, attitude, covariance)")
    time = increasing(f"{name}: time", estimate.time)
    place = np.minimum(np.searchsorted(record.time, time), len(record.time) - 1)
    if not np.array_equal(record.time[place], time):
        k = int(np.argmax(record.time[place] != time))
        raise InputError(
            f"{name}: time[{k}] is {time[k]:.9g} s, where the record has no edge; return values at record.time"
        )
    step = np.median(np.diff(time)) if len(time) > 1 else 0.0
    most = 1.5 * max(step, record.intervals.max())  # one step: without the first or the last edge
    if record.time[-1] - time[-1] > most or time[0] - record.time[0] > most:
        raise InputError(
            f"{name} gives values from {time[0]:.9g} to {time[-1]:.9g} s, and the record goes from {record.time[0]:.9g} to "
            f"{record.time[-1]:.9g} s; return values over all of it, NaN after a failure"
        )
    for what, width in (("attitude", 4), ("bias", 3), ("variance", 6)):
        array(f"{name}: {what}", np.nan_to_num(getattr(estimate, what)), (len(time), width))
    if times is None:
        return estimate  # type: ignore[no-any-return]
    rows = np.minimum(np.searchsorted(time, times), len(time) - 1)
    if not np.array_equal(time[rows], times):
        k = int(np.argmax(time[rows] != times))
        raise InputError(f"{name} gives no value at {times[k]:.9g} s; return one at each of record.time")
    values = {what: getattr(estimate, what) for what in ("attitude", "bias", "variance", "covariance")}
    part = {what: value[rows] for what, value in values.items() if value is not None}
    return replace(estimate, time=time[rows], **part)  # type: ignore[no-any-return]


def _plain(value: Any) -> Any:
    """Return a parameter in a form for files: numbers and texts unchanged, anything else by its type."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    return getattr(value, "__qualname__", None) or ("none" if value is None else type(value).__qualname__)
