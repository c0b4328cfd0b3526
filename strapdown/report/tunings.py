"""The page of a tuning: the result of `strapdown tune`, parameters with their intervals, and the validation on held-out data."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from strapdown.checks import Hint, InputError, count, finite, instance, one_of, positive
from strapdown.consistency.judgement import INNOVATIONS
from strapdown.files import reading
from strapdown.plots.tuning import TALLEST
from strapdown.report import page

BOUNDS = (
    "The NIS of a consistent filter is within its bounds with a probability of 99 %; the verdict is for all tests of a record together, so "
    "each statistic may be slightly outside its bounds"
)
"""Note below NIS and a verdict on the held-out data."""


def _text(place: str, value: Any) -> None:
    instance(place, value, str, "give a text")


def _flag(place: str, value: Any) -> None:
    instance(place, value, bool, "give true or false")


def _verdict(place: str, value: Any) -> None:
    one_of(place, value, VERDICTS)


def _number(place: str, value: Any) -> None:
    count(place, value, minimum=0)


VERDICTS = ("consistent", "cannot tell", "not consistent")
_JUDGEMENT = {"verdict": _verdict, "reason": _text, "findings": [{"rejected": _flag, "means": _text}]}
_FILTER = {
    "log_likelihood_per_innovation": finite,
    "nis_per_degree": finite,
    "nis_bounds": [finite, finite],
    "anees_per_state?": (finite,),
    "attitude_rms_rad?": (finite,),
    "judgements": [_JUDGEMENT],
    "over_time?": [{"of": _text, "time_s": [finite], "mean": [(finite,)], "bounds": [finite, finite]}],
}
_PARAMETER = {"name": _text, "note": _text, "identified": _flag, "unit?": _text, "si_per_unit?": positive}
_TUNING = {
    "records": [_text],
    "units": _text,
    "parameters": [_PARAMETER | dict.fromkeys(("start", "value", "lower", "upper"), (finite,))],
    "objective": {"name": _text, "before": finite, "after": finite, "attitude_rms_rad?": ([finite, finite],)},
    "searches": {"number": _number, "at_the_best_point": _number},
    "held_out?": ({"before": _FILTER, "after": _FILTER},),
    "gate?": ({"probability": (finite,), "lower": (finite,), "upper": (finite,), "thresholds": {"*": finite}},),
    "unmodelled?": [{"words": [_text]}],
    "slices?": [{"name": _text, "values": [finite], "fallen": [(finite,)]}],
}
"""Part of the JSON of `strapdown tune` that the page needs: a check of each value. ``?``: may be missing; (…,): may be null; [a]: of any
length; [a, b]: of two values; ``*``: any keys."""


def _need(place: str, value: Any, shape: Any) -> None:
    """Raise an error for a value that is not of a shape, written as :data:`_TUNING`."""
    if isinstance(shape, tuple):
        if value is not None:
            _need(place, value, shape[0])
    elif isinstance(shape, dict):
        instance(place or "its content", value, dict, "give a table")
        for key in value if "*" in shape else shape:
            name = key.removesuffix("?")
            if name in value:
                _need(f"{place}.{name}".lstrip("."), value[name], shape.get("*", shape.get(key)))
            elif name == key:
                raise InputError(f"{f'{place}.{name}'.lstrip('.')} is missing")
    elif isinstance(shape, list):
        instance(place, value, list, "give a list")
        if len(shape) > 1 and len(value) != len(shape):
            raise InputError(f"{place} has {len(value)} values, not {len(shape)}")
        for k, one in enumerate(value):
            _need(f"{place}.{k}", one, shape[0])
    else:
        shape(place, value)


def report(path: Path, confidence_level: float) -> tuple[str, dict[str, Any]]:
    """Return the page and the statistics for the JSON of a tuning; ``confidence_level`` is not used, since the verdicts are in the JSON."""
    content = read(path)
    held = content.get("held_out")
    answer = verdict(content)
    toml = path.with_suffix(".toml")
    parts = [
        page.verdict(*answer),
        page.section("Parameters", *_parameters(content)),
    ]
    if "slices" in content:
        parts.append(
            page.section("Likelihood along each parameter", *map(_slice, content["slices"], content["parameters"]))
        )
    if held:
        parts.append(page.section("Held-out data", *_held_out(held)))
    making = [page.provenance({"records": ", ".join(content["records"]), "units of the JSON": content["units"]})]
    if toml.exists():
        making += [page.paragraph(f"The filter, {toml.name}:"), page.code(reading.text(toml, link=False))]
    making += [
        page.paragraph("To use it:"),
        page.code(f'estimate = sd.estimate(record, setup=sd.estimation.setup.read_setup("{toml.name}"))'),
    ]
    parts.append(page.section("Provenance", *making))
    searches = content["searches"]
    subtitle = (
        f"Parameters: {len(content['parameters'])}; records: {len(content['records'])}; {searches['at_the_best_point']} of "
        f"{searches['number']} searches converged to the optimum"
    )
    html = page.page(f"Tuning: {path.name}", subtitle, *parts)
    return html, {"source": path.name, "judgement": {"verdict": answer[0], "reason": answer[1]}, "tuning": content}


def read(path: Path) -> dict[str, Any]:
    """Read the JSON of a tuning."""
    content = reading.json_file(path)
    try:
        _need("", content, _TUNING)
    except InputError as error:
        raise InputError(
            f"{path}: {error}; give the JSON that `strapdown tune` writes beside its filter.toml"
        ) from None
    return content  # type: ignore[no-any-return]


def verdict(content: dict[str, Any]) -> tuple[str, str, list[str]]:
    """Return the verdict on the tuned filter, its reason, and findings against it; with held-out data, the worst of its judgements."""
    held = content.get("held_out")
    if not held:
        return _on_its_own_data(content)
    after = held["after"]["judgements"]
    if not after:
        return "cannot tell", "the held-out data were not judged", []
    worst = max(after, key=lambda one: VERDICTS.index(one["verdict"]))
    details = [finding["means"] for one in after for finding in one["findings"] if finding["rejected"]]
    gain = held["after"]["log_likelihood_per_innovation"] - held["before"]["log_likelihood_per_innovation"]
    if gain < 0.0:
        details.append("on the held-out data the likelihood has decreased: keep the previous filter")
    return worst["verdict"], f"{worst['reason']}, on held-out data", details


def _on_its_own_data(content: dict[str, Any]) -> tuple[str, str, list[str]]:
    examined = content.get("unmodelled", [])
    prove = f"{Hint('holdout')} validates a tuning on held-out data"
    details = [words for one in examined for words in one["words"]]
    if content.get("innovations_fit") is False or details:
        return "not consistent", f"the tuned filter does not agree with the data used for tuning; {prove}", details
    if any(_untested(one.get("judgement", {})) for one in examined):
        return "cannot tell", f"the data used for tuning are too few to judge the filter; {prove}", []
    return "consistent", f"the tuned filter agrees with the data used for tuning; {prove}", []


def _untested(judgement: dict[str, Any]) -> bool:
    """Return whether the innovations of a judgement are too few to test."""
    return any(
        part["of"].startswith(INNOVATIONS) and (part["detectable_error"] or math.inf) > judgement["required"]
        for part in judgement.get("parts", ())
    )


def _parameters(content: dict[str, Any]) -> list[str]:
    rows = [
        (
            f"{one['name']}, {one['unit']}" if "unit" in one else one["name"],
            one["note"],
            *(
                page.number(one[key] / one.get("si_per_unit", 1.0) if one[key] is not None else float("nan"))
                for key in ("start", "value", "lower", "upper")
            ),
        )
        for one in content["parameters"]
    ]
    marked = ["" if one["identified"] else "unsure" for one in content["parameters"]]
    objective = content["objective"]
    gain = objective["before"] - objective["after"]
    gained = f"The {objective['name']} increased by {gain:.4g} nats."
    if rms := objective.get("attitude_rms_rad"):
        gained = f"RMS attitude error: {math.degrees(rms[0]):.4g}° before, {math.degrees(rms[1]):.4g}° after."
    return [
        page.table(("parameter", "identified", "before", "after", "from", "to (95 %)"), rows, numbers=4, marked=marked),
        page.paragraph(gained, faint=True),
        *_gate(content.get("gate")),
        *(page.paragraph(words) for one in content.get("unmodelled", []) for words in one["words"]),
    ]


def _gate(found: Any) -> list[str]:
    if not found or None in (found["probability"], found["lower"], found["upper"]):
        return []
    thresholds = ", ".join(f"{value:.3g} of {name}" for name, value in found["thresholds"].items())
    words = (
        f"The gate accepts {100.0 * found['probability']:.4g} % of valid measurements (95 %: {100.0 * found['lower']:.4g} to "
        f"{100.0 * found['upper']:.4g}): a measurement with a NIS above {thresholds} is more likely an outlier than noise."
    )
    return [page.paragraph(words)]


def _held_out(held: dict[str, Any]) -> list[str]:
    rows = []
    for name in ("before", "after"):
        one = held[name]
        low, high = one["nis_bounds"]
        extra = [one.get(key) for key in ("anees_per_state", "attitude_rms_rad")]
        rows.append(
            (
                name,
                page.number(one["log_likelihood_per_innovation"], 6),
                page.number(one["nis_per_degree"]),
                f"{low:.4f} to {high:.4f}",
                *(page.number(float("nan") if value is None else value) for value in extra),
            )
        )
    head = ("filter", "log-likelihood per innovation", "NIS", "99 % bounds", "ANEES per state", "attitude RMS, rad")
    return [page.table(head, rows, numbers=5), page.paragraph(f"{BOUNDS}.", faint=True), *_over_time(held)]


def _over_time(held: dict[str, Any]) -> list[str]:
    """Return a chart of each statistic over the first record, before and after tuning, with the bounds of a consistent filter."""
    charts = []
    for before, after in zip(*(held[name].get("over_time", []) for name in ("before", "after")), strict=True):
        time, (low, high) = np.array(after["time_s"]), after["bounds"]
        means = [np.array(one["mean"], float) for one in (before, after)]
        series = [
            page.Series(
                label="99 % bounds, each interval", value=np.full(len(time), high), colour="--faint", band=True
            ),
            page.Series(label="lower bound", value=np.full(len(time), low), colour="--faint", band=True),
            page.Series(label="before", value=means[0], colour="--b", dash=True),
            page.Series(label="after", value=means[1]),
        ]
        wide = np.nanmax(means) > 5.0 or np.nanmin(means) < 0.2
        charts.append(page.chart(after["of"], "mean over the interval", time, series, log=bool(wide)))
    return charts


def _slice(one: dict[str, Any], parameter: dict[str, Any]) -> str:
    """Return a chart of the likelihood along a parameter, with its interval, its tuned and its previous value."""
    size, unit = parameter.get("si_per_unit", 1.0), parameter.get("unit", "")
    values = np.array(one["values"]) / size
    first, last = float(values[0]), float(values[-1])
    value, before, low, high = (
        float(np.nan if parameter[key] is None else parameter[key] / size)
        for key in ("value", "start", "lower", "upper")
    )
    low, high = np.fmax(low, first), np.fmin(high, last)
    # A vertical line is two points of one value.
    marks = [x for x in (low, high, value, value, before, before) if first <= x <= last]
    x = np.sort(np.concatenate([np.geomspace(first, last, 400), marks]))
    fallen = np.interp(np.log(x), np.log(values), np.array(one["fallen"], float))
    up = np.arange(len(x)) % 2 == 1
    line = lambda at: np.where(x == at, np.where(up, TALLEST, 0.0), np.nan)  # noqa: E731
    within = (x >= low) & (x <= high)
    series = [
        page.Series(label="95 % interval", value=np.where(within, TALLEST, np.nan), colour="--faint", band=True),
        page.Series(label="its lower limit", value=np.where(within, 0.0, np.nan), colour="--faint", band=True),
        page.Series(label="−2 Δ log likelihood", value=np.where(fallen <= TALLEST, fallen, np.nan)),
        page.Series(label="tuned", value=line(value), colour="--c"),
        page.Series(label="before", value=line(before), colour="--b", dash=True),
    ]
    axis = f"{one['name']}, {unit}" if unit else one["name"]
    return page.chart(one["name"], "−2 Δ log likelihood", x, series, x=axis, log_x=last > 20.0 * first)
