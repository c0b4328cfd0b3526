"""Residual checks of a tuned filter: whether its tuning data still contradict it, and whether an error proportional to the rate does.

Tuning gives every parameter its most likely value even if the model is wrong. A gyro's scale-factor error changes its apparent bias with
the rate, so the random walk of the bias is tuned large enough to cover that; it appears identified, and the innovations appear white. The
test is then whether a scale factor explains the innovations better: the hypothesis of :mod:`strapdown.tuning.diagnosis`. Its gain is twice
the log-likelihood ratio to the tuned filter, χ² with three degrees of freedom if the scale factor is zero. (With a smaller random walk, as
of a filter that models the scale factor, the gain is up to twice as large, but it is found in the same records.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from strapdown import estimation
from strapdown.consistency import Judgement
from strapdown.consistency.judgement import concluded
from strapdown.estimation import setup
from strapdown.estimation.setup import FilterSetup
from strapdown.estimation.states import ProcessNoise
from strapdown.files import plain
from strapdown.records import Estimate, ImuRecord, cut
from strapdown.tuning import diagnosis
from strapdown.tuning.diagnosis import Cause
from strapdown.tuning.diagnosis.hypotheses import PLAUSIBLE, gyro_errors, shown, turns
from strapdown.tuning.diagnosis.likelihood import Model, by_mean, log_p, run
from strapdown.tuning.objective import Case, of_sensors
from strapdown.tuning.parameters import RRW
from strapdown.tuning.result import Tuning
from strapdown.tuning.validation import performance
from strapdown.vectors import VectorMeasurements

PROBABILITY = 0.99
"""Probability that a filter that models all errors passes all tests."""
MAX_REPORTED = 2
"""Maximum number of failed tests that are reported individually."""
SHAPES = ("whiteness", "normality", "mean innovation", "cross-correlation")
"""Tests of innovations that tuning σ cannot make pass."""


@dataclass(frozen=True, kw_only=True)
class Unmodelled:
    """Evidence against a filter in its tuning data."""

    record: str
    """Name of the record."""
    judgement: Judgement
    """Judgement of the tuned filter on its tuning data; of its errors too if there is a truth."""
    scale_factor: Cause
    """A gyro's scale factor as an explanation of what the filter models as noise."""
    causes: tuple[Cause, ...] = ()
    """Likely causes, if a test in :data:`SHAPES` fails."""
    remarks: tuple[str, ...] = ()
    """What the record specifies and the filter does not model, one sentence."""

    @property
    def moves_with_the_rate(self) -> bool:
        """Whether a scale factor explains the innovations better than the noise of the gyro and than any other cause."""
        other = max((cause.gain for cause in self.causes), default=0.0)
        return self.scale_factor.finding.p_value < 1.0 - PROBABILITY and self.scale_factor.gain > other

    @property
    def failed(self) -> tuple[str, ...]:
        """Failed tests in words; σ that are too large do not count, because they are no sign of an unmodelled error."""
        return tuple(
            finding.means
            for finding in self.judgement.findings
            if finding.rejected and not (finding.is_ratio and finding.value < 1.0)
        )

    @property
    def suspected(self) -> bool:
        """Whether an error without a state in the filter is likely."""
        return self.moves_with_the_rate or bool(self.failed)

    @property
    def severity(self) -> tuple[bool, bool, int]:
        """Order of several records by how much they contradict the filter."""
        return self.moves_with_the_rate, self.suspected, len(self.failed)

    @property
    def words(self) -> tuple[str, ...]:
        """Sentences that describe the evidence; none if nothing is suspected."""
        if not self.suspected:
            return ()
        sentences = [
            f"After tuning, {self.record or 'the record'} contradicts the filter in a way that no σ explains: an error without a state."
        ]
        if self.moves_with_the_rate:
            cause = self.scale_factor
            sentences.append(
                f"A scale factor of the gyro of {shown(cause.estimate, 1e6)} ± {shown(cause.standard_error, 1e6)} ppm explains the "
                f"innovations better than its noise does (gain {cause.gain:.3g}, p = {cause.finding.p_value:.1g}): the tuned noise of the "
                "gyro covers it. Calibrate it, or add a state for it."
            )
        sentences += [f"{what[0].upper()}{what[1:]}." for what in self.failed[:MAX_REPORTED]]
        left = len(self.failed) - MAX_REPORTED
        if left > 0:
            sentences.append(f"And {left} more of {len(self.judgement.findings)} tests contradict the tuned filter.")
        if self.causes:
            sentences.append(f"{self.causes[0].sentence}.")
        return (*sentences, *self.remarks)

    def summary(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        scale = self.scale_factor
        numbers = {"value": scale.estimate, "standard_error": scale.standard_error, "gain": scale.gain}
        return {
            "record": self.record,
            "suspected": self.suspected,
            "words": list(self.words),
            "moves_with_the_rate": self.moves_with_the_rate,
            "scale_factor": plain({**numbers, "p_value": scale.finding.p_value}),
            "causes": [cause.words for cause in self.causes],
            "judgement": self.judgement.summary(),
        }


def unmodelled(case: Case, filter_setup: FilterSetup) -> Unmodelled:
    """Return the evidence against a tuned filter in the part of a record that it was tuned on."""
    judgement = performance([case], filter_setup).judgements[0]
    record = record_for_tuning(case)
    used = of_sensors(filter_setup, record)
    initial = setup.initial_state(used, case.initial.attitude, case.initial.bias)
    if used.gate is not None:
        # A gate removes the tails of the innovations and passes small outliers: NIS and normality are not evidence then.
        kept = tuple(finding for finding in judgement.findings if finding.name not in ("NIS", "normality"))
        judgement = concluded(kept, judgement.limits, PROBABILITY, parts={}, unmodelled=judgement.unmodelled)
        record = accepted(record, setup.run(record, used, initial, every=len(record.increments)))
    causes: tuple[Cause, ...] = ()
    if any(finding.rejected and finding.name in SHAPES for finding in judgement.findings):
        causes = diagnosis.diagnose(record, used, initial).causes
    return Unmodelled(
        record=case.name,
        judgement=judgement,
        scale_factor=scale_factor(setup.modelled_record(record, used), used.process_noise, initial),
        causes=causes,
        remarks=tuple(setup.unmodelled_words(record.origin, filter_setup)),
    )


MAX_EXAMINED = 4
"""Maximum number of records examined for errors that the tuned filter does not model."""


def examined(cases: Sequence[Case], tuning: Tuning) -> Tuning:
    """Return a tuning with tests of each record for errors that the filter does not model; without if its states model them already.

    Nor if the data contradict a prior, which is the likely cause then. The random walk of the bias has a note if a scale factor explains
    the innovations better.
    """
    by_axis = any(  # the search for causes supports one σ per sample only
        series.anisotropic or (series.kind != "attitude" and isinstance(tuning.setup.sigma.get(series.sensor), tuple))
        for case in cases
        for series in case.record.vectors
    )
    if tuning.setup.states is not None or by_axis or tuning.contradicted:
        return tuning
    tested = tuple(unmodelled(case, tuning.setup) for case in cases[:MAX_EXAMINED])
    parameters = list(tuning.parameters)
    for j, parameter in enumerate(parameters):
        if parameter.name == RRW and parameter.identified and any(check.moves_with_the_rate for check in tested):
            parameters[j] = replace(parameter, note="in doubt: may cover a scale factor of the gyro")
    return replace(tuning, parameters=tuple(parameters), unmodelled=tested)


def record_for_tuning(case: Case) -> ImuRecord:
    """Return a case's record up to the end of its tuning data."""
    time = case.record.time
    last = int(np.searchsorted(time, case.last, side="right")) - 1
    return case.record if last >= len(time) - 1 else cut(case.record, 0, max(last, 1))


def accepted(record: ImuRecord, estimate: Estimate) -> ImuRecord:
    """Return a record without the measurements that the gate of an estimate refused."""

    def left(series: VectorMeasurements) -> VectorMeasurements:
        innovations = estimate.innovations.get(series.sensor)
        if innovations is None:
            return series
        return series.taken(~np.isin(series.time, innovations.time[~innovations.used]))

    return replace(record, vectors=tuple(map(left, record.vectors)))


def scale_factor(record: ImuRecord, noise: ProcessNoise, initial: estimation.State) -> Cause:
    """Return the gyro's scale factor as an explanation of the innovations of a filter."""
    model = Model(record=record, noise=noise, initial=initial)
    cause = by_mean(model, run(model), gyro_errors(turns(record, noise, initial))[0])
    gain = cause.gain - float(np.sum((cause.estimate / PLAUSIBLE) ** 2))
    return replace(cause, gain=gain, log_p=log_p(gain, 3))
