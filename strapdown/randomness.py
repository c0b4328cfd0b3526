"""Randomness is an argument: one independent stream for every (seed, run, source), whatever else is simulated and by how many workers."""

from __future__ import annotations

import zlib

import numpy as np

from strapdown.checks import count


def generator(seed: int, run: int, source: str) -> np.random.Generator:
    """Return the random stream of one source (``"gyro"``, ``"star tracker"``, …) in one run.

    The stream depends on these three alone: adding a sensor, changing the order of runs or the number of workers changes no other
    stream. (``SeedSequence`` with the run and the CRC-32 of the source's name as spawn key.)
    """
    key = (count("run", run, least=0), zlib.crc32(source.encode()))
    return np.random.default_rng(np.random.SeedSequence(count("seed", seed, least=0), spawn_key=key))
