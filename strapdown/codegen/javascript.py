"""The filter as an ES module."""

from __future__ import annotations

from strapdown.codegen.c import TYPES, constant_of, diagonal, is_public, may_be_missing, members, whole_bias, wrapped
from strapdown.codegen.program import Program
from strapdown.codegen.target import Target
from strapdown.codegen.writer import Language, Writer

LANGUAGE = Language(
    variable=dict.fromkeys(TYPES, "let"),
    constant=dict.fromkeys(TYPES, "const"),
    member=".",
    number=lambda x: repr(x).replace("inf", "Infinity"),
    function=lambda name: f"Math.{ {'lowest': 'floor', 'fabs': 'abs'}.get(name, name) }",
    numbers=lambda texts: f"[{', '.join(texts)}]",
    array=lambda name, size: f"const {name} = new Float64Array({size});",
    status=lambda name: f"STATUS.{name}",
    truncated=lambda text: f"Math.trunc({text})",
    real=lambda text: text,
    quotient=lambda text: f"Math.floor({text})",
)


def head(function: Target) -> str:
    """Return the head of a function."""
    parameters = [] if function.name == "far_turn" else ["f"]
    parameters += [parameter for parameter, _ in function.parameters]
    return f"{'export ' if is_public(function) else ''}function {function.name}({', '.join(parameters)})"


def files(program: Program, functions: list[Target], origin: str) -> dict[str, str]:
    """Return the files of the filter by name."""
    out = ["/*", wrapped(origin), " */", ""]
    out.append("/** Status of a call, and flags in the filter's status. */")
    out.append("export const STATUS = Object.freeze({")
    out += [f"    {name}: {bit}, // {words}" for name, (bit, words) in program.statuses.items()]
    out += ["});", ""]
    for i, sensor in enumerate(program.sensors):
        out.append(f"export const {constant_of(sensor).removeprefix('STRAPDOWN_')} = {i};")
    out += ["", "/** A filter; start it with init. */", "export function create() {", "    return {"]
    for name, size, words, _ in members(program):
        out.append(f"        {name}: {f'new Float64Array({size})' if size else '0'}, // {words}")
    out += ["        status: 0,", "    };", "}", ""]
    for function in functions:
        out += [
            f"/*\n{wrapped(function.words)}\n */",
            f"{head(function)} {{",
            *(f"    {name} ??= [0, 0, 0];" for name in may_be_missing(function)),
            *Writer(function, LANGUAGE).lines,
            "}",
            "",
        ]
    places = ", ".join(map(str, diagonal(program.n)))
    attitude = "attitude" if program.recording is None else "q"
    sigma = "f.P[i]" if program.recording is None else "k < 6 ? f.variance[k] : f.P[i]"
    biases = ", ".join(whole_bias(program, i, LANGUAGE) for i in range(3))
    out += [
        "/** Attitude q_fb, scalar first. */",
        f"export const attitude = (f) => Array.from(f.{attitude});",
        "",
        "/** Whole gyro bias, rad/s, body axes. */",
        f"export const bias = (f) => [{biases}];",
        "",
        "/** Standard deviations of the errors: attitude (rad, body axes), bias (rad/s), error states. */",
        f"export const sigma = (f) => [{places}].map((i, k) => Math.sqrt({sigma}));",
        "",
        "/** Last normalised innovation squared of a sensor. */",
        "export const nis = (f, sensor) => f.nis[sensor];",
        "",
    ]
    return {"strapdown_filter.mjs": "\n".join(out)}
