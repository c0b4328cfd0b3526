"""The script of the interactive part of the page on coning: the filter as ``strapdown.export`` writes it, a simulation, and the page."""

from __future__ import annotations

import json
import re
import tempfile
from pathlib import Path

import numpy as np

import strapdown as sd

SOURCES = Path(__file__).parent
ALGORITHMS = ("one-sample", "two-sample", "three-sample", "four-sample", "eight-sample")
STARS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
STAR_SIGMA = float(np.radians(20.0 / 3600.0))
SETUP = sd.FilterSetup(
    process_noise=sd.ProcessNoise(angle_random_walk=float(np.radians(0.15) / 60.0), rate_random_walk=1e-9),
    attitude_sigma=float(np.radians(0.25)),
    bias_sigma=float(np.radians(10.0 / 3600.0)),
)


def sensors() -> list[sd.VectorSensor]:
    """Return the two star directions."""
    return [
        sd.VectorSensor(name=f"star {k}", reference_f=np.array(star), sigma=STAR_SIGMA, rate=1.0)
        for k, star in enumerate(STARS, 1)
    ]


def simulation() -> str:
    """Return the exported filter, the coefficients of the algorithms and the simulation, as statements of one script."""
    with tempfile.TemporaryDirectory() as folder:
        (path,) = sd.export(SETUP, sensors(), folder=folder, to="js")
        exported = path.read_text(encoding="utf-8")
    # Browsers refuse to import modules of pages that are opened from a disk.
    exported = re.sub(r"^export (?=const|function)", "", exported, flags=re.MULTILINE)
    coefficients = {name: [float(k) for k in sd.coning.ALGORITHMS[name].coefficients] for name in ALGORITHMS}
    constants = {
        "angleRandomWalk": SETUP.process_noise.angle_random_walk,
        "biasSigma": SETUP.bias_sigma,
        "starSigma": STAR_SIGMA,
        "stars": STARS,
    }
    texts = (
        exported,
        f"const ALGORITHMS = {json.dumps(coefficients)};",
        f"const SETUP = {json.dumps(constants)};",
        (SOURCES / "simulation.js").read_text(encoding="utf-8"),
    )
    return "\n".join(texts)


def write(folder: Path) -> None:
    """Write ``coning.js`` into a folder of static files."""
    page = (SOURCES / "page.js").read_text(encoding="utf-8")
    (folder / "coning.js").write_text(f'"use strict";\n(() => {{\n{simulation()}\n{page}}})();\n', encoding="utf-8")
