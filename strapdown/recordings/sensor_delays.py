"""Delays of a unit's sensors, estimated from its recording.

A sensor's low-pass filter delays its samples by the group delay, which differs between the sensors of one unit: a magnetometer 11 ms behind
the gyro is in error by 6° at 500 °/s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from strapdown.checks import Array, Hint, InputError, median, non_negative
from strapdown.kernels import recording_samples, recording_steps
from strapdown.kernels.machine import compiled, read_only
from strapdown.records.recording import Recording, sampled
from strapdown.results import figure

FIELD_SPAN = 0.2
"""Time difference over which the change of the field, in the frame fixed by the integrated gyro, is fitted for the delay, s."""
PAIRS_IN_SPAN = 6
"""Number of pairs of field samples per span; more are not independent."""
LONGEST_DELAY = 0.5
"""Maximum delay of the magnetometer that is looked for, s."""
SEARCHED_PAIRS = 300
"""Number of pairs of field samples in the search for a long delay."""
SHORT_DELAY = 0.05
"""Delay up to which the linear fit finds it, s."""
LONG_MISFIT = 0.5
"""Mean square change of the field at a long delay, relative to that at a short one, below which the delay is long. In 91 public recordings,
none of which has one, it is 1; with a delay of 0.2 s added it is mostly below 0.3."""
SEARCH_SIGMA = 0.02
"""σ of a long delay that the fit does not refine, s: the search has steps of 33 ms, and a slow motion shows no better."""
MAX_DELAY_SIGMA = 2e-3
"""Maximum σ of a delay of the magnetometer that is used, s."""
ASSUMED_SIGMA = 2e-3
"""σ of an assumed gyro delay, s."""
GIVEN_SIGMA = 3e-4
"""σ of a given gyro delay, s."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Delays:
    """Delays of a recording's sensors."""

    gyro: float
    """Delay of the stamps of gyro and accelerometer relative to the motion, s."""
    sigma: float
    """Standard deviation of that delay, s."""
    field: Array | float
    """Delay of the magnetometer's stamps relative to the gyro's, s, negative for earlier: one number, or one per sample."""
    field_sigma: float
    """σ of the last value of ``field``, s; infinite if it is not observable."""
    is_specified: bool
    """Whether the gyro's delay was specified by the user."""

    @property
    def words(self) -> tuple[str, ...]:
        """Description of the delays."""
        late = 1e3 * self.gyro
        assumed = (
            f"Samples are assumed to be stamped {late:.3g} ms late."
            if self.is_specified
            else f"Samples are assumed to be stamped {late:.3g} ms late, half a sample interval, σ {1e3 * self.sigma:.2g} ms; "
            f"if the delay is known, give {Hint('latency')} (0: point samples)."
        )
        return (assumed, f"{self.field_words}.") if self.last_field else (assumed,)

    @property
    def field_words(self) -> str:
        """Description of the magnetometer's delay, and what :func:`strapdown.estimate` does with it; empty if it is not observable."""
        field, sigma = 1e3 * self.last_field, f"σ {figure(1e3 * self.field_sigma, 1)} ms"
        if field:
            side = "after" if field > 0.0 else "before"
            return f"The magnetometer's samples come {abs(field):.1f} ms {side} the gyro's, {sigma}, compensated in the estimate"
        if self.field_sigma == np.inf:
            return ""
        return f"The magnetometer shows no delay relative to the gyro, {sigma}: none is compensated in the estimate"

    @property
    def last_field(self) -> float:
        """Delay of the magnetometer relative to the gyro at the end, s."""
        return float(np.ravel(self.field)[-1])


def find(
    recording: Recording,
    latency: float | None = None,
    field: float | None = None,
    *,
    causal: bool = False,
    turned: Array | None = None,
) -> Delays:
    """Return the delays of a recording's sensors.

    ``latency`` is the delay of gyro and accelerometer, s, if known. The default is half a sample interval, as for means over the interval
    before the stamp. ``field`` is the delay of the magnetometer relative to the gyro, s, if known. ``causal``: each sample's delay is
    computed from the samples before it, and updated whenever the duration has doubled; only whether it is long, beyond the linear fit, is
    found from all samples. ``turned`` (n, 4): attitude from the gyro only, if
    already computed.
    """
    length = recording.time[-1] - recording.time[0]
    if latency is not None and non_negative("latency", latency, unit="s") >= length:
        raise InputError(f"latency is {latency:g} s, and {recording.source} lasts {length:.3g} s")
    field_delay = np.full(len(recording.time), field or 0.0)
    sigma = GIVEN_SIGMA if field is not None else np.inf
    if field is None and recording.magnetic_field is not None:
        long, evidence = _evidence(recording, gyro_attitude(recording) if turned is None else turned)
        field_delay[:] = long
        spans = [1.0] if causal else [length]
        while spans[-1] < length:
            spans.append(2.0 * spans[-1])
        for span in spans:
            until = np.searchsorted(evidence[0], recording.time[0] + span, side="right")
            remainder, sigma = _fitted(*(part[:until] for part in evidence[1:]))
            delay = long + remainder
            if sigma < MAX_DELAY_SIGMA and 3.0 * sigma < abs(delay):
                since = recording.time[0] + span if causal else recording.time[0]
                field_delay[np.searchsorted(recording.time, since) :] = delay
        sigma = SEARCH_SIGMA if long and sigma >= MAX_DELAY_SIGMA else sigma
    return Delays(
        gyro=0.5 * recording.interval if latency is None else latency,
        sigma=ASSUMED_SIGMA if latency is None else GIVEN_SIGMA,
        field=field_delay,
        field_sigma=sigma,
        is_specified=latency is not None,
    )


def magnetometer_delay(recording: Recording) -> tuple[float, float]:
    """Return the delay of the magnetometer's stamps relative to the gyro's, s, and its σ; (0, ∞) if it is not observable.

    In the frame fixed by the integrated gyro the field m is constant over a fraction of a second. Samples that are late by τ have the error
    ``−τ ṁ``, ``ṁ = −w × m``; the change of this error over :data:`FIELD_SPAN` is fitted by least squares without outliers. A field that
    rotates with the body (hard iron) is in quadrature with it in a swing: it does not appear as a delay, but large iron masks part of one.
    A delay too long for this linear fit, up to :data:`LONGEST_DELAY`, is first found by a search.
    """
    if recording.magnetic_field is None:
        return 0.0, np.inf
    long, evidence = _evidence(recording, gyro_attitude(recording))
    delay, sigma = _fitted(*evidence[1:])
    return long + delay, sigma


def gyro_attitude(recording: Recording) -> Array:
    """Return the attitude (n, 4) from the gyro only at every sample, identity at the first one."""
    attitude = np.empty((len(recording.time), 4))
    attitude[0] = 1.0, 0.0, 0.0, 0.0
    compiled(recording_steps.follow_gyro)(read_only(recording.time), read_only(recording.rate), attitude)
    return attitude


def _evidence(recording: Recording, turned: Array) -> tuple[float, tuple[Array, Array, Array, Array]]:
    """Return the long part of the delay, s, and the evidence of the rest.

    That is times (m,), s, of pairs of field samples, and the products c·w, w·w, c·c of their change c and that by a unit delay, w.
    """
    field = recording.magnetic_field
    assert field is not None
    known = sampled(field)
    number = np.count_nonzero(known)
    if number < 2:
        return 0.0, (np.empty(0),) * 4
    if 2 * number < len(known):  # of a slow sensor, no two samples may be a span of the gyro's rows apart
        recording, turned, field = recording.taken(known), turned[known], field[known]
    time = recording.time
    lag = int(np.searchsorted(time, time[0] + FIELD_SPAN))
    if len(time) < 10 * lag:
        return 0.0, (np.empty(0),) * 4
    stride = max(1, lag // PAIRS_IN_SPAN)
    lag = max(1, lag // stride)
    shift = stride * _long_shift(recording, turned, stride, lag)
    at = time[::stride]
    still, late, products = np.empty((len(at), 3)), np.empty((len(at), 3)), np.empty((len(at) - lag, 3))
    arrays = (read_only(column) for column in (recording.rate, _shifted(field, shift), turned))
    compiled(recording_samples.field_changes)(*arrays, stride, lag, still, late, products)
    pairs = np.isfinite(products[:, 1])
    return shift * recording.interval, (at[lag:][pairs], *products[pairs].T.copy())


def _long_shift(recording: Recording, turned: Array, stride: int, lag: int) -> int:
    """Return the delay of the field in strides of rows at which it changes least in the frame fixed by the gyro; 0 unless it is long."""
    field, longest = recording.magnetic_field, int(LONGEST_DELAY / (stride * recording.interval))
    assert field is not None
    begin, end = stride * longest, len(field) - stride * (longest + lag)
    rows = np.linspace(begin, end, SEARCHED_PAIRS, endpoint=False, dtype=int) if begin < end else np.empty(0, int)
    if longest < 1 or len(rows) == 0:
        return 0
    shifts, square = np.arange(-longest, longest + 1), np.empty((len(rows), 2 * longest + 1))
    compiled(recording_samples.shifted_changes)(*map(read_only, (field, turned, rows)), stride, lag, square)
    known = np.isfinite(square).all(axis=1)
    if not known.any():
        return 0
    misfit = square[known].mean(axis=0)
    is_short = stride * recording.interval * np.abs(shifts) < SHORT_DELAY
    return int(shifts[np.argmin(misfit)]) if misfit.min() < LONG_MISFIT * misfit[is_short].min() else 0


def _shifted(samples: Array, rows: int) -> Array:
    """Return samples (n, 3) moved up by that many rows; NaN at the end, or at the beginning if ``rows`` is negative."""
    if rows == 0:
        return samples
    moved = np.roll(samples, -rows, axis=0)
    moved[slice(-rows, None) if rows > 0 else slice(-rows)] = np.nan
    return moved


def _fitted(across: Array, along: Array, total: Array) -> tuple[float, float]:
    """Return the delay τ, s, of the fit c = τ w without outliers, and its σ, from c·w, w·w and c·c of each pair (m,)."""
    kept = np.ones(len(total))
    for _ in range(4):
        information = float(along @ kept)
        if information == 0.0:
            return 0.0, np.inf
        delay = float(across @ kept) / information
        left = total - 2.0 * delay * across + delay**2 * along
        middle = median(left)
        kept = (left <= 2.5**2 * middle).astype(np.float64)
    # The median norm of a normal residual with three components is 1.54 σ; the pairs of one span overlap and are not independent.
    return delay, float(np.sqrt(max(middle, 0.0) * PAIRS_IN_SPAN / information)) / 1.54


def turn_over(recording: Recording, delay: Array | float) -> Array:
    """Return the rotation vector (n, 3), rad, of the unit over a delay, s, before each stamp, from its gyro only.

    For a negative delay it is minus the rotation after the stamp. Before the first and after the last sample their rates are held. The
    delay must be so short that rotation vectors can be added.
    """
    late = np.broadcast_to(np.asarray(delay, np.float64), recording.time.shape)
    sums, turn = np.empty((2, len(late), 3))
    arrays = (read_only(column) for column in (recording.time, recording.rate, late))
    compiled(recording_steps.turn_over)(*arrays, sums, turn)
    return turn
