"""Attitudes over time from files of any filter or reference, with their covariance if the file gives it; for judging filters.

``read_attitudes`` recognises formats by content:

- results of this package (HDF5): estimate, simulated record (its truth);
- the reference of a recording (BROAD, EuRoC folder, Parquet), TUM trajectories (no covariance) and EuRoC's ground truth;
- CSV, TSV and Parquet with the columns of :data:`COLUMNS`, such as `strapdown convert estimate.h5 estimate.csv` writes;
- ROS bags: ``sensor_msgs/Imu`` (orientation), ``nav_msgs/Odometry``, ``geometry_msgs/PoseWithCovarianceStamped``, ``PoseStamped``,
  ``QuaternionStamped``;
- flight logs of PX4 (ULog): ``estimator_states`` with ``estimator_innovations``, or ``vehicle_attitude``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from strapdown import quaternion
from strapdown.checks import Array, Hint, InputError, are_finite, array, order_remedy
from strapdown.files import reading
from strapdown.recordings import columns as naming
from strapdown.recordings import dataframes, delimited, formats, recordfiles, ros, trajectories, ulog
from strapdown.records import Innovations, Origin, outputs, result_files
from strapdown.records.estimate import STATES
from strapdown.records.recording import TIME_UNITS, whole_ns
from strapdown.units import DEGREE, DEGREE_PER_HOUR


@dataclass(frozen=True, kw_only=True, eq=False)
class Attitudes:
    """Attitudes of a file or of another program, in its own clock and frames.

    Parameters
    ----------
    source : str
        Name of the file.
    stamps_ns : ndarray (m,) of int
        Time stamps, ns of the file's clock, increasing.
    attitude : ndarray (m, 4)
        q_fb, scalar first.
    covariance : ndarray (m, 3, 3) or (m, 6, 6), optional
        Covariance of the attitude error, rad², or including the bias.
    error_frame : str, default ""
        Error described by the covariance (:data:`strapdown.consistency.foreign.ERROR_FRAMES`), if the format defines it.
    bias : ndarray (m, 3), optional
        Gyro bias, rad/s, body axes.
    innovations : mapping of str to Innovations, default empty
        Innovations by sensor; times in s since the first stamp.
    movement : ndarray (m,) of bool, optional
        Whether the unit moved, if the file states it.
    motion : str, default ""
        Model of the motion, if the attitudes are an estimate of this package for a recording: its σ are then upper bounds
        (:class:`strapdown.records.Estimate`); a table states only that they are.
    origin : Origin, optional
        Origin of an estimate of this package, with what is specified of gyro and sensors.
    filter : str, default ""
        The filter of such an estimate, as TOML.
    remarks : tuple of str, default empty
        Choices of the reader.
    """

    source: str
    stamps_ns: NDArray[np.int64]
    attitude: Array
    covariance: Array | None = None
    error_frame: str = ""
    bias: Array | None = None
    innovations: Mapping[str, Innovations] = field(default_factory=dict)
    movement: NDArray[np.bool_] | None = None
    motion: str = ""
    origin: Origin | None = None
    filter: str = ""
    remarks: tuple[str, ...] = ()

    @classmethod
    def from_arrays(cls, time: ArrayLike, attitude: ArrayLike, *, source: str = "arrays", **fields: Any) -> Attitudes:
        """Return attitudes at times in seconds.

        Parameters
        ----------
        time : array_like (m,)
            Times, s, increasing.
        attitude : array_like (m, 4)
            q_fb, scalar first.
        source : str, default "arrays"
            Name in messages.
        **fields
            Other fields of this class; all are checked where they are used.

        Returns
        -------
        Attitudes
            Their stamps are rounded to nanoseconds.
        """
        stamps = whole_ns(array("time", time, ("m",)))
        return cls(source=source, stamps_ns=stamps, attitude=attitude, **fields)  # type: ignore[arg-type]

    @property
    def extent(self) -> str:
        """Number of attitudes and their time span, in words."""
        return f"{len(self.stamps_ns)} attitudes over {(self.stamps_ns[-1] - self.stamps_ns[0]) / 1e9:.6g} s"

    def seconds(self, origin_ns: int) -> Array:
        """Return the stamps relative to an origin.

        Parameters
        ----------
        origin_ns : int
            Origin, ns of the clock.

        Returns
        -------
        ndarray (m,)
            Times since the origin, s.
        """
        return np.asarray((self.stamps_ns - origin_ns) / 1e9)


def read_attitudes(path: str | os.PathLike[str], *, topic: str = "") -> Attitudes:
    """Read the attitudes of a file with an estimate or a reference of any filter.

    Parameters
    ----------
    path : str or path
        TUM trajectory, table, ULog, bag (for ROS 2 its folder), recording with a reference, or result of this package.
    topic : str, optional
        For a bag: its topic, if several have attitudes.

    Returns
    -------
    Attitudes
        Time stamps, q_fb, and covariance, bias and innovations if the file has them.

    Examples
    --------
    >>> import strapdown as sd
    >>> reference = sd.read_attitudes("flight.bag", topic="/mocap/pose")  # doctest: +SKIP
    >>> reference.attitude.shape  # doctest: +SKIP
    """
    file = Path(path)
    with reading.from_file(path):
        format_name = formats.format_of(file).name
        if format_name == "ROS bag":
            return _bag(file, topic)
        if topic:
            raise InputError(f"{file.name} is not a bag; leave {Hint('topic')} out")
        if format_name == "BROAD" and (kind := reading.kind(file)):
            return _own(file, kind)
        readers = {"ULog": _ulog, "TUM trajectory": _trajectory, "CSV": _csv, "Parquet": _parquet}
        return readers.get(format_name, _of_recording)(file)


def _trajectory(path: Path) -> Attitudes:
    stamps, q = trajectories.read_tum(path)
    return Attitudes(source=path.name, stamps_ns=stamps, attitude=q, remarks=("TUM trajectory: no covariance.",))


def _own(path: Path, kind: str) -> Attitudes:
    """Read a result of this package, of this kind."""
    if kind == "strapdown estimate":
        with reading.hdf5(path) as file:
            arrays = {name: reading.numbers(file, name) for name in ("time", "attitude")}
            P = reading.numbers(file, "covariance") if "covariance" in file else None
            if P is None and "variance" in file:
                variance = reading.numbers(file, "variance")
                P = variance[:, :, None] * np.eye(variance.shape[1])
            bias = reading.numbers(file, "bias") if "bias" in file else None
            innovations = result_files.innovations(file)
            attributes = reading.attributes(file)
        known = are_finite(arrays["attitude"])
        if not known.any():
            raise InputError(f"{path} is an estimate without a single attitude, because its filter failed; repeat it")
        time = arrays["time"][known]
        return Attitudes(
            source=path.name,
            stamps_ns=whole_ns(time) + recordfiles.epoch_of(attributes),
            attitude=quaternion.normalize(arrays["attitude"][known]),
            covariance=None if P is None else P[known],
            error_frame="" if P is None else "body",
            bias=None if bias is None else bias[known],
            innovations={k: replace(series, time=series.time - time[0]) for k, series in innovations.items()},
            motion=str(attributes.get("motion", "")),
            origin=recordfiles.origin_of(attributes, path),
            filter=str(attributes.get("filter", "")),
        )
    if kind == recordfiles.KIND:
        record = recordfiles.read_record(path)
        if (truth := record.truth) is None:
            raise InputError(f"{path} is a record without a truth; simulate one, or give another reference")
        stamps = whole_ns(record.time)
        return Attitudes(source=path.name, stamps_ns=stamps, attitude=truth.attitude, bias=truth.bias)
    raise InputError(f"{path} is a {kind}, which has no attitudes over time; give an estimate, record or trajectory")


def _of_recording(path: Path) -> Attitudes:
    """Read the reference of a recording."""
    recording = formats.read(path)
    if recording.true_attitude is None:
        raise InputError(f"{recording.source} is a recording without a reference attitude; give another reference")
    known = are_finite(recording.true_attitude)
    movement = None if recording.movement is None else recording.movement[known]
    return Attitudes(
        source=recording.source,
        stamps_ns=recording.clock_ns[known],
        attitude=recording.true_attitude[known],
        movement=movement,
    )


# ------------------------------------------------------------------------------------------------------------ tables

COLUMNS: dict[str, str] = {
    "time": r"(time|timestamp|t|stamp|#?timestamp)([ _]?[\[(]?(?P<unit>s|sec|ms|us|ns)[\])]?)?",
    "q": r"(q|q_|quat_|orientation[._]|rotation[._]|q_rs_)(?P<axis>[wxyz])( \[\])?",
    "cov": r"(cov|p)_((?P<frame>body|fixed|euler)_)?(?P<one>b?[xyz])(?P<two>b?[xyz])(_(?P<unit>rad2|deg2|rad2_per_s|rad2_per_s2))?",
    "sigma": r"(sigma|std)_(?P<axis>[xyz])_(?P<unit>rad|deg)",
    "angle": r"(?P<axis>roll|pitch|yaw)_(sigma|std)_(?P<unit>rad|deg)",
    "bias": r"(gyro_)?bias_(?P<axis>[xyz])_(?P<unit>rad_per_s|deg_per_h|deg_per_s)",
    "bound": r"sigma_upper_bound",
}
"""Columns of a table by their content: patterns of whole names, in lower case. ``cov_xy_rad2`` is an element of the covariance of the
attitude error, ``cov_xby`` one of attitude and bias, ``cov_fixed_xy_rad2`` one with its axes named; ``sigma_x_deg`` and
``yaw_sigma_deg`` are standard deviations, of the rotation vector or of the angles."""
_FACTORS = {"deg": DEGREE, "deg2": DEGREE**2, "deg_per_h": DEGREE_PER_HOUR, "deg_per_s": DEGREE}
"""Factors to SI of the units in names, unless they are SI."""


def _csv(path: Path) -> Attitudes:
    return _table(delimited.Table(path))


def _parquet(path: Path) -> Attitudes:
    """Read an estimate, or the reference of a recording."""
    table = dataframes.parquet_table(path)
    named = any(re.fullmatch(COLUMNS["q"], name.lower()) for name in table.header)
    return _table(table) if named else _of_recording(path)


def _table(table: naming.Table) -> Attitudes:
    """Read a table with the columns of :data:`COLUMNS`."""
    places, frame = _places(table.source, table.header)
    time_place, time_unit = places["time"][""]
    numbers = table.load(sorted({place for group in places.values() for place, _ in group.values()}), time_place)
    stamps = table.clock_ns("")  # dates, or numbers so large that no other unit makes sense
    if stamps is None:
        stamps = _counted_ns(table.source, numbers[time_place], TIME_UNITS[time_unit.replace("sec", "s") or "s"])
    columns = {
        name: {key: numbers[place] * _FACTORS.get(unit, 1.0) for key, (place, unit) in group.items()}
        for name, group in places.items()
    }
    q = np.stack([columns["q"][axis] for axis in "wxyz"], axis=1)
    rows = np.flatnonzero(are_finite(q))  # the others are not read
    columns = {name: {key: values[rows] for key, values in group.items()} for name, group in columns.items()}
    covariance, angles, remarks = _covariance(table.source, columns, rows)
    bias = None
    if set(columns["bias"]) == set("xyz"):
        bias = np.stack([columns["bias"][axis] for axis in "xyz"], axis=1)
    if covariance is not None and covariance.shape[1] == 6 and bias is None:
        covariance = covariance[:, :3, :3]
    if covariance is not None and covariance.shape[1] == 3:
        bias = None  # its covariance is not given
    back = np.diff(stamps[rows]) <= 0
    if back.any():
        k = int(np.argmax(back)) + 1
        remedy = order_remedy(stamps[rows], k, row := int(rows[k]) + 1)
        raise InputError(f"{table.source}: row {row} is not after the one before; {remedy}")
    return Attitudes(
        source=table.source,
        stamps_ns=stamps[rows],
        attitude=trajectories.unit_quaternions(table.source, q[rows]),
        covariance=covariance,
        error_frame=angles or frame,
        bias=bias,
        motion="not stated" if any(np.any(column) for column in columns["bound"].values()) else "",
        remarks=tuple(remarks),
    )


def _places(file: str, header: Sequence[str]) -> tuple[dict[str, dict[str, tuple[int, str]]], str]:
    """Return place and unit of the columns by content (:data:`COLUMNS`) and axis, and the axes that the covariance's names state."""
    places: dict[str, dict[str, tuple[int, str]]] = {name: {} for name in COLUMNS}
    frames: set[str] = set()
    for place, cell in enumerate(header):
        for name, pattern in COLUMNS.items():
            match = re.fullmatch(pattern, cell.strip().lower())
            if match is None:
                continue
            parts = match.groupdict()
            key = f"{parts['one']} {parts['two']}" if name == "cov" else str(parts.get("axis", ""))
            if parts.get("frame"):
                frames.add(parts["frame"])
            if key in places[name]:
                raise InputError(f"{file}: column {cell} has the same meaning as column {header[places[name][key][0]]}")
            places[name][key] = (place, parts.get("unit") or "")
    if len(frames) > 1:
        raise InputError(f"{file}: its covariance is of {' and '.join(sorted(frames))} axes; give all of one kind")
    if set(places["q"]) != set("wxyz") or not places["time"]:
        raise InputError(
            f"{file} lacks {'time' if not places['time'] else 'the four columns of a quaternion'}; wanted time_s (or _ns), "
            f"qw, qx, qy, qz[, cov_xx_rad2, …], and it has: {', '.join(header[:12])}"
        )
    return places, next(iter(frames), "")


def _counted_ns(file: str, time: Array, unit: float) -> NDArray[np.int64]:
    """Return times (m,) as stamps, ns; ``unit``: that of the times, s."""
    counts = array(f"{file}: time", np.rint(time * round(1e9 * unit)), ("m",))
    if np.any(np.abs(counts) >= 2.0**63):
        raise InputError(f"{file}: a time is {time[np.argmax(np.abs(counts))]:g}, which no clock counts")
    return counts.astype(np.int64)


def _covariance(
    name: str, columns: Mapping[str, Mapping[str, Array]], rows: NDArray[np.int64]
) -> tuple[Array | None, str, list[str]]:
    """Return the covariance from the columns of these rows, the kind of angles it describes (empty if not named), and remarks."""
    cov_columns = columns["cov"]
    if cov_columns:
        size = 6 if any("b" in key for key in cov_columns) else 3
        P = np.full((len(rows), size, size), np.nan)
        for key, value in cov_columns.items():
            i, j = (STATES.index(state) for state in key.split())
            P[:, i, j] = P[:, j, i] = value
        if np.isnan(P).any(axis=0).any():
            i, j = np.argwhere(np.isnan(P).any(axis=0))[0]
            raise InputError(f"{name}: cov_{STATES[i]}{STATES[j]} is missing, or empty in a row; give all elements")
        return P, "", []
    for group, axes, frame in (("sigma", "xyz", ""), ("angle", ("roll", "pitch", "yaw"), "euler")):
        if set(columns[group]) == set(axes):
            sigma = np.stack([columns[group][axis] for axis in axes], axis=1)
            for row, k in np.argwhere(sigma <= 0.0):
                place = f"{name}: σ of {axes[k]} in data row {rows[row] + 1}"
                raise InputError(f"{place} is not above zero; remove the row, or all columns of σ")
            words = "The file has σ and no covariance: errors of different axes are treated as independent."
            return np.apply_along_axis(np.diag, 1, sigma**2), frame, [words]
    words = (
        "The table has no covariance. Columns for it: cov_body_xx_rad2, cov_body_xy_rad2, … (or cov_fixed_…), or sigma_x_deg, sigma_y_deg, "
        "sigma_z_deg of the rotation vector, or yaw_sigma_deg, pitch_sigma_deg, roll_sigma_deg."
    )
    return None, "", [words]


# -------------------------------------------------------------------------------------------------------------- bags


def _bag(path: Path, topic: str) -> Attitudes:
    """Read the orientations of a bag. By REP 103, covariances of poses are about fixed axes; drivers of Imu messages differ."""
    topics = ros.topics_of(path, ros.ORIENTED)
    oriented = ros.topic_of(path.name, topics, topic, "topics with orientations", list(ros.ORIENTED))
    stamps, values, order_words = oriented.decoded(path.name, ros.ORIENTED[oriented.kind])
    q, P = values[:, [3, 0, 1, 2]], values[:, 4:]
    known = q.any(axis=1) & (P[:, 0] != -1.0 if P.size else True)
    if known.sum() < 2:
        raise InputError(f"{path.name}: topic {oriented.name} has no orientation in its {len(oriented)} messages")
    stamps, q, P = stamps[known], q[known], P[known]
    fresh = np.concatenate([[True], np.diff(stamps) > 0])
    count = f"Topic {oriented.name}: {int(fresh.sum())} orientations of {len(oriented)} messages."
    remarks = [count, *order_words]
    covariance = None
    if P.any():
        covariance = (P.reshape(-1, 6, 6)[:, 3:, 3:] if P.shape[1] == 36 else P.reshape(-1, 3, 3))[fresh]
    elif P.size:
        remarks.append("Its covariances are zero: unknown.")
    return Attitudes(
        source=path.name,
        stamps_ns=stamps[fresh],
        attitude=trajectories.unit_quaternions(path.name, q[fresh]),
        covariance=covariance,
        remarks=tuple(remarks),
    )


# -------------------------------------------------------------------------------------------------------------- ULog

_STATES_TOPIC = "estimator_states"
_INNOVATIONS, _VARIANCES = "estimator_innovations", "estimator_innovation_variances"


def _ulog(path: Path) -> Attitudes:
    """Read the attitude estimated by PX4, body axes forward, right, down, transformed to East-North-Up, and its innovations."""
    log = ulog.opened(path, [_STATES_TOPIC, ulog.ATTITUDE, _INNOVATIONS, _VARIANCES])
    data = {
        dataset.name: dataset.data
        for dataset in log.data_list
        if dataset.multi_id == 0 and len(dataset.data["timestamp"]) > 1
    }
    remarks: list[str] = []
    covariance = None
    topic = next((name for name in (_STATES_TOPIC, ulog.ATTITUDE) if name in data), None)
    if topic is None:
        raise InputError(f"{path.name} has neither {_STATES_TOPIC} nor {ulog.ATTITUDE}; log one of them")
    rows = data[topic]
    stamps, kept, _ = ulog.in_order(topic, rows.get("timestamp_sample", rows["timestamp"]))
    ned = trajectories.unit_quaternions(
        path.name, ulog.columns(rows, "q" if topic == ulog.ATTITUDE else "states", 4)[kept]
    )
    number = sum(name.startswith("covariances[") for name in rows)
    if topic == ulog.ATTITUDE:
        remarks.append(f"{ulog.ATTITUDE}: no covariance.")
    elif number == 24:  # variances of the quaternion: δθ = 2 Ξ(q)ᵀ δq, where the columns of Ξ are q ⊗ (0, e)
        xi = np.stack([quaternion.multiply(ned, [0.0, *axis]) for axis in np.eye(3)], axis=2)
        variance = ulog.columns(rows, "covariances", 4)[kept]
        covariance = 4.0 * np.einsum("mqi,mq,mqj->mij", xi, variance, xi)
        remarks.append("The log has variances of the quaternion without correlations: σ of attitude is approximate.")
    elif number > 0:
        covariance = np.apply_along_axis(np.diag, 1, ulog.columns(rows, "covariances", 3)[kept])
        remarks.append("The log has the variances of the attitude error without their correlations.")
    if covariance is not None and not (np.diagonal(covariance, axis1=1, axis2=2) > 0.0).all():
        covariance = None
        remarks.append("Its variances are not all above zero and are left out.")
    innovations: dict[str, Innovations] = {}
    if _INNOVATIONS in data and _VARIANCES in data:
        innovations = _ulog_innovations(data[_INNOVATIONS], data[_VARIANCES], int(stamps[0]))
    return Attitudes(
        source=path.name,
        stamps_ns=stamps * 1000,
        attitude=outputs.to_ned(ned),
        covariance=covariance,
        error_frame="body" if covariance is not None and number == 24 else "",
        innovations=innovations,
        remarks=tuple(remarks),
    )


def _ulog_innovations(values: Mapping[str, Any], variances: Mapping[str, Any], first: int) -> dict[str, Innovations]:
    """Return innovations by field; a value equal to that of the row before is not a new measurement."""
    at, rows, other = np.intersect1d(values["timestamp"], variances["timestamp"], return_indices=True)
    fields: dict[str, list[str]] = {}
    for name in values:
        if not name.startswith("timestamp") and name in variances:
            fields.setdefault(name.partition("[")[0], []).append(name)
    innovations = {}
    for name, parts in fields.items():
        e = np.stack([np.asarray(values[part], np.float64)[rows] for part in parts], axis=1)
        s = np.stack([np.asarray(variances[part], np.float64)[other] for part in parts], axis=1)
        new = are_finite(e) & are_finite(s) & (s > 0.0).all(axis=1)
        new &= np.concatenate([[True], np.any(np.diff(e, axis=0) != 0.0, axis=1)])
        if new.sum() > 1:
            time = (at[new].astype(np.int64) - first) / 1e6
            innovations[name] = Innovations(time=time, innovation=e[new], variance=s[new])
    return innovations
