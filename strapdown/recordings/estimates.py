"""Estimates in files: CSV and TSV, Parquet, TUM, Rerun. The columns are those of :meth:`strapdown.records.Estimate.table`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import Array
from strapdown.files import atomic_write
from strapdown.files.extras import library
from strapdown.recordings.dataframes import write_parquet_columns
from strapdown.recordings.delimited import write_columns
from strapdown.records import Estimate
from strapdown.records.recording import Recording
from strapdown.units import DEGREE


def write_table(
    estimate: Estimate, path: str | os.PathLike[str], *, recording: Recording | None = None, **options: Any
) -> None:
    """Write an estimate as Parquet or text, by the suffix; options as for :meth:`strapdown.records.Estimate.table`."""
    write = write_parquet_columns if Path(path).suffix.lower() == ".parquet" else write_columns
    write(path, estimate.table(recording=recording, **options))


def write_tum(
    estimate: Estimate, path: str | os.PathLike[str], *, recording: Recording | None = None, frame: str = "ENU"
) -> None:
    """Write attitudes as a TUM trajectory: ``time tx ty tz qx qy qz qw``, s of the recording's clock, positions zero."""
    found = estimate.table(frame=frame)
    q = np.stack([found[name] for name in ("qx", "qy", "qz", "qw")], axis=1)
    stamps = np.rint(estimate.time * 1e9).astype(np.int64) + (0 if recording is None else recording.epoch_ns)
    with atomic_write(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write("# time tx ty tz qx qy qz qw\n")
        for stamp, row in zip(stamps.tolist(), q.tolist(), strict=True):
            sign, size = "-" if stamp < 0 else "", abs(stamp)
            file.write(f"{sign}{size // 10**9}.{size % 10**9:09d} 0 0 0 {' '.join(map(repr, row))}\n")


def write_rerun(estimate: Estimate, path: str | os.PathLike[str], *, recording: Recording | None = None) -> None:
    """Write an estimate as a Rerun recording on the time line ``time``. Library: ``rerun-sdk`` (the extra ``rerun``).

    ``body`` rotates with the attitude; its axes and, for a recording, its specific force and magnetic field (of unit length) are arrows.
    ``angles`` and ``bias`` (°/h) with ±3σ, ``innovations/SENSOR`` with their ±3σ, and ``rate`` without the bias, °/s, are curves.
    """
    rr = library("rerun", f"writing {Path(path).name}", "rerun")
    found = estimate.table()
    with atomic_write(path) as temporary:
        stream = rr.RecordingStream("strapdown")
        stream.save(str(temporary))
        time = [rr.TimeColumn("time", duration=estimate.time)]

        def curve(place: str, values: Array, at: Any = time) -> None:
            stream.send_columns(place, indexes=at, columns=rr.Scalars.columns(scalars=values))

        stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        turns = np.ascontiguousarray(estimate.attitude[:, [1, 2, 3, 0]])
        stream.send_columns("body", indexes=time, columns=rr.Transform3D.columns(quaternion=turns))
        stream.log(
            "body/axes", rr.Arrows3D(vectors=np.eye(3), colors=[[255, 0, 0], [0, 255, 0], [0, 0, 255]]), static=True
        )
        for name, unit in (
            ("yaw", "deg"),
            ("pitch", "deg"),
            ("roll", "deg"),
            *((f"bias_{axis}", "deg_per_h") for axis in "xyz"),
        ):
            value = np.asarray(found[f"{name}_{unit}"], np.float64)
            reach = 3.0 * np.asarray(found[f"{name}_sigma_{unit}"], np.float64)
            kind = "bias" if name.startswith("bias") else "angles"
            for line, values in (("value", value), ("plus_3_sigma", value + reach), ("minus_3_sigma", value - reach)):
                curve(f"{kind}/{name}/{line}", values)
        for sensor, innovations in estimate.innovations.items():
            at = [rr.TimeColumn("time", duration=innovations.time)]
            for k in range(innovations.innovation.shape[1]):
                place, reach = f"innovations/{sensor}/{k}", 3.0 * np.sqrt(innovations.variance[:, k])
                curve(f"{place}/value", innovations.innovation[:, k], at)
                curve(f"{place}/plus_3_sigma", reach, at)
                curve(f"{place}/minus_3_sigma", -reach, at)
        if recording is not None:
            _log_samples(rr, stream, time, recording, estimate)
        stream.flush()
        stream.disconnect()


def _log_samples(rr: Any, stream: Any, time: Any, recording: Recording, estimate: Estimate) -> None:
    """Log the samples of a recording at the estimate's times."""
    rows = recording.rows_of(estimate.time)
    rate = (recording.rate[rows] - estimate.bias) / DEGREE
    for k, axis in enumerate("xyz"):
        stream.send_columns(f"rate/{axis}", indexes=time, columns=rr.Scalars.columns(scalars=rate[:, k]))
    for name, samples in (("specific_force", recording.specific_force), ("magnetic_field", recording.magnetic_field)):
        if samples is None:
            continue
        vectors = samples[rows]
        known = np.asarray(~np.isnan(vectors).any(axis=1) & (np.linalg.norm(np.nan_to_num(vectors), axis=1) > 0.0))
        at = [rr.TimeColumn("time", duration=estimate.time[known])]
        unit = vectors[known] / np.linalg.norm(vectors[known], axis=1, keepdims=True)
        stream.send_columns(f"body/{name}", indexes=at, columns=rr.Arrows3D.columns(vectors=unit))
