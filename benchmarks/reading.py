"""Reading recordings compared with iteration by the format's library: ns per message, and ratios. ``python benchmarks/reading.py``.

Each file contains only gyro and accelerometer, written by this package. rosbags yields raw messages, not decoded.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from strapdown import read, write
from strapdown.files import write_json
from strapdown.kernels.machine import describe
from strapdown.recordings import Recording

ENDINGS = (".db3", ".mcap", ".bag")


def recording(n: int) -> Recording:
    """Return a unit at rest, sampled at 1 kHz."""
    noise = np.random.default_rng(0)
    return Recording(
        source="benchmark",
        time=np.arange(n) / 1000.0,
        rate=1e-3 * noise.standard_normal((n, 3)),
        specific_force=noise.normal((0.0, 0.0, 9.81), 1.0, (n, 3)),
    )


def iterate(path: Path) -> None:
    """Iterate over all messages by the library of the format."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        for _ in reader.messages():
            pass


def main(*, n: int = 1_000_000, repeats: int = 3) -> dict[str, Any]:
    """Return ns per message (minimum of the repeats) of our reader and of the library, and their ratio, for each format."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for ending in ENDINGS:
            path = Path(folder) / f"unit{ending}"
            write(recording(n), path)
            works: dict[str, Callable[[Path], object]] = {"library": iterate, "read": read}
            times: dict[str, list[float]] = {name: [] for name in works}
            for _ in range(repeats):
                for name, work in works.items():
                    start = time.process_time()  # excludes other processes
                    work(path)
                    times[name].append((time.process_time() - start) / n * 1e9)
            ours, theirs = min(times["read"]), min(times["library"])
            rows.append({"ending": ending, "read": ours, "library": theirs, "ratio": ours / theirs})
            path.unlink()
    return {"machine": describe(), "messages": n, "rows": rows}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    result = main(n=arguments.messages, repeats=arguments.repeats)
    print(json.dumps(result["machine"]))
    print(f"{result['messages']} messages {'read, ns':>10s} {'library, ns':>12s} {'ratio':>6s}")
    for row in result["rows"]:
        print(f"{row['ending']:16s} {row['read']:10.0f} {row['library']:12.0f} {row['ratio']:6.2f}")
    if arguments.json:
        write_json(arguments.json, result)
