"""The multiplicative EKF with a triangular root of its covariance, ``P = Rᵀ R``, by QR: the reference for the digits of the covariance.

Transition, process noise and rows of the measurements are those of :class:`strapdown.StepFilter`; the recursion of the covariance is
another one, which never subtracts: ``R`` of ``[R Φᵀ; N]``, ``Nᵀ N = Q``, and of ``[√V 0; R Hᵀ R]`` for measurement noise V (Kailath, Sayed
& Hassibi 2000, section 12.3). Its relative error is that of rounding times the ratio of the σ, not of the variances.
"""

import numpy as np

from strapdown import kinematics
from strapdown.estimation.step_filter import StepFilter


def triangle(rows):
    """Return the upper triangle R of a QR decomposition, of rows in order of their size: rowwise accurate (Cox & Higham 1998)."""
    return np.linalg.qr(rows[np.argsort(-np.max(np.abs(rows), axis=1))], mode="r")


def root_of(P):
    """Return an upper triangular R with ``Rᵀ R = P``; states without variance have columns of zeros."""
    R, used = np.zeros(P.shape), np.flatnonzero(np.diag(P) > 0.0)
    sigma = np.sqrt(np.diag(P)[used])
    R[np.ix_(used, used)] = np.linalg.cholesky(P[np.ix_(used, used)] / np.outer(sigma, sigma)).T * sigma
    return R


class SquareRootFilter(StepFilter):
    """The step-by-step filter with a triangular root of its covariance, ``root``; P is made of it for the outside only."""

    def __init__(self, process_noise, initial, error_states=(), **options):
        super().__init__(process_noise, initial, error_states, **options)
        self.root = root_of(self.P)

    def _sub_step(self, part, dt):
        super()._sub_step(part, dt)
        self._set_root(triangle(np.vstack([self.root @ self.F.T, root_of(self.Q)])))

    def _filterpy_update(self, residual, H, R):
        """Return the gain times the residual; the root becomes that about the corrected state."""
        d, n = H.shape
        V = np.linalg.cholesky(R)
        whole = triangle(np.block([[V.T, np.zeros((d, n))], [self.root @ H.T, self.root]]))
        self.root = whole[d:, d:]
        return whole[:d, d:].T @ np.linalg.solve(whole[:d, :d].T, residual)

    def _move(self, correction, P):
        """Move the state, and its root to the tangent space there."""
        before = self.attitude
        super()._move(correction, P)
        G = np.eye(len(P))
        G[:3, :3] = kinematics.right_jacobian(correction[:3])
        self._set_root(self.root @ (self._motion.turning_matrix(before, self.attitude) @ G).T)

    def _set_root(self, root):
        self.root, self.P = root, root.T @ root
