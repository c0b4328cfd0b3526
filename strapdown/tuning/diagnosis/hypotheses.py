"""Possible faults: each hypothesis as a change of the record or of the filter's model."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from strapdown import estimation, quaternion
from strapdown.ahrs.check_conventions import ATTITUDE_READINGS, AXES, axes_words
from strapdown.checks import Array
from strapdown.estimation.states import ProcessNoise
from strapdown.records import ImuRecord
from strapdown.results import figure
from strapdown.tuning.diagnosis.causes import Cause
from strapdown.tuning.diagnosis.likelihood import Hypothesis, Model, Run, log_p, run
from strapdown.vectors import VectorMeasurements

PLAUSIBLE = 0.01
"""Prior standard deviation of a scale factor, or of a misalignment, rad."""
UNLIKELY = 0.01
"""Probability that noise is detected as motion for a body at rest."""


def shown(theta: Array, factor: float = 1.0) -> str:
    """Return numbers in brackets with three digits each."""
    return f"[{', '.join(figure(float(x * factor), 3) for x in theta)}]"


def mean_hypotheses(model: Model) -> Iterator[Hypothesis]:
    """Yield the hypotheses that shift innovations."""
    record = model.record
    interval = float(np.median(record.intervals))
    measured = [series for series in record.vectors if len(series.time)]
    for series in measured:
        yield _time_offset(series.sensor, (series.sensor,), interval)
        yield _mounting(series)
        if series.kind != "attitude" and np.ptp(series.vector_b, axis=0).any():  # the baseline of two antennas is exact
            yield _body_fixed(series)
        if series.kind == "vector":
            yield _reference_length(series)
        if len(measured) > 1:  # with one sensor, a rotated reference is only another fixed frame
            yield _reference_direction(series)
    if len(measured) > 1:
        yield _time_offset("gyro", tuple(series.sensor for series in measured), interval)
    yield from gyro_errors(turns(record, model.noise, model.initial))
    sigma = np.sqrt(np.diag(model.initial.covariance))
    yield _initial("attitude", "rad", sigma[:3])
    yield _initial("bias", "rad/s", sigma[3:6])


def _initial(part: str, unit: str, sigma: Array) -> Hypothesis:
    def apply(model: Model, theta: Array) -> Model:
        start = model.initial
        if part == "bias":
            return replace(model, initial=replace(start, bias=start.bias + theta))
        attitude = quaternion.normalize(quaternion.multiply(start.attitude, quaternion.exp(theta)))
        return replace(model, initial=replace(start, attitude=attitude))

    return Hypothesis(
        name=f"initial {part}",
        of="start",
        unit=unit,
        steps=1e-3 * sigma,
        limit=np.pi,
        apply=apply,
        words=lambda theta, _: (
            f"the initial {part} was in error by {shown(theta)} {unit},  {np.max(np.abs(theta / sigma)):.3g} times its σ: "
            "the initial covariance is too small"
        ),
    )


def _time_offset(of: str, sensors: tuple[str, ...], interval: float) -> Hypothesis:
    sign = -1.0 if of == "gyro" else 1.0  # late stamps of the gyro are equivalent to early ones of the other sensors

    def apply(model: Model, theta: Array) -> Model:
        for sensor in sensors:
            model = model.with_series(sensor, lambda s: replace(s, time=s.time - sign * float(theta[0]), arrival=None))
        return model

    return Hypothesis(
        name="time offset",
        of=of,
        unit="s",
        steps=np.array([0.02 * interval]),
        limit=2.0,
        apply=apply,
        words=lambda theta, spread: (
            f"the time stamps of {of} are {abs(theta[0]):.4g} ± {spread[0]:.2g} s too {'late' if theta[0] > 0.0 else 'early'}"
        ),
    )


def _of_series(
    sensor: str,
    name: str,
    unit: str,
    size: int,
    limit: float,
    change: Callable[[VectorMeasurements, Array], VectorMeasurements],
    words: Callable[[Array, Array], str],
) -> Hypothesis:
    """Return the hypothesis of a change of one sensor's series, with θ of this size."""
    return Hypothesis(
        name=name,
        of=sensor,
        unit=unit,
        steps=np.full(size, 1e-5),
        limit=limit,
        apply=lambda model, theta: model.with_series(sensor, lambda series: change(series, theta)),
        words=words,
    )


def _body_fixed(series: VectorMeasurements) -> Hypothesis:
    magnetic = "mag" in series.sensor.lower()

    def change(old: VectorMeasurements, theta: Array) -> VectorMeasurements:
        if old.kind == "vector":
            length = np.linalg.norm(old.references_f, axis=1, keepdims=True)
            return replace(old, vector_b=old.vector_b - theta * length)
        # The noise is scaled with the vectors; otherwise subtracting part of the direction would appear as less noise.
        length = np.linalg.norm(old.vector_b - theta, axis=1, keepdims=True)
        moved = replace(old, vector_b=(old.vector_b - theta) / length)
        return moved.noise_scaled(float(np.nanmean(1.0 / length)))

    def words(theta: Array, _: Array) -> str:
        what = "a hard iron" if magnetic else "a constant error in body axes"
        return f"{series.sensor} has {what} of {shown(theta)} times its reference"

    name = "hard iron" if magnetic else "body-fixed bias"
    return _of_series(series.sensor, name, "1 (length of the reference)", 3, 0.5, change, words)


def _mounting(series: VectorMeasurements) -> Hypothesis:
    def change(old: VectorMeasurements, theta: Array) -> VectorMeasurements:
        turn = quaternion.exp(theta)
        if old.attitude is not None:
            turned = quaternion.multiply(old.attitude, quaternion.conjugate(turn))
            return replace(old, attitude=quaternion.normalize(turned))
        return replace(old, vector_b=old.vector_b @ quaternion.to_matrix(turn).T)  # keeps rows of NaN

    def words(theta: Array, _: Array) -> str:
        return f"{series.sensor} has a mounting error of {shown(theta, 1e3)} mrad in the body"

    return _of_series(series.sensor, "mounting", "rad", 3, 0.35, change, words)


def _reference_length(series: VectorMeasurements) -> Hypothesis:
    def change(old: VectorMeasurements, theta: Array) -> VectorMeasurements:
        return replace(old, reference_f=old.reference_f / (1.0 + theta[0]))

    def words(theta: Array, spread: Array) -> str:
        off, scale = ("long", "small") if theta[0] > 0.0 else ("short", "large")
        size = f"{100.0 * abs(theta[0]):.3g} ± {100.0 * spread[0]:.2g} %"
        return f"the reference of {series.sensor} is {size} too {off}, or its scale factor too {scale} by as much"

    return _of_series(series.sensor, "reference length", "1", 1, 0.5, change, words)


def _reference_direction(series: VectorMeasurements) -> Hypothesis:
    def change(old: VectorMeasurements, theta: Array) -> VectorMeasurements:
        back = quaternion.exp(-theta)
        if old.attitude is not None:
            return replace(old, attitude=quaternion.normalize(quaternion.multiply(back, old.attitude)))
        if old.kind == "heading":  # only about the fixed z axis, so that the reference stays horizontal
            back = quaternion.exp(-theta * np.array([0.0, 0.0, 1.0]))
        return replace(old, reference_f=quaternion.rotate(back, old.reference_f))

    def words(theta: Array, _: Array) -> str:
        return f"the reference of {series.sensor} is rotated by {shown(theta, 1e3)} mrad in the fixed frame"

    return _of_series(series.sensor, "reference direction", "rad", 3, 0.35, change, words)


def gyro_errors(turned: Array) -> list[Hypothesis]:
    """Return the hypotheses of errors M of a gyro that measures (I + M) w; ``turned`` are the rotations on which they act."""

    def error(
        name: str, unit: str, size: int, matrix: Callable[[Array], Array], factor: float, words: str
    ) -> Hypothesis:
        def apply(model: Model, theta: Array) -> Model:
            # Increments times (I + M)⁻¹ would also change their noise and bias.
            excess = turned @ (np.eye(3) - np.linalg.inv(np.eye(3) + matrix(theta))).T
            return model.with_increments(model.record.increments - excess)

        return Hypothesis(
            name=name,
            of="gyro",
            unit=unit,
            steps=np.full(size, 1e-5),
            limit=0.2,
            plausible=PLAUSIBLE,
            apply=apply,
            words=lambda theta, _: words.format(shown(theta, factor)),
        )

    def off_diagonal(theta: Array) -> Array:
        matrix = np.zeros((3, 3))
        matrix[~np.eye(3, dtype=bool)] = theta
        return matrix

    def turned_back(theta: Array) -> Array:
        # In axes rotated by θ the measured rate is rotated by −θ.
        return quaternion.to_matrix(quaternion.exp(-theta)) - np.eye(3)

    return [
        error("scale factor", "1", 3, np.diag, 1e6, "the gyro's scale factor is in error by {} ppm"),
        error("mounting", "rad", 3, turned_back, 1e3, "the gyro has a mounting error of {} mrad in the body"),
        error(
            "misalignment",
            "rad",
            6,
            off_diagonal,
            1e3,
            "the gyro's axes are misaligned, xy, xz, yx, yz, zx, zy by {} mrad",
        ),
    ]


def turns(record: ImuRecord, noise: ProcessNoise, initial: estimation.State) -> Array:
    """Return the rotation of the body in each gyro interval (n, 3), rad, as far as it exceeds the gyro's noise.

    The increments themselves are unsuitable: subtracting a fraction of them reduces the gyro's noise too, so the noise would explain
    itself, more so the longer the record. So the rate, with the filter's bias subtracted, keeps only the components of its cosine transform
    above the filter's angle random walk: of m values with standard deviation s the largest is below ``s √(2 ln(m/p))`` except with
    probability p (the universal threshold of Donoho & Johnstone 1994, Biometrika 81).
    """
    from scipy.fft import dct, idct

    estimate = estimation.run(record, noise, initial)
    dt = record.intervals[:, None]
    free = record.increments / dt - 0.5 * (estimate.bias[1:] + estimate.bias[:-1])
    # Unlike Fourier's, it does not require equal ends of the record; being orthonormal, it keeps noise white.
    parts = dct(free, axis=0, norm="ortho")
    variance = noise.angle_random_walk**2 / float(np.mean(dt))
    parts[parts**2 < 2.0 * variance * np.log(parts.size / UNLIKELY)] = 0.0
    return np.asarray(idct(parts, axis=0, norm="ortho") * dt)


def noise_hypotheses(model: Model) -> Iterator[Hypothesis]:
    """Yield the hypotheses that scale innovations."""
    for series in model.record.vectors:
        if len(series.time):
            yield _sensor_noise(series.sensor)
    if model.noise.angle_random_walk > 0.0:
        yield _gyro_noise("angle_random_walk", "angle random walk")
    if model.noise.rate_random_walk > 0.0:
        yield _gyro_noise("rate_random_walk", "rate random walk of the bias")


def _sensor_noise(sensor: str) -> Hypothesis:
    def apply(model: Model, theta: Array) -> Model:
        return model.with_series(sensor, lambda series: series.noise_scaled(math.exp(theta[0])))

    return _noise("R", sensor, f"the noise of {sensor}", 0.1, apply)


def _gyro_noise(term: str, name: str) -> Hypothesis:
    def apply(model: Model, theta: Array) -> Model:
        size = getattr(model.noise, term) * math.exp(theta[0])
        return replace(model, noise=replace(model.noise, **{term: size}))

    return _noise("Q", name, f"the gyro's {name}", 0.2, apply)


def _noise(name: str, of: str, what: str, step: float, apply: Callable[[Model, Array], Model]) -> Hypothesis:
    """Return the hypothesis of a factor on the σ of a noise."""
    return Hypothesis(
        name=name,
        of=of,
        unit="ln of the factor on σ",
        steps=np.array([step]),
        limit=6.0,
        apply=apply,
        words=lambda theta, _: f"{what} is {math.exp(theta[0]):.3g} times the filter's model",
    )


MAX_OUTLIERS = 0.25


def outliers(sensor: str, white: Array) -> Cause:
    """Return the gain of a mixture of two normals for the innovations: the contaminated normal of Tukey (1960), by EM.

    Outliers have at least three times the σ and are at most a quarter of the samples; otherwise they are a larger noise.
    """
    from scipy.special import expit

    square, degrees = np.sum(white**2, axis=1), white.shape[1]
    share, spread = 0.02, 25.0

    def log_ratio() -> Array:
        """Logarithm of the ratio of the outliers' density to that of the others."""
        return np.asarray(0.5 * square * (1.0 - 1.0 / spread) - 0.5 * degrees * math.log(spread))

    for _ in range(60):
        belongs = expit(log_ratio() + math.log(share) - math.log1p(-share))
        share = float(np.clip(belongs.mean(), 1e-4, MAX_OUTLIERS))
        spread = float(max(np.sum(belongs * square) / max(degrees * belongs.sum(), 1e-12), 9.0))
    gain = 2.0 * float(np.sum(np.logaddexp(math.log1p(-share), log_ratio() + math.log(share))))
    return Cause(
        name="outliers",
        of=sensor,
        estimate=np.array([share, math.sqrt(spread)]),
        standard_error=np.full(2, np.nan),
        unit="fraction, factor on σ",
        gain=gain,
        log_p=log_p(gain, 2),
        words=f"{100.0 * share:.2g} % of the measurements of {sensor} are outliers of {math.sqrt(spread):.3g} σ",
    )


def conventions(model: Model, base: Run) -> list[Cause]:
    """Return the three changes of axes, units or quaternion convention with the largest gain."""
    turned, record = model.record.increments, model.record
    axes = {f"axes should be read as ({axes_words(matrix)})": matrix for matrix in AXES[1:]}
    units = {
        "rotation 57.3 times more than recorded": 180.0 / np.pi,
        "rotation 57.3 times less than recorded": np.pi / 180.0,
    }
    trials = [("gyro", words, model.with_increments(turned @ matrix.T)) for words, matrix in axes.items()]
    trials += [
        ("gyro", f"{words} (rad for deg?)", model.with_increments(turned * factor)) for words, factor in units.items()
    ]
    for k, series in enumerate(record.vectors):
        if series.attitude is None:
            changed = {words: replace(series, vector_b=series.vector_b @ matrix.T) for words, matrix in axes.items()}
        else:
            readings = {f"its quaternions are {words}": read for words, read in ATTITUDE_READINGS.items()}
            changed = {words: replace(series, attitude=read(series.attitude)) for words, read in readings.items()}
        for words, other in changed.items():
            vectors = (*record.vectors[:k], other, *record.vectors[k + 1 :])
            trials.append((series.sensor, words, replace(model, record=replace(record, vectors=vectors))))
    causes = []
    for of, words, trial in trials:
        gain = run(trial).gain_over(base)
        causes.append(
            Cause(
                name="wrong convention",
                of=of,
                estimate=np.empty(0),
                standard_error=np.empty(0),
                unit="",
                gain=gain,
                log_p=min(0.0, log_p(gain, 1) + math.log(len(trials))),
                words=f"{of}: {words}",
            )
        )
    return sorted(causes, key=lambda cause: -cause.gain)[:3]
