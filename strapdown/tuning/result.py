"""Result of a tuning: parameters with their intervals, the verdict on the tuned filter, and slices of the objective."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from strapdown.checks import Array, Hint, known_keys
from strapdown.consistency.judgement import VERDICTS
from strapdown.estimation.setup import FilterSetup
from strapdown.files import plain
from strapdown.results import Column, Listed, Table, figure
from strapdown.tuning.objective import Objective
from strapdown.tuning.parameters import SCALE, Unit

if TYPE_CHECKING:  # the steps after a search, which import this module
    from strapdown.tuning.outliers import TunedGate
    from strapdown.tuning.residual_checks import Unmodelled
    from strapdown.tuning.validation import Comparison

NOT_IDENTIFIED = "not identified"
WORSE = 1.05
"""An increase of the attitude error on the held-out data by more than this factor is reported."""
SLICE_POINTS = 25
"""Number of points of a slice, odd, so that the tuned one is the middle."""


@dataclass(frozen=True, kw_only=True)
class Estimated:
    """One tuned parameter with its interval; SI."""

    name: str
    start: float
    value: float
    """Value used in the filter: the most likely one, or the mean over the profile likelihood if zero is not excluded."""
    most_likely: float
    lower: float
    """Lower end of the 95 % interval; zero if there is only an upper bound."""
    upper: float
    """Upper end of the 95 % interval; infinite if there is no bound."""
    standard_error: float
    """Standard error of the logarithm, by the information, or by the sandwich if :attr:`Tuning.misfit` or against a truth."""
    identified: bool
    """Whether zero is rejected at 95 % and an upper end exists."""
    note: str
    """Interpretation; :attr:`words` adds the bound."""
    unit: Unit
    """Unit in which it is printed."""

    @property
    def words(self) -> str:
        """Interpretation with the upper bound, in its unit."""
        if self.note != NOT_IDENTIFIED:
            return self.note
        if not math.isfinite(self.upper):
            return f"{NOT_IDENTIFIED}: no information in these records"
        return f"{NOT_IDENTIFIED}: at most {figure(self.upper / self.unit.factor, 3)} {self.unit.name}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Tuning(Listed):
    """Result of a tuning.

    Parameters
    ----------
    parameters : tuple of Estimated
        Tuned parameters with their intervals, SI.
    setup : FilterSetup
        The filter with the tuned values.
    point : ndarray (p,)
        Natural logarithms of the most likely values, SI.
    before : float
        Negative log likelihood (with priors, without its constant) at the start.
    after : float
        Negative log likelihood at the most likely point.
    covariance : ndarray (p, p)
        Covariance of the logarithms.
    starts : ndarray (k, p)
        Points at which the searches started.
    optima : ndarray (k, p)
        Points at which the searches ended.
    misfit : bool
        Whether the gradient varies over the record by more than the information allows: the innovations are not white, or their variance
        is not that of any such filter, and the maximum-likelihood filter need not be the best one.
    agreeing : int
        Number of searches that ended within 0.001 of the best log likelihood.
    objective : Objective
        Function that was minimised, for :func:`slices` of it.
    contradicted : tuple of str, default empty
        Parameters whose priors the data contradict, by more than three σ of both together.
    gate : TunedGate, optional
        The gate, if outliers were modelled.
    comparison : Comparison, optional
        The filter before and after on held-out data.
    unmodelled : tuple of Unmodelled
        Tests of records for errors that the tuned filter does not model.
    remarks : tuple of str
        What the filter that was tuned has no state for, and what of it was not applied.
    """

    parameters: tuple[Estimated, ...]
    setup: FilterSetup
    point: Array
    before: float
    after: float
    covariance: Array
    starts: Array
    optima: Array
    misfit: bool
    agreeing: int
    objective: Objective
    contradicted: tuple[str, ...] = ()
    gate: TunedGate | None = None
    comparison: Comparison | None = None
    unmodelled: tuple[Unmodelled, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def composite(self) -> bool:
        """Whether the objective is no full likelihood, so that intervals come from the scatter of its gradient (sandwich)."""
        return self.objective.composite

    def summary(self) -> dict[str, Any]:
        """Return everything as plain values for JSON, in SI units.

        Returns
        -------
        dict
            Parameters with their intervals, objective, searches, errors not modelled, gate, and performance on held-out data; as text for
            a report the verdict, tables and words.
        """
        measure = "likelihood of the errors" if self.composite else "likelihood"
        parameters = []
        for parameter in self.parameters:
            unit = {"unit": parameter.unit.name, "si_per_unit": parameter.unit.factor}
            parameters.append({**vars(parameter), "note": parameter.words, **unit})
        content: dict[str, Any] = {
            "parameters": parameters,
            "units": "SI: rad, s, units of whole vectors; divide by si_per_unit for the unit of a parameter; standard_error: relative",
            "objective": {"name": measure, "before": self.before, "after": self.after},
            "searches": {"number": len(self.starts), "at_the_best_point": self.agreeing},
            "innovations_fit": not self.misfit,
            "contradicted_priors": self.contradicted,
            "unmodelled": [check.summary() for check in self.unmodelled],
        }
        if self.gate is not None:
            names = ("probability", "lower", "upper", "thresholds")
            content["gate"] = {name: getattr(self.gate, name) for name in names}
        if self.comparison is not None:
            content["held_out"] = self.comparison.summary()
        answer, reason, details = self.verdict
        shown = {"words": list(self.words), "tables": [table.as_text for table in self.tables]}
        content["report"] = {"verdict": answer, "reason": reason, "details": details, **shown}
        return plain(content)  # type: ignore[no-any-return]

    @property
    def words(self) -> tuple[str, ...]:
        """Sentences on what the parameters do not say: the remarks, the gate, errors that the filter does not model."""
        worst = max(self.unmodelled, key=lambda check: check.severity, default=None)
        gate = () if self.gate is None else (self.gate.words,)
        return tuple(dict.fromkeys((*self.remarks, *gate, *(() if worst is None else worst.words))))

    @property
    def tables(self) -> list[Table]:
        """The table of the parameters, and that of the filter before and after on held-out data."""
        return [self.listing(), *([] if self.comparison is None else [self.comparison.listing()])]

    def listing(self) -> Table:
        """Return the parameters with their intervals, as a table."""
        rows = []
        for p in self.parameters:
            values = (x / p.unit.factor for x in (p.start, p.value, p.lower, p.upper))
            rows.append((p.name, p.unit.name, *values, p.words, p.identified))
        notes = [
            f"{self.agreeing} of {len(self.starts)} searches ended at the best point; log-likelihood + "
            f"{self.before - self.after:.4g}."
        ]
        if not all(parameter.identified for parameter in self.parameters):
            notes.append(
                "For a parameter that is not identified these records give only an upper bound; the filter uses the value in the column "
                f"“after”, the mean below that bound. A prior can be given by {Hint('priors')}."
            )
        if self.contradicted:
            notes.append(f"{self._prior_words[0].upper()}{self._prior_words[1:]}.")
        elif self.misfit:
            remedy = (
                "A common scale leaves the estimates unchanged; it makes σ correct on average, not at each time."
                if self.parameters[0].name == SCALE
                else "The maximum-likelihood filter may follow them and estimate worse. Tune only filter.scale, or against a truth "
                f"({Hint('truth', True)}), or try {Hint('spacing')}."
            )
            notes.append(
                f"The innovations contradict any filter of this model: disturbances last over many samples, or vary. {remedy}"
            )
        columns = (
            Column("parameter", "name"),
            Column("unit", "unit"),
            Column("before", "before", 3),
            Column("after", "after", 3),
            Column("from", "lower_95", 3),
            Column("to", "upper_95", 3),
            Column(""),
            Column(None, "identified"),
        )
        return Table("Tuned parameters with 95 % intervals", columns, rows, notes, left=2, name="parameters")

    @property
    def _prior_words(self) -> str:
        """The priors that the data contradict, with both values and the remedy."""
        pairs = []
        for parameter in map(self.__getitem__, self.contradicted):
            unit, prior = parameter.unit, self.objective.priors[parameter.name].value
            values = (figure(value / unit.factor, 3) for value in (prior, parameter.value))
            pairs.append(f"{parameter.name} ({' against '.join(values)} {unit.name})")
        return f"the data contradict the prior of {' and '.join(pairs)}: give the noise of this gyro as {Hint('priors')}, or leave it out"

    def __getitem__(self, name: str) -> Estimated:
        """Return the parameter with this name."""
        known_keys("tuning", [name], [parameter.name for parameter in self.parameters])
        return next(parameter for parameter in self.parameters if parameter.name == name)

    @property
    def verdict(self) -> tuple[str, str, list[str]]:
        """The verdict on the tuned filter, its reason, and findings against it; with held-out data, the worst of its judgements."""
        comparison = self.comparison
        if comparison is None:
            prove = f"{Hint('holdout')} validates a tuning on held-out data"
            details = [words for check in self.unmodelled for words in check.words]
            if self.contradicted:
                return "not consistent", f"{self._prior_words}; {prove}", []
            if self.misfit or details:
                return (
                    "not consistent",
                    f"the tuned filter does not agree with the data used for tuning; {prove}",
                    details,
                )
            if any(check.judgement.innovations_untested for check in self.unmodelled):
                return "cannot tell", f"the data used for tuning are too few to judge the filter; {prove}", []
            return "consistent", f"the tuned filter agrees with the data used for tuning; {prove}", []
        judgements = comparison.after.judgements
        order = lambda judged: (VERDICTS.index(judged.verdict), sum(finding.rejected for finding in judged.findings))  # noqa: E731
        worst = max(judgements, key=order)
        details = [finding.means for finding in worst.findings if finding.rejected]
        details += [self._prior_words] if self.contradicted else []
        if not comparison.better and not self.composite:
            details.append("on the held-out data the likelihood has decreased: keep the previous filter")
        elif comparison.after.attitude_rms > WORSE * comparison.before.attitude_rms:
            details.append("on the held-out data the attitude error has increased: keep the previous filter")
        data = "held-out data" if len(judgements) == 1 else "the held-out data of the worst record"
        return worst.verdict, f"{worst.reason}, on {data}", details


@dataclass(frozen=True, kw_only=True, eq=False)
class Slices:
    """The likelihood along each parameter, with the others at their most likely values."""

    names: tuple[str, ...]
    values: Array
    """Values of the parameter (p, k), SI."""
    fallen: Array
    """2 Δℓ: decrease of twice the log likelihood from its maximum (p, k)."""

    def summary(self) -> list[dict[str, Any]]:
        """Return the slices as values for JSON, in SI units."""
        rows = zip(self.names, self.values, self.fallen, strict=True)
        return plain([{"name": name, "values": x, "fallen": y} for name, x, y in rows])  # type: ignore[no-any-return]


def slices(tuning: Tuning) -> Slices:
    """Return slices of the objective of a tuning through the tuned point, somewhat wider than each interval, without priors.

    The points are densest about the tuned one: a slice may be much narrower than the interval, for which the other parameters vary too.
    """
    grid = np.linspace(-1.0, 1.0, SLICE_POINTS) ** 3
    values, fallen = [], []
    for j, parameter in enumerate(tuning.parameters):
        value = parameter.value
        factor = np.exp(2.5 * min(max(parameter.standard_error, 1e-3), 1.0))
        low = max(min(parameter.lower, value), value / factor**2, 1e-300)
        high = max(parameter.upper, value) if np.isfinite(parameter.upper) else value * factor
        ends = np.log([low, high])
        ends += np.array([-0.3, 0.3]) * max(float(np.ptp(ends)), 1e-3)
        points = np.tile(tuning.point, (SLICE_POINTS, 1))
        points[:, j] += np.where(grid < 0.0, tuning.point[j] - ends[0], ends[1] - tuning.point[j]) * grid
        minus_log = tuning.objective.minus_log(points)
        values.append(np.exp(points[:, j]))
        fallen.append(2.0 * (minus_log - minus_log.min()))
    return Slices(names=tuning.objective.names, values=np.array(values), fallen=np.array(fallen))
