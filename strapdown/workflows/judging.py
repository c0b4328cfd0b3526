"""Verdict, causes and accuracy of a result."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from strapdown import consistency
from strapdown.checks import InputError, instance
from strapdown.consistency import Accuracy, Judgement
from strapdown.consistency.accuracy import accuracy as accuracy_of_rows
from strapdown.consistency.accuracy import accuracy_of
from strapdown.consistency.alignment import Series
from strapdown.estimation.states import State
from strapdown.recordings import Recording
from strapdown.recordings.attitudes import Attitudes
from strapdown.records import Estimate, ImuRecord, Truth
from strapdown.records.recording import matched
from strapdown.workflows.estimating import reference_of

if TYPE_CHECKING:
    from strapdown.montecarlo import Statistics
    from strapdown.montecarlo.campaign import Campaign
    from strapdown.tuning.diagnosis import Diagnosis

SAME_STAMP = 1e-9
"""Maximum difference between two time stamps of the same epoch, s."""


def check(
    result: Estimate | Statistics | Campaign,
    truth: Truth | ImuRecord | Recording | None = None,
    *,
    confidence_level: float = 0.99,
    detectable_error: float = consistency.DETECTABLE,
) -> Judgement:
    """Test whether a filter is consistent, that is, whether its errors and innovations agree with its covariance.

    The verdict is that of the command ``strapdown check`` and of the report. A result has all that it depends on, in memory and in a file.

    Parameters
    ----------
    result : Estimate, Statistics or Campaign
        Result of :func:`estimate`, :func:`monte_carlo` or :func:`read`.
    truth : Truth, ImuRecord or Recording, optional
        Truth at the epochs of the estimate, or the record or recording with its truth, which is matched by time. Default: the estimate's
        own; if it has none, only the innovations are tested.
    confidence_level : float, default 0.99
        Minimum probability with which a consistent filter passes all tests together.
    detectable_error : float, default 1.5
        "consistent" needs tests that would have detected an error of σ by this factor, of attitude, bias and innovations.

    Returns
    -------
    Judgement
        ``headline`` has the verdict, "consistent", "not consistent" or "cannot tell", and the parts that were tested; ``findings`` has the
        statistics.

    Examples
    --------
    >>> import strapdown as sd
    >>> print(sd.check(sd.estimate(sd.simulate("two-stars"))))  # doctest: +SKIP
    """
    if isinstance(result, Estimate):
        options = {"confidence_level": confidence_level, "detectable_error": detectable_error}
        return consistency.judge(result, _truth_at(result, truth), **options)
    from strapdown.montecarlo import Statistics
    from strapdown.montecarlo.campaign import Campaign

    statistics = result.statistics if isinstance(result, Campaign) else result
    if statistics is None:
        raise InputError("the Monte Carlo has no finished run yet; resume it")
    if not isinstance(statistics, Statistics):
        raise InputError(
            f"result is {type(result).__name__}; give an Estimate (of a record: that of `estimate`), or the result of a Monte Carlo"
        )
    if truth is not None:
        raise InputError("truth goes with an estimate; a Monte Carlo contains its own truth; leave it out")
    return statistics.judge(confidence_level=confidence_level, detectable_error=detectable_error)


def diagnose(
    result: Estimate, record: ImuRecord, *, judgement: Judgement | None = None
) -> tuple[Diagnosis | None, str]:
    """Search for the causes of an inconsistency, as ``strapdown check`` with a record does.

    Parameters
    ----------
    result : Estimate
        Result of :func:`estimate`, with its filter.
    record : ImuRecord
        The record from which it was made.
    judgement : Judgement, optional
        The verdict of :func:`check`, with which the causes are combined.

    Returns
    -------
    diagnosis : Diagnosis or None
        Causes, the most likely first, and the verdict from statistics and causes together; None if the filter has more states.
    reason : str
        Feature of the filter that the search does not support, so that only the statistics count; empty if there is none.

    Examples
    --------
    >>> import strapdown as sd
    >>> record = sd.read("flight.h5")  # doctest: +SKIP
    >>> causes, reason = sd.diagnose(sd.estimate(record), record)  # doctest: +SKIP
    """
    from strapdown.tuning import diagnosis
    from strapdown.tuning.residual_checks import accepted

    instance("record", record, ImuRecord, "causes are searched for in a record with its specification")
    filter_setup = result.setup
    if filter_setup is None:
        raise InputError("the estimate does not contain its filter; give one made by estimate")
    unknown = sorted(set(result.innovations) - {series.sensor for series in record.vectors})
    if unknown or not np.isin(result.time, record.time).all():
        what = f"has no sensor {unknown[0]!r}" if unknown else "has other time stamps"
        raise InputError(f"the record {what}; the estimate was made from another record")
    need_same_draw(result, record)
    if filter_setup.states is not None and filter_setup.states.names:
        names = ", ".join(filter_setup.states.names)
        return None, f"the search supports filters of attitude and bias only, and this one has the states {names}"
    P = np.diag(result.variance[0]) if result.covariance is None else result.covariance[0]
    initial = State(attitude=result.attitude[0], bias=result.bias[0], covariance=P)
    # The verdict is on the filter with its gate, so measurements that it rejected are left out.
    used = replace(accepted(record, result), origin=record.origin or result.origin)
    judgement = judgement or check(replace(result, origin=used.origin))
    causes = diagnosis.diagnose(used, filter_setup, initial, judgement=judgement)
    if filter_setup.robust is not None:
        return causes, "The filter weights measurements by their innovations, and the search for causes does not"
    if any(event.kind == "recovery" for event in result.events):
        return causes, "The filter recovered from a lost attitude, and the search for causes does not"
    return causes, ""


def accuracy(result: Estimate, truth: Truth | ImuRecord | Recording | Attitudes | None = None) -> Accuracy:
    """Return the attitude errors of an estimate: total, heading and inclination, as given, and aligned with a truth of another source.

    Parameters
    ----------
    result : Estimate
        Estimate of any filter.
    truth : Truth, ImuRecord, Recording or Attitudes, optional
        Truth at the epochs of the estimate; the record or recording with its truth; or attitudes of any source
        (:func:`read_attitudes`), in another clock and other frames. Default: the estimate's own.

    Returns
    -------
    Accuracy
        Errors over all samples and over the movement; with covariances also their coverage and the ratio of RMS error and σ.

    Examples
    --------
    >>> import strapdown as sd
    >>> print(sd.accuracy(sd.estimate(recording)))  # doctest: +SKIP
    """
    instance("result", result, Estimate, "give the result of estimate or read")
    if not isinstance(truth, Attitudes):
        known = _truth_at(result, truth) or result.truth
        return accuracy_of_rows(result, known, align=known is not None and not known.has_bias)
    P = result.attitude_covariance
    own = Series(result.time, result.attitude, P if P is not None and np.isfinite(P).all() else None)
    return accuracy_of(own, Series(truth.seconds(result.epoch_ns), truth.attitude, movement=truth.movement))


def need_same_draw(result: Estimate, record: ImuRecord) -> None:
    """Raise an error for a simulated record of another seed, run or scenario than the estimate's; their time stamps may be the same."""
    origins = [origin for origin in (record.origin, result.origin) if origin is not None and origin.seed is not None]
    drawn = [f"of seed {origin.seed}, run {origin.run}" for origin in origins]
    if len(set(drawn)) > 1:
        raise InputError(f"the record is {drawn[0]}, and the estimate {drawn[1]}; give the record of the estimate")
    scenarios = [origin.scenario for origin in origins if origin.scenario is not None]
    if len(scenarios) > 1 and scenarios[0] != scenarios[1]:
        raise InputError("the record is of another scenario; the estimate was made from another record")


def _truth_at(result: Estimate, truth: Truth | ImuRecord | Recording | None) -> Truth | None:
    """Return the truth at the epochs of an estimate."""
    if truth is None or isinstance(truth, Truth):
        if truth is not None and len(truth.attitude) != len(result.time):
            raise InputError(
                f"truth has {len(truth.attitude)} epochs and the estimate {len(result.time)}; give the record, which is matched by time"
            )
        return truth
    if isinstance(truth, Attitudes):
        raise InputError(
            "truth is attitudes of another clock and other frames; give them, and the Attitudes of the estimate, to "
            "strapdown.consistency.check_attitudes"
        )
    instance(
        "truth", truth, (ImuRecord, Recording), "give the record, the recording, or a Truth at the estimate's epochs"
    )
    if isinstance(truth, ImuRecord):
        need_same_draw(result, truth)
    rows, same = matched(truth.time, result.time, SAME_STAMP)
    if not same.all():
        raise InputError("the time stamps of record and estimate differ; give the record of the estimate")
    if isinstance(truth, Recording) and truth.true_attitude is not None:
        return reference_of(truth, rows, result)
    if isinstance(truth, ImuRecord) and truth.truth is not None:
        return truth.truth.taken(rows)
    raise InputError("truth is a record without a truth; leave it out to test the innovations only")
