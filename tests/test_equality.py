"""Every dataclass of the package can be compared, looked for in a tuple and hashed, whatever its fields hold."""

import collections.abc
import dataclasses
import importlib
import pkgutil
import types
import typing
from collections.abc import Iterator
from typing import Any

import numpy as np

import strapdown
from strapdown import estimation, gyro, motion, scenarios, tuning, vectors
from strapdown.estimation import setup
from strapdown.motion.orbit import CircularOrbit
from strapdown.results import equal
from strapdown.tuning.diagnosis import Cause

FOR_CHECKERS = {
    "CircularOrbit": CircularOrbit,
    "GyroSpec": gyro.GyroSpec,
    "Scenario": scenarios.Scenario,
    "TunedGate": tuning.TunedGate,
    "Comparison": tuning.Comparison,
    "Unmodelled": tuning.Unmodelled,
}
"""Types that a module imports for type checkers alone: they stand above it."""


def dataclasses_of_the_package() -> Iterator[type]:
    for module in pkgutil.walk_packages(strapdown.__path__, "strapdown."):
        content = vars(importlib.import_module(module.name))
        yield from (
            one
            for one in content.values()
            if isinstance(one, type) and dataclasses.is_dataclass(one) and one.__module__ == module.name
        )


def dummy(hint: Any, above: tuple[type, ...] = ()) -> Any:  # noqa: PLR0911
    """A value of a type; of several alternatives the one that is hardest to compare."""
    origin, arguments = typing.get_origin(hint) or hint, typing.get_args(hint)
    if origin is np.ndarray or hint is Any:
        return np.arange(3.0)
    if origin in (types.UnionType, typing.Union):
        made = [dummy(one, above) for one in arguments if one is not type(None)]
        return next((one for one in made if isinstance(one, np.ndarray | dict | list)), made[0])
    if origin is tuple:
        return tuple(dummy(one, above) for one in arguments if one is not Ellipsis)
    if origin in (dict, collections.abc.Mapping):
        return {"key": dummy(arguments[1], above)}
    if origin is collections.abc.Sequence:  # all make a tuple of it
        return (dummy(arguments[0], above),)
    if origin is list:
        return [dummy(arguments[0], above)]
    if dataclasses.is_dataclass(origin):
        return "a tree ends" if origin in above else filled(origin, above)
    return 1.0 if origin in (int, float) else "text"


def filled(kind: type, above: tuple[type, ...] = ()) -> Any:
    """An instance whose fields hold values of their types, unchecked."""
    made = object.__new__(kind)
    hints = typing.get_type_hints(kind, localns=FOR_CHECKERS)
    for field in dataclasses.fields(kind):
        object.__setattr__(made, field.name, dummy(hints[field.name], (*above, kind)))
    return made


def test_any_two_can_be_compared_and_hashed():
    for kind in dataclasses_of_the_package():
        one, other = filled(kind), filled(kind)
        assert one in (one,), kind
        equal = one == other
        assert isinstance(equal, bool), kind
        assert (one in (other,)) is equal, kind
        if kind.__dataclass_params__.frozen:
            assert hash(one) == hash(one), kind
            assert not equal or hash(one) == hash(other), kind


def test_specifications_are_compared_by_value():
    """They are written to files and read back, so two of the same numbers are the same."""

    def scenario(bias: float = 1e-3) -> scenarios.Scenario:
        return scenarios.Scenario(
            motion=motion.TorqueFree(inertia=(1.0, 1.5, 2.0), initial_rate=np.array([0.1, 0.2, 0.3])),
            gyro=gyro.GyroSpec(turn_on_bias=np.array([bias, 0.0, -0.0])),
            sensors=(
                vectors.VectorSensor(name="star", reference_f=np.array([0.0, 3.0, 4.0]), sigma=1e-3, rate=1.0),
                vectors.Magnetometer(name="field", field_f=np.array([2e-5, 0.0, 0.0]), sigma=1e-7, rate=1.0),
                vectors.Accelerometer(name="vertical", sigma=0.1, rate=1.0),
                vectors.HeadingPair(name="line", baseline_b=np.array([1.0, 0.0, 0.0]), sigma=1e-2, rate=1.0),
            ),
            rate=10.0,
            duration=10.0,
        )

    assert scenario() == scenario()
    assert hash(scenario()) == hash(scenario())
    assert scenario() != scenario(2e-3)
    assert len({scenario(), scenario(), scenario(2e-3)}) == 2
    noise = estimation.ProcessNoise(angle_random_walk=1e-4, rate_random_walk=0.0)
    chosen = setup.FilterSetup(process_noise=noise, bias_sigma=1e-3, sigma={"star": (1e-3, 1e-3, 2e-3)})
    assert chosen == dataclasses.replace(chosen)
    assert hash(chosen) == hash(dataclasses.replace(chosen))
    assert chosen != dataclasses.replace(chosen, sigma={"star": 1e-3})


def test_methods_are_equal_if_function_and_object_are():
    """A magnetometer whose field is that of an orbit is written to a file and read back."""
    field, same, other = (CircularOrbit(altitude=h).magnetic_field for h in (5e5, 5e5, 6e5))
    assert equal(field, same)
    assert not equal(field, other)
    assert not equal(field, CircularOrbit(altitude=5e5).position)


def test_results_are_compared_by_identity():
    """Two causes with the same estimate are two causes; the one that is listed is found."""

    def cause() -> Cause:
        return Cause(
            name="R",
            of="star",
            estimate=np.zeros(3),
            standard_error=np.ones(3),
            unit="",
            gain=1.0,
            log_p=-1.0,
            words="",
        )

    one, other = cause(), cause()
    assert one in (other, one)
    assert one not in (other,)
