"""The smoother in matrices, over what the step-by-step filter passed through: for blocks told by functions.

The textbook's step (Rauch, Tung & Striebel 1965), carried from one tangent space to the next as in :mod:`strapdown.kernels.smoother_step`.
With ``C = P Φᵀ P⁻⁻¹`` the covariance is ``(I − C Φ) P (I − C Φ)ᵀ + C Q Cᵀ + C P_later Cᵀ``: a sum of squares, in which nothing cancels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from strapdown import kinematics, mekf, quaternion
from strapdown.augmented import joining, stepping
from strapdown.augmented.blocks import Block
from strapdown.augmented.filtering import AugmentedEstimate
from strapdown.augmented.model import AugmentedState, turning_matrix
from strapdown.checks import Array
from strapdown.mekf import ProcessNoise
from strapdown.records import ImuRecord
from strapdown.robustness import Gate, Robust


@dataclass(frozen=True, kw_only=True, eq=False)
class Passed:
    """A state that the filter passed through: attitude (4,), the bias and the blocks' values (3 + m,), and their covariance."""

    attitude: Array
    others: Array
    covariance: Array

    @classmethod
    def of(cls, face: stepping.StepFilter) -> Passed:
        """Return the present state of a filter."""
        return cls(attitude=face.attitude, others=np.append(face.bias, face.values), covariance=face.P.copy())


@dataclass(frozen=True, kw_only=True, eq=False)
class Step:
    """A prediction of the filter."""

    before: Passed
    after: Passed
    transition: Array
    process_noise: Array
    chains: Array
    """Those of the blocks' model, which tell what is carried."""


class RecordingFilter(stepping.StepFilter):
    """The filter that keeps its steps, and in ``number`` how many there were before the first prediction and after each."""

    def __init__(
        self, process_noise: ProcessNoise, initial: AugmentedState, blocks: Sequence[Block], **options: object
    ) -> None:
        super().__init__(process_noise, initial, blocks, **options)  # type: ignore[arg-type]
        self.steps: list[Step] = []
        self.number = [0]

    def predict(self, delta_theta: ArrayLike, dt: float | None = None, *, time: float | None = None) -> None:
        """Predict as ever."""
        super().predict(delta_theta, dt, time=time)
        self.number.append(len(self.steps))

    def _step(self, part: Array, dt: float, model: object) -> None:
        before = Passed.of(self)
        super()._step(part, dt, model)  # type: ignore[arg-type]
        self.steps.append(
            Step(
                before=before,
                after=Passed.of(self),
                transition=self.F.copy(),
                process_noise=self.Q.copy(),
                chains=self._model("").chains,
            )
        )


def back(step: Step, later: Passed) -> Passed:
    """Return what is known before a step, given what is known of the state after it."""
    P, F = step.before.covariance, step.transition
    predicted = step.after.covariance
    scale = np.sqrt(np.diag(predicted))
    gain = np.linalg.solve(predicted / np.outer(scale, scale), (F @ P) / scale[:, None]).T / scale
    a = quaternion.log(quaternion.multiply(quaternion.conjugate(step.after.attitude), later.attitude))
    J = turning_matrix(step.chains, len(P), later.attitude, step.after.attitude)
    J[:3, :3] = kinematics.inverse_right_jacobian(a)
    x = gain @ np.concatenate([a, J[3:, 3:] @ later.others - step.after.others])
    kept = np.eye(len(P)) - gain @ F
    carried = gain @ J
    P = kept @ P @ kept.T + gain @ step.process_noise @ gain.T + carried @ later.covariance @ carried.T
    attitude = quaternion.normalize(quaternion.multiply(step.before.attitude, quaternion.exp(x[:3])))
    J = turning_matrix(step.chains, len(P), step.before.attitude, attitude)
    J[:3, :3] = kinematics.right_jacobian(x[:3])
    return Passed(attitude=attitude, others=J[3:, 3:] @ (step.before.others + x[3:]), covariance=J @ P @ J.T)


def smooth(
    record: ImuRecord,
    process_noise: ProcessNoise,
    state: AugmentedState,
    blocks: tuple[Block, ...],
    lag: float,
    gate: Gate | None,
    robust: Robust | None,
) -> tuple[AugmentedEstimate, list[Passed]]:
    """Return the filter's estimate and the smoothed state at every edge."""
    face = RecordingFilter(process_noise, state, blocks, gate=gate, robust=robust)
    forward, _ = stepping.run_on(
        record, process_noise, state, blocks, every=len(record.time), gate=gate, robust=robust, face=face
    )
    steps, rows = face.steps, [*(step.before for step in face.steps), Passed.of(face)]
    start = float(record.time[0])
    breaks = [joining.break_of(event, None, start) for event in joining.recoveries(forward.events)]
    until = joining.last_seen(record.time, lag)
    # The filter predicts from each edge or measurement to the next.
    events = mekf.schedule(record.vectors, record.time[0], record.time[-1], anisotropic=True)
    predicted = np.unique(np.concatenate([record.time, events.time]))
    first = np.array(face.number)[np.searchsorted(predicted, joining.stops(record.time, breaks))]
    places = np.arange(len(rows))
    found: list[Passed] = [rows[-1]] * len(record.time)
    for one in joining.trajectories(record.time, until, breaks, first, places, [None] * len(breaks)):
        own = one.segments[one.starts[one.edge]]
        # From edge to edge backward; those that see the same go on with what the one after has found.
        now, seen = 0, -1
        for k in range(len(own) - 1, -1, -1):
            if one.last[k] != seen:
                seen = int(one.last[k])
                now = int(one.segments[one.starts[seen]])
                later = rows[now]
            while now > own[k]:
                now -= 1
                later = back(steps[now], later)
            found[one.row[k]] = later
    return forward, found
