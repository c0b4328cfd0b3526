"""Check of conventions of a recording: conjugated quaternions, swapped axes, wrong frames and units.

A recording that follows the conventions of :mod:`strapdown` satisfies these relations, whatever the motion:

- the rotation measured by the gyro over a short window is that of the reference attitude, log(q₁⁻¹ ⊗ q₂);
- the specific force, rotated to the fixed frame by the reference, is the reaction to gravity on average over some seconds, because no body
  accelerates in one direction for long; the magnetic field points North and up or down;
- without a reference: specific force and field, rotated by the integrated gyro, are constant over some seconds, so their means keep their
  magnitude, and the angle between both means is always the same.

Each hypothesis (order and direction of the quaternions, fixed frame, one of the 48 permutations and inversions of a sensor's axes, unit)
is applied, and the misfit m of each relation computed: 0 for a perfect fit, 1 for unrelated data, 2 for opposite data. The score is a
log-likelihood, ``−½ 3K ln(m + m₀)`` summed over the relations, with K = 20 and m₀ the misfit of a good recording, less 5 for each change
from the declared conventions: of two explanations that fit equally well, the simpler one is reported.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from strapdown import coning, quaternion
from strapdown.ahrs.starting import quiet_span
from strapdown.checks import Array, InputError, lengths
from strapdown.records.recording import Recording, increments
from strapdown.units import DEGREE, STANDARD_GRAVITY

__all__ = [
    "Examination",
    "examine",
]

AXES: tuple[Array, ...] = tuple(
    np.array([[s if column == where else 0.0 for column in range(3)] for where, s in zip(order, signs, strict=True)])
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
)
"""All 48 permutations and inversions of the axes, the identity first."""
_ALL = np.stack(AXES)

ATTITUDE_READINGS: dict[str, Callable[[Array], Array]] = {
    "conjugated (fixed to body)": quaternion.conjugate,
    "scalar-last": lambda q: np.roll(q, 1, axis=-1),
    "scalar-last and conjugated": lambda q: quaternion.conjugate(np.roll(q, 1, axis=-1)),
}
"""Conversions of quaternions in other conventions to q_fb (body to fixed), scalar first."""

FRAMES: dict[str, Array] = {
    "East-North-Up": np.eye(3),
    "North-East-Down": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "North-West-Up": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
"""Fixed frames, with the matrices that transform their components to East-North-Up."""


def _unit(fault: str, taken: str, sensor: str, unit: str) -> str:
    """Return the description of a wrong unit, with its remedy."""
    return f"{fault} ({taken}: --{sensor}-unit {unit}; units={{{sensor!r}: {unit!r}}} in Python)"


GYRO_UNITS: dict[str, float] = {
    "": 1.0,
    _unit("gyro rates are 57.3 times too large", "deg/s read as rad/s", "gyro", "deg/s"): math.pi / 180.0,
    _unit("gyro rates are 57.3 times too small", "rad/s read as deg/s", "gyro", "rad/s"): 180.0 / math.pi,
}
FORCE_UNITS: dict[str, float] = {
    "": 1.0,
    _unit("specific force is 9.81 times too small", "g read as m/s²", "accelerometer", "g"): STANDARD_GRAVITY,
    _unit("specific force is 9.81 times too large", "m/s² read as g", "accelerometer", "m/s2"): 1.0 / STANDARD_GRAVITY,
}

PENALTY = 5.0
FLOORS = {"reference": 0.003, "vectors": 0.04}
"""m₀ of relations to a reference, and of those between sensors only, which accelerations and the gyro's bias disturb."""
WINDOWS = 50
"""Maximum number of windows evaluated."""
INDEPENDENT = 20
"""Effective number of windows: their disturbances are not independent."""
MARGIN = 5.0
"""Minimum difference in score between distinguishable explanations."""
MAX_EQUAL = 8
"""Maximum number of equally good explanations, which may be symmetries of the relations; above it the recording has too little motion."""
POOR = 0.4
"""Misfit above which the best explanation is rejected, if every relation exceeds it."""
MIN_TURN = 0.5
"""Minimum rotation, rad, summed over the windows used, for a decision."""
FASTEST = 4000.0 * DEGREE
"""Rate, rad/s, beyond the range of nearly all gyros."""


def axes_words(matrix: Array) -> str:
    """Return a signed permutation in words, such as "x, −z, y"."""
    names = []
    for row in matrix:
        k = int(np.argmax(np.abs(row)))
        names.append(f"{'−' if row[k] < 0.0 else ''}{'xyz'[k]}")
    return ", ".join(names)


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """One explanation of a recording.

    Parameters
    ----------
    changes : tuple of str
        Changes of the declared conventions; empty: none.
    score : float
        Log-likelihood less the penalty for changes.
    misfit : mapping of str to float
        Misfit of each relation: 0 perfect, 1 unrelated, 2 opposite.
    """

    changes: tuple[str, ...]
    score: float
    misfit: Mapping[str, float]

    @property
    def words(self) -> str:
        """The changes in one line."""
        return "; ".join(self.changes) or "no change"


@dataclass(frozen=True, kw_only=True)
class Examination:
    """Result of the check of conventions.

    Parameters
    ----------
    source : str
        Name of the recording.
    verdict : {"as declared", "wrong convention", "cannot tell"}
        Verdict.
    reason : str
        Reason of the verdict, in one sentence.
    candidates : tuple of Candidate
        The best explanations, by score.
    notes : tuple of str, default empty
        Conventions that cannot be checked with this recording.
    doubts : tuple of str, default empty
        Values that are implausible under any convention.
    """

    source: str
    verdict: Literal["as declared", "wrong convention", "cannot tell"]
    reason: str
    candidates: tuple[Candidate, ...]
    notes: tuple[str, ...] = field(default=())
    doubts: tuple[str, ...] = field(default=())

    @property
    def words(self) -> str:
        """Verdict and reason in one line."""
        return f"{self.verdict}: {self.reason}"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for an estimate, in which wrong axes, signs or units are easily overlooked."""
        return (f"probably {self.reason}",) if self.verdict == "wrong convention" else self.doubts

    def summary(self) -> dict[str, Any]:
        """Return everything as plain values for JSON.

        Returns
        -------
        dict
            Fields of the examination.
        """
        return {
            "source": self.source,
            "verdict": self.verdict,
            "reason": self.reason,
            "candidates": [
                {"changes": list(one.changes), "score": one.score, "misfit": dict(one.misfit)}
                for one in self.candidates
            ],
            "notes": list(self.notes),
            "doubts": list(self.doubts),
        }


def examine(recording: Recording) -> Examination:
    """Check which conventions a recording follows, by comparison with the alternatives.

    Parameters
    ----------
    recording : Recording
        Recording with a reference attitude, an accelerometer or a magnetometer; each of them allows more checks.

    Returns
    -------
    Examination
        Verdict, reason and the best explanations.

    Raises
    ------
    InputError
        If the recording has only a gyro, with which nothing can be compared.
    """
    if all(value is None for value in (recording.true_attitude, recording.specific_force, recording.magnetic_field)):
        raise InputError(
            f"{recording.source} has only a gyro; a reference attitude, an accelerometer or a magnetometer is needed too"
        )
    unit_changes, doubts = _force_unit(recording)
    doubts += _too_fast(recording)
    unsaid = [f"as it seems, {words}" for words in unit_changes]  # gravity alone shows it, whatever the turns do
    upright = at_rest(recording)
    found = list(_with_reference(recording) if recording.true_attitude is not None else _without_reference(recording))
    notes = _unseen(recording)
    if not found:
        return Examination(
            source=recording.source,
            verdict="cannot tell",
            reason="the recording has hardly any rotation, or too few samples",
            candidates=(),
            notes=tuple(notes),
            doubts=tuple(upright + unsaid + doubts),
        )
    candidates = [
        Candidate(
            changes=(*one.changes, *unit_changes),
            score=one.score - PENALTY * len(unit_changes),
            misfit=one.misfit,
        )
        for one in found
    ]
    candidates.sort(key=lambda one: -one.score)
    result = _concluded(recording.source, candidates, unit_changes, notes)
    if upright and result.verdict == "as declared":
        result = replace(
            result, verdict="cannot tell", reason="the sensors agree with each other; see the warning on their sign"
        )
    return replace(result, doubts=tuple(upright + (unsaid if result.verdict == "cannot tell" else []) + doubts))


def _concluded(source: str, candidates: list[Candidate], sure: tuple[str, ...], notes: list[str]) -> Examination:
    best = candidates[0]
    plain = next(one for one in candidates if len(one.changes) == len(sure))
    named = best if best.score - plain.score >= MARGIN else plain
    fit = {id(one): one.score + PENALTY * len(one.changes) for one in candidates}
    equal = [one for one in candidates if one is not named and fit[id(one)] > fit[id(named)] - MARGIN]
    verdict: Literal["as declared", "wrong convention", "cannot tell"]
    if min(best.misfit.values()) > POOR:
        verdict = "cannot tell"
        reason = "no explanation tried fits; misfits of the best one: " + ", ".join(
            f"{name} {value:.2f}" for name, value in best.misfit.items()
        )
    elif len(equal) > MAX_EQUAL:
        verdict = "cannot tell"
        reason = f"{len(equal)} other explanations fit as well as “{named.words}”: the rotation is too small, or about one axis only"
    elif named is plain:
        verdict = "wrong convention" if sure else "as declared"
        reason = "; ".join(sure) if sure else "no change explains the recording better than its declared conventions"
    else:
        verdict, reason = "wrong convention", named.words
    if equal and verdict != "cannot tell":
        notes = [*notes, "fits as well: " + " / ".join(one.words for one in equal)]
    return Examination(
        source=source, verdict=verdict, reason=reason, candidates=tuple(candidates[:12]), notes=tuple(notes)
    )


REST_SPREAD = 0.05
"""Maximum σ of the specific force over the quiet second, relative to its mean, of a unit at rest."""
REST_STRENGTH = 0.15
"""Maximum relative deviation of the mean specific force from gravity, of a unit at rest."""
DOWN = 0.7
"""Share of gravity along the body's −z axis above which z points down."""
MIN_DIP = 10.0 * DEGREE
"""Minimum angle of the field to the horizontal for it to distinguish up from down."""


def at_rest(recording: Recording) -> list[str]:
    """Return warnings if gravity and the field at rest contradict body axes with z up or an accelerometer that reads +g upward.

    The sensors of a body whose z axis points down agree with each other, and so do those of a unit with an inverted accelerometer; the
    attitude is then in error by 180°. With a reference attitude the error is found by :func:`examine`.
    """
    seen = None if recording.true_attitude is not None else _resting(recording)
    if seen is None:
        return []
    upward, reading, dip = seen
    reads = f"at rest the accelerometer reads {reading:.3g} m/s² along z"
    if dip is not None and dip < -MIN_DIP:
        field = (
            f"the field points {-dip / DEGREE:.0f}° upward by the accelerometer, as south of the magnetic equator only"
        )
        if upward > DOWN:
            return [f"{field}; elsewhere the magnetometer is inverted (--invert magnetometer; invert= in Python)"]
        return [
            f"{reads}, and {field}; elsewhere the accelerometer is inverted, as those of iPhones "
            "(--invert accelerometer; invert= in Python)"
        ]
    if upward >= -DOWN:
        return []
    where = " south of the magnetic equator" if dip is not None and dip > MIN_DIP else ""
    return [
        f"{reads}: the body's z axis points down (--axes x,-y,-z, axes= in Python, reads forward-right-down as forward-left-up; "
        f"--frame ned keeps them and gives the output in North-East-Down), or the unit lies upside down, or{where} the accelerometer is "
        "inverted (--invert accelerometer; invert= in Python)"
    ]


def _resting(recording: Recording) -> tuple[float, float, float | None] | None:
    """Return the share of gravity along the body's z axis, the reading there, m/s², and the field's dip, rad; None if not at rest."""
    force = recording.specific_force
    try:
        quiet = quiet_span(recording)
    except InputError:  # too short
        return None
    if force is None or not (known := np.isfinite(force[quiet]).all(axis=1)).any():
        return None
    samples = force[quiet][known]
    mean = samples.mean(axis=0)
    strength = float(np.linalg.norm(mean))
    unit = STANDARD_GRAVITY if strength > math.sqrt(STANDARD_GRAVITY) else 1.0  # m/s², or g read as m/s²
    moving = np.linalg.norm(samples.std(axis=0)) >= REST_SPREAD * strength
    if moving or abs(strength / unit - 1.0) > REST_STRENGTH:
        return None
    return float(mean[2]) / strength, float(mean[2]), _dip(recording, quiet, mean / strength)


def _dip(recording: Recording, quiet: slice, up: Array) -> float | None:
    """Return the angle of the field below the horizontal, rad, at quiet samples."""
    if recording.magnetic_field is None:
        return None
    samples = recording.magnetic_field[quiet]
    field = samples[np.isfinite(samples).all(axis=1)]
    if len(field) == 0 or not np.any(mean := field.mean(axis=0)):
        return None
    return -math.asin(float(np.clip(mean @ up / np.linalg.norm(mean), -1.0, 1.0)))


def _force_unit(recording: Recording) -> tuple[tuple[str, ...], list[str]]:
    if recording.specific_force is None:
        return (), []
    strength = float(np.nanmedian(lengths(recording.specific_force)))
    if not strength > 0.0:
        return (), ["the accelerometer reads zero throughout"]
    distances = {words: abs(math.log(strength * factor / STANDARD_GRAVITY)) for words, factor in FORCE_UNITS.items()}
    words = min(distances, key=lambda name: distances[name])
    if distances[words] > 0.5:
        return (), [f"the median specific force, {strength:.3g} m/s², fits neither m/s² nor g"]
    return ((words,) if words else ()), []


def _too_fast(recording: Recording) -> list[str]:
    speed = lengths(recording.rate)
    k = int(np.argmax(speed))
    if speed[k] <= FASTEST:
        return []
    return [
        f"the gyro reads {speed[k] / DEGREE:.3g} °/s at {recording.time[k]:.6g} s, and {np.mean(speed > FASTEST):.2%} of its samples "
        f"exceed {FASTEST / DEGREE:g} °/s, the range of nearly all gyros"
    ]


def _unseen(recording: Recording) -> list[str]:
    notes = []
    if recording.true_attitude is None:
        notes.append(
            "without a reference attitude these cannot be checked: an accelerometer (or magnetometer) inverted on all axes, "
            "axes swapped alike on all sensors, the fixed frame"
        )
        if recording.specific_force is None or recording.magnetic_field is None:
            notes.append("with only one sensor besides the gyro, it cannot be decided which of the two has wrong axes")
    elif recording.magnetic_field is None:
        notes.append("without a magnetometer a wrong frame cannot be distinguished from an inverted accelerometer")
    elif recording.specific_force is None:
        notes.append("without an accelerometer the vertical cannot be checked")
    return notes


def _score(misfit: float, kind: str = "reference") -> float:
    return -1.5 * INDEPENDENT * math.log(max(misfit, 0.0) + FLOORS[kind])


SPAN = 4.0
"""Duration of the windows over which vectors are averaged, s: accelerations average out, and the gyro's bias causes a small rotation."""
MIN_INTERVAL = 0.02
"""Minimum interval of the samples of a vector used, s."""


class _Windows(NamedTuple):
    """Windows with the fastest rotation, and the samples of a vector there."""

    rows: np.ndarray
    """Rows of the samples in the recording (m,)."""
    vectors: Array
    """Vectors relative to their median magnitude (m, 3)."""
    begin: np.ndarray
    """First sample of each window but the first."""
    counts: np.ndarray
    """Number of samples of each window."""

    def means(self, attitude: Array) -> Array:
        """Return the means over each window of R_ab v_c (windows, 3, 3, 3), R of attitudes at the rows (m, 4)."""
        turned = quaternion.to_matrix(attitude).reshape(-1, 9)
        parts = zip(np.split(turned, self.begin), np.split(self.vectors, self.begin), strict=True)
        sums = np.reshape([R.T @ w for R, w in parts], (-1, 3, 3, 3))
        return np.asarray(sums / self.counts[:, None, None, None])


def _turned(means: Array, axes: Array) -> Array:
    """Return the mean of R A v over each window (..., windows, 3) for axes A (..., 3, 3)."""
    flat = means.reshape(len(means), 3, 9)
    return np.asarray(np.moveaxis(flat @ axes.reshape(*axes.shape[:-2], 9).T, (0, 1), (-2, -1)))


def _windows(recording: Recording, vectors: Array | None, known: np.ndarray | bool = True) -> _Windows | None:
    """Return the windows with samples of a vector, where the attitude is ``known``; None if there are none."""
    strength = 0.0 if vectors is None else float(np.nanmedian(lengths(vectors)))
    if vectors is None or not strength > 0.0:
        return None
    step = max(1, round(MIN_INTERVAL / float(np.median(np.diff(recording.time)))))
    rows = slice(None, None, step)
    time, v = recording.time[rows], vectors[rows] / strength
    seen = np.isfinite(lengths(v)) & np.broadcast_to(known, recording.time.shape)[rows]
    window = np.floor((time - time[0]) / SPAN).astype(int)
    number = int(window[-1]) + 1
    turning = np.bincount(window, lengths(recording.rate[rows]), number) / np.bincount(window, minlength=number).clip(1)
    counts = np.bincount(window[seen], minlength=number)
    full = np.flatnonzero(counts >= 0.5 * max(1.0, SPAN / float(np.median(np.diff(time)))))
    chosen = np.sort(full[np.argsort(-turning[full])][:WINDOWS])
    used = np.flatnonzero(seen & np.isin(window, chosen))
    begin = np.flatnonzero(np.diff(window[used], prepend=-1))[1:]
    return _Windows(step * used, v[used], begin, counts[chosen]) if len(chosen) else None


# ------------------------------------------------------------------------------------------------------------------ with a reference

REFERENCE_SPAN = 0.1
"""Duration of the windows over which the rotations of gyro and reference are compared, s."""


def _with_reference(recording: Recording) -> Iterator[Candidate]:
    assert recording.true_attitude is not None
    known = np.isfinite(recording.true_attitude).all(axis=1)
    known &= lengths(np.nan_to_num(recording.true_attitude)) > 0.0
    first, last, turn = _turns(recording, known)
    if len(first) < 10:
        return
    force = _windows(recording, recording.specific_force, known)
    magnetic = _windows(recording, recording.magnetic_field, known)
    for reading, read in {"": lambda q: q, **ATTITUDE_READINGS}.items():

        def at(rows: np.ndarray, read: Callable[[Array], Array] = read) -> Array:
            return quaternion.normalize(read(recording.true_attitude[rows]))  # type: ignore[index]

        reference = quaternion.log(quaternion.multiply(quaternion.conjugate(at(first)), at(last)))
        if np.sum(np.linalg.norm(reference, axis=1)) < MIN_TURN:
            return
        gyro = _gyro_fits(turn, reference)
        up = None if force is None else _turned(force.means(at(force.rows)), _ALL)
        north = None if magnetic is None else _turned(magnetic.means(at(magnetic.rows)), _ALL)
        for frame, to_enu in FRAMES.items():
            parts = {"gyro": gyro}
            if up is not None:
                parts["accelerometer"] = _force_fits(up @ to_enu.T)
            if north is not None:
                parts["magnetometer"] = _field_fits(north @ to_enu.T)
            common = tuple(
                words
                for words in (
                    f"reference quaternions are {reading}" if reading else "",
                    f"the reference's fixed frame is {frame}" if frame != "East-North-Up" else "",
                )
                if words
            )
            yield from _combined(common, parts)


def _turns(recording: Recording, known: np.ndarray) -> tuple[np.ndarray, np.ndarray, Array]:
    """Return first and last samples of the short windows with the largest rotations, and the rotations (k, 3) measured there by the gyro.

    ``known`` masks the samples at which a window may begin and end.
    """
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(increments(recording), axis=0)])
    step = max(1, round(REFERENCE_SPAN / float(np.median(np.diff(recording.time)))))
    first = np.arange(0, len(recording.time) - step, max(1, step // 2))
    first = first[known[first] & known[first + step]]
    turn = total[first + step] - total[first]
    chosen = np.sort(np.argsort(-lengths(turn))[:2000])
    return first[chosen], first[chosen] + step, turn[chosen]


_Fits = dict[tuple[int, str], float]
"""Misfit by index of the axes in AXES and description of the unit."""


def _gyro_fits(turn: Array, reference: Array) -> _Fits:
    """Return misfits of ``reference = unit · axes · turn``."""
    cross = reference.T @ turn
    own, other = float(np.sum(turn**2)), float(np.sum(reference**2))
    return {
        (k, words): 1.0 - 2.0 * factor * float(np.sum(matrix * cross)) / (factor**2 * own + other)
        for k, matrix in enumerate(AXES)
        for words, factor in GYRO_UNITS.items()
    }


def _force_fits(v: Array) -> _Fits:
    """Return misfits of the mean specific force, by axes and window (48, windows, 3), East-North-Up, with the vertical."""
    misfit = 1.0 - 2.0 * v[..., 2].sum(axis=1) / (np.sum(v**2, axis=(1, 2)) + v.shape[1])
    return {(k, ""): float(value) for k, value in enumerate(misfit)}


def _field_fits(v: Array) -> _Fits:
    """Return misfits of the mean field with the best-fitting field that points North, of any dip."""
    _, north, up = v.mean(axis=1).T
    along = np.where(north > 0.0, np.hypot(north, up), np.abs(up))
    misfit = 1.0 - 2.0 * along / (np.mean(np.sum(v**2, axis=2), axis=1) + 1.0)
    return {(k, ""): float(value) for k, value in enumerate(misfit)}


def _combined(common: tuple[str, ...], parts: dict[str, _Fits]) -> Iterator[Candidate]:
    """Yield combinations of the best settings of each sensor, and those that change the axes of all sensors alike."""

    def penalised(item: tuple[tuple[int, str], float]) -> float:
        (k, unit), misfit = item
        return _score(misfit) - PENALTY * ((k > 0) + bool(unit))

    best = [
        dict([((0, ""), fits[0, ""]), *sorted(fits.items(), key=penalised, reverse=True)[:3]]).items()
        for fits in parts.values()
    ]
    for chosen in itertools.product(*best):
        changes = list(common)
        for name, ((k, unit), _) in zip(parts, chosen, strict=True):
            changes += [_axes_change(name, k)] if k else []
            changes += [unit] if unit else []
        yield _candidate(tuple(changes), dict(zip(parts, (m for _, m in chosen), strict=True)))
    if len(parts) > 1:
        for k in range(1, len(AXES)):
            yield _candidate(
                (*common, _axes_change("whole unit", k)), {name: fits[k, ""] for name, fits in parts.items()}
            )


@functools.cache
def _axes_change(name: str, k: int) -> str:
    if np.array_equal(AXES[k], -np.eye(3)):
        return f"axes of the {name} are inverted" + (
            f" (--invert {name}; invert= in Python)" if name != "whole unit" else ""
        )
    words = axes_words(AXES[k])
    option = words.replace("−", "-").replace(" ", "")
    return f"axes of the {name} should be read as ({words}) (--axes {'' if name == 'whole unit' else f'{name}='}{option}; axes= in Python)"


def _candidate(changes: tuple[str, ...], misfit: dict[str, float], kind: str = "reference") -> Candidate:
    score = sum(_score(value, kind) for value in misfit.values()) - PENALTY * len(changes)
    return Candidate(changes=changes, score=score, misfit=misfit)


# --------------------------------------------------------------------------------------------------------------- without a reference


def _without_reference(recording: Recording) -> Iterator[Candidate]:
    """Yield explanations with one wrong sensor: two wrong sensors could not be distinguished from the third one being wrong.

    For a proper rotation P of the gyro's axes, increments P Δθ integrate to P R Pᵀ. P therefore has the same effect on a vector's mean as
    axes Pᵀ of the vector's sensor. An improper P is a proper one of the inverted gyro, which is integrated separately.
    """
    windows = {
        name: found
        for name, vectors in (
            ("accelerometer", recording.specific_force),
            ("magnetometer", recording.magnetic_field),
        )
        if (found := _windows(recording, vectors)) is not None
    }
    if not windows:
        return
    turns = increments(recording)
    for unit, factor in GYRO_UNITS.items():
        changes = (unit,) if unit else ()
        for sign in (1.0, -1.0):
            attitude = coning.integrate(sign * factor * turns)
            means = {name: one.means(attitude[one.rows]) for name, one in windows.items()}
            for k, matrix in enumerate(AXES):
                if np.linalg.det(matrix) * sign > 0.0:
                    axes = dict.fromkeys(means, sign * matrix.T)
                    yield _candidate(
                        (*([_axes_change("gyro", k)] if k else []), *changes), _fixed_misfits(means, axes), "vectors"
                    )
                if k and sign > 0.0 and not unit:
                    for name in means:
                        axes = {other: matrix if other == name else np.eye(3) for other in means}
                        yield _candidate((_axes_change(name, k),), _fixed_misfits(means, axes), "vectors")


def _fixed_misfits(means: dict[str, Array], axes: dict[str, Array]) -> dict[str, float]:
    """Return the relative loss of magnitude of the means, and the spread of the angle between two of them."""
    vectors = {name: _turned(mean, axes[name]) for name, mean in means.items()}
    length = {name: np.linalg.norm(v, axis=1) for name, v in vectors.items()}
    misfit = {f"gyro and {name}": max(0.0, 1.0 - float(np.mean(size))) for name, size in length.items()}
    if len(vectors) == 2:
        one, other = vectors
        rows = min(len(vectors[one]), len(vectors[other]))
        product = np.sum(vectors[one][:rows] * vectors[other][:rows], axis=1)
        cosine = product / np.maximum(length[one][:rows] * length[other][:rows], 1e-12)
        misfit[f"{one} and {other}"] = float(3.0 * np.var(cosine))  # two unrelated directions: 1/3
    return misfit
