"""The exported filter: size and stack on a Cortex-M4, and time per sample on this machine. ``python benchmarks/export.py``.

The six-state filter with accelerometer and magnetometer (heading) and a gate. Size and stack need ``arm-none-eabi-gcc``; they are those of
single precision at ``-Os``: bytes of code, the state struct, and the deepest stack of the filter's functions one below the other. Times are
minima over runs in C (``-O2``) and of :func:`strapdown.estimation.run` on the same record, gate included.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import strapdown as sd
from strapdown.files import write_json
from strapdown.kernels.machine import describe

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from sims import export_filter

ARM = ("-std=c99", "-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-Os")


def cortex_m4(setup: sd.FilterSetup, record: Any, folder: Path) -> dict[str, int] | str:
    """Return bytes of code, state and stack on a Cortex-M4; a reason without its compiler."""
    if shutil.which("arm-none-eabi-gcc") is None:
        return "no arm-none-eabi-gcc on this machine"
    sd.export(setup, record, folder=folder, precision="single")
    (folder / "state.c").write_text('#include "strapdown_filter.h"\nstrapdown_filter f;\n', encoding="utf-8")
    for name, more in (("strapdown_filter", ["-fstack-usage"]), ("state", [])):
        subprocess.run(["arm-none-eabi-gcc", *ARM, *more, "-c", f"{name}.c"], cwd=folder, check=True)
    sizes = subprocess.run(
        ["arm-none-eabi-size", "strapdown_filter.o", "state.o"], cwd=folder, check=True, capture_output=True, text=True
    ).stdout.splitlines()[1:]
    rows = (folder / "strapdown_filter.su").read_text(encoding="utf-8")
    frames = {m[1]: int(m[2]) for m in re.finditer(r":(\w+)(?:\.\w+)*\t(\d+)\t", rows)}
    public = max(size for name, size in frames.items() if name.startswith("strapdown_"))
    called = sum(size for name, size in frames.items() if not name.startswith("strapdown_"))
    return {
        "text": int(sizes[0].split()[0]),
        "state": int(sizes[1].split()[1]) + int(sizes[1].split()[2]),
        "stack_at_most": public + called,
    }


def python_seconds(setup: sd.FilterSetup, record: Any, repeats: int) -> float:
    """Return the time of the compiled filter per gyro sample, s."""
    assert record.truth is not None
    initial = sd.initial_state(
        record.truth.attitude[0], attitude_sigma=setup.attitude_sigma, bias_sigma=setup.bias_sigma
    )
    times = []
    for _ in range(repeats + 1):
        start = time.process_time()
        sd.estimation.run(record, setup.process_noise, initial, gate=setup.gate, every=1000)
        times.append(time.process_time() - start)
    return min(times[1:]) / len(record.increments)


def main(*, duration: float = 200.0, repeats: int = 7) -> dict[str, Any]:
    """Return sizes, and seconds per sample in C, double and single, and in Python, with a gate."""
    record = export_filter.simulated(duration, 1, 0)
    noise = sd.ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
    setup = sd.FilterSetup(process_noise=noise, attitude_sigma=0.2, bias_sigma=5e-3, gate=sd.Gate(recovery=None))
    assert record.truth is not None
    found: dict[str, Any] = {"machine": describe(), "samples": len(record.increments)}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for name in ("arm", "double", "single"):
            (folder / name).mkdir()
        found["cortex_m4"] = cortex_m4(setup, record, folder / "arm")
        for precision in ("double", "single"):
            run = export_filter.in_c(setup, record, record.truth.attitude[0], folder / precision, precision)
            found[f"c_{precision}"] = run.seconds
    found["python"] = python_seconds(setup, record, repeats)
    found["python_without_gate"] = python_seconds(replace(setup, gate=None), record, repeats)
    found["ratio"] = found["c_double"] / found["python"]
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--duration", type=float, default=200.0, help="s")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    result = main(duration=arguments.duration, repeats=arguments.repeats)
    print(json.dumps(result["machine"]))
    print(f"Cortex-M4, single precision: {result['cortex_m4']}")
    for key in ("c_double", "c_single", "python", "python_without_gate"):
        print(f"{key:20s} {1e9 * result[key]:8.0f} ns per sample")
    print(f"C over Python, with gate: {result['ratio']:.2f}")
    if arguments.json:
        write_json(arguments.json, result)
