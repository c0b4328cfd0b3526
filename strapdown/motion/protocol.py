"""What a motion is."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from strapdown import checks
from strapdown.checks import Array


@runtime_checkable
class Motion(Protocol):
    """A motion of a rigid body about one point, as a function of time in s; ``time`` may have any shape ``(...)``.

    Any object with these methods is a motion and may be the base or the vibration of a :class:`Composed`.

    A motion whose body rate is not smooth everywhere also has an attribute or property ``breaks``: the times, s, of shape (k,), at
    which the rate or one of its derivatives jumps. It is optional, so it is no member of this protocol; whoever integrates the rate
    (:class:`Composed` does) then integrates from break to break. A break left unnamed costs accuracy and time, one too
    many a little time.
    """

    def attitude(self, time: ArrayLike) -> Array:
        """Return q_fb, unit, shape (..., 4)."""
        ...

    def body_rate(self, time: ArrayLike) -> Array:
        """Return w_b of equation (17), rad/s, shape (..., 3)."""
        ...

    def fixed_rate(self, time: ArrayLike) -> Array:
        """Return w_f of equation (3), rad/s, shape (..., 3)."""
        ...

    def body_angular_acceleration(self, time: ArrayLike) -> Array:
        """Return dw_b/dt (components in body axes), rad/s², shape (..., 3)."""
        ...

    def increments(self, edges: ArrayLike) -> Array:
        """Return ∫ w_b dt over each interval between consecutive edges, rad, shape (n, 3) for n + 1 edges."""
        ...


def break_times(name: str, motion: Motion) -> Array:
    """Return the ``breaks`` (k,), s, sorted, of the motion that the caller calls ``name``; none if it has no such attribute."""
    return np.unique(checks.array(f"{name}.breaks", getattr(motion, "breaks", ()), ("k",)))
