"""Axes and signs of a recording's sensors, if they differ from those of :mod:`strapdown`.

The gyro's sign is by the right-hand rule, the accelerometer measures the specific force (at rest +g upward), the magnetometer the field.
Devices differ: bodies whose z axis points down, phones whose accelerometer has the opposite sign, boards with a rotated magnetometer.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array, InputError, are_finite, one_of
from strapdown.records.recording import SENSORS, Recording


def axes_matrix(text: str, name: str = "axes") -> Array:
    """Return the signed permutation C (3, 3) of a text such as ``"x,-y,-z"``: ``v = C v_recorded``.

    Examples
    --------
    >>> axes_matrix("y,-x,z") @ [1.0, 2.0, 3.0]
    array([ 2., -1.,  3.])
    """
    parts = text.replace("\N{MINUS SIGN}", "-").replace("+", "").replace(" ", "").lower().split(",")
    if sorted(part.removeprefix("-") for part in parts) != ["x", "y", "z"]:
        raise InputError(f"{name} is {text!r}; give each of x, y and z once, with a sign where inverted, as in x,-y,-z")
    matrix = np.zeros((3, 3))
    for row, part in enumerate(parts):
        matrix[row, "xyz".index(part[-1])] = -1.0 if part.startswith("-") else 1.0
    return matrix


def with_axes(
    recording: Recording, axes: str | Mapping[str, str] | None = None, invert: str | Iterable[str] = ()
) -> Recording:
    """Return a recording in other body axes, or with the axes of single sensors corrected; its ``remarks`` list the changes.

    ``axes`` are the recorded axes that become x, y, z, ``"x,-y,-z"`` from forward-right-down to forward-left-up, of the whole unit with its
    reference attitude, or of single sensors, ``{"magnetometer": "y,x,-z"}``. ``invert`` lists sensors with inverted sign on all axes.
    """
    whole, single = (None, dict(axes)) if isinstance(axes, Mapping) else (axes, {})
    matrices = {sensor: axes_matrix(text, f"axes of the {sensor}") for sensor, text in single.items()}
    words = [f"Axes of the {sensor} read as ({text})." for sensor, text in single.items()]
    for sensor in [invert] if isinstance(invert, str) and invert else invert:
        matrices[sensor] = -matrices.get(sensor, np.eye(3))
        words.append(f"Sign of the {sensor} inverted.")
    for sensor in matrices:
        if one_of("axes and invert: sensor", sensor, SENSORS) not in recording.parts:
            raise InputError(f"{recording.source} has no {sensor}; leave its axes and its inversion out")
    changed: dict[str, Any] = {}
    if whole:
        turn = axes_matrix(whole)
        words.append(f"Body axes read as ({whole}).")
        matrices = {s: turn @ matrices.get(s, np.eye(3)) for s in SENSORS if s in recording.parts}
        if recording.true_attitude is not None:  # of v' = C v it is R' = R Cᵀ
            changed["true_attitude"] = _turned(recording.source, recording.true_attitude, turn.T)
    changed |= {SENSORS[sensor]: getattr(recording, SENSORS[sensor]) @ C.T for sensor, C in matrices.items()}
    return replace(recording, remarks=(*recording.remarks, *words), **changed)


def _turned(source: str, attitude: Array, turn: Array) -> Array:
    if np.linalg.det(turn) < 0.0:
        raise InputError(f"{source}: axes mirror the unit, which its reference cannot be; give those of single sensors")
    known = are_finite(attitude)
    result = attitude.copy()
    result[known] = quaternion.multiply(attitude[known], quaternion.from_matrix(turn))
    return result
