"""Interface of a motion, checks of parameters and times, and the shape of results."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from strapdown import checks
from strapdown.checks import Array

IDENTITY = (1.0, 0.0, 0.0, 0.0)
"""Attitude of a body whose axes are the fixed axes."""


@runtime_checkable
class Motion(Protocol):
    """A motion of a rigid body about one point, as a function of time.

    Any object with these methods is a motion and may be the base or the vibration of a :class:`Composed`.

    A motion whose body rate is not smooth everywhere also has an attribute or property ``breaks``: the times (k,), s, at which the
    rate or one of its derivatives is discontinuous. It is optional and therefore not a member of this protocol. The rate is then
    integrated from break to break, as :class:`Composed` does. A missing break costs accuracy and time, an unnecessary one a little time.
    """

    def attitude(self, time: ArrayLike) -> Array:
        """Return the attitude.

        Parameters
        ----------
        time : array_like (...)
            Times, s.

        Returns
        -------
        ndarray (..., 4)
            Unit quaternions q_fb.
        """

    def body_rate(self, time: ArrayLike) -> Array:
        """Return the angular rate in body axes, w_b of equation (17) of *Quaternion differentiation*.

        Parameters
        ----------
        time : array_like (...)
            Times, s.

        Returns
        -------
        ndarray (..., 3)
            w_b, rad/s.
        """

    def body_angular_acceleration(self, time: ArrayLike) -> Array:
        """Return the angular acceleration in body axes, dw_b/dt.

        Parameters
        ----------
        time : array_like (...)
            Times, s.

        Returns
        -------
        ndarray (..., 3)
            dw_b/dt, rad/s².
        """

    def increments(self, edges: ArrayLike) -> Array:
        """Return the rotation increments, ∫ w_b dt over each interval between consecutive edges.

        Parameters
        ----------
        edges : array_like (n + 1,)
            Times of the edges, s, increasing.

        Returns
        -------
        ndarray (n, 3)
            Increments in body axes, rad.
        """


def break_times(name: str, motion: Motion) -> Array:
    """Return the sorted ``breaks`` (k,), s, of a motion, called ``name`` in errors; none if it has no such attribute."""
    return np.unique(checks.array(f"{name}.breaks", getattr(motion, "breaks", ()), ("k",)))


def times(time: ArrayLike) -> Array:
    """Return finite times, s, of any shape."""
    return checks.array("time", time, (...,))


def edge_stamps(edges: ArrayLike) -> Array:
    """Return the edges (n + 1,) of n ≥ 1 intervals, s, increasing."""
    return checks.increasing("edges", edges, minimum=2)


def store_numbers(motion: object, **units: str) -> None:
    """Check parameters of a frozen motion, by name, in these units, and store them as finite floats."""
    for name, unit in units.items():
        object.__setattr__(motion, name, checks.finite(name, getattr(motion, name), unit=unit))


def store_vector(motion: object, name: str) -> tuple[float, ...]:
    """Check a parameter of a frozen motion and store it as three floats."""
    value = tuple(checks.array(name, getattr(motion, name), (3,)).tolist())
    object.__setattr__(motion, name, value)
    return value


def store_attitude(motion: object) -> None:
    """Check the initial attitude of a frozen motion and store it as a unit quaternion."""
    name = "initial_attitude"
    value = checks.unit_quaternions(name, checks.array(name, getattr(motion, name), (4,)))
    object.__setattr__(motion, name, tuple(value.tolist()))


def stacked(*components: float | Array) -> Array:
    """Return the components stacked along a new last axis."""
    return np.stack(np.broadcast_arrays(*components), axis=-1).astype(np.float64, copy=False)
