"""Joint least squares of sensor errors and motion, with the noise found from the residuals.

Unknown are the sensor errors, and at every node the attitude, the velocity, the lever arm from the point about which the unit is turned,
the gyro bias and the disturbance of the field. The equations, three each, are, for every interval k from one node to the next,

- rotation: ``Log((R_k C_k)ᵀ R_{k+1}) = 0``, noise of the gyro,
- specific force: ``R_k f_k = g + (v_{k+1} − v_k) / L`` with ``v = u + R (w × r)``,
- velocity u: a Gauss–Markov process whose σ follows the acceleration, small at rest; lever arm r and gyro bias: random walks,
- field: ``R_k m_k = m_0 + d``, and the disturbance d: a Gauss–Markov process,

with C_k, f_k and m_k from :mod:`strapdown.calibration.intervals`, and a prior of every sensor error. Thus rests need not be segmented, and
free motion serves too: a velocity that is bounded, averaged over seconds, does not hide gravity. The factors of the noise of each kind of
equation are estimated by restricted maximum likelihood. Rows of the normal equations couple neighbouring nodes and the sensor errors only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import SuperLU, splu
from scipy.spatial.transform import Rotation

from strapdown.calibration.intervals import Errors, Intervals, Mean, Prediction, predicted
from strapdown.checks import Array
from strapdown.kinematics import right_jacobian, skew
from strapdown.units import DEGREE

VELOCITY_TIME = 0.3
"""Correlation time of the velocity, s."""
REACTION_TIME = 0.3
"""σ of the velocity over that of the acceleration, s, before its factor is estimated."""
REST_VELOCITY = 5e-4
"""σ of the velocity at rest, m/s, added to the former."""
LEVER_SIGMA = 0.3
"""σ of the lever arm, each component, m."""
LEVER_WALK = 0.05
"""Random walk of the lever arm, m/√s."""
BIAS_SIGMA = 6.0 * DEGREE
"""σ of the gyro bias at the start of each part, rad/s."""
DISTURBANCE_TIME = 3.0
"""Correlation time of the disturbance of the field, s."""
FORCE_FLOOR = 1e-3
"""Minimum noise of the specific force, m/s²/√Hz."""
MAX_STEPS = 60
"""Maximum number of steps of the least squares."""
FREE_STEPS = 3
"""Number of steps with the initial noise."""
PROBES = 16
"""Random vectors with which the redundancy of each kind of equation is estimated."""
NOISE_TOLERANCE = 0.02
"""Relative change of the noise below which it is final."""
WINDOW = 8.0
"""Length of the windows in which the spectra of velocity and disturbance are computed, s."""

SYMMETRIC = np.zeros((9, 6))
"""Entries of a symmetric matrix by its diagonal and the three entries above it."""
for _k, (_i, _j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
    SYMMETRIC[3 * _i + _j, _k] = SYMMETRIC[3 * _j + _i, _k] = 1.0

_ENDS = np.cumsum([0, 9, 3, 6, 1, 3, 9, 1, 1]).tolist()
GYRO, BIAS, FORCE, FORCE_DELAY, IRON, FIELD, FIELD_DELAY, DIP = map(slice, _ENDS[:-1], _ENDS[1:])
"""Places of the sensor errors in the vector of unknowns: gyro matrix; accelerometer bias, matrix, delay; hard iron, magnetometer matrix,
delay; dip of the field."""
ATTITUDE, VELOCITY, LEVER, GYRO_BIAS, DISTURBANCE = (3 * k for k in range(5))
"""Places of the unknowns of a node."""


class Prior(NamedTuple):
    """Prior of the sensor errors."""

    mean: Array
    sigma: Array


@dataclass(eq=False)
class Unknowns:
    """Sensor errors (m,), attitudes (n, 3, 3) and the other unknowns of the nodes (n, 9 or 12)."""

    errors: Array
    attitude: Array
    nodes: Array

    @property
    def bias(self) -> Array:
        """Gyro bias at the nodes (n, 3)."""
        return np.asarray(self.nodes[:, GYRO_BIAS - 3 : GYRO_BIAS])

    def moved(self, step: Array) -> Unknowns:
        """Return them after a step, which begins with the nodes."""
        nodes = step[: -len(self.errors)].reshape(len(self.nodes), -1)
        turn = Rotation.from_rotvec(nodes[:, :3]).as_matrix()
        return Unknowns(self.errors + step[len(nodes.ravel()) :], self.attitude @ turn, self.nodes + nodes[:, 3:])


class Fit(NamedTuple):
    """Result of the least squares."""

    unknowns: Unknowns
    covariance: Array
    """Covariance of the sensor errors, followed by the gyro bias at the last node."""


def unpacked(x: Array) -> Errors:
    """Return the sensor errors of a vector of unknowns; those of a magnetometer are zero if there is none."""
    full = np.zeros(DIP.stop)
    full[: len(x)] = x
    return Errors(
        gyro_matrix=full[GYRO].reshape(3, 3),
        accelerometer_bias=full[BIAS],
        accelerometer_matrix=(SYMMETRIC @ full[FORCE]).reshape(3, 3),
        accelerometer_delay=float(full[FORCE_DELAY][0]),
        hard_iron=full[IRON],
        magnetometer_matrix=full[FIELD].reshape(3, 3),
        magnetometer_delay=float(full[FIELD_DELAY][0]),
    )


@dataclass(eq=False)
class _Equations:
    """Weighted residuals and their sparse derivatives, by kind."""

    columns: int
    residuals: list[Array] = field(default_factory=list)
    triplets: list[tuple[np.ndarray, np.ndarray, Array]] = field(default_factory=list)
    kinds: dict[str, slice] = field(default_factory=dict)
    rows: int = 0

    def add(
        self, kind: str, residual: Array, sigma: Array | float, *parts: tuple[np.ndarray | int, np.ndarray]
    ) -> None:
        """Add residuals (k, m) with their σ (k,), and their derivatives (k, m, c) by the unknowns from a place (k,) on."""
        count, size = residual.shape
        weight = np.broadcast_to(1.0 / np.asarray(sigma, np.float64), (count,))
        first = self.rows + size * np.arange(count)
        for place, derivative in parts:
            shape = (count, size, derivative.shape[-1])
            row = first[:, None, None] + np.arange(size)[:, None]
            column = np.broadcast_to(np.asarray(place), (count,))[:, None, None] + np.arange(shape[2])
            value = np.broadcast_to(derivative, shape) * weight[:, None, None]
            self.triplets.append(tuple(np.broadcast_to(a, shape).ravel() for a in (row, column, value)))  # type: ignore[arg-type]
        self.residuals.append((residual * weight[:, None]).ravel())
        start = self.kinds[kind].start if kind in self.kinds else self.rows
        self.rows += count * size
        self.kinds[kind] = slice(start, self.rows)

    def add_measured(
        self,
        kind: str,
        residual: Array,
        sigma: Array,
        to_body: Array,
        matrix: Array,
        own: tuple[int, Array],
        *parts: tuple[np.ndarray | int, np.ndarray],
    ) -> None:
        """Add residuals (k, 3) of corrected samples, body axes, as those of the samples, whose noise does not depend on the matrix.

        Otherwise larger scale factors would fit better, because the corrected noise is smaller. ``to_body`` (k, 3, 3) takes the
        derivatives to body axes; ``own``: place of the matrix, and its entries (9, c) by the unknowns there.
        """
        measured, (place, entries) = np.eye(3) + matrix, own
        by_matrix = (np.eye(3)[:, :, None] * residual[:, None, None, :]).reshape(-1, 3, 9) @ entries
        parts = (*((at, measured @ to_body @ part) for at, part in parts), (place, by_matrix))
        self.add(kind, residual @ measured.T, sigma, *parts)

    @property
    def residual(self) -> Array:
        return np.concatenate(self.residuals)

    @property
    def jacobian(self) -> scipy.sparse.csr_matrix:
        row, column, value = (np.concatenate(each) for each in zip(*self.triplets, strict=True))
        result: scipy.sparse.csr_matrix = scipy.sparse.csr_matrix(
            (value, (row, column)), shape=(self.rows, self.columns)
        )
        return result


class Problem:
    """The equations of some intervals; ``gravity`` is in m/s², the field in units of its magnitude."""

    def __init__(self, intervals: Intervals, prior: Prior, gravity: float) -> None:
        self.intervals, self.prior, self.gravity = intervals, prior, gravity
        self.size = 15 if intervals.field is not None else 12
        nodes = len(intervals.node_rate)
        self.here, self.there = self.size * intervals.node, self.size * (intervals.node + 1)
        self.errors_at = self.size * nodes
        self._last: tuple[Unknowns, Prediction] | None = None
        self.activity = np.full(nodes, 1.0)
        self.floor = {"rotation": intervals.gyro_noise, "bias": 1e-6, "force": FORCE_FLOOR, "velocity": 0.02}
        self.noise = {"rotation": 10.0 * intervals.gyro_noise, "bias": 2e-4, "force": 0.05, "velocity": 1.0}
        if intervals.field is not None:
            self.floor |= {"field": intervals.field.noise, "disturbance": 1e-4}
            self.noise |= {"field": max(0.02, intervals.field.noise), "disturbance": 0.02}

    def measure_activity(self, x: Unknowns) -> None:
        """Set σ of the velocity at the nodes from the RMS acceleration over the second around each."""
        mean = self._predicted(x).force.value
        acceleration = np.einsum("kij,kj->ki", x.attitude[self.intervals.node], mean) - self.gravity * np.eye(3)[2]
        noise = self.noise["force"] ** 2 / self.intervals.length
        square = np.maximum(np.mean(acceleration**2, axis=1) - noise, 0.0)
        width = 1 + 2 * round(1.0 / float(np.median(self.intervals.length)))
        square = np.convolve(np.pad(square, width // 2, mode="edge"), np.full(width, 1.0 / width), mode="valid")
        activity = np.full(len(self.activity), np.nan)
        activity[self.intervals.node] = REACTION_TIME * np.sqrt(square) + REST_VELOCITY
        activity[np.isnan(activity)] = activity[np.flatnonzero(np.isnan(activity)) - 1]
        self.activity = activity

    def _predicted(self, x: Unknowns) -> Prediction:
        """Return the prediction at some unknowns; the last one is kept, because it does not depend on the noise."""
        if self._last is None or self._last[0] is not x:
            node = self.intervals.node
            bias = np.asarray(0.5 * (x.bias[node] + x.bias[node + 1]))
            self._last = x, predicted(self.intervals, unpacked(x.errors), bias)
        return self._last[1]

    def equations(self, x: Unknowns) -> _Equations:
        """Return the equations linearised at some unknowns."""
        noise, node, length = self.noise, self.intervals.node, self.intervals.length
        equations, p = _Equations(self.errors_at + len(x.errors)), self._predicted(x)
        self._add_rotation(equations, x, p)
        self._process(equations, x, "bias", GYRO_BIAS, np.inf, BIAS_SIGMA, noise["bias"] * np.sqrt(length))
        self._process(equations, x, "lever", LEVER, np.inf, LEVER_SIGMA, LEVER_WALK * np.sqrt(length))
        velocity = noise["velocity"] * self.activity
        middle = np.sqrt(velocity[node] * velocity[node + 1])
        self._process(equations, x, "velocity", VELOCITY, VELOCITY_TIME, velocity, middle)
        self._add_force(equations, x, p.force)
        if p.field is not None and self.intervals.field is not None:
            sigma = noise["disturbance"]
            self._process(equations, x, "disturbance", DISTURBANCE, DISTURBANCE_TIME, sigma, sigma)
            self._add_field(equations, x, p.field, self.intervals.field.number)
        equations.add(
            "prior", (x.errors - self.prior.mean)[:, None], self.prior.sigma,
            (self.errors_at + np.arange(len(x.errors)), np.ones((1, 1))),
        )  # fmt: skip
        return equations

    def _add_rotation(self, equations: _Equations, x: Unknowns, p: Prediction) -> None:
        """Add the equations of the rotation from node to node."""
        node, here, there = self.intervals.node, self.here, self.there
        relative = np.swapaxes(x.attitude[node] @ p.turn, 1, 2) @ x.attitude[node + 1]
        e = Rotation.from_matrix(relative).as_rotvec()
        inverse = np.linalg.inv(right_jacobian(e))
        back = -inverse @ np.swapaxes(relative, 1, 2)
        by_bias = 0.5 * back @ p.turn_by[:, :, :3]
        equations.add_measured(
            "rotation", e, self.noise["rotation"] * np.sqrt(self.intervals.length),
            np.eye(3), unpacked(x.errors).gyro_matrix, (self.errors_at + GYRO.start, np.eye(9)),
            (here + ATTITUDE, back @ np.swapaxes(p.turn, 1, 2)), (there + ATTITUDE, inverse),
            (here + GYRO_BIAS, by_bias), (there + GYRO_BIAS, by_bias),
            (self.errors_at, back @ p.turn_by[:, :, 3:]),
        )  # fmt: skip

    def _add_force(self, equations: _Equations, x: Unknowns, mean: Mean) -> None:
        """Add the equations of the mean specific force."""
        node, length, here, there = self.intervals.node, self.intervals.length, self.here, self.there
        rotation, unit, L = x.attitude[node], np.eye(3), length[:, None, None]
        rate = (self.intervals.node_rate - x.bias) @ np.linalg.inv(unit + unpacked(x.errors).gyro_matrix).T
        u, r = x.nodes[:, VELOCITY - 3 : VELOCITY], x.nodes[:, LEVER - 3 : LEVER]
        across = np.cross(rate, r)
        v = u + np.einsum("kij,kj->ki", x.attitude, across)
        by_turn, by_lever = -x.attitude @ skew(across), x.attitude @ skew(rate)
        sigma = self.noise["force"] / np.sqrt(length)
        sigma[self.intervals.force.number == 0.0] = np.inf
        by_node = self.gravity * unit[2] + (v[node + 1] - v[node]) / length[:, None]
        true = np.einsum("kji,kj->ki", rotation, by_node)
        own = rotation @ mean.by_own
        own = np.concatenate([own[:, :, :3], own[:, :, 3:12] @ SYMMETRIC, own[:, :, 12:]], axis=2)
        equations.add_measured(
            "force", mean.value - true, sigma,
            np.swapaxes(rotation, 1, 2), unpacked(x.errors).accelerometer_matrix, (self.errors_at + FORCE.start, SYMMETRIC),
            (here + ATTITUDE, -rotation @ skew(true) + by_turn[node] / L), (there + ATTITUDE, -by_turn[node + 1] / L),
            (here + VELOCITY, unit / L), (there + VELOCITY, -unit / L),
            (here + LEVER, by_lever[node] / L), (there + LEVER, -by_lever[node + 1] / L),
            *self._by_errors(rotation @ mean.by_turn, own, BIAS.start),
        )  # fmt: skip

    def _add_field(self, equations: _Equations, x: Unknowns, mean: Mean, number: Array) -> None:
        """Add the equations of the mean field; ``number`` (k,): its samples in each interval."""
        node, here, there = self.intervals.node, self.here, self.there
        rotation, dip, unit = x.attitude[node], x.errors[DIP.start], np.eye(3)
        sigma = self.noise["field"] / np.sqrt(np.where(number > 0.0, number, np.finfo(float).tiny))
        d = x.nodes[:, DISTURBANCE - 3 : DISTURBANCE]
        by_node = np.array([0.0, np.cos(dip), -np.sin(dip)]) + 0.5 * (d[node] + d[node + 1])
        true = np.einsum("kji,kj->ki", rotation, by_node)
        equations.add_measured(
            "field", mean.value - true, sigma,
            np.swapaxes(rotation, 1, 2), unpacked(x.errors).magnetometer_matrix, (self.errors_at + FIELD.start, np.eye(9)),
            (here + ATTITUDE, -rotation @ skew(true)),
            (here + DISTURBANCE, -0.5 * unit), (there + DISTURBANCE, -0.5 * unit),
            (self.errors_at + DIP.start, np.array([[0.0], [np.sin(dip)], [np.cos(dip)]])),
            *self._by_errors(rotation @ mean.by_turn, rotation @ mean.by_own, IRON.start),
        )  # fmt: skip

    def _by_errors(self, by_turn: Array, by_own: Array, place: int) -> Sequence[tuple[np.ndarray | int, np.ndarray]]:
        """Return the derivatives of a mean (k, 3) by gyro bias and matrix, and by the errors of its own sensor from ``place`` on."""
        half = 0.5 * by_turn[:, :, :3]
        return (
            (self.here + GYRO_BIAS, half),
            (self.there + GYRO_BIAS, half),
            (self.errors_at, by_turn[:, :, 3:]),
            (self.errors_at + place, by_own),
        )

    def _process(
        self,
        equations: _Equations,
        x: Unknowns,
        kind: str,
        place: int,
        time: float,
        first: Array | float,
        sigma: Array | float,
    ) -> None:
        """Add a random walk of σ an interval, or for a finite correlation time a Gauss–Markov process of σ; ``first`` is σ at the start."""
        node, values = self.intervals.node, x.nodes[:, place - 3 : place]
        decay = np.exp(-self.intervals.length / time)
        drive = np.sqrt(1.0 - decay**2) if np.isfinite(time) else 1.0
        begin = self.intervals.first
        equations.add(
            kind, values[node + 1] - decay[:, None] * values[node], sigma * drive,
            (self.there + place, np.eye(3)), (self.here + place, -decay[:, None, None] * np.eye(3)),
        )  # fmt: skip
        kind = kind if kind != "bias" else "start"  # the factor of the random walk's noise is not that of its start
        equations.add(
            kind, values[begin], np.broadcast_to(first, len(values))[begin], (self.size * begin + place, np.eye(3))
        )


def _factor(matrix: scipy.sparse.csc_matrix) -> SuperLU:
    """Return the factors of normal equations in the order of the nodes, in which they stay sparse."""
    return splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def solve(problem: Problem, x: Unknowns) -> Fit:
    """Return the least squares from initial unknowns, with the noise estimated from the residuals.

    A motion that swings with one period is no broadband noise: over a swing, its acceleration and the field along its path may depend on
    the attitude as a scale factor does. Therefore the noise of velocity and disturbance is finally increased to the level at the
    frequencies where they are (:func:`_coherence`).
    """
    # The heading of each part is arbitrary without a magnetometer.
    weak = np.zeros(problem.errors_at + len(x.errors))
    weak[(problem.size * problem.intervals.first[:, None] + np.arange(3)).ravel()] = 1e-2
    x = _iterated(problem, x, weak, noise=True)
    noise = problem.noise
    factors = {"velocity": _coherence(problem, x, VELOCITY, VELOCITY_TIME, noise["velocity"] * problem.activity)}
    if "disturbance" in noise:
        sigma = np.full(len(x.nodes), noise["disturbance"])
        factors["disturbance"] = _coherence(problem, x, DISTURBANCE, DISTURBANCE_TIME, sigma)
    for kind, factor in factors.items():
        noise[kind] *= max(1.0, factor) ** 0.5
    x = _iterated(problem, x, weak, noise=False)
    equations = problem.equations(x)
    factor = _factor((equations.jacobian.T @ equations.jacobian).tocsc() + scipy.sparse.diags(weak, format="csc"))
    bias = problem.size * (len(x.nodes) - 1) + GYRO_BIAS + np.arange(3)
    wanted = np.concatenate([problem.errors_at + np.arange(len(x.errors)), bias])
    unit = np.zeros((equations.columns, len(wanted)))
    unit[wanted, np.arange(len(wanted))] = 1.0
    return Fit(x, factor.solve(unit)[wanted])


def _iterated(problem: Problem, x: Unknowns, weak: Array, *, noise: bool) -> Unknowns:
    """Return the unknowns after damped Gauss–Newton steps, between which the noise is estimated; ``weak``: added to the diagonal."""
    random = np.random.default_rng(0)
    prior = scipy.sparse.diags(weak, format="csc")
    damping, changed = 1e-3, 0.0
    for step in range(MAX_STEPS):
        if noise and step < 2 * FREE_STEPS:
            problem.measure_activity(x)
        equations = problem.equations(x)
        J = equations.jacobian
        if noise and step >= FREE_STEPS:
            changed = _estimate_noise(problem, equations, J, _factor((J.T @ J).tocsc() + prior), random)
            equations = problem.equations(x)
            J = equations.jacobian
        r = equations.residual
        x, damping, gain = _descended(problem, x, (J.T @ J).tocsc() + prior, J.T @ r, float(r @ r), damping)
        if (not noise or step > 2 * FREE_STEPS) and changed < NOISE_TOLERANCE and gain < 1e-4:
            break
    return x


def _coherence(problem: Problem, x: Unknowns, place: int, time: float, sigma: Array) -> float:
    """Return the power of a process (n, 3) at its own frequencies, relative to that of its model with σ (n,).

    It is the mean over the frequencies, weighted by the power, of the ratio of the power to that of the Gauss–Markov process with the
    correlation time, in windows of :data:`WINDOW`; 1 for the process itself.
    """
    interval = float(np.median(problem.intervals.length))
    width = round(WINDOW / interval)
    decay = np.exp(-interval / time)
    frequency = np.arange(width // 2 + 1) / width
    model = (1.0 - decay**2) / (1.0 - 2.0 * decay * np.cos(2.0 * np.pi * frequency) + decay**2)
    taper = np.hanning(width + 2)[1:-1, None]
    values = x.nodes[:, place - 3 : place] / sigma[:, None]
    products, power = 0.0, 0.0
    for part in np.split(values, problem.intervals.first[1:]):
        for begin in range(0, len(part) - width + 1, width // 2):
            spectrum = np.abs(np.fft.rfft(taper * part[begin : begin + width], axis=0)) ** 2 / np.sum(taper**2)
            own = spectrum.mean(axis=1)
            products, power = products + float(np.sum(own**2 / model)), power + float(np.sum(own))
    # The mean of three squares of a complex normal number has the mean square 4/3 of its squared mean.
    return products / power / (4.0 / 3.0) if power > 0.0 else 1.0


def _descended(
    problem: Problem, x: Unknowns, normal: scipy.sparse.csc_matrix, gradient: Array, cost: float, damping: float
) -> tuple[Unknowns, float, float]:
    """Return the unknowns after a step that reduces the cost, the next damping, and the relative reduction."""
    scale = scipy.sparse.diags(normal.diagonal(), format="csc")
    while damping < 1e8:
        tried = x.moved(-_factor(normal + damping * scale).solve(gradient))
        r = problem.equations(tried).residual
        if (after := float(r @ r)) <= cost * (1.0 + 1e-9):
            return tried, max(0.2 * damping, 1e-9), 1.0 - after / cost
        damping = max(5.0 * damping, 1e-6)
    return x, 1e-3, 0.0


def _estimate_noise(
    problem: Problem, equations: _Equations, J: scipy.sparse.csr_matrix, factor: SuperLU, random: np.random.Generator
) -> float:
    """Scale the noise of each kind of equation to its residuals; return the largest relative change.

    The expected square sum of m residuals is m less the trace of their part of J (JᵀJ)⁻¹ Jᵀ, which is estimated with random signs.
    """
    signs = random.choice([-1.0, 1.0], (equations.rows, PROBES))
    projected = J @ factor.solve(J.T @ signs)
    residual, changed = equations.residual, 0.0
    for kind, least in problem.floor.items():
        rows = equations.kinds[kind]
        count = rows.stop - rows.start
        redundancy = max(count - float(np.sum(signs[rows] * projected[rows])) / PROBES, 0.02 * count)
        ratio = np.clip(np.sqrt(float(residual[rows] @ residual[rows]) / redundancy), 0.3, 3.0)
        before, problem.noise[kind] = problem.noise[kind], max(float(problem.noise[kind] * ratio), least)
        changed = max(changed, abs(np.log(problem.noise[kind] / before)))
    return float(changed)
