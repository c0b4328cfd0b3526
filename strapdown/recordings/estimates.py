"""Estimates in files: CSV and TSV, Parquet, TUM. The columns are those of :meth:`strapdown.records.Estimate.table`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from strapdown.files import atomic_write
from strapdown.recordings.dataframes import write_parquet_columns
from strapdown.recordings.delimited import write_columns
from strapdown.records import Estimate
from strapdown.records.recording import Recording


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
