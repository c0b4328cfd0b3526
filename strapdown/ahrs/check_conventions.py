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
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from strapdown import coning, quaternion
from strapdown.ahrs.starting import quiet_span
from strapdown.checks import Array, Hint, InputError, are_finite, lengths, median
from strapdown.files import plain
from strapdown.kernels import recording_steps
from strapdown.kernels.lane_values import WIDTH
from strapdown.kernels.machine import compiled, read_only
from strapdown.recordings import sensor_delays, sensor_faults
from strapdown.records.outputs import FIXED_FRAMES
from strapdown.records.recording import Recording, sampled
from strapdown.results import Column, Table
from strapdown.units import DEGREE, STANDARD_GRAVITY

__all__ = ["Examination", "examine"]

AXES: Array = np.array(
    [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
)
"""All 48 permutations and inversions of the axes (48, 3, 3), the identity first."""

ATTITUDE_READINGS: dict[str, Callable[[Array], Array]] = {
    "conjugated (fixed to body)": quaternion.conjugate,
    "scalar-last": lambda q: np.roll(q, 1, axis=-1),
    "scalar-last and conjugated": lambda q: quaternion.conjugate(np.roll(q, 1, axis=-1)),
}
"""Conversions of quaternions in other conventions to q_fb (body to fixed), scalar first."""

FRAMES = {name: np.rint(quaternion.to_matrix(q)) for name, q in FIXED_FRAMES.items()}
"""Fixed frames, with the matrices that transform their components to East-North-Up."""


class Change(NamedTuple):
    """A change of the declared conventions."""

    words: str
    hint: str = ""
    """Argument that makes it."""

    def __str__(self) -> str:
        return f"{self.words} ({self.hint})" if self.hint else self.words


def _unit(sensor: str, unit: str) -> Change:
    return Change(f"{sensor} in {unit}", str(Hint("units", {sensor: unit})))


AS_DECLARED = Change("")
GYRO_UNITS: dict[Change, float] = {
    AS_DECLARED: 1.0,
    _unit("gyro", "deg/s"): DEGREE,
    _unit("gyro", "rad/s"): 1.0 / DEGREE,
    _unit("gyro", "mrad/s"): 1e-3,
}
"""Factors of the rates if they were read in a wrong unit: deg/s read as rad/s, rad/s as deg/s, mrad/s as rad/s."""
FORCE_UNITS: dict[Change, float] = {
    AS_DECLARED: 1.0,
    _unit("accelerometer", "g"): STANDARD_GRAVITY,
    _unit("accelerometer", "m/s2"): 1.0 / STANDARD_GRAVITY,
    _unit("accelerometer", "mg"): 1e-3 * STANDARD_GRAVITY,
    _unit("accelerometer", "mm/s2"): 1e-3,
}
"""The same of the specific force: g, mg or mm/s² read as m/s², m/s² read as g."""

NO_CHANGE = "no change"
PENALTY = 5.0
FLOORS = {"reference": 0.003, "vectors": 0.04}
"""m₀ of relations to a reference, and of those between sensors only, which the gyro's bias disturbs. To those of the accelerometer the
mean square difference of its magnitude from gravity, in g, is added: acceleration, and clipping by it, disturb its mean."""
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
    return ", ".join(("−" if np.sum(row) < 0.0 else "") + "xyz"[np.argmax(np.abs(row))] for row in matrix)


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
        Conventions that cannot be checked with this recording, and the delay of the magnetometer.
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

    def listing(self) -> Table:
        """Return the best explanations as a table; the hints to their remedies are in the verdict."""
        columns = [Column("explanation"), Column("score", shown="{:.1f}".format)]
        for name in self.candidates[0].misfit:  # "gyro and accelerometer": gyro–acc
            relation = name.replace("accelerometer", "acc").replace("magnetometer", "mag").replace(" and ", "–")
            columns.append(Column(relation, shown="{:.3f}".format))
        rows = [
            (
                "; ".join(best.changes[:2]) + "; …" * (len(best.changes) > 2) or NO_CHANGE,
                best.score,
                *best.misfit.values(),
            )
            for best in self.candidates[:8]
        ]
        title = "Explanations: score (log-likelihood) and misfit, 0 perfect, 1 unrelated, 2 opposite"
        return Table(title, columns, rows)

    def summary(self) -> dict[str, Any]:
        """Return all fields as plain values for JSON.

        Returns
        -------
        dict
            Fields of the examination.
        """
        return plain(asdict(self))  # type: ignore[no-any-return]


class ConventionWarning(UserWarning):
    """Axes, signs or units of a recording seem wrong."""


def warn(source: Recording) -> bool:
    """Warn the caller of the calling function if axes, signs or units of a recording seem wrong; return whether they do."""
    sentences = _examined(source).warnings
    for words in sentences:
        warnings.warn(f"{source.source}: {words}", ConventionWarning, stacklevel=3)
    return len(sentences) > 0


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
    result = _examined(recording)
    delays = sensor_delays.find(sensor_faults.find(recording).recording)  # as the smoother's
    return replace(result, notes=(*result.notes, *filter(None, [delays.field_words])))


def _examined(recording: Recording) -> Examination:
    """Return :func:`examine`, without the delays."""
    if all(value is None for value in (recording.true_attitude, recording.specific_force, recording.magnetic_field)):
        raise InputError(
            f"{recording.source} has only a gyro; a reference attitude, an accelerometer (with gravity) or a magnetometer is needed too; "
            f"if the file has one, name its columns, as in {Hint('columns', {'ax': 'NAME'})}"
        )
    step = max(1, round(MIN_INTERVAL / recording.interval))
    sensors = {
        name: _sensor(vectors, step)
        for name, vectors in (("accelerometer", recording.specific_force), ("magnetometer", recording.magnetic_field))
        if vectors is not None
    }
    unit_changes, doubts = _force_unit(sensors["accelerometer"]) if "accelerometer" in sensors else ((), [])
    stuck, bursts = sensor_faults.stuck_words(recording), sensor_faults.burst_words(recording)
    doubts += _too_fast(recording) + stuck + bursts
    unsaid = [f"as it seems, {change}" for change in unit_changes]  # gravity alone shows it, whatever the turns
    upright = at_rest(recording)
    explained = _without_reference if recording.true_attitude is None else _with_reference
    explanations = explained(recording, sensors, step)
    notes = tuple(_unseen(recording))
    if explanations is None:
        reason = "the recording has hardly any rotation, or too few samples"
        result = Examination(source=recording.source, verdict="cannot tell", reason=reason, candidates=(), notes=notes)
    else:
        result = _concluded(recording.source, explanations, unit_changes, notes)
        if stuck or bursts:
            reason = f"{'a sensor is stuck' if stuck else 'the samples come in bursts'}; see the warning"
            result = replace(result, verdict="cannot tell", reason=reason, notes=notes)
        elif not doubts and (doubts := _without_gravity(result.candidates[0], sensors.get("accelerometer"))):
            result = replace(result, verdict="cannot tell", reason="the accelerometer shows no gravity", notes=notes)
            unsaid = []
    if upright and result.verdict == "as declared":
        result = replace(result, verdict="cannot tell", reason="the sensors agree; see the warning on their sign")
    doubts = doubts + sensor_faults.clipped_words(recording)
    return replace(result, doubts=tuple(upright + (unsaid if result.verdict == "cannot tell" else []) + doubts))


class _Explanations(NamedTuple):
    """Explanations of a recording; the first one changes nothing."""

    misfit: dict[str, Array]
    """Misfits (m,) of each relation."""
    number: Array
    """Number of changes (m,)."""
    changes: Callable[[int], tuple[Change, ...]]
    """Changes of one of them."""
    floors: dict[str, float]
    """m₀ of each relation."""


def _concluded(source: str, tried: _Explanations, sure: tuple[Change, ...], notes: tuple[str, ...]) -> Examination:
    fit = np.sum([_score(values, tried.floors[name]) for name, values in tried.misfit.items()], axis=0)
    score = fit - PENALTY * (tried.number + len(sure))
    order = np.argsort(-score, kind="stable")
    named = order[0] if score[order[0]] - score[0] >= MARGIN else 0
    equal = [k for k in order[fit[order] > fit[named] - MARGIN] if k != named]
    best = [
        Candidate(
            changes=tuple(change.words for change in (*tried.changes(k), *sure)),
            score=float(score[k]),
            misfit={name: float(values[k]) for name, values in tried.misfit.items()},
        )
        for k in order[:12]
    ]
    words = lambda k: "; ".join(map(str, (*tried.changes(k), *sure))) or NO_CHANGE  # noqa: E731
    verdict: Literal["as declared", "wrong convention", "cannot tell"]
    if min(best[0].misfit.values()) > POOR:
        verdict = "cannot tell"
        misfits = ", ".join(f"{name} {value:.2f}" for name, value in best[0].misfit.items())
        reason = f"no explanation tried fits; misfits of the best one: {misfits}"
    elif len(equal) > MAX_EQUAL:
        verdict = "cannot tell"
        reason = f"{len(equal)} other explanations fit as well as “{words(named)}”: the rotation is too small, or about one axis only"
    elif named or sure:
        verdict, reason = "wrong convention", words(named)
    else:
        verdict, reason = "as declared", "no change explains the recording better than its declared conventions"
    if equal and verdict != "cannot tell":
        notes = (*notes, "fits as well: " + " / ".join(map(words, equal)))
    return Examination(source=source, verdict=verdict, reason=reason, candidates=tuple(best), notes=notes)


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
    resting = None if recording.true_attitude is not None else _resting(recording)
    if resting is None:
        return []
    upward, reading, dip = resting
    reads = f"at rest the accelerometer reads {reading:.3g} m/s² along z"
    if dip is not None and dip < -MIN_DIP:
        upward_by = f"{-dip / DEGREE:.0f}° upward by the accelerometer"
        field = f"the field points {upward_by}, as south of the magnetic equator only"
        if upward > DOWN:
            return [f"{field}; elsewhere the magnetometer is inverted ({Hint('invert', 'magnetometer')})"]
        return [
            f"{reads}, and {field}; elsewhere the accelerometer is inverted, as those of iPhones "
            f"({Hint('invert', 'accelerometer')})"
        ]
    if upward >= -DOWN:
        return []
    where = " south of the magnetic equator" if dip is not None and dip > MIN_DIP else ""
    return [
        f"{reads}: the body's z axis points down ({Hint('axes', 'x,-y,-z')} reads forward-right-down as forward-left-up; "
        f"{Hint('frame', 'ned')} keeps them and gives the output in North-East-Down), or the unit lies upside down, or{where} "
        f"the accelerometer is inverted ({Hint('invert', 'accelerometer')})"
    ]


def _resting(recording: Recording) -> tuple[float, float, float | None] | None:
    """Return the share of gravity along the body's z axis, the reading there, m/s², and the field's dip, rad; None if not at rest."""
    force = recording.specific_force
    try:
        quiet = quiet_span(recording)
    except InputError:  # too short
        return None
    if force is None or not (known := are_finite(force[quiet])).any():
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
    field = samples[are_finite(samples)]
    if len(field) == 0 or not np.any(mean := field.mean(axis=0)):
        return None
    return -math.asin(float(np.clip(mean @ up / np.linalg.norm(mean), -1.0, 1.0)))


def _gravity(strength: float) -> tuple[Change, float]:
    """Return the change of unit by which a specific force of this magnitude is nearest to gravity, and gravity in its unit."""
    change = min(FORCE_UNITS, key=lambda unit: abs(math.log(strength * FORCE_UNITS[unit] / STANDARD_GRAVITY)))
    return change, STANDARD_GRAVITY / FORCE_UNITS[change]


def _force_unit(force: _Sensor) -> tuple[tuple[Change, ...], list[str]]:
    """Return the change of unit by which the median specific force is gravity, and the doubt if there is none.

    The median of a unit that is swung is larger than gravity by about the variation of the specific force.
    """
    strength = force.strength
    if not strength > 0.0:
        return (), ["the accelerometer reads zero throughout"]
    change, gravity = _gravity(strength)
    if abs(math.log(strength / gravity)) > 0.5 + float(np.std(force.size)) / strength:
        return (), [f"the median specific force, {strength:.3g} m/s², is not gravity in m/s², g, mm/s² or mg"]
    return (change,) * (change != AS_DECLARED), []


MIN_GRAVITY = 0.6
"""Minimum mean specific force over a window, relative to gravity; in 94 recordings it was .72 or more, without gravity mostly below .6."""


def _without_gravity(best: Candidate, force: _Sensor | None) -> list[str]:
    """Return the doubt if the mean specific force, rotated by the gyro, is by the best explanation not gravity in any unit."""
    misfit = best.misfit.get("gyro and accelerometer")  # none with a reference
    if force is None or misfit is None:
        return []
    mean = (1.0 - misfit) * force.strength
    weak = mean < MIN_GRAVITY * _gravity(force.strength)[1]
    return weak * [
        f"the specific force averages {mean:.2g} m/s² over {SPAN:g} s, which is not gravity; use the acceleration with gravity, not the "
        "“linear” or “user” acceleration"
    ]


def _too_fast(recording: Recording) -> list[str]:
    if max(recording.rate.max(), -recording.rate.min()) <= FASTEST / math.sqrt(3.0):
        return []
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


def _floors(relations: Iterable[str], floor: float, sensors: _Sensors) -> dict[str, float]:
    """Return m₀ of each relation, by its name."""
    acceleration = 0.0
    force = sensors.get("accelerometer")
    if force is not None and force.strength > 0.0:
        acceleration = float(np.mean((force.size / _gravity(force.strength)[1] - 1.0) ** 2))
    return {name: floor + acceleration * ("accelerometer" in name) for name in relations}


def _score(misfit: Array, floor: float) -> Array:
    return np.asarray(-1.5 * INDEPENDENT * np.log(np.maximum(misfit, 0.0) + floor))


SPAN = 4.0
"""Duration of the windows over which vectors are averaged, s: accelerations average out, and the gyro's bias causes a small rotation."""
MIN_INTERVAL = 0.1
"""Minimum interval of the samples of a vector used, s."""


class _Sensor(NamedTuple):
    """Samples of a vector."""

    vectors: Array
    """Those at the interval used."""
    known: np.ndarray
    """Which of them there are."""
    size: Array
    """Their magnitudes, of those that there are."""
    strength: float
    """Their median."""


_Sensors = Mapping[str, _Sensor]


def _sensor(vectors: Array, step: int) -> _Sensor:
    """Return the samples of a vector in every ``step``-th row, or within a step after it if the sensor is slower than the gyro."""
    samples = vectors[::step]
    if np.isnan(samples).any():
        rows = np.arange(0, len(vectors), step)
        known = np.append(np.flatnonzero(are_finite(vectors)), len(vectors) + step)
        later = known[np.searchsorted(known, rows)]
        samples = vectors[np.where(later < rows + step, later, rows)]
    size = lengths(samples)
    there = np.isfinite(size)
    size = size if there.all() else size[there]
    return _Sensor(samples, there, size, median(size))


class _Windows(NamedTuple):
    """Windows with the fastest rotation, and the samples of the vectors there."""

    rows: np.ndarray
    """Rows of the samples in the recording (m,)."""
    edges: np.ndarray
    """First sample of each window, and m."""
    vectors: Array
    """Vectors of all sensors side by side, relative to their median magnitude (m, 8); 0 if not used."""
    counts: dict[str, np.ndarray]
    """Number of samples used of each sensor in each window."""

    def means(self, attitudes: Array) -> dict[str, Array]:
        """Return for each sensor the means over each window of R_ab v_c (attitudes, windows, 3, 9), R of attitudes at the rows."""
        sums = np.empty((len(attitudes), len(self.edges) - 1, 9, self.vectors.shape[1]))
        compiled(recording_steps.rotated_sums)(*map(read_only, (attitudes, self.vectors, self.edges)), sums)
        return {
            name: (sums[:, n > 0, :, 3 * k : 3 * k + 3] / n[n > 0, None, None]).reshape(len(sums), -1, 3, 9)
            for k, (name, n) in enumerate(self.counts.items())
        }


def _turned(means: Array) -> Array:
    """Return the mean of R A v over each window (..., 48, windows, 3) for all axes A, from the means of R_ab v_c (..., windows, 3, 9)."""
    return np.moveaxis(means @ AXES.reshape(-1, 9).T, -1, -3)


def _windows(recording: Recording, sensors: _Sensors, step: int, known: np.ndarray | bool = True) -> _Windows | None:
    """Return the windows with samples of each vector, every ``step``-th, where the attitude is ``known``; None if there are none."""
    time = recording.time[::step]
    if len(time) < 2:
        return None
    window = np.floor((time - time[0]) / SPAN).astype(int)
    turning = np.bincount(window, lengths(recording.rate[::step])) / np.bincount(window).clip(1)
    least = 0.5 * max(1.0, SPAN / (step * recording.interval))
    side_by_side, used = np.zeros((len(time), WIDTH)), {}
    for name, (samples, there, _, strength) in sensors.items():
        has_sample = there & known & (strength > 0.0)
        full = np.flatnonzero(np.bincount(window[has_sample], minlength=len(turning)) >= least)
        fastest = np.zeros(len(turning), bool)
        fastest[full[np.argsort(-turning[full])][:WINDOWS]] = True
        if fastest.any():
            used[name] = has_sample & fastest[window]
            columns = slice(3 * len(used) - 3, 3 * len(used))
            np.copyto(side_by_side[:, columns], samples / strength, where=used[name][:, None])
    if not used:
        return None
    evaluated = np.bincount(window[np.any([*used.values()], axis=0)], minlength=len(turning)) > 0
    kept = np.flatnonzero(evaluated[window] & known)
    begin = np.flatnonzero(np.diff(window[kept], prepend=-1))
    counts = {name: np.add.reduceat(samples_used[kept], begin, dtype=int) for name, samples_used in used.items()}
    return _Windows(step * kept, np.append(begin, len(kept)), side_by_side[kept], counts)


# ------------------------------------------------------------------------------------------------------------------ with a reference

REFERENCE_SPAN = 0.1
"""Duration of the windows over which the rotations of gyro and reference are compared, s."""
MAX_TURNS = 500
"""Maximum number of these windows, those with the largest rotations. With 2000, in two of 94 recordings exchanged axes of the gyro were
not recognised, because the errors of their references weigh more in windows with smaller rotations."""


def _with_reference(recording: Recording, sensors: _Sensors, step: int) -> _Explanations | None:
    true = recording.true_attitude
    assert true is not None
    first, last, turn = _turns(recording, true)
    if len(first) < 10:
        return None

    def at(rows: np.ndarray) -> Array:
        """Return the reference (readings, m, 4)."""
        q = true[rows] / lengths(true[rows])[:, None]
        return np.stack([q, *(read(q) for read in ATTITUDE_READINGS.values())])

    reference = quaternion.rotation_between(at(first), at(last))
    if np.sum(lengths(reference[0])) < MIN_TURN:
        return None
    parts = {"gyro": np.repeat(_gyro_fits(turn, reference), len(FRAMES), axis=0)}
    to_enu = np.stack([frame.T for frame in FRAMES.values()])
    windows = _windows(recording, sensors, step, sampled(true[::step]))
    for name, means in ({} if windows is None else windows.means(at(windows.rows))).items():
        v = _turned(means)  # (readings, 48, windows, 3)
        square = np.mean(np.sum(v**2, axis=-1), axis=-1)[:, None]
        mean = v.mean(axis=-2)[:, None] @ to_enu  # (readings, frames, 48, 3)
        parts[name] = (_force_fits if name == "accelerometer" else _field_fits)(mean, square).reshape(-1, len(AXES))
    return _combined(parts, _floors(parts, FLOORS["reference"], sensors))


def _turns(recording: Recording, true: Array) -> tuple[np.ndarray, np.ndarray, Array]:
    """Return first and last samples of the short windows with the largest rotations, and the rotations (k, 3) measured there by the gyro.

    A window begins and ends at samples with a reference ``true`` (n, 4).
    """
    step = max(1, round(REFERENCE_SPAN / recording.interval))
    first = np.arange(0, len(recording.time) - step, max(1, step // 2))
    first = first[sampled(true[first]) & sampled(true[first + step])]
    turn = _turns_between(recording, first, first + step)
    largest = np.sort(np.argsort(-lengths(turn))[:MAX_TURNS])
    return first[largest], first[largest] + step, turn[largest]


def _turns_between(recording: Recording, first: np.ndarray, last: np.ndarray) -> Array:
    """Return the sums of the increments from some samples to others (m, 3)."""
    turns = np.empty((len(first), 3))
    compiled(recording_steps.turns_between)(*map(read_only, (recording.time, recording.rate, first, last)), turns)
    return turns


def _gyro_fits(turn: Array, reference: Array) -> Array:
    """Return misfits (readings, 48 · units) of ``reference = unit · axes · turn``, by axes and unit."""
    cross = np.swapaxes(reference, -1, -2) @ turn
    own, other = np.sum(turn**2), np.sum(reference**2, axis=(1, 2))
    factor = np.array(list(GYRO_UNITS.values()))
    along = cross.reshape(-1, 9) @ AXES.reshape(-1, 9).T
    misfit = 1.0 - 2.0 * factor * along[..., None] / (factor**2 * own + other[:, None, None])
    return np.asarray(misfit.reshape(len(reference), -1))


def _force_fits(mean: Array, square: Array) -> Array:
    """Return misfits (...,) of the specific force with the vertical, from its mean (..., 3), East-North-Up, and mean square."""
    return np.asarray(1.0 - 2.0 * mean[..., 2] / (square + 1.0))


def _field_fits(mean: Array, square: Array) -> Array:
    """Return misfits (...,) of the field with the best-fitting one that points North, of any dip."""
    _, north, up = np.moveaxis(mean, -1, 0)
    along = np.where(north > 0.0, np.hypot(north, up), np.abs(up))
    return np.asarray(1.0 - 2.0 * along / (square + 1.0))


def _combined(parts: dict[str, Array], floors: dict[str, float]) -> _Explanations:
    """Return combinations of the best settings of each sensor, and those that change the axes of all sensors alike.

    ``parts``: misfits of each sensor by reading and frame of the reference, and by setting of the sensor; ``floors``: m₀ of each.
    """
    commons = [
        (Change(f"reference {reading}"),) * (reading != "")
        + (Change(f"reference in {frame}"),) * (frame != "East-North-Up")
        for reading in ("", *ATTITUDE_READINGS)
        for frame in FRAMES
    ]
    # A row for each reading and frame. A column for each combination of the sensors' settings: of each as declared and the three best;
    # then one for each change of the axes of all sensors alike.
    combinations = np.indices((4,) * len(parts)).reshape(len(parts), -1)
    alike = range(1, len(AXES) if len(parts) > 1 else 1)
    columns = combinations.shape[1]
    number = np.add.outer([len(common) for common in commons], [0] * columns + [1] * len(alike))
    settings, misfit = {}, {}
    for (name, values), choice in zip(parts.items(), combinations, strict=True):
        changed = np.array([len(changes) for changes in _settings(name)])
        best = np.argsort(PENALTY * changed - _score(values, floors[name]), axis=1, kind="stable")[:, :3]
        best = np.insert(np.where(best, best, -1), 0, 0, axis=1)[:, choice]  # as declared comes first, and once
        number[:, :columns] += changed[best]
        whole = np.array(alike, int) * (len(changed) // len(AXES))
        settings[name] = np.hstack([best, np.tile(whole, (len(commons), 1))])
        misfit[name] = np.take_along_axis(values, settings[name], axis=1)
    kept = np.flatnonzero(np.all([setting >= 0 for setting in settings.values()], axis=0))

    def changes(k: int) -> tuple[Change, ...]:
        common, column = divmod(int(kept[k]), number.shape[1])
        if column >= columns:
            return (*commons[common], _axes_change("whole unit", alike[column - columns]))
        return sum((_settings(name)[which[common, column]] for name, which in settings.items()), commons[common])

    misfit = {name: values.ravel()[kept] for name, values in misfit.items()}
    return _Explanations(misfit, number.ravel()[kept], changes, floors)


@functools.cache
def _settings(name: str) -> tuple[tuple[Change, ...], ...]:
    """Return the changes of each setting of a sensor: axes and, for the gyro, units."""
    units = GYRO_UNITS if name == "gyro" else (AS_DECLARED,)
    return tuple(
        (_axes_change(name, k),) * (k > 0) + (unit,) * (unit != AS_DECLARED) for k in range(len(AXES)) for unit in units
    )


@functools.cache
def _axes_change(name: str, k: int) -> Change:
    if np.array_equal(AXES[k], -np.eye(3)):
        return Change(f"{name} inverted", "" if name == "whole unit" else str(Hint("invert", name)))
    words = axes_words(AXES[k])
    option = words.replace("−", "-").replace(" ", "")
    return Change(f"{name} axes ({words})", str(Hint("axes", option if name == "whole unit" else {name: option})))


# --------------------------------------------------------------------------------------------------------------- without a reference


def _without_reference(recording: Recording, sensors: _Sensors, step: int) -> _Explanations | None:
    """Return explanations with one wrong sensor: two wrong sensors could not be distinguished from the third one being wrong.

    For a proper rotation P of the gyro's axes, increments P Δθ integrate to P R Pᵀ. P therefore has the same effect on a vector's mean as
    axes Pᵀ of the vector's sensor. An improper P is a proper one of the inverted gyro, which is integrated separately.
    """
    windows = _windows(recording, sensors, step)
    if windows is None:
        return None
    # Only within each window: the attitude at its begin has no effect on the misfits.
    rows = windows.rows
    factors = np.multiply.outer(list(GYRO_UNITS.values()), [1.0, -1.0]).reshape(-1, 1, 1)
    turns = factors * _turns_between(recording, rows, np.append(rows[1:], rows[-1]))
    attitudes = coning.integrate(turns.reshape(-1, 3))[:-1].reshape(len(factors), -1, 4)
    which, axes, changes = _one_wrong(tuple(windows.counts))
    vectors = {name: _turned(mean)[which, axes[name]] for name, mean in windows.means(attitudes).items()}
    number = np.array([len(change) for change in changes])
    misfit = _fixed_misfits(vectors, windows.counts)
    return _Explanations(misfit, number, changes.__getitem__, _floors(misfit, FLOORS["vectors"], sensors))


def _place(matrix: Array) -> int:
    """Return the place of a matrix in :data:`AXES`."""
    return int(np.argmax((matrix == AXES).all(axis=(1, 2))))


@functools.cache
def _one_wrong(names: tuple[str, ...]) -> tuple[np.ndarray, dict[str, np.ndarray], list[tuple[Change, ...]]]:
    """Return explanations with one wrong sensor: which attitude by the gyro, which axes of each vector, and the changes."""
    rows = []
    for which, sign in enumerate((1.0, -1.0) * len(GYRO_UNITS)):
        for k, matrix in enumerate(AXES):
            if np.linalg.det(matrix) * sign > 0.0:
                changes = _settings("gyro")[k * len(GYRO_UNITS) + which // 2]
                rows.append((which, [_place(sign * matrix.T)] * len(names), changes))
            if k and which == 0:
                for name in names:
                    rows.append((which, [k * (other == name) for other in names], _settings(name)[k]))
    attitudes, axes, words = zip(*rows, strict=True)
    return np.array(attitudes), dict(zip(names, np.transpose(axes), strict=True)), list(words)


def _fixed_misfits(vectors: dict[str, Array], counts: dict[str, np.ndarray]) -> dict[str, Array]:
    """Return the relative loss of magnitude of the means (..., windows, 3), and the spread of the angle between two of them.

    ``counts``: number of samples of each sensor in all windows; only windows with samples have a mean.
    """
    length = {name: lengths(v) for name, v in vectors.items()}
    misfit = {f"gyro and {name}": np.maximum(0.0, 1.0 - np.mean(size, axis=-1)) for name, size in length.items()}
    both = np.all([n > 0 for n in counts.values()], axis=0)
    if len(vectors) == 2 and both.any():
        (first, u), (other, v) = ((name, vectors[name][..., both[n > 0], :]) for name, n in counts.items())
        cosine = np.sum(u * v, axis=-1) / np.maximum(lengths(u) * lengths(v), 1e-12)
        misfit[f"{first} and {other}"] = 3.0 * np.var(cosine, axis=-1)  # two unrelated directions: 1/3
    return misfit
