"""Export of a filter as source code for a microcontroller (C99) or a web page (JavaScript).

- ``design``: The setup and its sensors as a program; refusals.
- ``program``: The filter sample by sample, with checks, flags and a gate, around the formulas of the kernels.
- ``recording``: That of an IMU, around the functions of :mod:`strapdown.kernels.live_imu`.
- ``symbols``: Operations, recorded.
- ``interpreted``: These functions and the kernels, executed on symbols.
- ``functions``: A function of the target: statements, branches, calls.
- ``regions``: The block to which each operation belongs.
- ``target``: All functions of a filter, traced.
- ``writer``: A function as text.
- ``c``, ``javascript``: The files.

The formulas are those of :mod:`strapdown.kernels.filter`, executed on symbols instead of numbers. So the exported filter in double
precision gives the same bits as these formulas in Python, if the compiler does not contract products and sums.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import strapdown
from strapdown.ahrs import LiveAhrs
from strapdown.ahrs.parameters import MOTIONS, of_motion
from strapdown.checks import Hint, InputError, instance, one_of, positive
from strapdown.codegen import c, design, javascript
from strapdown.codegen.target import traced
from strapdown.estimation.setup import FilterSetup, read_setup, to_toml
from strapdown.files import usable_folder, writable, write_text
from strapdown.kernels.recording_samples import AGAIN, RANGE
from strapdown.records import ImuRecord
from strapdown.records.recording import LARGEST_FORCE
from strapdown.vectors import VectorMeasurements, VectorSensor

if TYPE_CHECKING:
    from strapdown.scenarios import Scenario

__all__ = ["export"]

Sensors = ImuRecord | Sequence[VectorSensor | VectorMeasurements]


def export(
    setup: FilterSetup | LiveAhrs | str | os.PathLike[str],
    sensors: Sensors | Scenario | None = None,
    *,
    folder: str | os.PathLike[str],
    rate: float | None = None,
    magnetometer: bool = False,
    to: Literal["c", "js"] = "c",
    precision: Literal["double", "single"] = "double",
) -> tuple[Path, ...]:
    """Write a filter as source code that needs nothing else: C99 for a microcontroller, or JavaScript.

    The filter predicts with each gyro sample and updates with each measurement, as :class:`strapdown.LiveFilter`; or it takes the samples
    of an IMU as :class:`strapdown.LiveAhrs`. In C it has no heap and no global variables, and needs only ``sqrt`` (with states that decay,
    ``expm1`` too; that of an IMU, functions of angles and ``exp``).

    Parameters
    ----------
    setup : FilterSetup, LiveAhrs, path or str
        Noise of the gyro, initial σ, σ of sensors, error states, gate without its recovery; or a TOML file of them. Or a motion of
        :data:`strapdown.ahrs.MOTIONS` (``"hand"``, …): the filter of :func:`strapdown.estimate` for an IMU; with other parameters, a
        ``LiveAhrs``, whose samples are left out.
    sensors : ImuRecord, Scenario or sequence of VectorSensor or VectorMeasurements, optional
        Sensors of the filter: their names, kinds, references and σ. Of a record or scenario all are exported. An IMU has its own.
    folder : path
        Folder of the files: ``strapdown_filter.h`` and ``.c``, ``main.c`` (an example) and ``CMakeLists.txt``; or
        ``strapdown_filter.mjs``. Files of these names are replaced.
    rate : float, optional
        Sample rate of the IMU, Hz, with a motion.
    magnetometer : bool, default False
        Whether the IMU has a magnetometer, with a motion.
    to : {"c", "js"}, default "c"
        Language.
    precision : {"double", "single"}, default "double"
        Precision of all numbers; JavaScript has only double.

    Returns
    -------
    tuple of Path
        The files.

    Raises
    ------
    InputError
        If an argument is invalid, or the setup has what the exported filter has not: another estimator than the mekf, robust updates,
        an integration algorithm of several samples, temperature, lever arms, noise that varies.

    Examples
    --------
    >>> import strapdown as sd
    >>> noise = sd.ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-6)
    >>> up = sd.VectorSensor(name="accelerometer", reference_f=[0.0, 0.0, 1.0], sigma=0.02, rate=100.0)
    >>> setup = sd.FilterSetup(process_noise=noise, bias_sigma=1e-3)
    >>> sd.export(setup, [up], folder="firmware", precision="single")  # doctest: +SKIP
    >>> sd.export("hand", rate=100.0, magnetometer=True, folder="firmware", precision="single")  # doctest: +SKIP
    """
    instance("setup", setup, (FilterSetup, LiveAhrs, str, os.PathLike), "give one of these")
    one_of("to", to, ("c", "js"))
    one_of("precision", precision, ("double", "single"))
    if to == "js" and precision == "single":
        raise InputError("precision is 'single', but numbers in JavaScript are double; use 'double'")
    if isinstance(setup, str) and setup in MOTIONS:
        setup = _of_motion(setup, rate, magnetometer=magnetometer)
    elif rate is not None or magnetometer:
        raise InputError(f"give {Hint('rate')} and {Hint('magnetometer')} only with a motion: {', '.join(MOTIONS)}")
    elif not isinstance(setup, FilterSetup | LiveAhrs):
        setup = read_setup(setup)
    usable_folder("folder", folder)
    single = precision == "single"
    if isinstance(setup, LiveAhrs):
        if sensors is not None:
            raise InputError("sensors are given, but the filter of an IMU has its own; leave them out")
        program = design.program_of_live(setup, single=single)
    else:
        if setup.gate is not None:  # recovery would run a second filter beside the first
            setup = replace(setup, gate=replace(setup.gate, recovery=None))
        program = design.program_of(setup, _sensors_of(sensors), single=single)
    source = program, traced(program), _origin(setup, precision)
    texts = c.files(*source, single=single) if to == "c" else javascript.files(*source)
    paths = [Path(folder) / name for name in texts]
    writable("folder", *paths)
    for path, text in zip(paths, texts.values(), strict=True):
        write_text(path, text)
    return tuple(paths)


def _of_motion(motion: str, rate: float | None, *, magnetometer: bool) -> LiveAhrs:
    """Return the filter of an IMU for a motion."""
    if rate is None:
        raise InputError(f"rate is missing: the filter of an IMU ({motion}) needs the sample rate, such as 100 Hz")
    interval = 1.0 / positive("rate", rate, unit="Hz")
    instance("magnetometer", magnetometer, bool, "give True or False")
    return LiveAhrs(
        interval=interval, magnetometer=magnetometer, parameters=of_motion(motion, magnetometer=magnetometer)
    )


def _sensors_of(sensors: Sensors | Scenario | None) -> Sequence[VectorSensor | VectorMeasurements]:
    """Return the sensors of a record, of a scenario, or those given."""
    if sensors is None:
        return ()
    if isinstance(sensors, ImuRecord):
        return sensors.vectors
    if isinstance(sensors, Sequence):
        return sensors
    from strapdown.scenarios import Scenario, simulate

    if isinstance(sensors, Scenario):
        return simulate(sensors).vectors
    remedy = "give a record, a scenario or a sequence of sensors; for an IMU, a motion as the setup"
    raise InputError(f"sensors is {type(sensors).__name__}; {remedy}")


def _origin(setup: FilterSetup | LiveAhrs, precision: str) -> str:
    """Return the comment at the top of the files: version, conventions, setup."""
    prose = [
        f"Attitude filter exported by strapdown {strapdown.__version__}, {precision} precision. Do not edit: export again.",
        "",
        "Multiplicative extended Kalman filter of attitude and gyro bias. Quaternions are Hamilton's, scalar first; q_fb takes vectors "
        "from body axes to fixed axes, v_f = q_fb v_b q_fb*. Errors are those of the body side: q_true = q exp(error). SI units and "
        "radians. One filter is one struct; nothing is allocated, and nothing is global. An invalid sample sets a flag and leaves the "
        "filter as it was.",
        "",
    ]
    if isinstance(setup, FilterSetup):
        return "\n".join((*prose, c.SETUP, to_toml(setup).strip(), ""))
    field = "with" if setup.magnetometer else "without"
    prose += [
        f"For an IMU {field} a magnetometer and samples every {setup.interval:g} s, as strapdown.LiveAhrs. Fixed axes: East, (magnetic) "
        "North, up; without a magnetometer the first heading is arbitrary. Times are double in single precision too. A gap of up to an "
        "hour is bridged. Samples that come more than four times as fast as these are not used, nor those of a specific force above "
        f"{LARGEST_FORCE:g} m/s^2, nor some of more than {RANGE:g} m/s^2 on an axis unless they come again within {AGAIN:g} s.",
        "",
    ]
    return "\n".join(
        (*prose, c.SETUP, *(f"{name} = {value!r}" for name, value in asdict(setup.parameters).items()), "")
    )
