"""Exported filters beside imufusion (C) and VQF (C++): size on a Cortex-M4, and time per sample. ``python benchmarks/export.py``.

All process the same samples of a hand-held unit with accelerometer and magnetometer at 100 Hz. For a Cortex-M4 they are compiled at ``-Os``
in single precision by ``arm-none-eabi-gcc`` and run by ``qemu-arm``:

- code: bytes of the filter's own functions and constants; flash: with the functions of the C library that it calls.
- state: bytes of its variables; stack: the deepest place that a sample has written, in bytes.
- instructions: mean per sample.

On this machine they run in C at ``-O2``; the compiled kernels of the package process the same samples for comparison. Sources of peers are
taken from ``--sources``, where pip puts them if they are missing. Whatever is missing is named, and its columns stay empty.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import strapdown as sd
from strapdown.files import write_json
from strapdown.kernels.machine import describe
from strapdown.recordings import Recording
from strapdown.results import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import timing
from sims import export_filter

ARM = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-Os", "-ffunction-sections")
LINK = ("-nostartfiles", "--specs=nosys.specs", "-Wl,--gc-sections", "-Wl,--no-warnings")
PLAIN = ("-fno-exceptions", "-fno-rtti", "-fno-threadsafe-statics")
SAMPLES, WARM = 200, 50
"""Samples of a run under emulation; instructions are counted after the first of them."""

OF_A_BOARD = """
static long call(long number, long a, const void *b, long c) {
    register long r7 __asm__("r7") = number, r0 __asm__("r0") = a, r2 __asm__("r2") = c;
    register const void *r1 __asm__("r1") = b;
    __asm__ volatile("svc 0" : "+r"(r0) : "r"(r7), "r"(r1), "r"(r2) : "memory");
    return r0;
}
enum { DEEPEST = 65536 };
static void __attribute__((noinline)) paint(void) {
    volatile char space[DEEPEST];
    for (int i = 0; i < DEEPEST; i++) space[i] = 0x5a;
}
static long __attribute__((noinline)) depth(void) {
    volatile char space[DEEPEST];
    int i = 0;
    while (i < DEEPEST && space[i] == 0x5a) i++;
    return DEEPEST - i;
}
EXTERN void _start(void) {
    start();
    paint();
    for (int k = 0; k < COUNT; k++) sample(k);
    const long deep = depth();
    call(4, 1, &deep, 4);
    call(1, 0, 0, 0);
    for (;;) {}
}
"""
OF_THIS_MACHINE = """
#include <stdio.h>
#include <time.h>
int main(void) {
    double least = 1e9;
    for (int repeat = 0; repeat < 9; repeat++) {
        start();
        const clock_t begin = clock();
        for (int k = 0; k < COUNT; k++) sample(k);
        const double seconds = (double)(clock() - begin) / CLOCKS_PER_SEC / COUNT;
        if (seconds < least) least = seconds;
    }
    printf("%.17g", least);
    return 0;
}
"""
IMU = """
#include "strapdown_filter.h"
strapdown_filter state;
static void start(void) { strapdown_init(&state); }
static void sample(int k) { strapdown_update(&state, 0.01 * k, rows[k], rows[k] + 3FIELD); }
"""
SIX = """
#include "strapdown_filter.h"
strapdown_filter state;
static void start(void) { const strapdown_real q[4] = {START}; strapdown_init(&state, q); }
static void sample(int k) {
    strapdown_predict(&state, rows[k], (strapdown_real)0.01);
    strapdown_update_accelerometer(&state, rows[k] + 3);
    strapdown_update_magnetometer(&state, rows[k] + 6);
}
"""
FUSION = """
#include "Fusion.h"
struct { FusionBias bias; FusionAhrs ahrs; } state;
static void start(void) { FusionBiasInitialise(&state.bias); FusionAhrsInitialise(&state.ahrs); }
static void sample(int k) {
    const real *r = rows[k];
    const FusionVector rate = {{57.29578f * (float)r[0], 57.29578f * (float)r[1], 57.29578f * (float)r[2]}};
    const FusionVector force = {{0.1019716f * (float)r[3], 0.1019716f * (float)r[4], 0.1019716f * (float)r[5]}};
    const FusionVector field = {{(float)r[6], (float)r[7], (float)r[8]}};
    FusionAhrsUpdate(&state.ahrs, FusionBiasUpdate(&state.bias, rate), force, field);
}
"""
VQF = """
#include "NAME.hpp"
#include <new>
alignas(CLASS) unsigned char state[sizeof(CLASS)];
static void start(void) { new (state) CLASS((vqf_real_t)0.01); }
static void sample(int k) { reinterpret_cast<CLASS *>(state)->update(rows[k], rows[k] + 3, rows[k] + 6); }
"""


@dataclass(frozen=True, kw_only=True)
class Filter:
    """A filter as sources with a driver."""

    name: str
    driver: str
    sources: Callable[[Path, str], list[Path]]
    """Files to compile, from a folder for new ones and the precision."""
    kernel: Callable[[], Any] | None = None
    """The same filter by compiled kernels over all samples."""
    flags: tuple[str, ...] = ()


def samples(duration: float) -> tuple[sd.ImuRecord, Recording, np.ndarray]:
    """Return a simulated record, the same as a recording, and its rows: rate, specific force, field."""
    record = export_filter.simulated(duration, 1, 0)
    force, field = (factor * series.vector_b for factor, series in zip((9.81, 45.0), record.vectors, strict=True))
    rate = record.increments / record.intervals[:, None]
    recording = Recording(
        source="simulated", time=record.time[1:], rate=rate, specific_force=force, magnetic_field=field
    )
    return record, recording, np.hstack([rate, force, field])


def our_filters(record: sd.ImuRecord, recording: Recording) -> list[Filter]:
    """Return the exported filters: of a setup with six states and a gate, and those of an IMU."""
    noise = sd.ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
    setup = sd.FilterSetup(process_noise=noise, attitude_sigma=0.2, bias_sigma=5e-3, gate=sd.Gate(recovery=None))
    assert record.truth is not None
    start = record.truth.attitude[0]
    initial = sd.initial_state(start, attitude_sigma=setup.attitude_sigma, bias_sigma=setup.bias_sigma)

    def exported(what: Any, sensors: Any, **imu: Any) -> Callable[[Path, str], list[Path]]:
        return lambda folder, precision: [
            path
            for path in sd.export(what, sensors, folder=folder, precision=precision, **imu)  # type: ignore[arg-type]
            if path.name == "strapdown_filter.c"
        ]

    def of_imu(motion: str, magnetometer: bool) -> Filter:
        here = recording if magnetometer else replace(recording, magnetic_field=None)
        return Filter(
            name=f"strapdown export {motion}{' --magnetometer' if magnetometer else ''}",
            driver=IMU.replace("FIELD", ", rows[k] + 6" if magnetometer else ""),
            sources=exported(motion, None, rate=100.0, magnetometer=magnetometer),
            kernel=lambda: sd.ahrs.estimate(here, sd.ahrs.of_motion(motion, magnetometer=magnetometer)),
        )

    six = Filter(
        name="strapdown export, 6 states, gate",
        driver=SIX.replace("START", ", ".join(f"(strapdown_real){x!r}" for x in start.tolist())),
        sources=exported(setup, record),
        kernel=lambda: sd.estimation.run(record, setup.process_noise, initial, gate=setup.gate, every=1000),
    )
    return [six, of_imu("any", True), of_imu("hand", False), of_imu("hand", True)]


def unpacked(name: str, folder: Path) -> Path | None:
    """Return the folder of a package's sources; None if there are none and pip gets none."""
    folder.mkdir(parents=True, exist_ok=True)
    if not list(folder.glob(f"{name}-*.tar.gz")):
        pip = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--no-binary", name, name, "-d", folder]
        subprocess.run(pip, check=False, capture_output=True)
    archives = sorted(folder.glob(f"{name}-*.tar.gz"))
    if not archives:
        return None
    with tarfile.open(archives[-1]) as archive:
        archive.extractall(folder, filter="data")
    return archives[-1].with_name(archives[-1].name.removesuffix(".tar.gz"))


def peers(folder: Path) -> tuple[list[Filter], list[str]]:
    """Return the peers, and what is missing."""
    filters, missing = [], []
    for name in ("imufusion", "vqf"):
        root = unpacked(name, folder)
        if root is None:
            missing.append(f"{name}: no sources in {folder}, and pip got none")
        elif name == "imufusion":
            files = sorted((root / "Fusion").glob("*.c"))
            filters.append(
                Filter(
                    name=f"{root.name} (C)",
                    driver=FUSION,
                    sources=lambda _, __, files=files: files,  # type: ignore[misc]
                    flags=(f"-I{root / 'Fusion'}",),
                )
            )
        else:
            for part, kind in (("vqf", "VQF"), ("basicvqf", "BasicVQF")):
                file = root / f"vqf/cpp/{part}.cpp"
                filters.append(
                    Filter(
                        name=f"{root.name} {kind} (C++)",
                        driver=VQF.replace("NAME", part).replace("CLASS", kind),
                        sources=lambda _, __, file=file: [file],  # type: ignore[misc]
                        flags=(f"-I{file.parent}",),
                    )
                )
    return filters, missing


def compiled(
    filter_: Filter, folder: Path, prefix: str, flags: tuple[str, ...], driver: str, single: bool
) -> list[Path]:
    """Compile the sources of a filter and its driver; return the objects, that of the driver first."""
    sources = filter_.sources(folder, "single" if single else "double")
    cpp = any(source.suffix == ".cpp" for source in sources)
    (folder / f"driver.{'cpp' if cpp else 'c'}").write_text(driver, encoding="utf-8")
    objects = []
    for source in (folder / f"driver.{'cpp' if cpp else 'c'}", *sources):
        objects.append(folder / f"{source.stem}.o")
        language = (f"{prefix}g++", *PLAIN) if source.suffix == ".cpp" else (f"{prefix}gcc", "-std=gnu99")
        precision = ("-DVQF_SINGLE_PRECISION",) if single else ()
        include = (f"-I{folder}", *filter_.flags, *precision)
        subprocess.run([*language, *flags, *include, "-c", source, "-o", objects[-1]], check=True, capture_output=True)
    return objects


def driver_of(filter_: Filter, rows: np.ndarray, main: str, *, real: str) -> str:
    """Return the driver with its samples."""
    numbers = ",\n".join("{" + ", ".join(f"{x:.9g}" for x in row) + "}" for row in rows.tolist())
    outside = 'extern "C"' if ".hpp" in filter_.driver else ""
    return (
        f"typedef {real} real;\nenum {{ ROWS = {len(rows)} }};\n#ifndef COUNT\n#define COUNT ROWS\n#endif\n"
        f"static const real rows[ROWS][9] = {{{numbers}}};\n{filter_.driver}{main.replace('EXTERN', outside)}"
    )


def text_bytes(*files: Path) -> int:
    """Return the bytes of code and constants, with the initial values of variables."""
    if not files:
        return 0
    shown = subprocess.run(["arm-none-eabi-size", *files], check=True, capture_output=True, text=True).stdout
    return sum(sum(map(int, line.split()[:2])) for line in shown.splitlines()[1:])


def on_a_board(filter_: Filter, rows: np.ndarray, folder: Path, without: int) -> dict[str, Any]:
    """Return sizes on a Cortex-M4 and, with its emulator, stack and instructions. ``without``: flash of the samples and the driver."""
    driver = driver_of(filter_, rows[:SAMPLES], OF_A_BOARD, real="float")
    sizes: dict[str, Any] = {}
    lines = []
    for count in (WARM, SAMPLES):
        flags = (*ARM, f"-DCOUNT={count}")
        first, *others = compiled(filter_, folder, "arm-none-eabi-", flags, driver, single=True)
        tool = "arm-none-eabi-g++" if ".hpp" in filter_.driver else "arm-none-eabi-gcc"
        program = folder / f"run{count}"
        subprocess.run(
            [tool, *ARM, *LINK, first, *others, "-o", program, "-lm"], check=True, capture_output=True, cwd=folder
        )
        symbols = subprocess.run(["arm-none-eabi-nm", "-S", first], check=True, capture_output=True, text=True).stdout
        (size,) = (int(line.split()[1], 16) for line in symbols.splitlines() if line.split()[-1] == "state")
        sizes |= {"code": text_bytes(*others), "flash": text_bytes(program) - without, "state": size}
        if shutil.which("qemu-arm") is not None:
            stack, number = emulated(program)
            sizes["stack"] = stack
            lines.append(number)
    if len(lines) == 2:
        sizes["instructions"] = round((lines[1] - lines[0]) / (SAMPLES - WARM))
    return sizes


def emulated(program: Path) -> tuple[int, int]:
    """Return the bytes of stack that a program for a board has used, and the number of its instructions."""
    # The emulator of Linux programs has no Cortex-M; a Cortex-A executes the same instructions.
    for option in ("-one-insn-per-tb", "-singlestep"):
        command = ["qemu-arm", "-cpu", "cortex-a15", option, "-d", "exec,nochain", program]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run:
            assert run.stdout is not None
            assert run.stderr is not None
            number = sum(block.count(b"Trace ") for block in iter(lambda: run.stderr.read(1 << 20), b""))  # type: ignore[union-attr]
            deep = run.stdout.read()
        if run.returncode == 0:
            return int.from_bytes(deep[:4], "little"), number
    raise SystemExit(f"qemu-arm ended with status {run.returncode}")


def on_this_machine(filter_: Filter, rows: np.ndarray, folder: Path, *, single: bool) -> float:
    """Return the time of a sample, s."""
    flags = ("-O2", "-ffp-contract=off")
    driver = driver_of(filter_, rows, OF_THIS_MACHINE, real="float" if single else "double")
    objects = compiled(filter_, folder, "", flags, driver, single)
    tool = "g++" if ".hpp" in filter_.driver else "gcc"
    subprocess.run([tool, *objects, "-o", folder / "run", "-lm"], check=True, capture_output=True)
    return float(subprocess.run([folder / "run"], check=True, capture_output=True, text=True).stdout)


def main(*, duration: float = 100.0, repeats: int = 5, sources: Path | None = None) -> dict[str, Any]:
    """Return what is missing, and the columns of each filter."""
    record, recording, rows = samples(duration)
    with tempfile.TemporaryDirectory() as scratch:
        others, missing = peers(sources or Path(scratch) / "sources")
        board, host = (
            all(map(shutil.which, names)) for names in (("arm-none-eabi-gcc", "arm-none-eabi-g++"), ("gcc", "g++"))
        )
        missing += [] if board else ["arm-none-eabi-gcc and -g++: no sizes on a Cortex-M4"]
        missing += [] if board and shutil.which("qemu-arm") else ["qemu-arm: no stack and no instructions"]
        missing += [] if host else ["gcc and g++: no times of C"]
        without = 0
        if board:
            nothing = Filter(
                name="",
                driver="char state; static void start(void) {} static void sample(int k) { state += rows[k][0] > 0; }",
                sources=lambda _, __: [],
            )
            (Path(scratch) / "nothing").mkdir()
            without = on_a_board(nothing, rows, Path(scratch) / "nothing", 0)["flash"]
        described = []
        for k, filter_ in enumerate((*our_filters(record, recording), *others)):
            columns: dict[str, Any] = {"name": filter_.name}
            for part in ("arm", "double", "single"):
                folder = Path(scratch) / f"{k}-{part}"
                folder.mkdir()
                if part == "arm" and board:
                    columns |= on_a_board(filter_, rows, folder, without)
                elif part != "arm" and host and (part, filter_.driver) != ("double", FUSION):
                    columns[f"{part}_ns"] = 1e9 * on_this_machine(filter_, rows, folder, single=part == "single")
            if filter_.kernel is not None:
                columns |= timing.least({"package_ns": (filter_.kernel, len(rows))}, repeats)
            described.append(columns)
    return {"machine": describe(), "missing": missing, "filters": described}


COLUMNS = ("code", "flash", "state", "stack", "instructions", "double_ns", "single_ns", "package_ns")

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--duration", type=float, default=100.0, help="of the samples, s")
    parser.add_argument("--repeats", type=int, default=5, help="of the package's kernels")
    parser.add_argument("--sources", type=Path, help="folder of the peers' source distributions")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    result = main(duration=arguments.duration, repeats=arguments.repeats, sources=arguments.sources)
    print(json.dumps(result["machine"]))
    cells = [[row["name"], *(row.get(name) for name in COLUMNS)] for row in result["filters"]]
    print(Table("", ["", *COLUMNS], cells, [f"missing: {words}" for words in result["missing"]]).text)
    if arguments.json:
        write_json(arguments.json, result)
