"""Validation of the arguments of public functions, before any computation.

Each check returns the value in the form that the code needs (a float64 array, a float) or raises :class:`InputError`, whose message names
the value, the place (name and index) and the remedy. Kernels do not check their arguments.
"""

from __future__ import annotations

import ast
import difflib
import os
import re
import reprlib
from collections.abc import Callable, Iterable, Sequence
from types import EllipsisType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

UNIT_NORM_TOLERANCE = 1e-6
"""Maximum norm error of a unit quaternion; larger than the rounding errors of float32 files."""

ROUNDING = 1e-14
"""Norm errors below this are not corrected."""


class InputError(ValueError):
    """Bad input: the message names the value, the place and the remedy.

    Examples
    --------
    >>> import strapdown as sd
    >>> sd.simulate("two-star")
    Traceback (most recent call last):
        ...
    strapdown.checks.InputError: scenario 'two-star' is not known; did you mean 'two-stars'? ...
    """


class Hint(NamedTuple):
    """An argument to give, as part of a message: :func:`str` names it as in Python, and the command line its option.

    Examples
    --------
    >>> f"the accelerometer is inverted: {Hint('invert', 'accelerometer')}; the delay may be given, {Hint('latency')}"
    "the accelerometer is inverted: `invert='accelerometer'`; the delay may be given, `latency=`"
    """

    argument: str
    value: Any = None
    """Value to give; None: any."""

    def __str__(self) -> str:
        return f"`{self.argument}={'' if self.value is None else repr(self.value)}`"

    @staticmethod
    def replaced(text: str, shown: Callable[[Hint], str]) -> str:
        """Return a message with another form of the hints in it."""

        def replaced(match: re.Match[str]) -> str:
            try:
                return shown(Hint(match[1], ast.literal_eval(match[2] or "None")))
            except (ValueError, SyntaxError):  # no hint, but a name from a file that looks like one
                return match[0]

        return re.sub(r"`(\w+)=([^`]*)`", replaced, text)


OF_YOUR_OWN = "a filter of your own"
"""Part of the note added to exceptions raised by a user's filter."""


def place(name: str, index: Iterable[int | np.intp]) -> str:
    """Return the name of an entry of an array for messages."""
    index = tuple(index)
    return f"{name}[{', '.join(str(int(i)) for i in index)}]" if index else name


def _first(mask: NDArray[np.bool_]) -> tuple[np.intp, ...]:
    return tuple(np.argwhere(mask)[0]) if mask.ndim else ()


_NO_NUMBERS = {"b": "True or False", "S": "text", "U": "text", "c": "complex numbers", "M": "dates", "m": "time spans"}
"""Kinds of dtype that NumPy converts to float although they are not numbers."""


def _truth_value(value: object) -> bool:
    """Return whether a value is True or False, or a sequence that contains one."""
    if isinstance(value, (list, tuple)):
        return any(_truth_value(item) for item in value)
    return isinstance(value, (bool, np.bool_))


def _unmasked(name: str, value: ArrayLike, allow_nan: bool) -> ArrayLike:
    """Return a masked array with NaN in place of masked values, or an error; NumPy would use the values under the mask as data."""
    if isinstance(value, (list, tuple)) and any(isinstance(item, np.ma.MaskedArray) for item in value):
        value = np.ma.array(value)
    if not isinstance(value, np.ma.MaskedArray):
        return value
    mask = np.ma.getmaskarray(value)
    if not mask.any():
        return np.asarray(value)
    if not allow_nan:
        raise InputError(f"{place(name, _first(mask))} is masked; remove or interpolate such samples first")
    return np.asarray(np.ma.filled(value.astype(np.float64), np.nan))


def numbers(name: str, value: ArrayLike, *, allow_nan: bool = False) -> Array:
    """Return ``value`` as a float64 array of any shape; raise an error for text, dates and booleans, which NumPy would convert."""
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    if hasattr(value, "as_quat"):
        raise InputError(f"{name} is a SciPy Rotation; give rotation.as_quat(scalar_first=True)")
    try:
        raw = np.asarray(_unmasked(name, value, allow_nan))
        held = "True or False" if _truth_value(value) else _NO_NUMBERS.get(raw.dtype.kind, "")
        result = raw if held else np.asarray(raw, dtype=np.float64)
    except InputError:
        raise
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is not an array of numbers ({error}); pass floats") from None
    if held:
        raise InputError(f"{name} is not an array of numbers (it holds {held}); pass floats")
    return result


def array(name: str, value: ArrayLike, shape: Sequence[int | str | EllipsisType], *, allow_nan: bool = False) -> Array:
    """Return ``value`` as a finite float64 array of the given shape.

    Parameters
    ----------
    name : str
        Name in the caller, for the error message.
    value : array_like
    shape : sequence
        One entry per axis: an ``int`` is exact, a ``str`` names a free length, a leading ``...`` any leading axes.
    allow_nan : bool
        Whether NaN or a mask (missing samples) is allowed; infinities never are.
    """
    result = numbers(name, value, allow_nan=allow_nan)
    free = bool(shape) and shape[0] is ...
    tail = shape[1:] if free else shape
    least = len(tail)
    if result.shape != shape and (
        result.ndim < least
        or (result.ndim > least and not free)
        or any(isinstance(want, int) and have != want for have, want in zip(result.shape[-least:], tail, strict=False))
    ):
        wanted = "(" + ", ".join("..." if s is ... else str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"
        raise InputError(f"{name} has shape {result.shape}, wanted {wanted}; reshape it or check what was passed")
    bad = np.isinf(result) if allow_nan else ~np.isfinite(result)
    if bad.any():
        index = _first(bad)
        raise InputError(f"{place(name, index)} is {result[index]}; remove or interpolate such samples first")
    return result


def symmetric(name: str, value: Array, tolerance: float = 1e-9) -> Array:
    """Return matrices (..., n, n), unless an element differs from the one across the diagonal by more than rounding.

    ``tolerance`` is in units of σᵢσⱼ: a computed covariance is symmetric to rounding of its diagonal, not of each small element.
    """
    if np.array_equal(value, np.swapaxes(value, -1, -2)):
        return value
    sigma = np.sqrt(np.abs(np.diagonal(value, axis1=-2, axis2=-1)))
    apart = np.abs(value - np.swapaxes(value, -1, -2)) > tolerance * sigma[..., :, None] * sigma[..., None, :]
    if apart.any():
        *row, i, j = (int(k) for k in _first(apart))
        raise InputError(
            f"{place(name, row)} is not symmetric: [{i}, {j}] is {value[*row, i, j]:g} but [{j}, {i}] is {value[*row, j, i]:g}; "
            "use ½(P + Pᵀ)"
        )
    return value


def positive(name: str, value: float, *, unit: str = "") -> float:
    """Return ``value`` as a float above zero."""
    number = finite(name, value, unit=unit)
    if number <= 0.0:
        raise InputError(f"{name} is {number:g}{_unit(unit)}; it must be greater than zero")
    return number


def by_axis(name: str, value: ArrayLike, remedy: str = "") -> Array:
    """Return one number for all axes, or one for each, as three (3,) above zero; ``remedy`` ends the message about a wrong shape."""
    components = numbers(name, value)
    if components.shape not in ((), (1,), (3,)):
        raise InputError(f"{name} has shape {components.shape}; give one number, or three, one per axis{remedy}")
    return np.array(
        [positive(f"{name}[{k}]", float(component)) for k, component in enumerate(np.broadcast_to(components, 3))]
    )


def half_turn(name: str, sigma: ArrayLike) -> None:
    """Raise an error for a σ of an attitude error, rad, of more than π, the largest rotation."""
    if (largest := float(np.max(sigma))) > np.pi:
        raise InputError(f"{name} is {largest:g} rad; no attitude error is larger than π, 180°: check its unit")


def fraction(name: str, value: float) -> float:
    """Return ``value`` as a float between 0 and 1, both excluded."""
    number = finite(name, value)
    if not 0.0 < number < 1.0:
        raise InputError(f"{name} is {number:g}; it must lie between 0 and 1")
    return number


def non_negative(name: str, value: float, *, unit: str = "") -> float:
    """Return ``value`` as a float of zero or more."""
    number = finite(name, value, unit=unit)
    if number < 0.0:
        raise InputError(f"{name} is {number:g}{_unit(unit)}; it must not be negative")
    return number


def finite(name: str, value: float, *, unit: str = "") -> float:
    """Return ``value`` as a finite float."""
    try:
        raw = np.asarray(value)
        if raw.ndim or raw.dtype.kind in _NO_NUMBERS:  # "60" in a file is an error, not a number; so is True
            raise ValueError
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} is {value!r}; it must be one number{_unit(unit, ' in ')}") from None
    if not np.isfinite(number):
        raise InputError(f"{name} is {number}; it must be a finite number{_unit(unit, ' in ')}")
    return number


MAX_COUNTED = 2.0**63
"""Upper bound of whole numbers, so that they fit into an int64 array."""


def count(name: str, value: int, *, minimum: int = 1) -> int:
    """Return ``value`` as a whole number of at least ``minimum``."""
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    # NaN and infinity are not below the bound.
    if not number or not abs(value) < MAX_COUNTED or int(value) != value or value < minimum:
        bound = ", and below 2^63" if number and isinstance(value, int) and abs(value) >= MAX_COUNTED else ""
        raise InputError(f"{name} is {value!r}; it must be a whole number of {minimum} or more{bound}")
    return int(value)


def _unit(unit: str, glue: str = " ") -> str:
    return f"{glue}{unit}" if unit else ""


def unit_quaternions(name: str, value: ArrayLike) -> Array:
    """Return ``value`` as an array (..., 4) of unit quaternions; norm errors of the size of float32 rounding are removed."""
    q = array(name, value, (..., 4))
    norm = lengths(q)
    off = np.abs(norm - 1.0)
    if not np.any(off > ROUNDING):
        return q.copy()
    bad = off > UNIT_NORM_TOLERANCE
    if np.any(bad):
        index = _first(bad)
        raise InputError(
            f"{place(name, index)} has norm {norm[index]:.9g}, not 1; normalise it (quaternion.normalize) "
            "and check that it is a quaternion, scalar first"
        )
    return np.asarray(np.where(off[..., None] > ROUNDING, q / norm[..., None], q))


def lengths(vectors: Array) -> Array:
    """Return the norms (...,) of vectors (..., k), component by component: a sum over a short last axis takes five times as long."""
    total = vectors[..., 0] ** 2
    for k in range(1, vectors.shape[-1]):
        total = total + vectors[..., k] ** 2
    return np.asarray(np.sqrt(total))


def are_finite(rows: Array) -> np.ndarray:
    """Return whether all numbers of each row (n, k) are finite (n,), column by column, which takes a tenth of the time for a small k."""
    finite = np.ones(len(rows), bool)
    for column in rows.T:
        finite &= np.isfinite(column)
    return finite


def median(values: Array) -> float:
    """Return the median of finite numbers (n,): ``np.median``, which selects several of them, takes five times as long."""
    high = len(values) // 2
    ordered = np.partition(values, high)
    return float(ordered[high] if len(values) % 2 else 0.5 * (ordered[:high].max() + ordered[high]))


def increasing(name: str, time: ArrayLike, *, minimum: int = 1) -> Array:
    """Return ``time`` as an array (n,) of strictly increasing stamps, s."""
    stamps = array(name, time, ("n",))
    if len(stamps) < minimum:
        raise InputError(f"{name} has {len(stamps)} stamps; at least {minimum} are needed")
    not_back(name, stamps)
    if np.any(same := np.diff(stamps) == 0.0):
        k = int(np.argmax(same)) + 1
        raise InputError(f"{name}[{k}] repeats {stamps[k]:.9g} s; drop repeated stamps")
    return stamps


def not_back(name: str, stamps: Array) -> None:
    """Raise an error for a stamp, s, before that of the row before."""
    if np.any(back := np.diff(stamps) < 0.0):
        k = int(np.argmax(back)) + 1
        remedy = order_remedy(stamps, k, k + 1)
        raise InputError(f"{name}[{k}] goes back to {stamps[k]:.9g} s after {stamps[k - 1]:.9g} s; {remedy}")


def order_remedy(stamps: NDArray[Any], k: int, row: int) -> str:
    """Return the remedy for a stamp k, of the row of that number in the source, that is not after the one before.

    If it lies more than half of the time before, and ten steps, the clock restarted: sorted stamps would mix the samples of two recordings.
    """
    steps = np.diff(stamps)
    back = -steps[k - 1]
    if back > 0.5 * (stamps[k - 1] - stamps[0]) and back > 10.0 * np.median(np.abs(steps)):
        return f"the clock restarted in row {row}: split the recording there"
    return "sort the rows and drop repeated ones, or check the time's unit"


def is_definite(matrix: Array) -> bool:
    """Return whether a symmetric matrix has a Cholesky factor, which takes a quarter of the time of its eigenvalues."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def covariance(name: str, value: ArrayLike, size: int) -> Array:
    """Return ``value`` as a symmetric positive-definite matrix (size, size)."""
    matrix = symmetric(name, array(name, value, (size, size)))
    if is_definite(matrix):
        return matrix
    # Scaled to unit diagonal first: with rad² and (rad/s)² in one matrix, rounding could make it appear indefinite.
    scale = np.sqrt(np.diag(matrix)) if np.all(np.diag(matrix) > 0.0) else np.full(size, np.nan)
    least = (
        float(np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0])
        if np.all(scale > 0.0)
        else float(np.diag(matrix).min())
    )
    if not least > 0.0:
        raise InputError(
            f"{name} is not positive definite: its smallest (scaled) eigenvalue is {least:.3g}; "
            "give every state a variance above zero"
        )
    return matrix


def one_of(name: str, value: str, choices: Iterable[str]) -> str:
    """Return ``value`` if it is one of ``choices``; the error suggests the nearest."""
    known = list(choices)
    if value in known:
        return value
    begun = [
        name for name in known if value and name.startswith(str(value))
    ]  # a missing ending, such as that of a unit
    near = difflib.get_close_matches(str(value), known, n=5) or [name for name in known if value and str(value) in name]
    near = [*begun, *near]
    near.sort(key=lambda candidate: ("_deg" in str(value)) != ("_deg" in candidate))  # names with the same unit first
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise InputError(f"{name} {value!r} is not known{hint} (known: {', '.join(known)})")


def instance(name: str, value: object, wanted: type | tuple[type, ...], remedy: str) -> None:
    """Raise an error if a value is not of a class, or of one of several; ``remedy`` ends the message."""
    if not isinstance(value, wanted):
        classes = " or ".join(kind.__name__ for kind in (wanted if isinstance(wanted, tuple) else (wanted,)))
        # An object of this package is described by several lines.
        plain = value is None or isinstance(
            value, (str, os.PathLike, int, float, complex, list, tuple, dict, set, type, np.ndarray)
        )
        what = reprlib.repr(value) if plain else f"of class {type(value).__name__}"
        raise InputError(f"{name} is {what}, not of class {classes}; {remedy}")


def known_keys(place: str, keys: Iterable[str], known: Iterable[str]) -> None:
    """Raise an error for unknown keys that names the nearest known one."""
    for key in keys:
        one_of(f"{place}: key", key, known)
