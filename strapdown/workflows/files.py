"""Reading and writing of records, recordings, estimates and Monte Carlos."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from strapdown import recordings, scenarios
from strapdown.checks import Hint, InputError, instance
from strapdown.estimation import setup as setups
from strapdown.estimation.setup import FilterSetup
from strapdown.files import HDF5, reading, write_text
from strapdown.recordings import Recording, recordfiles
from strapdown.records import Estimate, ImuRecord
from strapdown.scenarios import Scenario

if TYPE_CHECKING:
    from strapdown.montecarlo.campaign import Campaign

COLUMNS = ("columns", "data_vars", "__arrow_c_stream__")
"""Attributes of an object that holds columns."""


def read(
    path: Any,
    *,
    units: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
    topic: str = "",
    axes: str | Mapping[str, str] | None = None,
    invert: str | Iterable[str] = (),
) -> ImuRecord | Recording | Estimate | Campaign:
    """Read a file of any known format, identified by its content, or a table in memory.

    Parameters
    ----------
    path : path, DataFrame, Dataset or mapping
        A simulated record, an estimate or a Monte Carlo of this package, or a recording in a format of
        :data:`strapdown.recordings.FORMATS` (CSV, ROS bag, ULog, EuRoC folder, …); or the columns of a recording named as in a CSV file:
        of pandas, polars, pyarrow, xarray, a structured array, or arrays by name, of which arrays (n, 3) hold x, y and z.
    units : mapping of str to str, optional
        For tables: units of ``time``, ``gyro``, ``accelerometer`` and ``magnetometer`` if the header does not declare them.
    columns : mapping of str to str, optional
        For tables: names of columns by role, optionally with a unit, ``{"time": "timestamp [us]", "gx": "gyro_x[dps]"}``; the others
        are found by their names.
    topic : str, default ""
        For bags and flight logs: topic of the inertial unit, if there are several.
    axes : str or mapping of str to str, optional
        For recordings: the recorded axes that become the body's x, y, z, for example ``"x,-y,-z"`` for a unit whose z axis points down;
        or those of single sensors, ``{"magnetometer": "y,x,-z"}``.
    invert : str or iterable of str, default empty
        For recordings: sensors with inverted sign, ``"accelerometer"`` for one that reads −g upward at rest.

    Returns
    -------
    ImuRecord, Estimate, Campaign or Recording
        A record has its ``origin``; the ``remarks`` of a recording list the choices of the reader.

    Examples
    --------
    >>> import strapdown as sd
    >>> walk = sd.read("walk.csv", units={"gyro": "deg/s", "accelerometer": "g"})  # doctest: +SKIP
    """
    declared = {"units": units, "columns": columns, "topic": topic, "axes": axes, "invert": invert}
    options: dict[str, Any] = {name: value for name, value in declared.items() if value}
    if isinstance(path, (Mapping, np.ndarray)) or any(map(partial(hasattr, path), COLUMNS)):
        if topic:
            raise InputError(f"{Hint('topic')} is for a bag or a flight log; leave it out")
        table = recordings.from_table(path, units=units, columns=columns)
        return recordings.with_axes(table, axes, invert) if axes or invert else table
    instance("path", path, (str, os.PathLike), "give a path, a data frame, a Dataset, or arrays by name")
    file = Path(path)
    kinds = {recordfiles.KIND: "a record", "strapdown estimate": "an estimate", "strapdown montecarlo": "a Monte Carlo"}
    kind = kinds.get(reading.kind(file), "")
    if not kind:
        return recordings.read(file, **options)
    for name, value in options.items():
        raise InputError(f"{file} is {kind} of this package and declares its own layout; leave {Hint(name, value)} out")
    if kind == "a record":
        return recordfiles.read_record(file)
    if kind == "an estimate":
        return setups.read_estimate(file)
    from strapdown.montecarlo import campaign

    return campaign.read(file)


def write(
    content: ImuRecord | Recording | Estimate | Scenario | FilterSetup, path: str | os.PathLike[str], **options: Any
) -> Path:
    """Write a record, recording, estimate, scenario or filter setup to a file, atomically.

    Parameters
    ----------
    content : ImuRecord, Recording, Estimate, Scenario or FilterSetup
        The file of a record contains its origin; a scenario that includes your own Python functions or classes is omitted.
    path : path
        The suffix selects the format: ``.h5`` holds a record or an estimate completely, with its filter, origin and truth, ``.toml`` a
        scenario (read by :func:`strapdown.scenarios.load_scenario`) or a filter setup (:func:`strapdown.estimation.setup.read_setup`);
        :data:`strapdown.recordings.FORMATS` lists the others for recordings and estimates.
    **options
        Options of the format: for an estimate as a table ``sequence`` and ``frame`` (:meth:`strapdown.records.Estimate.table`), and
        ``recording``, from which it was made, whose samples a ROS bag needs.

    Returns
    -------
    Path
        The file.

    Examples
    --------
    >>> import strapdown as sd
    >>> sd.write(estimate, "walk-angles.csv", sequence="ZYX")  # doctest: +SKIP
    """
    kinds = (ImuRecord, Recording, Estimate, Scenario, FilterSetup)
    instance("content", content, kinds, "give one of these")
    if isinstance(content, (Scenario, FilterSetup)):
        if Path(path).suffix.lower() != ".toml" or options:
            raise InputError(
                f"{path}: a {type(content).__name__} is written as TOML without options; name a file *.toml"
            )
        text = setups.to_toml(content) if isinstance(content, FilterSetup) else scenarios.scenario_to_toml(content)
        write_text(path, text)
    elif isinstance(content, (ImuRecord, Estimate)) and Path(path).suffix.lower() in HDF5:
        save: Callable[..., None] = setups.write_estimate if isinstance(content, Estimate) else recordfiles.write_record
        save(path, content, **options)
    else:
        endings = recordings.writers("write_estimate" if isinstance(content, Estimate) else "write")
        if not isinstance(content, Recording) and Path(path).suffix.lower() not in endings:
            raise InputError(f"{path} must end in one of {', '.join((*HDF5, *endings))}")
        recordings.write(content, path, **options)
    return Path(path)
