"""The reference: every public name is documented as numpydoc wants it, and every example in it runs."""

import ast
import doctest
import functools
import importlib
import inspect
import pkgutil
import re
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import strapdown

pytest.importorskip("numpydoc", reason="needs numpydoc: pip install '.[test]'")
from numpydoc.docscrape import NumpyDocString, get_doc_object
from numpydoc.validate import ERROR_MSGS, Validator, validate

CHECKS = {
    *("GL06", "GL07", "GL08"),  # sections known and in order, docstring present
    *("SS01", "SS03", "SS06"),  # a summary of one line that ends with a period
    *("PR01", "PR02", "PR03"),  # parameters: those of the signature, in order
    *("PR04", "PR07", "PR10"),  # each with type and description
    *("RT01", "RT03", "YD01"),  # what is returned, described
}

UNITS = {
    **dict.fromkeys(("duration", "edges", "sample_interval", "taus"), "s"),
    **dict.fromkeys(("angle", "increments", "rotation_vector"), "rad"),
    **{"altitude": "m", "frequency": "Hz", "specific_force": "m/s²", "temperature": "(°C|K)"},
    **{"angle_random_walk": "rad/√s", "rate_random_walk": "rad/s/√s"},
}
"""Units that the parameters of these names have everywhere, and their descriptions name."""

PROTOCOLS = ("strapdown.motion.Motion", "strapdown.vectors.Sensor", "strapdown.results.Listed")
"""What documents its methods for all classes that have them; there a line is enough."""


def _modules() -> list[str]:
    """Return the package, its public submodules, and what below them says what is public."""
    names = [module.name for module in pkgutil.walk_packages(strapdown.__path__, "strapdown.")]
    shown = [name for name in names if name.split(".")[1] in strapdown.__all__]
    return ["strapdown", *(name for name in shown if hasattr(importlib.import_module(name), "__all__"))]


def _public(module: str) -> dict[str, Any]:
    """Return the names in ``__all__`` of a module and what they are."""
    loaded = importlib.import_module(module)
    return {name: getattr(loaded, name) for name in loaded.__all__}


def _callables(module: str) -> Iterator[tuple[str, Any]]:
    """Yield the public functions and classes of a module, and the public methods and properties of the classes, by full name."""
    for name, value in _public(module).items():
        if not (inspect.isfunction(value) or inspect.isclass(value)):
            continue
        owner = value.__module__.split(".")[1]
        if module == "strapdown" and owner in strapdown.__all__ and name in _public(f"strapdown.{owner}"):
            continue  # its own module documents it
        full = f"{module}.{name}"
        yield full, value
        if inspect.isclass(value) and value.__module__.startswith("strapdown"):
            for own, member in vars(value).items():
                if not own.startswith("_") and (
                    inspect.isfunction(member) or isinstance(member, property | classmethod | staticmethod)
                ):
                    yield f"{full}.{own}", getattr(value, own)


class _Reference(Validator):  # type: ignore[misc]
    """numpydoc's validator; what a class holds may stand under Attributes, and a protocol is not constructed."""

    def __init__(self, obj_name: str) -> None:
        super().__init__(get_doc_object(Validator._load_obj(obj_name)))

    @property
    def is_function_or_method(self) -> bool:
        return inspect.isroutine(self.obj)  # class methods too

    @functools.cached_property
    def doc_all_parameters(self) -> Any:
        if getattr(self.obj, "_is_protocol", False):
            return {}
        own = {parameter.name: (parameter.type, parameter.desc) for parameter in self._attributes}
        return super().doc_all_parameters | {name: text for names, text in own.items() for name in names.split(", ")}

    @property
    def _attributes(self) -> Any:
        """Return what the docstring itself lists as attributes; numpydoc adds the properties of a class."""
        return NumpyDocString(inspect.getdoc(self.obj))["Attributes"] if inspect.isclass(self.obj) else []

    @property
    def signature_parameters(self) -> Any:
        if inspect.isclass(self.obj) and (issubclass(self.obj, Exception) or getattr(self.obj, "_is_protocol", False)):
            return ()
        return super().signature_parameters


def _in_protocol(name: str) -> bool:
    """Return whether a method is one that a protocol documents for its class."""
    owner, _, method = name.rpartition(".")
    if owner in PROTOCOLS:
        return False
    cls = Validator._load_obj(owner)
    return any(
        inspect.isclass(cls) and hasattr(protocol, method) and all(hasattr(cls, own) for own in _members(protocol))
        for protocol in map(Validator._load_obj, PROTOCOLS)
    )


def _members(protocol: Any) -> list[str]:
    return [name for name in vars(protocol) if not name.startswith("_") and inspect.isfunction(vars(protocol)[name])]


def _faults(name: str) -> list[str]:
    """Return what is missing in the documentation of one name."""
    checks = {"GL08", "SS01", "SS03", "SS06"} if _in_protocol(name) else CHECKS
    parsed = functools.cache(_Reference)
    validation = validate(name, parsed)
    faults = [f"{code} {message}" for code, message in validation["errors"] if code in checks]
    if "GL08" not in " ".join(faults):
        for parameter, (kind, text) in parsed(obj_name=name).doc_all_parameters.items():
            unit = UNITS.get(parameter)
            if unit and not re.search(rf"(?<![\w/²√]){unit}(?![\w/²√])", f"{kind} {' '.join(text)}"):
                faults.append(f"the description of {parameter} does not name its unit, {unit}")
    return [f"{name}: {fault}" for fault in faults]


def _undocumented(module: str) -> list[str]:
    """Return what is missing in the documentation of a module."""
    return [fault for name, _ in _callables(module) for fault in _faults(name)]


def test_the_checks_are_those_of_numpydoc() -> None:
    assert set(ERROR_MSGS) >= CHECKS


@pytest.mark.parametrize("module", list(_modules()))
def test_every_public_name_is_documented(module: str) -> None:
    faults = _undocumented(module)
    assert not faults, "\n".join(faults)


def _stated(kind: str) -> Any:
    """Return the default in the type of a documented parameter, if it is a literal."""
    stated = re.search(r"default (.+)$", kind)
    try:
        return ast.literal_eval(stated.group(1)) if stated else inspect.Parameter.empty
    except (SyntaxError, ValueError):  # words, or a value with its unit
        return inspect.Parameter.empty


@pytest.mark.parametrize("module", list(_modules()))
def test_documented_defaults_are_those_of_the_signature(module: str) -> None:
    wrong = []
    for name, value in _callables(module):
        if not callable(value) or _in_protocol(name) or (inspect.isclass(value) and issubclass(value, Exception)):
            continue
        parameters = inspect.signature(value).parameters
        for names, (kind, _) in _Reference(name).doc_all_parameters.items():
            default = parameters[names].default if names in parameters else inspect.Parameter.empty
            stated = _stated(kind)
            several = isinstance(stated, tuple) and not isinstance(default, tuple)  # of parameters documented together
            if inspect.Parameter.empty in (stated, default) or several or default == "":  # "": a name that is derived
                continue
            if isinstance(default, float | int | str | tuple | types.NoneType) and default != stated:
                wrong.append(f"{name}: {names} is {default!r} by default, and documented as {stated!r}")
    assert not wrong, "\n".join(wrong)


def _with_examples() -> list[str]:
    root = Path(strapdown.__file__).parent
    files = sorted(file for file in root.rglob("*.py") if ">>> " in file.read_text(encoding="utf-8"))
    return [
        ".".join(("strapdown", *file.relative_to(root).with_suffix("").parts)).removesuffix(".__init__")
        for file in files
    ]


@pytest.mark.parametrize("module", _with_examples())
def test_the_examples_run(module: str) -> None:
    with np.printoptions(precision=6, suppress=True):
        failed, _ = doctest.testmod(importlib.import_module(module), optionflags=doctest.ELLIPSIS)
    assert failed == 0
