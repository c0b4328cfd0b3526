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
from strapdown.estimation import error_states, setup
from strapdown.motion.orbit import CircularOrbit
from strapdown.results import equal

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
            value
            for value in content.values()
            if isinstance(value, type) and dataclasses.is_dataclass(value) and value.__module__ == module.name
        )


def dummy(hint: Any, above: tuple[type, ...] = ()) -> Any:  # noqa: PLR0911
    """A value of a type; of several alternatives the one that is hardest to compare."""
    origin, arguments = typing.get_origin(hint) or hint, typing.get_args(hint)
    if origin is np.ndarray or hint is Any:
        return np.arange(3.0)
    if origin in (types.UnionType, typing.Union):
        dummies = [dummy(argument, above) for argument in arguments if argument is not type(None)]
        return next((value for value in dummies if isinstance(value, np.ndarray | dict | list)), dummies[0])
    if origin is tuple:
        return tuple(dummy(argument, above) for argument in arguments if argument is not Ellipsis)
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
    instance = object.__new__(kind)
    hints = typing.get_type_hints(kind, localns=FOR_CHECKERS)
    for field in dataclasses.fields(kind):
        object.__setattr__(instance, field.name, dummy(hints[field.name], (*above, kind)))
    return instance


def test_any_two_can_be_compared_and_hashed():
    for kind in dataclasses_of_the_package():
        instance, other = filled(kind), filled(kind)
        assert instance in (instance,), kind
        equal = instance == other
        assert isinstance(equal, bool), kind
        assert (instance in (other,)) is equal, kind
        if kind.__dataclass_params__.frozen:
            assert hash(instance) == hash(instance), kind
            assert not equal or hash(instance) == hash(other), kind


def test_what_a_package_offers_cannot_be_changed():
    for kind in dataclasses_of_the_package():
        package = importlib.import_module(kind.__module__.rpartition(".")[0])
        if getattr(package, kind.__name__, None) is kind:
            assert kind.__dataclass_params__.frozen, kind


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
    filter_setup = setup.FilterSetup(process_noise=noise, bias_sigma=1e-3, sigma={"star": (1e-3, 1e-3, 2e-3)})
    assert filter_setup == dataclasses.replace(filter_setup)
    assert hash(filter_setup) == hash(dataclasses.replace(filter_setup))
    assert filter_setup != dataclasses.replace(filter_setup, sigma={"star": 1e-3})


def test_a_record_is_equal_to_its_file_and_its_parts_print_in_a_line(tmp_path):
    time = np.arange(8.0)
    attitudes = motion.ConstantRate(rate=np.array([0.0, 0.1, 0.0])).attitude(time)
    star = vectors.VectorSensor(name="star", reference_f=np.array([0.0, 0.0, 1.0]), sigma=1e-3, rate=10.0)
    scenario = scenarios.Scenario(
        motion=motion.SampledAttitude(time=time, attitudes=attitudes),
        gyro=gyro.GyroSpec(angle_random_walk=1e-4),
        sensors=(star,),
        rate=10.0,
        duration=5.0,
    )
    record = scenarios.simulate(scenario)
    assert strapdown.read(strapdown.write(record, tmp_path / "record.h5")) == record
    assert record != dataclasses.replace(record, increments=record.increments + 1e-9)
    assert repr(scenario) == (
        "Scenario(motion=SampledAttitude(time=array([0., 1., 2., 3., 4., 5., 6., 7.]), attitudes=<array (8, 4)>), "
        "gyro=GyroSpec(angle_random_walk=0.0001), sensors=(VectorSensor(name='star', rate=10.0, "
        "reference_f=array([0., 0., 1.]), sigma=0.001),), rate=10.0, duration=5.0)"
    )
    assert repr(type("Own", (error_states.ErrorStates,), {})()) == "Own()"  # no dataclass
    assert repr(record.vectors[0]).endswith("time=<array (50,)>, vector_b=<array (50, 3)>, sigma=<array (50,)>)")


def test_methods_are_equal_if_function_and_object_are():
    """A magnetometer whose field is that of an orbit is written to a file and read back."""
    field, same, other = (CircularOrbit(altitude=h).magnetic_field for h in (5e5, 5e5, 6e5))
    assert equal(field, same)
    assert not equal(field, other)
    assert not equal(field, CircularOrbit(altitude=5e5).position)
