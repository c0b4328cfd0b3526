"""Parameters of the filter of recordings: what a choice on all sets but one is worth, and what each part of the model gives.

*Left out*: of the released parameters and those with one of :data:`SEARCHED` multiplied by a factor, those are chosen with the least
geometric mean, over the other sets, of the error relative to VQF's (offline VQF's for the smoother), and scored on the set left out. Sets
without a magnetometer have parameters of their own, chosen on all sets without their magnetometers.

*Parts*: the released parameters with one part of the model left out in turn (:data:`PARTS`).

Run ``python benchmarks/recording_parameters.py [--every N] [--json FILE] FOLDER...``; a folder is a set (``benchmarks/recordings.py``).
"""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import recordings as leaderboard
from strapdown import ahrs
from strapdown.ahrs import AhrsParameters, starting
from strapdown.checks import Array
from strapdown.files import write_json
from strapdown.recordings import Recording, sensor_faults

SEARCHED = {
    "acceleration_time": (0.5, 1.5),
    "rate_random_walk": (0.4, 2.5),
    "gyro_scale_sigma": (0.5, 2.0),
    "accelerometer_bias_sigma": (0.5, 2.0),
    "hard_iron_time": (0.4, 2.5),
    "usual_variation": (0.5, 2.0),
    "field_deviation": (0.6, 1.6),
    "field_change_time": (0.5, 2.0),
}
"""Factors by which each parameter is multiplied."""

MIN_COVERAGE = 0.88
"""Minimum coverage of the total, mean over a set, with which parameters are chosen."""


PARTS: dict[str, dict[str, float] | tuple[Any, dict[str, Any]]] = {
    "nothing": {},
    "bounded velocity (white acceleration instead)": {"velocity_sigma": 0.0, "specific_force_noise": 0.6},
    "gyro scale and misalignment": {"gyro_scale_sigma": 0.0},
    "level of the motion": {"usual_variation": 0.0},
    "accelerometer bias that rest shows": (starting, {"MAX_DEVIATION": np.inf}),
    "accelerometer bias": {"accelerometer_bias_sigma": 0.0},
    "drift of the gyro's bias": {"rate_random_walk": 0.0},
    "hard iron": {"hard_iron_sigma": 0.0},
    "deviation of the field": {"field_deviation": 1e3},
    "recognition of interpolated gaps": (sensor_faults, {"interpolated": lambda *_: []}),
}
"""What is left out of the model: parameters, or names of a module, with other values."""


@dataclass(frozen=True)
class Group:
    """A set with a model: its recordings, and the total error of the peer on each."""

    name: str
    recordings: list[Recording]
    peer: Array

    @property
    def magnetometer(self) -> bool:
        """Whether there is one."""
        return self.recordings[0].magnetic_field is not None


def groups(folders: Sequence[Path], *, smooth: bool, every: int = 1) -> list[Group]:
    """Return the sets, and after them those with a magnetometer without it, their names with a minus sign."""
    sets = [(folder.name, leaderboard.read(folder)[::every]) for folder in folders]
    for name, those in sets[:]:
        if those[0].magnetic_field is not None:
            sets.append(
                (f"{name} −", [replace(recording, magnetic_field=None, magnetic_unit="") for recording in those])
            )
    peer = functools.partial(leaderboard.vqf, offline=smooth)
    return [
        Group(name, those, np.array([leaderboard.score(recording, peer).error_deg for recording in those])[:, 0])
        for name, those in sets
    ]


def scored(group: Group, parameters: AhrsParameters, *, smooth: bool) -> dict[str, float]:
    """Return the error of the total relative to the peer's, the coverage of the total and the median NEES."""

    def run(recording: Recording) -> tuple[Array, Array]:
        estimate = ahrs.estimate(recording, parameters, smooth=smooth, full_covariance=True).estimate
        assert estimate.covariance is not None
        return estimate.attitude, estimate.covariance[:, :3, :3]

    result = leaderboard.mean([leaderboard.score(recording, run) for recording in group.recordings])
    assert result.error_deg is not None
    assert result.coverage is not None
    return {
        "ratio": result.error_deg[0] / float(group.peer.mean()),
        "coverage": result.coverage[0],
        "nees": result.nees,
    }


def geometric_mean(scores: Sequence[dict[str, float]]) -> float:
    """Return the geometric mean of the ratios."""
    return float(np.exp(np.mean(np.log([score["ratio"] for score in scores]))))


def left_out(those: Sequence[Group], *, smooth: bool) -> dict[str, Any]:
    """Return what is chosen on the other sets, and the score on each set that counts: those as recorded."""
    result: dict[str, Any] = {}
    for magnetometer in (True, False):
        model = [group for group in those if group.magnetometer == magnetometer]
        released = ahrs.of_motion("hand", magnetometer=magnetometer, smooth=smooth)
        candidates = {"released": released}
        for name, factors in SEARCHED.items():
            value = getattr(released, name)
            candidates |= {f"{name} {f * value:.3g}": replace(released, **{name: f * value}) for f in factors if value}
        scores = {}
        for name, parameters in candidates.items():
            scores[name] = [scored(group, parameters, smooth=smooth) for group in model]
            print(
                "smoothed" if smooth else "online",
                name,
                [round(score["ratio"], 3) for score in scores[name]],
                flush=True,
            )
        for k, group in enumerate(model):
            others = {name: those[:k] + those[k + 1 :] for name, those in scores.items()}
            enough = [n for n, s in others.items() if min(score["coverage"] for score in s) >= MIN_COVERAGE] or [
                "released"
            ]
            best = min(enough, key=lambda name: geometric_mean(others[name]))
            if not group.name.endswith("−"):
                result[group.name] = {"chosen": best, **scores[best][k], "released": scores["released"][k]["ratio"]}
    print("geometric mean on the sets left out:", round(geometric_mean(list(result.values())), 3), flush=True)
    return result


def parts(those: Sequence[Group], *, smooth: bool) -> dict[str, Any]:
    """Return the scores without each part: the geometric mean of the errors, and the mean coverage of the total."""
    result = {}
    for name, part in PARTS.items():
        changes, module = ({}, patch.multiple(part[0], **part[1])) if isinstance(part, tuple) else (part, nullcontext())
        scores = []
        with module:
            for group in those:
                parameters = ahrs.of_motion("hand", magnetometer=group.magnetometer, smooth=smooth)
                scores.append(scored(group, replace(parameters, **changes), smooth=smooth))
        held = float(np.mean([score["coverage"] for score in scores]))
        result[name] = {"ratio": geometric_mean(scores), "coverage": held}
        print("smoothed" if smooth else "online", "without", name, result[name], flush=True)
    return result


def table(result: dict[str, Any]) -> str:
    """Return the parts as a table in Markdown: geometric mean of the errors, and mean coverage of the total."""
    rows = [["left out", "online", "95 % region", "smoothed", "95 % region"], ["---"] * 5]
    for name in result["parts"]["online"]:
        cells = [name]
        for mode in ("online", "smoothed"):
            score = result["parts"][mode][name]
            cells += [f"{score['ratio']:.3f}", f"{score['coverage']:.2f}"]
        rows.append(cells)
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def main(folders: Sequence[Path], studies: Sequence[str], *, every: int = 1) -> dict[str, Any]:
    """Return the results of the studies, online and smoothed."""
    result: dict[str, Any] = {name: {} for name in studies}
    for smooth in (False, True):
        those = groups(folders, smooth=smooth, every=every)
        for name in studies:
            study = (
                left_out(those, smooth=smooth) if name == "left out" else parts(those[: len(folders)], smooth=smooth)
            )
            result[name]["smoothed" if smooth else "online"] = study
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--studies", nargs="+", choices=("left out", "parts"), default=["left out", "parts"])
    parser.add_argument("--every", type=int, default=1, help="use every N-th recording of each set")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    scores = main(arguments.folders, arguments.studies, every=arguments.every)
    if arguments.json:
        write_json(arguments.json, scores)
