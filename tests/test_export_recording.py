"""The exported filter of an IMU against its program in plain Python, to the bit, and against LiveAhrs, to rounding."""

import ctypes
import functools
import math
import re
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from exported import STRICT, Compiled, Plain, by_node, c_files, compiler, run_sanitized
from scipy.spatial.transform import Rotation
from test_live_ahrs import swinging, with_missing

import strapdown as sd
from strapdown import quaternion
from strapdown.ahrs import AhrsParameters, LiveAhrs, of_motion
from strapdown.checks import InputError
from strapdown.codegen import design
from strapdown.randomness import generator
from strapdown.recordings import read, sensor_delays

SINGLE_SIGMA = 1e-3
"""Largest difference of single precision from double, in units of σ."""


@functools.cache
def case(name):
    """A filter that has not started; samples, some damaged, with a gap: time, gyro, accelerometer, magnetometer; None: missing."""
    recording = with_missing(swinging(duration=12.0, shaken=10.0)).taken(np.r_[:900, 980:1200])
    recording.specific_force[250:252] = [300.0, -200.0, 500.0]  # damaged
    if name != "hand":
        parameters = of_motion("hand", magnetometer=True)
        if name == "white":
            parameters = AhrsParameters(rest_bias_sigma=1e-3, hard_iron_sigma=0.0)
        live = LiveAhrs(interval=0.01, magnetometer=True, parameters=replace(parameters, rate_random_walk=1e-3))
        turned = quaternion.conjugate(sensor_delays.gyro_attitude(recording))
        field = quaternion.rotate(turned, [0.0, 20.0, -43.0]) + np.array([4.0, -2.0, 1.0])
        field += generator(12, 0, "field").normal(0.0, 0.3, field.shape)
        field[5::13] = np.nan
        field[320:350] = 0.0
        field[260] *= 20.0  # damaged
        recording = replace(recording, magnetic_field=field)
    else:
        # A gyro whose bias is measured in nearly every second at rest.
        parameters = replace(of_motion(name, magnetometer=False), rate_random_walk=1e-3)
        live = LiveAhrs(interval=0.01, parameters=parameters)
    return live, rows_of(recording)


@functools.cache
def program(name, *, single=False):
    return design.program_of_live(case(name)[0], single=single)


def rows_of(recording):
    columns = [recording.rate, recording.specific_force]
    if recording.magnetic_field is not None:
        columns.append(recording.magnetic_field)
    vectors = zip(*(column.tolist() for column in columns), strict=True)
    return [
        (time, *(None if math.isnan(sum(v)) else v for v in row))
        for time, row in zip(recording.time.tolist(), vectors, strict=True)
    ]


def fresh(live):
    return LiveAhrs(interval=live.interval, magnetometer=live.magnetometer, parameters=live.parameters)


def fed(f, rows):
    f.start()
    state = f.state if isinstance(f, Compiled) else f.f
    out = []
    for row in rows:
        assert f.take(*row) == 0
        bias = state.bias if isinstance(f, Compiled) else state.x[4:7]
        out.append([*state.q, *bias, *state.variance])
    return np.array(out)


@functools.cache
def expected(name):
    """Attitude, bias and variances by LiveAhrs after each sample."""
    live, rows = case(name)
    return by_live(fresh(live), rows)


def by_live(live, rows):
    out = []
    for row in rows:
        live.update(*row)
        out.append([*live.attitude, *live.bias, *live.variance])
    return np.array(out)


def need_close(numbers, others, *, angle, bias, variance):
    assert quaternion.angle_between(numbers[:, :4], others[:, :4]).max() < angle
    assert np.abs(numbers[:, 4:7] - others[:, 4:7]).max() < bias
    np.testing.assert_allclose(numbers[:, 7:], others[:, 7:], rtol=variance)


def cases(*names):
    """Cases of a test; the others are slow: six states ("white") compile a live filter that no other test needs."""
    return [pytest.param(name, marks=() if name in names else pytest.mark.slow) for name in ("iron", "hand", "white")]


@pytest.fixture(scope="module", params=cases("iron", "hand"))
def compiled(request, tmp_path_factory):
    """Name of a case, and its filter in C."""
    return request.param, Compiled(program(request.param), tmp_path_factory.mktemp("double"))


def test_c_equals_python_to_the_bit(compiled):
    name, f = compiled
    rows = case(name)[1][: 330 if name == "hand" else 310]  # shaken for two seconds, then at rest
    plain = Plain(f.program)
    np.testing.assert_array_equal(fed(f, rows), fed(plain, rows))
    assert {"end_step", "carry_to_sample", "find_rest", "use_rest", "propagate", "update_accelerometer"} <= plain.called


def test_c_equals_live_ahrs_to_rounding(compiled):
    name, f = compiled
    need_close(fed(f, case(name)[1]), expected(name), angle=1e-12, bias=1e-13, variance=1e-11)
    assert np.abs(np.diff(expected(name)[:, 4:7], axis=0)).max() > 1e-4  # a rest has corrected the bias


def test_a_rest_after_a_slow_turn_counts_as_for_live_ahrs(compiled):
    """The turn of the field is compared in spans that may be rests only: one of twenty seconds must not spoil the rest after it."""
    name, f = compiled
    time, draw = 0.01 * np.arange(3000), generator(13, 0, "slow turn")
    turning = np.where((time > 4.0) & (time < 24.0), np.radians(0.8), 0.0)
    attitude = Rotation.from_rotvec(np.outer(np.cumsum(turning) * 0.01, [1.0, 0.0, 0.0]))
    still = draw.normal([2e-3, -1e-3, 5e-4], 1e-3, (3000, 3))
    columns = [np.outer(turning, [1.0, 0.0, 0.0]) + still, attitude.inv().apply([0.0, 0.0, 9.81])]
    if name != "hand":
        columns.append(attitude.inv().apply([0.0, 20.0, -43.0]))
    rows = [(t, *row) for t, *row in zip(time.tolist(), *(column.tolist() for column in columns), strict=True)]
    by_python = by_live(fresh(case(name)[0]), rows)
    need_close(fed(f, rows), by_python, angle=1e-10, bias=1e-11, variance=1e-8)
    bias = by_python[:, 4:7]
    assert np.abs(bias[2600] - bias[2390]).max() > 1e-6  # the rest after the turn has corrected it


def test_after_a_short_gap_c_is_as_uncertain_as_live_ahrs(compiled):
    """A step of another length has other coefficients, which C computes with its own exponential."""
    name, f = compiled
    rows = case(name)[1]
    rows = [*rows[:620], *rows[640:700]]
    by_python = by_live(fresh(case(name)[0]), rows)
    need_close(fed(f, rows), by_python, angle=1e-10, bias=1e-11, variance=1e-8)
    before, after = by_python[619, 7:10], by_python[624, 7:10]
    assert after.sum() > before.sum() + 1e-4


def test_a_filter_that_looks_for_no_rest_equals_live_ahrs(tmp_path):
    """As that of any motion: the frame of its headings has no bias of a rest to drift with. That of a hand is compiled already."""
    rows = case("iron")[1]
    parameters = replace(of_motion("hand", magnetometer=True), rest_bias_sigma=0.0)
    live = LiveAhrs(interval=0.01, magnetometer=True, parameters=parameters)
    f = Compiled(design.program_of_live(live, single=False), tmp_path)
    need_close(fed(f, rows), by_live(live, rows), angle=1e-12, bias=1e-13, variance=1e-11)


@pytest.mark.parametrize("name", cases("iron"))
def test_single_precision_within_a_thousandth_of_sigma(name, tmp_path):
    """Also after weeks: times are double, for in single 100 Hz could not be told apart after a few days."""
    f = Compiled(program(name, single=True), tmp_path, single=True)
    late = [(time + 2.0**22, *vectors) for time, *vectors in case(name)[1]]
    numbers, others = fed(f, late), expected(name)
    away = quaternion.log(quaternion.multiply(quaternion.conjugate(others[:, :4]), numbers[:, :4]))
    assert np.max(np.abs(away) / np.sqrt(others[:, 7:10])) < SINGLE_SIGMA
    assert np.max(np.abs(numbers[:, 4:7] - others[:, 4:7]) / np.sqrt(others[:, 10:])) < SINGLE_SIGMA
    np.testing.assert_allclose(numbers[:, 7:], others[:, 7:], rtol=1e-3)


FEED = """
import * as filter from './strapdown_filter.mjs';
import fs from 'fs';
const f = filter.create();
filter.init(f);
const out = JSON.parse(fs.readFileSync('inputs.json')).map((row) => {
    if (filter.update(f, ...row) !== 0) throw new Error(`status of ${row}`);
    return [...filter.attitude(f), ...filter.bias(f), ...filter.sigma(f).slice(0, 6).map((s) => s * s)];
});
console.log(JSON.stringify(out));
"""


@pytest.mark.parametrize("name", cases("iron"))
def test_javascript_equals_live_ahrs_to_rounding(name, tmp_path):
    numbers = np.array(by_node(program(name), FEED, case(name)[1], tmp_path))
    need_close(numbers, expected(name), angle=1e-12, bias=1e-13, variance=1e-11)


def test_a_recording_of_broad(compiled, broad):
    """Fast rotations, beside iron, at three times the usual rate: equal to LiveAhrs within a millionth of a degree."""
    name, f = compiled
    live = fresh(case(name)[0])
    recording = read(broad / "07_undisturbed_fast_rotation_B.hdf5")
    rows = rows_of(recording if live.magnetometer else replace(recording, magnetic_field=None))[: 15 * 286]
    need_close(fed(f, rows), by_live(live, rows), angle=1e-8, bias=1e-9, variance=1e-6)


BAD = [math.nan, math.inf, -math.inf, 1e13, -1e300]
BAD_TIMES = [math.nan, math.inf, -math.inf, 0.0, -1e300, 1e300, 1e6]


def test_hostile_samples_set_a_flag_and_leave_the_filter_as_it_was(compiled):
    name, f = compiled
    f.start()
    assert f.take(0.0, [0.0] * 3, None, None) == 16  # waits for the vertical
    assert f.take(0.0, [0.0] * 3, [0.0, -3000.0, 9.8], None) == 1  # beyond any accelerometer
    for k, (time, *vectors) in enumerate(case(name)[1][:600]):
        f.take(time, *vectors)
        f.library.strapdown_clear_status(ctypes.byref(f.state))
        before = bytes(f.state)
        values = [time + 0.01, *([1.0, 2.0, 3.0] for _ in vectors)]
        place = k % len(values)
        if place:
            values[place][k % 3] = BAD[k % len(BAD)]
        else:
            values[0] = BAD_TIMES[k % len(BAD_TIMES)]
        assert f.take(*values) == f.status == 1, (k, values)
        f.library.strapdown_clear_status(ctypes.byref(f.state))
        assert bytes(f.state) == before
    assert np.isfinite(f.numbers).all()
    need_close(fed(f, case(name)[1]), expected(name), angle=1e-12, bias=1e-13, variance=1e-11)  # starts again as new


def test_a_start_does_not_depend_on_what_the_memory_held(compiled):
    """As on a stack, where nothing is zero."""
    name, f = compiled
    rows = case(name)[1][:330]
    clean = fed(f, rows)
    for member, kind in f.state._fields_:
        if getattr(kind, "_type_", None) is ctypes.c_int:
            setattr(f.state, member, kind(*[1] * kind._length_))
        elif hasattr(kind, "_length_"):
            setattr(f.state, member, kind(*[rows[0][0]] * kind._length_))
    np.testing.assert_array_equal(fed(f, rows), clean)


SANITIZED = """
#include <math.h>
#include <stdlib.h>
#include "strapdown_filter.h"
int main(void) {
    static strapdown_filter f;
    const strapdown_real bad[8] = {NAN, INFINITY, -INFINITY, 1e9, -1e9, 1e30, 1e-30, 0};
    double time = 1e9;
    strapdown_init(&f);
    srand(1);
    for (int k = 0; k < 6000; k++) {
        strapdown_real v[3][3];
        for (int i = 0; i < 9; i++) v[i / 3][i % 3] = (strapdown_real)rand() / RAND_MAX - (strapdown_real)0.5;
        v[1][2] += 9;
        if (k % 3 == 0) v[rand() % 3][rand() % 3] = bad[rand() % 8];
        time += k % 97 == 0 ? bad[rand() % 8] : k % 1000 == 1 ? 1000.0 : 0.01;
        if (!(fabs(time) < 1e12)) time = 1e9 + 0.01 * k;
        strapdown_update(&f, time, v[0], k % 5 ? v[1] : 0MAGNETOMETER);
        if (k % 2500 == 2499) strapdown_init(&f);
    }
    strapdown_real sigma[STRAPDOWN_STATES];
    strapdown_sigma(&f, sigma);
    for (int i = 0; i < STRAPDOWN_STATES; i++) if (!(sigma[i] > 0)) return 1;
    return 0;
}
"""


@pytest.mark.parametrize("name", cases("hand"))
def test_sanitizers_find_nothing(name, tmp_path):
    magnetometer = ", k % 7 ? v[2] : 0" if case(name)[0].magnetometer else ""
    run_sanitized({**c_files(program(name)), "main.c": SANITIZED.replace("MAGNETOMETER", magnetometer)}, tmp_path)


def test_the_command_writes_a_filter_that_compiles_and_says_what_it_is(run, tmp_path):
    status, out, _ = run("export", "hand", "--rate", "100", "--precision", "single", "--out", str(tmp_path))
    assert (status, "IMU at 100 Hz" in out) == (0, True)
    live = LiveAhrs(interval=0.01, parameters=of_motion("hand", magnetometer=False))
    for path in sd.export(live, folder=tmp_path / "live", precision="single"):
        assert path.read_bytes() == (tmp_path / path.name).read_bytes()
    header = (tmp_path / "strapdown_filter.h").read_text(encoding="utf-8")
    for words in (
        sd.__version__,
        "without a magnetometer and samples every 0.01 s",
        f"specific_force_noise = {live.parameters.specific_force_noise!r}",
        "double time",
    ):
        assert words in " ".join(header.replace(" *", "").split())
    gcc = [compiler(), *STRICT, "main.c", "strapdown_filter.c", "-o", "run", "-lm"]
    subprocess.run(gcc, cwd=tmp_path, check=True)
    done = subprocess.run(["./run"], cwd=tmp_path, capture_output=True, text=True, check=True)
    for k in range(1000):
        live.update(0.01 * k, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
    words = re.fullmatch(r"attitude 0.707107 0 0 0.707107, sigma (\S+) (\S+) (\S+) rad, status 0\n", done.stdout)
    assert words is not None
    np.testing.assert_allclose([float(sigma) for sigma in words.groups()], np.sqrt(live.variance[:3]), rtol=1e-3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("hand",), "rate is missing"),
        (("hand", "spin", "--rate", "100"), "an IMU has its own"),
        (("hand", "--rate", "-1"), "rate is -1"),
        (("hand", "--rate", "1e7"), "interval is 1e-07 s; give that of the samples"),
        (("filter.toml", "flight.HDF5"), "flight.HDF5 does not exist"),
        (("filter.toml", "--rate", "100"), "error: give --rate and --magnetometer only with a motion"),
    ],
)
def test_the_command_refuses_what_does_not_belong_together(arguments, words, run):
    status, _, error = run("export", *arguments)
    assert status != 0
    assert words in " ".join(error.split())


def test_a_live_filter_has_its_sensors_and_a_setup_has_not(tmp_path):
    live, _ = case("hand")
    with pytest.raises(InputError, match="has its own"):
        sd.export(live, [], folder=tmp_path)
    with pytest.raises(InputError, match="only with a motion: hand, "):
        sd.export(live, folder=tmp_path, rate=100.0)
    with pytest.raises(InputError, match="no sensor"):
        sd.export(live.parameters.setup, folder=tmp_path)
