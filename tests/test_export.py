"""Exported filters: C and JavaScript against the same formulas in plain Python, and against the compiled filter over records."""

import ctypes
import dataclasses
import functools
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from exported import STRICT, Compiled, Plain, c_files, compiler, fed, fed_javascript, run_sanitized, samples

import strapdown as sd
from strapdown import estimation, quaternion
from strapdown.checks import InputError
from strapdown.codegen import c, design
from strapdown.codegen.functions import Function, Member
from strapdown.codegen.interpreted import Interpreter
from strapdown.codegen.symbols import Values
from strapdown.codegen.writer import Writer
from strapdown.estimation import setup as setups
from strapdown.estimation.features import FEATURES
from strapdown.estimation.setup import SensorStates, States

NOISE = sd.ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-5)
GATE = sd.Gate(recovery=None)
RATE = 50.0

SENSORS = {
    "direction": sd.VectorSensor(name="star", reference_f=[0.6, 0.0, 0.8], sigma=0.02, rate=10.0),
    "level": sd.VectorSensor(name="accelerometer", reference_f=[0.0, 0.0, 1.0], sigma=0.02, rate=RATE),
    "vector": sd.VectorSensor(name="field", reference_f=[20.0, 3.0, -40.0], sigma=0.02, rate=10.0),
    "heading": sd.VectorSensor(
        name="magnetometer", kind="heading", reference_f=[0.1, 1.0, -2.0], sigma=0.03, rate=10.0
    ),
    "attitude": sd.vectors.AttitudeSensor(name="star tracker", sigma_across=1e-3, sigma_about=1e-2, rate=2.0),
    "oblique": sd.vectors.AttitudeSensor(
        name="tracker", sigma_across=1e-3, sigma_about=1e-2, rate=2.0, boresight=[1.0, 2.0, 2.0]
    ),
    "precise": sd.VectorSensor(name="precise", reference_f=[0.6, 0.0, 0.8], sigma=1e-6, rate=10.0),
}

STATES = {
    "scale": States(
        gyro_scale_sigma=5e-3,
        gyro_misalignment_sigma=((0.0, 2e-3, 2e-3), (2e-3, 0.0, 2e-3), (2e-3, 2e-3, 0.0)),
        gyro_force_sigma=1e-5,
    ),
    "drift": States(gyro_drift_sigma=(1e-4, 3e-5), gyro_drift_time=(10.0, 100.0)),
    "bias": States(
        sensors={
            "field": SensorStates(bias_sigma=2.0, mounting_sigma=0.01),
            "star tracker": SensorStates(bias_sigma=1e-3),
            "magnetometer": SensorStates(bias_sigma=0.03),
        }
    ),
    "heading bias": States(sensors={"magnetometer": SensorStates(bias_sigma=0.03)}),
    "correlated": States(
        sensors={"star": SensorStates(bias_sigma=0.01, correlated_sigma=0.02, correlation_time=3.0, frame="fixed")}
    ),
    "hand": States(
        sensors={"accelerometer": SensorStates(velocity_time=0.5, velocity_sigma=0.5, acceleration_time=0.5)}
    ),
}

CASES = {
    "every sensor": (tuple(SENSORS)[:-1], None, None),
    "precise": (("precise",), None, None),
    "gate": (("direction", "vector", "heading"), None, GATE),
    "scale": (("direction", "vector"), "scale", None),
    "drift": (("direction", "level"), "drift", GATE),
    "bias": (("attitude", "vector", "heading"), "bias", GATE),
    "correlated": (("direction", "level"), "correlated", None),
    "hand": (("level", "heading"), "hand", None),
}
SMALL = {"direction": (("direction",), None, None), "heading bias": (("level", "heading"), "heading bias", GATE)}


def whole(series):
    """The field as a whole vector with its length."""
    if series.sensor != "field":
        return series
    length = np.linalg.norm([20.0, 3.0, -40.0])
    return sd.vectors.VectorMeasurements(
        sensor="field",
        kind="vector",
        time=series.time,
        vector_b=length * series.vector_b,
        reference_f=length * series.reference_f,
        sigma=length * series.sigma,
    )


@functools.cache
def case(name):
    """Record, setup and start of a case: with outliers and fast turns, so that every branch is taken somewhere."""
    sensors, states, gate = (CASES | SMALL)[name]
    motion = sd.motion.SpinCone(angle=0.4, precession_rate=2.0, spin_rate=-1.5)
    spec = sd.GyroSpec(angle_random_walk=1e-4, rate_random_walk=1e-5, turn_on_bias_sigma=5e-3)
    scenario = sd.Scenario(
        motion=motion, gyro=spec, sensors=tuple(SENSORS[kind] for kind in sensors), rate=RATE, duration=2.4
    )
    record = sd.simulate(scenario, seed=3)
    record = dataclasses.replace(record, vectors=tuple(map(whole, record.vectors)))
    setup = sd.FilterSetup(
        process_noise=NOISE,
        attitude_sigma=0.8,
        bias_sigma=5e-3,
        gate=gate,
        states=None if states is None else STATES[states],
    )
    start = quaternion.multiply(record.truth.attitude[0], quaternion.exp([0.4, -0.2, 0.3]))
    return record, setup, start


def rows_of(name):
    record, _, start = case(name)
    rows = samples(record, [series.kind for series in record.vectors])
    # Beyond the range of the polynomials, and an outlier: a turn of 1.2 rad in one sample, and a measurement from the other side.
    rows.insert(40, (None, [40.0, -40.0, 20.0], 0.02))
    rows.insert(41, (None, [-40.0, 40.0, -20.0], 0.02))
    at = next(k for k in range(90, len(rows)) if rows[k][0] is not None)
    sensor, value, _ = rows[at]
    rows.insert(at, (sensor, [-x for x in value] if len(value) == 3 else value[::-1], 0.0))
    return rows, start


@functools.cache
def program(name, *, single=False):
    record, setup, _ = case(name)
    return design.program_of(setup, record.vectors, single=single)


@functools.cache
def plain(name):
    rows, start = rows_of(name)
    f = Plain(program(name))
    return *fed(f, rows, start), f


def some(*names, of=tuple(CASES)):
    """Cases of a test; those that are not named are slow."""
    return [pytest.param(name, marks=() if name in names else pytest.mark.slow) for name in of]


@pytest.mark.parametrize("name", some(*(name for name in CASES if name != "hand")))  # as in the filter of an IMU
def test_c_equals_python_to_the_bit(name, tmp_path):
    rows, start = rows_of(name)
    compiled = Compiled(program(name), tmp_path, flags=("-O2" if name == "gate" else "-O0",))
    numbers, statuses = fed(compiled, rows, start)
    expected, expected_statuses, _ = plain(name)
    assert statuses == expected_statuses
    assert np.isfinite(expected).all()
    np.testing.assert_array_equal(numbers, expected)


def test_recorded_samples_give_the_bits_of_python(broad, tmp_path):
    """Fast rotations with accelerations that the gate refuses."""
    recording = sd.recordings.read(broad / "07_undisturbed_fast_rotation_B.hdf5")
    setup = sd.FilterSetup(process_noise=NOISE, attitude_sigma=0.4, bias_sigma=5e-3, gate=GATE)
    program = design.program_of(setup, [SENSORS["level"], SENSORS["heading"]], single=False)
    first = len(recording.time) // 2
    columns = recording.time, recording.rate, recording.specific_force, recording.magnetic_field
    time, rate, force, field = (column[first : first + 250].tolist() for column in columns)
    rows = []
    for k in range(1, len(time)):
        rows += [(None, rate[k], time[k] - time[k - 1]), (0, force[k], 0.0), (1, field[k], 0.0)]
    start = sd.vectors.wahba.from_vertical_and_heading(force[0], field[0])
    numbers, statuses = fed(Compiled(program, tmp_path), rows, start)
    expected, expected_statuses = fed(Plain(program), rows, start)
    assert statuses == expected_statuses
    assert 0.01 < np.mean(np.array(statuses) == 2) < 0.9
    np.testing.assert_array_equal(numbers, expected)


@pytest.mark.parametrize("name", some("every sensor", "drift", "bias"))
def test_javascript_equals_python_to_the_bit(name, tmp_path):
    rows, start = rows_of(name)
    numbers, statuses = fed_javascript(program(name), tmp_path, rows, start)
    expected, expected_statuses, _ = plain(name)
    assert statuses == expected_statuses
    np.testing.assert_array_equal(numbers, expected)


def test_the_cases_take_the_rare_branches():
    """Otherwise equality of bits would say nothing about them."""
    for name in ("gate", "precise"):
        _, statuses, f = plain(name)
        assert statuses.count(0) > 0.9 * len(statuses)
        assert (2 in statuses) == (name == "gate")
        assert f.far_turns > 0
        assert {"step", "subtract", "take_row", "apply_step"} <= f.called


@pytest.mark.parametrize("name", some("gate", of=[name for name in CASES if name != "precise"]))
def test_program_equals_the_compiled_filter(name):
    record, setup, start = case(name)
    rows, _ = rows_of(name)
    kinds = {series.sensor: series.kind for series in record.vectors}
    live = estimation.LiveFilter(
        setup.process_noise,
        estimation.initial_state(start, attitude_sigma=setup.attitude_sigma, bias_sigma=setup.bias_sigma),
        error_states=() if setup.states is None else setup.states.blocks(kinds),
        sensors=record.vectors,
        gate=setup.gate,
    )
    numbers, statuses, _ = plain(name)
    n = 6 + len(live.values)
    names = list(kinds)
    for k, (sensor, value, dt) in enumerate(rows):
        refused = sum(live.refused.values())
        if sensor is None:
            live.update(live.time + dt, value)
        else:
            live.update(live.time, **{names[sensor]: value})
        assert (sum(live.refused.values()) > refused) == (statuses[k] == 2), k
        expected = np.concatenate([live.attitude, live.bias, live.values])
        sigma = np.sqrt(np.diag(live.covariance))
        np.testing.assert_allclose(
            numbers[k][7 : n + 1], expected[7:], rtol=0.0, atol=1e-7 * np.max(sigma[6:], initial=1e-3)
        )
        assert quaternion.angle_between(numbers[k][:4], expected[:4]) < 1e-9
        np.testing.assert_allclose(numbers[k][4:7], expected[4:7], rtol=0.0, atol=1e-9)
        P = numbers[k][n + 1 : n + 1 + n * (n + 1) // 2]
        off = P - live.covariance[np.triu_indices(n)]
        assert np.max(np.abs(off) / np.outer(sigma, sigma)[np.triu_indices(n)]) < 1e-6


@pytest.mark.parametrize("name", some("drift", "bias", of=("every sensor", "drift", "bias", "hand")))
def test_single_precision_within_a_thirtieth_of_sigma(name, tmp_path):
    rows, start = rows_of(name)
    compiled = Compiled(program(name, single=True), tmp_path, single=True)
    numbers, statuses = fed(compiled, rows, start)
    expected, expected_statuses, _ = plain(name)
    n, whole = compiled.program.n, len(rows) - 1
    assert np.mean(np.array(statuses) != expected_statuses) < 0.01
    P = np.zeros((n, n))
    P[np.triu_indices(n)] = expected[whole][n + 1 : n + 1 + n * (n + 1) // 2]
    sigma = np.sqrt(np.diag(P))
    away = quaternion.log(quaternion.multiply(quaternion.conjugate(expected[whole][:4]), numbers[whole][:4]))
    assert np.max(np.abs(away) / sigma[:3]) < 1.0 / 30.0
    assert np.max(np.abs(numbers[whole] - expected[whole])[4 : n + 1] / sigma[3:]) < 1.0 / 30.0
    np.testing.assert_allclose(compiled.sigma(), sigma, rtol=1e-2)


HOSTILE = [np.nan, np.inf, -np.inf, 1e9, -1e9, 1e300, 1e-300, 0.0]


@pytest.mark.parametrize(
    ("name", "single"),
    [
        *(("scale", False), ("bias", False), ("bias", True)),
        *(
            pytest.param(name, single, marks=pytest.mark.slow)
            for name in ("every sensor", "correlated")
            for single in (False, True)
        ),
    ],
)
def test_hostile_samples_set_a_flag_and_leave_the_state_valid(name, single, tmp_path):
    _, _, start = case(name)
    f = Compiled(program(name, single=single), tmp_path, single=single)
    n = f.program.n
    generator = np.random.default_rng(1)
    f.init(list(start))
    flagged = 0
    for k in range(1000):
        before = f.numbers[: -len(f.program.sensors)]
        value = generator.normal(size=4)
        if k % 2:
            value[generator.integers(4)] = generator.choice(HOSTILE)
        if k % 3 == 0:
            dt = float(generator.choice([0.02, 0.02, 0.0, -1.0, np.nan, np.inf, 1e9]))
            status = f.predict(value[:3], dt)
            invalid = (
                not (0.0 < dt <= 3600.0) or not np.isfinite(value[:3]).all() or np.max(np.abs(value[:3])) * dt > 200.0
            )
        else:
            i = int(generator.integers(len(f.program.sensors)))
            value = value[: f.program.sensors[i].size]
            status = f.update(i, value)
            invalid = not np.isfinite(value).all()
        assert not invalid or status == 1, (k, value, status)
        if status:
            flagged += 1
            np.testing.assert_array_equal(f.numbers[: -len(f.program.sensors)], before)
        numbers = f.numbers[: -len(f.program.sensors)]
        assert np.isfinite(numbers).all(), (k, value)
        assert abs(np.linalg.norm(numbers[:4]) - 1.0) < (1e-5 if single else 1e-12)
        P = np.zeros((n, n))
        P[np.triu_indices(n)] = numbers[n + 1 :]
        assert np.diag(P).min() > 0.0, (k, value)
    assert flagged > 160
    assert f.status & 1


def test_a_bad_start_is_level_and_flagged(tmp_path):
    f = Compiled(program("direction"), tmp_path)
    for bad in ([np.nan, 0.0, 0.0, 0.0], [0.0] * 4, [np.inf, 0.0, 0.0, 0.0]):
        assert f.init(bad) == 1
        np.testing.assert_array_equal(f.numbers[:4], [1.0, 0.0, 0.0, 0.0])
    assert f.init([2.0, 0.0, 0.0, 0.0]) == 0


SANITIZED = """
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include "strapdown_filter.h"
int main(void) {
    strapdown_filter f;
    const strapdown_real start[4] = {1, 0, 0, 0};
    const strapdown_real bad[8] = {NAN, INFINITY, -INFINITY, 1e9, -1e9, 1e30, 1e-30, 0};
    strapdown_init(&f, start);
    srand(1);
    for (int k = 0; k < 5000; k++) {
        strapdown_real v[4];
        for (int i = 0; i < 4; i++) v[i] = (strapdown_real)rand() / RAND_MAX - (strapdown_real)0.5;
        if (k % 3 == 0) v[rand() % 4] = bad[rand() % 8];
        strapdown_predict(&f, v, k % 7 ? (strapdown_real)0.02 : bad[rand() % 8]);
        UPDATES
    }
    strapdown_real sigma[STRAPDOWN_STATES];
    strapdown_sigma(&f, sigma);
    for (int i = 0; i < STRAPDOWN_STATES; i++) if (!(sigma[i] > 0)) return 1;
    printf("%u", strapdown_status(&f));
    return 0;
}
"""


@pytest.mark.parametrize("name", some("gate", of=("gate", "drift")))
def test_sanitizers_find_nothing(name, tmp_path):
    updates = " ".join(f"strapdown_update_{sensor.name}(&f, v);" for sensor in program(name).sensors)
    run_sanitized({**c_files(program(name)), "main.c": SANITIZED.replace("UPDATES", updates)}, tmp_path)


def test_the_header_has_the_sigma_of_each_axis():
    """Not the root mean square over a star tracker's axes, which differ by the factor ten."""
    header = " ".join(c_files(program("every sensor"))["strapdown_filter.h"].replace("*", " ").split())
    for words in (
        "sigma about body x, y, z (0.001, 0.001, 0.01) rad = (0.0573, 0.0573, 0.573) deg.",
        "sigma 0.02 rad = 1.146 deg.",
        "sigma 0.8 rad = 45.84 deg about each axis, and at zero bias, sigma 0.005 rad/s.",
    ):
        assert words in header


def test_the_example_and_the_header_of_the_export(tmp_path):
    record, setup, _ = case("gate")
    paths = sd.export(setup, record, folder=tmp_path, precision="single")
    assert [path.name for path in paths] == ["strapdown_filter.h", "strapdown_filter.c", "main.c", "CMakeLists.txt"]
    header = paths[0].read_text(encoding="utf-8")
    assert sd.__version__ in header
    toml = header.partition("The setup:")[2].partition(" */")[0].replace("\n *", "\n")
    assert setups.from_toml(toml) == setup
    gcc = compiler()
    subprocess.run([gcc, *STRICT, "main.c", "strapdown_filter.c", "-o", "run", "-lm"], cwd=tmp_path, check=True)
    run = subprocess.run(["./run"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert run.stdout.startswith("attitude ")


def test_a_compiler_that_presumes_finite_numbers_is_refused(tmp_path):
    """With -ffast-math a sample that is not a number passed the tests, and the attitude was none from then on."""
    record, setup, _ = case("gate")
    sd.export(setup, record, folder=tmp_path)
    build = [compiler(), *STRICT, "-O2", "-c", "strapdown_filter.c", "-ffast-math"]
    done = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "compile with -fno-finite-math-only" in done.stderr
    subprocess.run([*build, "-fno-finite-math-only"], cwd=tmp_path, check=True)


ARDUINO = "#include <stdint.h>\nunsigned long micros();\n"
AROUND_A_SKETCH = """
#include "Arduino.h"
#include "strapdown_filter.h"
void readSensors(strapdown_real *gyro, strapdown_real *force, strapdown_real *field = nullptr) {
    for (int i = 0; i < 3; i++) {
        gyro[i] = 0;
        force[i] = i == 2 ? strapdown_real(9.81) : 0;
        if (field) field[i] = i == 0 ? 0 : i == 1 ? 20 : -40;
    }
}
SKETCH
unsigned long micros() {
    static unsigned long time = 4294900000;
    return (time += 10000) & 0xffffffff;
}
int main() {
    setup();
    for (int k = 0; k < 100; k++) loop();
    return int(strapdown_status(&f));
}
"""


@pytest.mark.parametrize("place", [0, 1])
def test_the_sketches_of_the_guide_compile_and_run(place, tmp_path):
    guide = Path(__file__).parents[1] / "docs" / "guide" / "embedded.md"
    sketches = [part.partition("```")[0] for part in guide.read_text(encoding="utf-8").split("```cpp\n")[1:]]
    assert len(sketches) == 2
    if place == 0:
        record, setup, _ = case("heading bias")
        sd.export(setup, record, folder=tmp_path, precision="single")
    else:
        sd.export("hand", rate=100.0, folder=tmp_path, precision="single")
    (tmp_path / "Arduino.h").write_text(ARDUINO, encoding="utf-8")
    text = AROUND_A_SKETCH.replace("SKETCH", sketches[place])
    (tmp_path / "sketch.cpp").write_text(text, encoding="utf-8")
    for build in (
        [compiler(), *STRICT, "-c", "strapdown_filter.c"],
        [compiler("C++"), "-std=c++11", "-Wall", "-Wextra", "-Werror", "sketch.cpp", "strapdown_filter.o", "-lm"],
    ):
        done = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    assert subprocess.run(["./a.out"], cwd=tmp_path, check=False).returncode == 0


REFUSED = {
    "robust": {"robust": sd.Robust()},
    "integration": {"integration": sd.coning.ALGORITHMS["three-sample"]},
    "estimator": {"estimator": lambda record, initial: None},
    "temperature": {"states": States(gyro_temperature_sigma=1e-5)},
    "record": {"states": States(sensors={"star": SensorStates(lever_arm_sigma=0.1)})},
    "varying": {},
}


@pytest.mark.parametrize("name", FEATURES)
def test_features_that_an_exported_or_a_live_filter_lacks_are_refused_before_anything_is_written(name, tmp_path):
    record, setup, _ = case("direction")
    setup, sensors = dataclasses.replace(setup, **REFUSED[name]), record.vectors
    if name == "varying":
        series = sensors[0]
        sensors = [dataclasses.replace(series, sigma=np.linspace(0.01, 0.02, len(series.time)))]
    words = re.escape(f"the exported filter has no {FEATURES[name].words}; {FEATURES[name].remedy}")
    with pytest.raises(InputError, match=words):
        sd.export(setup, sensors, folder=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    if name in ("integration", "estimator"):
        return  # LiveFilter has no argument for them
    start = sd.initial_state([1.0, 0.0, 0.0, 0.0], attitude_sigma=0.1, bias_sigma=1e-3)
    blocks = () if setup.states is None else setup.states.blocks({"star": "direction"})
    options = {"sensors": sensors, "gate": setup.gate, "robust": setup.robust}
    if FEATURES[name].live:
        sd.LiveFilter(setup.process_noise, start, blocks, **options)
    else:
        with pytest.raises(InputError, match=f"has no {FEATURES[name].words}"):
            sd.LiveFilter(setup.process_noise, start, blocks, **options)


def test_a_gate_is_exported_without_its_recovery(tmp_path):
    record, setup, _ = case("gate")
    setups_ = setup, dataclasses.replace(setup, gate=sd.Gate())
    first, other = ([p.read_text() for p in sd.export(s, record, folder=tmp_path)] for s in setups_)
    assert first == other
    assert "recovery = 0" in other[0]


@pytest.mark.parametrize("name", ["states", "OK", "f", "int"])
def test_a_sensor_may_have_a_name_that_the_files_use(name, tmp_path):
    _, setup, _ = case("precise")
    sd.export(setup, [dataclasses.replace(SENSORS["level"], name=name)], folder=tmp_path)
    build = [compiler(), *STRICT, "main.c", "strapdown_filter.c", "-o", "run", "-lm"]
    done = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_refusals_of_arguments(tmp_path):
    record, setup, _ = case("precise")
    for arguments, words in (
        ({"to": "rust"}, "rust"),
        ({"precision": "half"}, "half"),
        ({"to": "js", "precision": "single"}, "double"),
        ({"precision": "single"}, "keeps no digits"),
    ):
        with pytest.raises(InputError, match=words):
            sd.export(setup, record, folder=tmp_path, **arguments)
    for sensors, words in (
        ([], "no sensor"),
        ("star", "give vectors.VectorSensor"),
        ([record.vectors[0]] * 2, "twice|same name"),
    ):
        with pytest.raises(InputError, match=words):
            sd.export(setup, sensors, folder=tmp_path)


def kernel(a, n, x):
    """A kernel with all that the interpreter knows: elements are read before and after they are written, wherever they are."""
    old, first, q = a[n, 0], a[0, 1], (x, 1.0)
    a[n, 0] = 2.0 * x
    a[0, 1] += a[n, 0]
    count = 0
    for k in range(n):
        if a[k, 1] < 0.0 or k == 1:
            continue
        q = (q[1], q[0] + a[k, 0])
        count += 1
    for k in (0, 1, 2):
        if k == 1 or a[k, 0] > 2.0:
            continue
        q = (q[0] + a[k, 1], q[1])
    while count > 0 and q[0] > 1.0:
        q = (0.5 * q[0], q[1])
        count -= 1
    if 0.0 < x < 2.0 and n != 3:
        a[1, 1] = x
        far = q
    elif x > 5.0:
        far = (0.0, abs(x))
    else:
        far = (1.0 if n % 2 == 0 else -1.0, max(x, q[0]))
    a[n - 1, 1] = a[1, 1] + a[n, 0]
    return old + 3.0 * first + far[0] + 7.0 * far[1] + 0.1 * count + 0.01 * a[0, 1] + a[n // 2, 1] + a[1, 1] + a[2, 1]


def test_kernels_with_branches_and_loops_are_those_of_python(tmp_path):
    gcc = compiler()
    m = Function("work", [("a", -12), ("n", "int"), ("x", 0)], returns="real")
    m.give(Interpreter(m, {})(kernel, Member(m, "a", (6, 2)), m.argument("n"), m.argument("x")))
    lines = "\n".join(Writer(m, c.language(single=False)).lines)
    source = (
        f"#include <math.h>\ntypedef double strapdown_real;\ndouble work(double *a, int n, double x) {{\n{lines}\n}}\n"
    )
    (tmp_path / "work.c").write_text(source, encoding="utf-8")
    subprocess.run([gcc, *STRICT, "-shared", "-fPIC", "work.c", "-o", "work.so"], cwd=tmp_path, check=True)
    work = ctypes.CDLL(str(tmp_path / "work.so")).work
    work.restype = ctypes.c_double
    draw = np.random.default_rng(3)
    for n in (1, 2, 3, 4, 5):
        for x in (-1.0, 0.5, 1.5, 3.0, 8.0):
            a = draw.normal(1.0, 2.0, (6, 2))
            other = (ctypes.c_double * 12)(*a.ravel())
            assert kernel(a, n, x) == work(other, n, ctypes.c_double(x)), (n, x)
            np.testing.assert_array_equal(a.ravel(), other[:])


def written(a):
    a[0, 1] = 1.0
    return True


def hasty(a, x):
    return 2.0 if x > 0.0 and written(a) else 1.0


def test_an_operand_that_writes_is_refused_because_the_target_evaluates_it_always():
    m = Function("work", [("a", -12), ("x", 0)], returns="real")
    own = Function("written", [("a", -12)], returns="int")
    Interpreter(own, {})(written, Member(own, "a", (6, 2)))
    m.functions, m.name_of = {"written": own}, lambda function, known: function.__name__
    inline = Interpreter(m, {})
    of_target = Interpreter(m, {"written": lambda a: inline._call_own(written, [a])})
    for execute in (inline, of_target):
        with pytest.raises(TypeError, match="operand of `and` or `or` after the first writes to an array"):
            execute(hasty, Member(m, "a", (6, 2)), m.argument("x"))


def test_values_read_before_an_effect_are_those_before_it(tmp_path):
    """A load may not move behind a call or a branch that changes the array, nor be remembered after it."""
    m = Function("work", [("x", 0)])
    P = Values(m.trace, lambda i: f"f->P[{i}]")
    old = P[0]
    m.call("double_all")
    after = P[0]
    x = m.argument("x")

    def change():
        P[0] = P[0] + 100.0

    m.branch(x > 0.0, change)
    P[1] = P[0]
    P[2] = old
    P[3] = after
    m.flush()
    text = "\n".join(
        [
            "typedef double strapdown_real; typedef struct { double P[4]; } strapdown_filter;",
            "static void double_all(strapdown_filter *f) { for (int i = 0; i < 4; i++) f->P[i] *= 2.0; }",
            "void work(strapdown_filter *f, double x) {",
            *Writer(m, c.language(single=False)).lines,
            "}",
        ]
    )
    (tmp_path / "work.c").write_text(text, encoding="utf-8")
    subprocess.run([compiler(), *STRICT, "-shared", "-fPIC", "work.c", "-o", "work.so"], cwd=tmp_path, check=True)
    work = ctypes.CDLL(str(tmp_path / "work.so")).work
    for x, expected in ((1.0, [106.0, 106.0, 3.0, 6.0]), (-1.0, [6.0, 6.0, 3.0, 6.0])):
        numbers = (ctypes.c_double * 4)(3.0, 0.0, 0.0, 0.0)
        work(numbers, ctypes.c_double(x))
        assert list(numbers) == expected


def test_a_covariance_that_is_not_a_number_does_not_reach_the_attitude(tmp_path):
    """Memory of a microcontroller may be damaged; the attitude by the gyro alone goes on."""
    _, _, start = case("direction")
    f = Compiled(program("direction"), tmp_path)
    f.init(list(start))
    for i in range(21):
        f.state.P[i] = np.nan
    before = f.numbers[:7]
    assert f.update(0, [0.6, 0.0, 0.8]) == 1
    np.testing.assert_array_equal(f.numbers[:7], before)
    assert f.predict([0.1, 0.0, 0.0], 0.02) == 0
    assert np.isfinite(f.numbers[:7]).all()
