"""Equality by value for frozen dataclasses that hold arrays or mappings, which the generated ``==`` and ``hash`` cannot take.

Specifications (of a gyro, a sensor, a filter) derive from :class:`ByValue`: they are written to files and read back, and two with the same
numbers are the same. Data and results are compared by identity; for them ``@dataclass(eq=False)`` is enough.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np


class ByValue:
    """Base of a frozen dataclass, declared with ``eq=False``, whose instances are equal if all their fields are.

    Examples
    --------
    >>> import numpy as np
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True, eq=False)
    ... class Direction(ByValue):
    ...     axis: np.ndarray
    >>> Direction(np.array([0.0, 0.0, 1.0])) == Direction(np.array([0.0, 0.0, 1.0]))
    True
    """

    def __eq__(self, other: object) -> bool:
        """Compare all fields, arrays element by element."""
        if type(self) is not type(other):
            return NotImplemented
        return _contents(self) == _contents(other)

    def __hash__(self) -> int:
        """Return a hash that equal instances share."""
        return hash((type(self), _contents(self)))


def _contents(instance: Any) -> tuple[Any, ...]:
    return tuple(_plain(getattr(instance, field.name)) for field in dataclasses.fields(instance))


def _plain(value: Any) -> Any:
    """Return a value with its arrays and containers as tuples, and mappings as sets of items, which compare and hash by value."""
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return frozenset((key, _plain(content)) for key, content in value.items())
    if isinstance(value, (list, tuple)):
        return tuple(_plain(one) for one in value)
    return value
