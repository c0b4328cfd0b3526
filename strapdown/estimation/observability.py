"""Observability of each state over a record: rank, singular values, and the weakest directions as text."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array, positive
from strapdown.estimation import model as modelling
from strapdown.estimation.error_states import AXES, ErrorStates
from strapdown.estimation.smoothing import smooth
from strapdown.estimation.states import ProcessNoise, State
from strapdown.records import ImuRecord
from strapdown.results import Column, Listed, Table
from strapdown.units import error_state_name, error_state_unit

WEAKEST = 3
"""Minimum number of directions in text: these, and all that are not observed."""
NAMED = 0.25
"""Minimum component of a direction, relative to its largest, for a state to be named."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Observability(Listed):
    """Information of a record's measurements about the initial state, relative to the prior.

    With the prior covariance ``P₀ = S Sᵀ`` and the covariance P of the same state after the whole record, the information of the
    measurements is ``O = Sᵀ (P⁻¹ − P₀⁻¹) S``: the observability Gramian, linearised along the estimate, including process noise,
    with every state relative to its prior σ, so that rad, T and ppm can be compared. A singular value s of
    ``√O`` is dimensionless: along its direction the record reduces the σ to ``1/√(1 + s²)`` of the prior σ.

    Parameters
    ----------
    states : tuple of str (n,)
        Name of each state.
    units : tuple of str (n,)
        SI unit of each state.
    prior_sigma : ndarray (n,)
        Standard deviations at the first edge before any measurement, in ``units``.
    start_sigma : ndarray (n,)
        Standard deviations of the same state, at the first edge, after all measurements, in ``units``.
    singular_values : ndarray (n,)
        Singular values, dimensionless, in descending order.
    directions : ndarray (n, n)
        Unit directions in the space of states relative to their prior σ, one per row, in the order of the singular values.
    threshold : float
        Minimum singular value of an observed direction.
    """

    states: tuple[str, ...]
    units: tuple[str, ...]
    prior_sigma: Array
    start_sigma: Array
    singular_values: Array
    directions: Array
    threshold: float

    @property
    def rank(self) -> int:
        """Number of observed directions."""
        return int(np.sum(self.singular_values >= self.threshold))

    @property
    def unobserved(self) -> Array:
        """Part of each state in directions that are not observed (n,): 0 fully observed, 1 not at all."""
        return np.asarray(np.sqrt(np.sum(self.directions[self.rank :] ** 2, axis=0)))

    def listing(self) -> Table:
        """Return the σ of each state, and the weakest directions with their singular values, as a table."""
        n, relative = len(self.states), self.start_sigma / self.prior_sigma
        units, sizes = zip(*map(error_state_unit, self.states, self.units), strict=True)
        rows = list(zip(self.states, units, self.prior_sigma / sizes, relative, self.unobserved, strict=True))
        sigmas = (Column(label, digits=3) for label in ("prior σ", "start/prior"))
        weakest = range(n - 1, min(self.rank, n - WEAKEST) - 1, -1)
        notes = [f"{self.singular_values[k]:14.3g}: {self._words(k)}" for k in weakest]
        notes.insert(0, "singular value: the weakest directions, each state relative to its prior σ")
        title = f"{self.rank} of {n} directions are observed (singular value {self.threshold:g} or more)"
        return Table(
            title, ["state", "unit", *sigmas, Column("unobserved", shown="{:.2f}".format)], rows, notes, left=2
        )

    def summary(self) -> dict[str, Any]:
        """Return everything as plain values for JSON, in SI units; the directions as rows, each state relative to its prior σ.

        Returns
        -------
        dict
            Rank and threshold, the σ of each state, singular values and directions.
        """
        arrays = ("prior_sigma", "start_sigma", "unobserved", "singular_values", "directions")
        return {
            "rank": self.rank,
            "threshold": self.threshold,
            "states": list(self.states),
            "units": list(self.units),
            **{name: getattr(self, name).tolist() for name in arrays},
        }

    def _words(self, k: int) -> str:
        """Return the k-th direction as text: states with large components relative to the prior σ, the largest first."""
        size = np.abs(self.directions[k])
        large = [i for i in np.argsort(-size, kind="stable") if size[i] >= NAMED * size.max()]
        relative = self.directions[k] * np.sign(self.directions[k, large[0]])
        return " ".join(f"{relative[i]:+.2f} {self.states[i]}" for i in large).removeprefix("+")


def state_names(blocks: Sequence[ErrorStates]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return name and unit of every state: attitude, bias, error states."""
    names = [f"attitude {axis}" for axis in AXES] + [f"gyro bias {axis}" for axis in AXES]
    units = ["rad"] * 3 + ["rad/s"] * 3
    for block in blocks:
        names += map(error_state_name, [block.name] * block.size, block.components, block.units)
        units += block.units
    return tuple(names), tuple(units)


def observability(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: State,
    error_states: Sequence[ErrorStates] = (),
    *,
    threshold: float = 1.0,
) -> Observability:
    """Return the observability of each state of a filter over a record.

    The model is linearised along the smoothed attitude, with no calibration errors. A direction in the space of the states is
    observed if its singular value is ``threshold`` or more: at 1 the record has as much information about it as the prior. Singular values
    are accurate up to about 1e7. For a state with a correlation time (:class:`strapdown.estimation.error_states.GaussMarkov`), the
    information about its initial value counts.

    Parameters
    ----------
    record : ImuRecord
    process_noise : ProcessNoise
    initial : State
        State at the first edge, with the prior σ.
    error_states : sequence of ErrorStates, default none
        Error states in addition to attitude and bias.
    threshold : float, default 1

    Returns
    -------
    Observability
        Result, which prints as a table.

    Raises
    ------
    InputError
        If an argument is out of range, or an error state belongs to a sensor that the record does not have.
    """
    error_states = modelling.as_blocks(error_states)
    positive("threshold", threshold)
    state = modelling.begin(initial, error_states)
    where = smooth(record, process_noise, state, error_states)
    fixed = without_errors(record, where.attitude)
    begin = dataclasses.replace(state, attitude=where.attitude[0], bias=np.zeros(3), values=np.zeros(len(state.values)))
    whole = smooth(fixed, process_noise, begin, error_states, full_covariance=True)
    covariance = whole.whole_covariance if error_states else whole.covariance
    assert covariance is not None
    P = covariance[0]
    sigma = np.sqrt(np.diag(state.covariance))
    value, vector = np.linalg.eigh(state.covariance / np.outer(sigma, sigma))
    # The symmetric root of the correlation rotates the states as little as possible: not at all if the prior is diagonal.
    root, inverse = (vector * np.sqrt(value)) @ vector.T, (vector / np.sqrt(value)) @ vector.T
    left, direction = np.linalg.eigh(inverse @ (P / np.outer(sigma, sigma)) @ inverse)
    left = np.clip(left, 1e-15, 1.0)  # of the prior variance
    directions = (root @ direction).T
    names, units = state_names(error_states)
    return Observability(
        states=names,
        units=units,
        prior_sigma=sigma,
        start_sigma=np.sqrt(np.diag(P)),
        singular_values=np.sqrt(1.0 / left - 1.0),
        directions=directions / np.linalg.norm(directions, axis=1, keepdims=True),
        threshold=threshold,
    )


def without_errors(record: ImuRecord, attitude: Array) -> ImuRecord:
    """Return the record of ideal sensors on a body with these attitudes at the edges (n + 1, 4), rotating at constant rate between them.

    A filter started on it stays on it, whatever its noise model, so its covariance is linearised along one trajectory. Linearised along an
    estimate that changes with each measurement, it would have spurious information about unobservable directions.
    """
    turns = quaternion.rotation_between(attitude[:-1], attitude[1:])
    series = []
    for whole in record.vectors:
        s = whole.taken((whole.time >= record.time[0]) & (whole.time <= record.time[-1]))
        k = np.clip(np.searchsorted(record.time, s.time, side="left") - 1, 0, len(turns) - 1)
        share = (s.time - record.time[k]) / (record.time[k + 1] - record.time[k])
        q = quaternion.multiply(attitude[k], quaternion.exp(share[:, None] * turns[k]))
        inverse = quaternion.conjugate(q)
        if s.attitude is not None:
            series.append(dataclasses.replace(s, attitude=quaternion.normalize(q)))
            continue
        exact_f = s.references_f
        if s.kind == "heading":
            # Only the heading of the reference is used; its inclination is that of the measurement.
            measured_f = quaternion.rotate(q, s.vector_b)
            level = np.linalg.norm(exact_f[:, :2], axis=1, keepdims=True)
            size = np.linalg.norm(measured_f[:, :2], axis=1, keepdims=True)
            exact_f = np.concatenate([exact_f[:, :2] / level * size, measured_f[:, 2:]], axis=1)
        exact_b = np.where(np.isfinite(s.vector_b), quaternion.rotate(inverse, exact_f), np.nan)
        series.append(dataclasses.replace(s, vector_b=exact_b))
    return ImuRecord(time=record.time, increments=turns, vectors=tuple(series), temperature=record.temperature)
