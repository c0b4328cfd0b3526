"""Integration algorithms as tables of coefficients, from which the drift under small coning is derived exactly, and their catalogue."""

from __future__ import annotations

import functools
import operator
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from numbers import Rational
from typing import Any

import numpy as np

from strapdown import checks, results
from strapdown.checks import Array, InputError
from strapdown.coning import coefficients as exact
from strapdown.coning.coefficients import Rationals, Table
from strapdown.files import reading

SOLVERS = {
    "compressed": "rotation vector with one cross product",
    "pairs": "rotation vector with all cross products",
    "polynomial": "quaternion equation solved to rounding on the rate polynomial",
    "magnus-6": "one exponential of three moments",
}
"""Methods by which the rotation of a step is computed from its increments."""


def pair_tables(samples: int, window: int, own: Mapping[int, Table]) -> Array:
    """Return pair tables as floats by the place of the step in the window (M − N + 1, M, M): ``own``, and time-Taylor ones elsewhere.

    Near the ends of a record the window is shifted to stay inside it, so that the step has another place in the window, for which the table
    of the algorithm is not valid. For a record shorter than the window it is never valid.
    """
    places = range(max(0, window - samples + 1))
    tables = [own.get(place) or exact.taylor_pairs(samples, place, window - samples - place) for place in places]
    return np.array([exact.floats(table) for table in tables]).reshape(len(places), window, window)


@dataclass(frozen=True, kw_only=True)
class Algorithm:
    """Integration algorithm as a table of coefficients, from which the drift under small coning is derived in exact rationals.

    Parameters
    ----------
    name : str
        Name in the catalogue.
    solver : str
        One of :data:`SOLVERS`.
    samples : int
        N, number of increments in a step.
    previous : int, default 0
        p, number of increments used before the step.
    following : int, default 0
        f, number of increments used after the step: the delay in samples.
    order : int
        Global order of convergence for any smooth motion and exact increments.
    products : tuple of tuples of Fraction
        Coefficients K_ij of all products Δθ_i × Δθ_j, i < j, in a step, over the window: a pair table (see ``coefficients``). The pairs
        solver computes φ = Σ Δθ_i + Σ_{i<j} K_ij Δθ_i × Δθ_j, the compressed one also, from products with the last increment only. The
        polynomial solver adds to its solution what K exceeds that solution's own products by. Those of magnus-6 are its own.
    source : str, default ""
        Publication.
    """

    name: str
    solver: str
    samples: int
    previous: int = 0
    following: int = 0
    order: int
    products: Table = field(repr=False)
    source: str = ""

    def __post_init__(self) -> None:
        checks.one_of(f"{self.name}: solver", self.solver, SOLVERS)
        for what, minimum in (("samples", 1), ("order", 1), ("previous", 0), ("following", 0)):
            checks.count(f"{self.name}: {what}", getattr(self, what), minimum=minimum)
        m, table = self.window, self.products
        if len(table) != m or any(len(row) != m for row in table):
            raise InputError(f"{self.name}: products is not {m} by {m}, one row for each increment of the window")
        if not all(isinstance(x, Rational) for row in table for x in row):
            raise InputError(
                f"{self.name}: products has a number that is not rational; give fractions.Fraction or int, since orders are derived exactly"
            )
        if any(table[i][j] != -table[j][i] for i in range(m) for j in range(i + 1)):
            raise InputError(f"{self.name}: products is not antisymmetric; Δθ_i × Δθ_j changes sign with its order")
        if self.solver == "compressed" and (self.following or any(any(row[:-1]) for row in table[:-1])):
            raise InputError(
                f"{self.name}: the compressed solver uses products with the last increment of the step only; use solver 'pairs'"
            )
        if self.solver == "magnus-6" and table != exact.magnus_products(self.samples):
            raise InputError(f"{self.name}: the products of solver {self.solver!r} are given by its increments alone")

    @classmethod
    def from_table(cls, table: Mapping[str, Any], place: str = "algorithm") -> Algorithm:
        """Return an algorithm of your own from a table, such as that of a file; its orders and its drift constant are derived.

        Parameters
        ----------
        table : mapping of str
            ``name``, and either ``coefficients``: [c_1, …, c_{M−1}] of ``φ = Σ Δθ_i + (c_1 Δθ_1 + … + c_{M−1} Δθ_{M−1}) × Δθ_M``, that of
            the oldest increment first, as in textbooks (the property ``coefficients`` has the opposite order). Or ``products``:
            [[i, j, K_ij], …] of ``φ = Σ Δθ_i + Σ K_ij Δθ_i × Δθ_j``, increments counted from 1, the oldest of the window, with ``samples``,
            the number N of increments in a step. Optional: ``previous`` and, with products, ``following``, the numbers of increments of
            the window before and after the step; ``source``, the publication. Coefficients are numbers, fractions or text such as "27/20";
            a float is converted to a simple fraction (:func:`strapdown.coning.coefficients.rational`).
        place : str, default "algorithm"
            Name of the table, for error messages.

        Returns
        -------
        Algorithm
            The algorithm.

        Examples
        --------
        >>> own = Algorithm.from_table({"name": "ignagni-3", "coefficients": ["9/20", "27/20"]})
        >>> own.samples, own.order, own.drift_order, str(own.drift_constant)
        (3, 3, 6, '1/280')
        >>> miller = [(1, 3, "9/20"), (1, 2, "27/40"), (2, 3, "27/40")]
        >>> Algorithm.from_table({"name": "miller-3", "samples": 3, "products": miller}).order
        4
        """
        checks.known_keys(
            place, table, ("name", "samples", "previous", "following", "coefficients", "products", "source")
        )
        if not isinstance(table.get("name"), str):
            raise InputError(f"{place}: name is missing; give the algorithm a name, in quotes")
        if ("coefficients" in table) == ("products" in table):
            raise InputError(
                f"{place}: give either coefficients, [c_1, …] of (Σ c_i Δθ_i) × Δθ_M, or products, [[i, j, K], …] of K Δθ_i × Δθ_j"
            )
        form = "products" if "products" in table else "coefficients"
        if not isinstance(table[form], list):
            raise InputError(f"{place}: {table[form]!r} is no list; write numbers, or fractions in quotes, in brackets")
        previous, following = (
            checks.count(f"{place}: {name}", table.get(name, 0), minimum=0) for name in ("previous", "following")
        )
        if form == "products":
            samples = checks.count(f"{place}: samples", table.get("samples"))  # type: ignore[arg-type]
            products = _pair_table(f"{place}: products", table[form], samples + previous + following)
        else:
            rationals = _rationals(f"{place}: coefficients", table[form])
            samples = len(rationals) + 1 - previous
            if samples < 1 or following or table.get("samples", samples) != samples:
                raise InputError(
                    f"{place}: {len(rationals)} coefficients and previous {previous} make samples {samples}, which must be 1 or more, and "
                    "following 0; for another step give products"
                )
            products = _with_last(rationals)
        return cls(
            name=table["name"],
            solver="pairs" if form == "products" else "compressed",
            samples=samples,
            previous=previous,
            following=following,
            products=products,
            source=table.get("source", ""),
            order=exact.second_order(products, samples, previous),
        )

    def to_table(self) -> dict[str, Any]:
        """Return the algorithm as a table for :meth:`from_table`.

        Returns
        -------
        dict
            Table; exists for rotation-vector algorithms only.
        """
        table: dict[str, Any] = {"name": self.name, "samples": self.samples}
        table |= {name: getattr(self, name) for name in ("previous", "following", "source") if getattr(self, name)}
        if self.solver == "compressed":
            table["coefficients"] = [str(k) for k in reversed(self.coefficients)]
        elif self.solver == "pairs":
            rows = enumerate(self.products, start=1)
            table["products"] = [[i, j, str(k)] for i, row in rows for j, k in enumerate(row, start=1) if k and i < j]
        else:
            raise InputError(f"{self.name}: an algorithm with solver {self.solver!r} has no table; write its name")
        return table

    @property
    def window(self) -> int:
        """M = N + p + f, number of increments used for one step."""
        return self.samples + self.previous + self.following

    @property
    def coefficients(self) -> Rationals:
        """For the compressed solver: k_1 … k_{M−1} in φ = Σ Δθ_i + (Σ_j k_j Δθ_{N−j}) × Δθ_N."""
        return tuple(row[-1] for row in reversed(self.products[:-1]))

    @property
    def correction(self) -> Table:
        """For the polynomial solver: what ``products`` exceeds the products of its solution by."""
        own = exact.taylor_pairs(self.samples, self.previous, self.following)
        return tuple(tuple(map(operator.sub, *rows)) for rows in zip(self.products, own, strict=True))

    @functools.cached_property
    def lags(self) -> Rationals:
        """k_1 … k_{M−1}: sums of the products by lag."""
        return exact.lag_sums(self.products)

    @functools.cached_property
    def _leading_drift(self) -> tuple[int, Fraction]:
        # M − 1 lag sums satisfy at most M − 1 conditions, so the drift is of order λ^{2M} at most.
        series = self._drift_series(self.window + 1)
        return next((2 * n, c) for n, c in enumerate(series) if c)

    @property
    def drift_order(self) -> int:
        """Order of the drift under small coning: the (even) power of λ."""
        return self._leading_drift[0]

    @property
    def drift_constant(self) -> Fraction:
        """C of the leading drift −C β² ω λ^``drift_order``; for N + p samples, compressed, (M!)²/(2(2M+1)!)."""
        return -self._leading_drift[1]

    # Arrays for the kernels, cached here: hashing hundreds of fractions for a cache takes longer than a short record.

    @functools.cached_property
    def coefficient_array(self) -> Array:
        """``coefficients`` as floats."""
        return np.array([float(k) for k in self.coefficients])

    @functools.cached_property
    def pair_arrays(self) -> Array:
        """``products`` as floats, by the place of the step in the window (M − N + 1, M, M), as :func:`pair_tables` gives them."""
        return pair_tables(self.samples, self.window, {self.previous: self.products})

    @functools.cached_property
    def correction_array(self) -> Array:
        """``correction`` as floats."""
        return exact.floats(self.correction)

    def _drift_series(self, terms: int) -> Rationals:
        """Return the coefficients of λ⁰, λ², λ⁴, … of the drift divided by β²ω."""
        return tuple(c / self.samples for c in exact.residuals(self.lags, self.samples, terms))

    @functools.cached_property
    def drift_series(self) -> tuple[float, ...]:
        """Coefficients of λ⁰, λ², λ⁴, … of the drift divided by β²ω, enough for λ ≤ 1 and a window of 17."""
        return tuple(float(c) for c in self._drift_series(48))


def _with_last(coefficients: Rationals) -> Table:
    """Return the pair table of (Σ c_i Δθ_i) × Δθ_M, c_1 … c_{M−1}."""
    return exact.outer_pairs((*coefficients, Fraction(0)), (*[Fraction(0)] * len(coefficients), Fraction(1)))


def _pair_table(place: str, products: Sequence[Any], window: int) -> Table:
    """Return the pair table of products (i, j, K) of the increments 1 … ``window``."""
    table = [[Fraction(0)] * window for _ in range(window)]
    for k, entry in enumerate(products):
        here = f"{place}[{k}]"
        if not isinstance(entry, Sequence) or isinstance(entry, str) or len(entry) != 3:
            raise InputError(f"{here} is {entry!r}; give (i, j, K), the coefficient K of Δθ_i × Δθ_j")
        i, j = (checks.count(here, index) for index in entry[:2])
        if i == j or max(i, j) > window:
            raise InputError(f"{here} is of Δθ_{i} × Δθ_{j}; give two different increments of 1 … {window}")
        if table[i - 1][j - 1]:
            raise InputError(
                f"{here} is of Δθ_{i} × Δθ_{j} again; give the product of two increments once, with the sum"
            )
        (value,) = _rationals(here, entry[2:])
        table[i - 1][j - 1], table[j - 1][i - 1] = value, -value
    return tuple(map(tuple, table))


def _rationals(place: str, values: Sequence[Any]) -> Rationals:
    rationals = []
    for k, value in enumerate(values):
        try:
            rationals.append(exact.rational(value))
        except (ValueError, TypeError, ZeroDivisionError, OverflowError):
            raise InputError(
                f'{place}[{k}] is {value!r}; give a number, a fraction in quotes such as "27/20", or fractions.Fraction'
            ) from None
    return tuple(rationals)


def read_algorithms(path: str | os.PathLike[str]) -> tuple[Algorithm, ...]:
    """Read the algorithms of a TOML file: one table ``[algorithm]``, or several ``[[algorithm]]``.

    Parameters
    ----------
    path : path-like
        File with the tables of :meth:`Algorithm.from_table`.

    Returns
    -------
    tuple of Algorithm
        The algorithms.
    """
    with reading.from_file(path):
        content = reading.toml(path)
        checks.known_keys(f"{path}", content, ("algorithm",))
        tables: Any = content.get("algorithm")
        entries = {f"[{k}]": table for k, table in enumerate(tables)} if isinstance(tables, list) else {"": tables}
        if not entries or not all(isinstance(table, Mapping) for table in entries.values()):
            raise InputError(f"{path} has no table [algorithm]; add one with name, and coefficients or products")
        algorithms = tuple(Algorithm.from_table(table, f"{path}: algorithm{k}") for k, table in entries.items())
    names = [algorithm.name for algorithm in algorithms]
    for algorithm in algorithms:
        if names.count(algorithm.name) > 1:
            raise InputError(f"{path} has two algorithms of the name {algorithm.name}; give each a different name")
        if algorithm.name in ALGORITHMS:
            raise InputError(f"{path}: {algorithm.name} is the name of a built-in algorithm; choose another")
    return algorithms


# ------------------------------------------------------------------------------------------------------------------- makers


def compressed(samples: int, previous: int = 0) -> Algorithm:
    """Return the coning-optimal compressed algorithm with N samples and p samples of the previous step."""
    products = _with_last(tuple(reversed(exact.compressed_coefficients(samples, previous))))
    return Algorithm(
        name=f"{_NUMBERS[samples - 1]}-sample" + (f"-previous-{previous}" if previous else ""),
        solver="compressed",
        samples=samples,
        previous=previous,
        order=exact.second_order(products, samples, previous),
        products=products,
        source="Miller 1983; Ignagni 1996; Savage 2010",
    )


def uncompressed(family: str, samples: int) -> Algorithm:
    """Return the rotation-vector algorithm that is exact, to second order, for a rate polynomial of degree N − 1 (``"time-taylor"``).

    Or the one that is optimal under coning and otherwise closest to it (``"uncompressed"``).
    """
    pairs, source = exact.taylor_pairs(samples), "Jordan 1969; Savage 1998; Song 2013"
    if family == "uncompressed":
        pairs = exact.sum_of_tables(pairs, exact.matched_correction(samples))
        source = "Song 2013, with the free coefficients of matched_correction"
    name = f"{family}-{samples}"
    return Algorithm(name=name, solver="pairs", samples=samples, order=4, products=pairs, source=source)


def polynomial(samples: int) -> Algorithm:
    """Return the algorithm that solves the quaternion equation to rounding for the rate polynomial through the N increments of a step."""
    return Algorithm(
        name=f"polynomial-{samples}",
        solver="polynomial",
        samples=samples,
        order=_fitted_order(samples),
        products=exact.taylor_pairs(samples),
        source="Wu 2018 (RodFIter, QuatFIter); Yan 2017 (Picard)",
    )


def matched(samples: int, previous: int, following: int = 0) -> Algorithm:
    """Return an algorithm derived for this package, see :func:`strapdown.coning.coefficients.matched_correction`."""
    window = samples, previous, following
    m = sum(window)
    return Algorithm(
        name=f"matched-{samples}-{previous}" + (f"-{following}" if following else ""),
        solver="polynomial",
        samples=samples,
        previous=previous,
        following=following,
        order=_fitted_order(m) if previous == following else m + 1,
        products=exact.sum_of_tables(exact.taylor_pairs(*window), exact.matched_correction(*window)),
        source="this package",
    )


def magnus() -> Algorithm:
    """Return the sixth-order Magnus step, from moments of the rate polynomial through the four increments of a step."""
    name, products = "magnus-6", exact.magnus_products(4)
    source = "Blanes, Casas, Ros 2000"
    return Algorithm(name=name, solver=name, samples=4, order=6, products=products, source=source)


def _fitted_order(samples: int) -> int:
    # A symmetric window with an even number of increments gains an order, as Simpson's rule does.
    return samples + 1 if samples % 2 else samples + 2


_NUMBERS = ("one", "two", "three", "four", "five", "six", "seven", "eight")


# ---------------------------------------------------------------------------------------------------------------- catalogue


class Catalogue(Mapping[str, Algorithm]):
    """Algorithms by name, each constructed and checked on first use, so that the import is fast."""

    def __init__(self, makers: dict[str, Callable[[], Algorithm]]) -> None:
        self._makers = {name: functools.cache(make) for name, make in makers.items()}

    def __getitem__(self, name: str) -> Algorithm:
        return self._makers[name]()

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)

    def __contains__(self, name: object) -> bool:
        return name in self._makers


def _makers() -> dict[str, Callable[[], Algorithm]]:
    makers: dict[str, Callable[[], Algorithm]] = {}
    for p in range(4):
        for n, number in enumerate(_NUMBERS, start=1):
            makers[f"{number}-sample" + (f"-previous-{p}" if p else "")] = functools.partial(compressed, n, p)
    for family in ("time-taylor", "uncompressed"):
        for n in range(2, 7):
            makers[f"{family}-{n}"] = functools.partial(uncompressed, family, n)
    for n in range(2, 9):
        makers[f"polynomial-{n}"] = functools.partial(polynomial, n)
    makers |= {
        "magnus-6": magnus,
        "matched-2-8": functools.partial(matched, 2, 8),
        "matched-4-11": functools.partial(matched, 4, 11),
        "matched-1-4-4": functools.partial(matched, 1, 4, 4),
        "matched-1-8-8": functools.partial(matched, 1, 8, 8),
    }
    return makers


ALGORITHMS: Mapping[str, Algorithm] = Catalogue(_makers())
"""All built-in algorithms by name."""


def named(algorithm: str | Algorithm) -> Algorithm:
    """Return the algorithm of a name in :data:`ALGORITHMS`, the one of a FILE.toml (:func:`read_algorithms`), or the one given."""
    if isinstance(algorithm, Algorithm):
        return algorithm
    if isinstance(algorithm, str) and algorithm.lower().endswith(".toml"):
        algorithms = read_algorithms(algorithm)
        if len(algorithms) > 1:
            raise InputError(f"{algorithm} holds {len(algorithms)} algorithms; choose one of coning.read_algorithms")
        return algorithms[0]
    return ALGORITHMS[checks.one_of("algorithm", algorithm, ALGORITHMS)]


def algorithm_table(seconds: Mapping[str, float] | None = None) -> results.Table:
    """Return the catalogue as a table; ``seconds``: the time per sample of each algorithm, by name."""
    column = results.Column
    columns = [
        column("name", "name"),
        column("N", "samples"),
        column(None, "previous"),
        column("later", "following"),
        column("order", "order"),
        column("n", "drift_order"),
        column("C", "drift_constant", 3),
        *([] if seconds is None else [column("ns/sample", "ns_per_sample", shown="{:.1f}".format)]),
        column(None, "source"),
    ]
    rows = []
    for a in ALGORITHMS.values():
        times = [] if seconds is None else [1e9 * seconds[a.name]]
        orders = (a.samples, a.previous, a.following, a.order, a.drift_order, float(a.drift_constant))
        rows.append((a.name, *orders, *times, a.source))
    notes = (
        "From rate samples, form increments of eight points (increments_from_rates). matched-… were derived for this package: "
        "matched-1-8-8 is the most accurate and needs 8 later samples; matched-4-11 runs in real time; four-sample is enough in most "
        "cases.",
    )
    title = "Integration algorithms: drift under small coning is −C β² ω (ωh)^n"
    return results.Table(title, columns, rows, notes, name="algorithms")
