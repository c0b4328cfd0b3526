"""The HDF5 layout of the BROAD data set (Laidig et al. 2021).

``imu_gyr`` (n, 3) rad/s, ``imu_acc`` (n, 3) m/s², ``imu_mag`` (n, 3) µT, in the axes of the unit; ``opt_quat`` (n, 4), the optical
reference q_fb, scalar first, East-North-Up with magnetic North; ``movement`` (n,) bool; the attribute ``sampling_rate``, Hz. There are no
time stamps: time begins at 0. :func:`write_broad` writes the same layout and therefore needs equal sample intervals.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import Array, InputError, increasing, positive
from strapdown.files import atomic_write, reading, whole_hdf5
from strapdown.recordings import recordfiles
from strapdown.records.recording import Recording, field_in, with_gyro


def read_broad(path: Path) -> Recording:
    """Read a trial of the BROAD data set (Laidig et al. 2021): ``imu_gyr``, ``imu_acc``, ``imu_mag``, ``opt_quat``, ``movement``."""
    name = path.name
    with reading.hdf5(path) as file:
        held = reading.attributes(file)
        kind = str(held.get("kind", ""))
        if kind == recordfiles.KIND:
            raise InputError(f"{name} is a simulated record, not a recording; use `strapdown integrate` or `estimate`")
        if kind.startswith("strapdown "):
            raise InputError(f"{name} is a {kind}, a result, not a recording; give the recording that it was made from")
        missing = ["imu_gyr"] * ("imu_gyr" not in file)
        missing += ["the attribute sampling_rate"] * ("sampling_rate" not in held)
        if missing:
            raise InputError(f"{name} lacks {', '.join(missing)}; it is not of BROAD (has: {', '.join(file)})")
        fields: dict[str, Any] = {field: reading.numbers(file, key) for key, field in _FIELDS.items() if key in file}
        sampling = positive(f"{name}: sampling_rate", held["sampling_rate"], unit="Hz")
        if "movement" in fields:
            fields["movement"] = fields["movement"].astype(bool)
        unit = "uT" if "magnetic_field" in fields else ""
        return with_gyro(source=name, time=np.arange(len(fields["rate"])) / sampling, magnetic_unit=unit, **fields)


_FIELDS = {
    "imu_gyr": "rate",
    "imu_acc": "specific_force",
    "imu_mag": "magnetic_field",
    "opt_quat": "true_attitude",
    "movement": "movement",
}
"""Fields of a recording by data set."""
EVEN = 1e-3
"""Maximum relative deviation of a sample interval from the mean, for the intervals to count as equal."""


def sample_interval(source: str, time: Array) -> float:
    """Return the interval between the stamps (n,) of a recording, s; if the intervals differ, the error names the worst."""
    steps = np.diff(increasing(f"{source}: time", time, minimum=2))
    mean = float(steps.mean())
    worst = int(np.argmax(np.abs(steps - mean)))
    if abs(steps[worst] - mean) > EVEN * mean:
        raise InputError(
            f"{source}: the interval after {time[worst]:.6g} s is {steps[worst]:.6g} s, the mean {mean:.6g} s; "
            "cut the recording to a part with equal sample intervals"
        )
    return mean


def write_broad(recording: Recording, path: Path) -> None:
    """Write a recording with equal sample intervals in the layout of BROAD, which has no clock."""
    interval = sample_interval(recording.source, recording.time)
    content = {key: getattr(recording, field) for key, field in _FIELDS.items()}
    if recording.magnetic_field is not None and recording.magnetic_unit:
        content["imu_mag"] = field_in("uT", recording)
    with atomic_write(path) as temporary, whole_hdf5(temporary) as file:
        file.attrs["sampling_rate"] = 1.0 / interval
        for key, value in content.items():
            if value is not None:
                file.create_dataset(key, data=value)
