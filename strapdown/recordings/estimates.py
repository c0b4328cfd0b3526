"""Estimates in files: CSV and TSV, Parquet, TUM trajectories, HDF5. What the columns are: :func:`strapdown.outputs.table`."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from strapdown import outputs
from strapdown.files import written_beside
from strapdown.recordings.dataframes import write_parquet_columns
from strapdown.recordings.delimited import write_columns
from strapdown.recordings.recording import Recording
from strapdown.records import Estimate
from strapdown.records import write_estimate as write_result


def write_csv(
    estimate: Estimate, path: str | os.PathLike[str], *, recording: Recording | None = None, **options: Any
) -> None:
    """Write an estimate as a table of text; ``sequence`` and ``frame`` as :func:`strapdown.outputs.table` takes them."""
    write_columns(path, outputs.table(estimate, recording=recording, **options))


def write_parquet(
    estimate: Estimate, path: str | os.PathLike[str], *, recording: Recording | None = None, **options: Any
) -> None:
    """Write an estimate as Parquet; ``sequence`` and ``frame`` as :func:`strapdown.outputs.table` takes them."""
    write_parquet_columns(path, outputs.table(estimate, recording=recording, **options))


def write_hdf5(estimate: Estimate, path: str | os.PathLike[str], *, recording: Recording | None = None) -> None:
    """Write an estimate in the package's own layout, which `strapdown check` and `report` read."""
    write_result(path, estimate, {} if recording is None else {"source": recording.source})


def write_tum(
    estimate: Estimate, path: str | os.PathLike[str], *, recording: Recording | None = None, frame: str = "ENU"
) -> None:
    """Write attitudes as a TUM trajectory: ``time tx ty tz qx qy qz qw``, s of the recording's clock, positions zero."""
    found = outputs.table(estimate, frame=frame)
    q = np.stack([found[name] for name in ("qx", "qy", "qz", "qw")], axis=1)
    stamps = np.rint(estimate.time * 1e9).astype(np.int64) + (0 if recording is None else recording.epoch_ns)
    with written_beside(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write("# time tx ty tz qx qy qz qw\n")
        for stamp, row in zip(stamps.tolist(), q.tolist(), strict=True):
            sign, size = "-" if stamp < 0 else "", abs(stamp)
            file.write(f"{sign}{size // 10**9}.{size % 10**9:09d} 0 0 0 {' '.join(map(repr, row))}\n")
