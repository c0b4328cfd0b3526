"""The filter as C99: header, source, an example and a CMake file."""

from __future__ import annotations

import math
import re
import textwrap

import numpy as np

from strapdown.codegen.program import MEANINGS, Program, Sensor, place
from strapdown.codegen.target import Target
from strapdown.codegen.writer import Language, Writer
from strapdown.kernels import chains

SMALLEST = float(np.finfo(np.float32).tiny)
"""Smallest number with all its digits in single precision."""
TYPES = {"": "strapdown_real", "int": "int", "wide": "double", "status": "unsigned"}


def _number(x: float, single: bool) -> str:
    if math.isinf(x):
        return f"{'-' if x < 0.0 else ''}HUGE_VAL{'F' if single else ''}"
    if not single:
        return repr(x)
    if 0.0 < abs(x) < SMALLEST:  # a bound that keeps a divisor from zero
        x = math.copysign(SMALLEST, x)
    text = str(np.float32(x))
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def language(*, single: bool) -> Language:
    """Return the words of C."""
    return Language(
        variable=TYPES,
        constant={kind: f"const {word}" for kind, word in TYPES.items()},
        member="->",
        number=lambda x: _number(x, single),
        function=lambda name: "floor" if name == "lowest" else f"{name}f" if single else name,
        numbers=lambda texts: f"(const strapdown_real[]){{{', '.join(texts)}}}",
        array=lambda name, size: f"strapdown_real {name}[{size}];",
        status=lambda name: f"STRAPDOWN_{name}",
        truncated=lambda text: f"(int)({text})",
        real=lambda text: f"(strapdown_real){text}",
        quotient=lambda text: text,
    )


def is_public(function: Target) -> bool:
    """Return whether users of the filter call a function."""
    if function.program.recording is not None:
        return function.name in ("init", "update")
    return function.name in ("init", "predict") or function.name.startswith("update_")


def signature(function: Target) -> str:
    """Return the head of a function."""
    public = is_public(function)
    name = f"strapdown_{function.name}" if public else function.name
    parameters = [] if function.name == "far_turn" else ["strapdown_filter *f"]
    for parameter, size in function.parameters:
        if isinstance(size, str) or size == 0:
            parameters.append(f"{TYPES[size or '']} {parameter}")
        else:
            constant = "const " if size > 0 else ""
            parameters.append(f"{constant}strapdown_real {parameter}[{abs(size)}]")
    result = {**TYPES, "real": "strapdown_real", "": "void"}[function.returns]
    return f"{'' if public else 'static '}{result} {name}({', '.join(parameters)})"


def may_be_missing(function: Target) -> list[str]:
    """Return the parameters that may be null."""
    return [
        name for name, _ in function.parameters if is_public(function) and name in ("accelerometer", "magnetometer")
    ]


def constant_of(sensor: Sensor) -> str:
    """Return the constant that names a sensor."""
    return f"STRAPDOWN_{sensor.name.upper()}"


def members(program: Program) -> list[tuple[str, int, str, str]]:
    """Return name, size (0: a scalar), meaning and type of the numbers of the filter's state."""
    rows = [
        ("attitude", 4, "q_fb: unit quaternion, scalar first, from body axes to fixed axes"),
        ("bias", 3, "gyro bias, rad/s, body axes"),
    ]
    if program.n > 6:
        rows.append(("states", program.n - 6, "error states: " + ", ".join(program.state_names)))
    triangle = "covariance of the errors of attitude, bias and states: upper triangle by rows"
    rows.append(("P", program.number_of_covariances, triangle))
    rows.append(("nis", max(len(program.sensors), 1), "last normalised innovation squared of each sensor"))
    if program.structure.chains:
        rows.append(("coefficients", chains.SET * len(program.model.last), "of the states that decay, for steps of dt"))
        rows.append(("step_dt", 0, "s"))
    arrays = () if program.recording is None else program.recording.arrays
    return [(*row, "") for row in rows] + [(a.name, math.prod(a.shape), a.words, a.kind) for a in arrays]


def wrapped(text: str) -> str:
    """Return text as the lines inside a comment, which it cannot end."""
    lines: list[str] = []
    prose, _, setup = text.replace("*/", "* /").partition(SETUP)
    for part in prose.rstrip().split("\n"):
        lines += textwrap.wrap(part, 100) or [""]
    if setup:
        lines += ["", SETUP, *setup.splitlines()[1:]]
    return "\n".join(f" * {line}".rstrip() for line in lines)


SETUP = "The setup:"
"""Line of the origin after which lines are kept as they are."""


def header(program: Program, functions: list[Target], origin: str, *, single: bool) -> str:
    """Return the header."""
    out = ["/*", wrapped(origin), " */", "#ifndef STRAPDOWN_FILTER_H", "#define STRAPDOWN_FILTER_H", ""]
    out += ["#ifdef __cplusplus", 'extern "C" {', "#endif", ""]
    out += [f"typedef {'float' if single else 'double'} strapdown_real;", ""]
    out += [f"#define STRAPDOWN_STATES {program.n}", ""]
    out.append(
        "/* Status of a call, and flags in the filter's status, where they stay until strapdown_clear_status. */"
    )
    out += [f"#define STRAPDOWN_{name} {bit}u /* {words} */" for name, (bit, words) in program.statuses.items()]
    if program.sensors:
        out += ["", "/* Sensors, for strapdown_nis. */"]
        out += [f"#define {constant_of(sensor)} {i}" for i, sensor in enumerate(program.sensors)]
    out += ["", "typedef struct {"]
    for name, size, words, kind in members(program):
        out.append(f"    {TYPES[kind]} {name}{f'[{size}]' if size else ''}; /* {words} */")
    out += ["    unsigned status; /* flags, see above */", "} strapdown_filter;", ""]
    for function in functions:
        head = signature(function)
        if not head.startswith("static"):
            out += ["/*", wrapped(function.words), " */", f"{head};", ""]
    for words, head, _ in accessors(program, single=single):
        out += [f"/* {words} */", f"{head};", ""]
    out += ["#ifdef __cplusplus", "}", "#endif", "", "#endif", ""]
    return "\n".join(out)


def diagonal(n: int) -> list[int]:
    """Return the places of the variances in P."""
    return [place(n, i, i) for i in range(n)]


def accessors(program: Program, *, single: bool) -> list[tuple[str, str, list[str]]]:
    """Return comment, head and lines of the functions that read the filter."""
    words = language(single=single)
    attitude = "attitude" if program.recording is None else "q"
    places = ", ".join(map(str, diagonal(program.n)))
    variance = "f->P[places[i]]" if program.recording is None else "i < 6 ? f->variance[i] : f->P[places[i]]"
    return [
        (
            "Attitude q_fb, scalar first.",
            "void strapdown_attitude(const strapdown_filter *f, strapdown_real q[4])",
            [f"q[{i}] = f->{attitude}[{i}];" for i in range(4)],
        ),
        (
            "Whole gyro bias, rad/s, body axes, with the contributions of error states.",
            "void strapdown_bias(const strapdown_filter *f, strapdown_real bias[3])",
            [f"bias[{i}] = {whole_bias(program, i, words)};" for i in range(3)],
        ),
        (
            "Standard deviations of the errors: attitude (rad, body axes), bias (rad/s), error states.",
            "void strapdown_sigma(const strapdown_filter *f, strapdown_real sigma[STRAPDOWN_STATES])",
            [
                f"static const unsigned short places[STRAPDOWN_STATES] = {{{places}}};",
                "for (int i = 0; i < STRAPDOWN_STATES; i++) {",
                f"    sigma[i] = {words.function('sqrt')}({variance});",
                "}",
            ],
        ),
        (
            "Last normalised innovation squared of a sensor.",
            "strapdown_real strapdown_nis(const strapdown_filter *f, int sensor)",
            ["return f->nis[sensor];"],
        ),
        (
            "Flags since the last strapdown_clear_status.",
            "unsigned strapdown_status(const strapdown_filter *f)",
            ["return f->status;"],
        ),
        ("Clear the flags.", "void strapdown_clear_status(strapdown_filter *f)", ["f->status = 0;"]),
    ]


def whole_bias(program: Program, axis: int, words: Language) -> str:
    """Return the expression of the whole bias about an axis."""
    text = f"f->bias[{axis}]"
    for k, offset in enumerate(program.offsets):
        if offset[axis] != 0.0:
            text += f" + f->states[{k}] * {words.number(offset[axis])}"
    return text.replace("->", words.member)


FINITE_MATH = """
#if (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__) || defined(_M_FP_FAST)
#error "invalid samples would not be refused: compile with -fno-finite-math-only, without /fp:fast"
#endif
"""


def source(program: Program, functions: list[Target], origin: str, *, single: bool) -> str:
    """Return the source."""
    words = language(single=single)
    out = ["/*", wrapped(origin), " */", '#include "strapdown_filter.h"', "", "#include <math.h>", FINITE_MATH]
    if program.recording is not None:
        out += ["static const strapdown_real missing[3] = {0};", ""]
    for function in functions:
        out += [
            f"/*\n{wrapped(function.words)}\n */",
            f"{signature(function)} {{",
            *(f"    {name} = {name} ? {name} : missing;" for name in may_be_missing(function)),
            *Writer(function, words).lines,
            "}",
            "",
        ]
    for _, head, lines in accessors(program, single=single):
        out += [f"{head} {{", *(f"    {line}" for line in lines), "}", ""]
    return "\n".join(out)


def example(program: Program) -> str:
    """Return an example of the use."""
    if program.recording is not None:
        return example_of_recording(program)
    calls = []
    for sensor in program.sensors:
        example_value = (1.0, 0.0, 0.0, 0.0) if sensor.size == 4 else tuple(sensor.length * x for x in sensor.frame[6:])
        value = ", ".join(f"(strapdown_real){x:.6g}" for x in example_value)
        calls += [
            f"        const strapdown_real {sensor.name}[{sensor.size}] = {{{value}}}; /* read the sensor here */",
            f"        if (strapdown_update_{sensor.name}(&f, {sensor.name}) != STRAPDOWN_OK) {{",
            "            /* not used: see the status */",
            "        }",
        ]
    updates = "\n".join(calls)
    return f"""/* The filter in a loop of 100 samples at 100 Hz. */
#include <stdio.h>

#include "strapdown_filter.h"

int main(void) {{
    strapdown_filter f;
    const strapdown_real start[4] = {{1.0, 0.0, 0.0, 0.0}};
    strapdown_init(&f, start);
    for (int k = 0; k < 100; k++) {{
        const strapdown_real gyro[3] = {{0.0, 0.0, 0.0}}; /* rad/s, body axes: read the sensor here */
        strapdown_predict(&f, gyro, (strapdown_real)0.01);
{updates}
    }}
{REPORT}"""


def example_of_recording(program: Program) -> str:
    """Return an example of the use of the filter of an IMU."""
    r = program.recording
    declaration, argument = "", ""
    if r.imu.magnetometer:
        declaration = "\n        const strapdown_real magnetometer[3] = {0.0, 20.0, -43.0}; /* any unit */"
        argument = ", magnetometer"
    return f"""/* The filter over ten seconds of samples. */
#include <stdio.h>

#include "strapdown_filter.h"

static strapdown_filter f;

int main(void) {{
    strapdown_init(&f);
    for (int k = 0; k * {r.imu.interval!r} < 10.0; k++) {{
        const strapdown_real gyro[3] = {{0.0, 0.0, 0.0}}; /* rad/s, body axes: read the sensors here */
        const strapdown_real accelerometer[3] = {{0.0, 0.0, (strapdown_real)9.81}}; /* m/s^2 */{declaration}
        if (strapdown_update(&f, k * {r.imu.interval!r}, gyro, accelerometer{argument})) {{
            /* not used: see the status */
        }}
    }}
{REPORT}"""


REPORT = """    strapdown_real q[4], sigma[STRAPDOWN_STATES];
    strapdown_attitude(&f, q);
    strapdown_sigma(&f, sigma);
    printf("attitude %g %g %g %g, sigma %g %g %g rad, status %u\\n", (double)q[0], (double)q[1], (double)q[2],
           (double)q[3], (double)sigma[0], (double)sigma[1], (double)sigma[2], strapdown_status(&f));
    return 0;
}
"""


CMAKE = """cmake_minimum_required(VERSION 3.10)
project(strapdown_filter C)
set(CMAKE_C_STANDARD 99)

add_library(strapdown_filter STATIC strapdown_filter.c)
target_include_directories(strapdown_filter PUBLIC ${CMAKE_CURRENT_SOURCE_DIR})
# Without contraction the results are those of Python, bit for bit (double precision).
target_compile_options(strapdown_filter PRIVATE -ffp-contract=off)
if(UNIX)
  target_link_libraries(strapdown_filter PUBLIC m)
endif()

add_executable(strapdown_example main.c)
target_link_libraries(strapdown_example strapdown_filter)
"""


def files(program: Program, functions: list[Target], origin: str, *, single: bool) -> dict[str, str]:
    """Return the files of the filter by name."""
    return {
        "strapdown_filter.h": header(program, functions, origin, single=single),
        "strapdown_filter.c": source(program, functions, origin, single=single),
        "main.c": example(program),
        "CMakeLists.txt": CMAKE,
    }


WORDS_OF_C = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long register restrict return "
    "short signed sizeof static struct switch typedef union unsigned void volatile while"
)
EXAMPLE = ("f", "k", "gyro", "start")
"""Variables of the example."""
RESERVED = {"status", "states", *map(str.lower, MEANINGS), *EXAMPLE, *WORDS_OF_C.split()}
"""Names that a sensor cannot have."""


def identifier(name: str) -> str:
    """Return a sensor's name as an identifier."""
    text = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower()
    return text if text and not text[0].isdigit() and text not in RESERVED else f"sensor_{text}"
