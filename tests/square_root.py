"""The multiplicative EKF with a triangular root of its covariance, ``P = Rᵀ R``, by QR: the reference for the digits of the covariance.

Transition, process noise and rows of the measurements are those of :class:`strapdown.StepFilter`; the recursion of the covariance is
another one, which never subtracts: ``R`` of ``[R Φᵀ; N]``, ``Nᵀ N = Q``, and of ``[√V 0; R Hᵀ R]`` for measurement noise V (Kailath, Sayed
& Hassibi 2000, section 12.3). Its relative error is that of rounding times the ratio of the σ, not of the variances.
"""

import numpy as np

from strapdown import kinematics, quaternion
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

    def _correct(self, residual, H, R):
        """Correct the state; the root becomes that in the tangent space there."""
        d, n = H.shape
        V = np.linalg.cholesky(R)
        whole = triangle(np.block([[V.T, np.zeros((d, n))], [self.root @ H.T, self.root]]))
        correction, before = whole[:d, d:].T @ np.linalg.solve(whole[:d, :d].T, residual), self.attitude
        self.attitude = quaternion.normalize(quaternion.multiply(before, quaternion.exp(correction[:3])))
        T, G = self._motion.turning_matrix(before, self.attitude), np.eye(n)
        G[:3, :3] = kinematics.right_jacobian(correction[:3])
        self.bias, self.values = self.bias + correction[3:6], T[6:, 6:] @ (self.values + correction[6:])
        self._set_root(whole[d:, d:] @ (T @ G).T)

    def _set_root(self, root):
        self.root, self.P = root, root.T @ root
