"""Random streams: one independent stream for every (seed, run, source), whatever else is simulated and by how many workers."""

from __future__ import annotations

import zlib

import numpy as np

from strapdown.checks import count


def generator(seed: int, run: int, source: str) -> np.random.Generator:
    """Return the random stream of one source in one run.

    Its key is (seed, run, CRC-32 of the source's name): adding a sensor, or changing the order of runs or the number of workers, changes no
    other stream.

    Examples
    --------
    >>> bool(generator(1, 0, "gyro").random() == generator(1, 0, "gyro").random())
    True
    """
    key = (count("run", run, minimum=0), zlib.crc32(source.encode()))
    return np.random.default_rng(np.random.SeedSequence(count("seed", seed, minimum=0), spawn_key=key))
