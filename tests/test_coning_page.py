"""The filter that runs in the page on coning: its simulation, against the package's filter on the same increments and directions."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import strapdown as sd

sys.path.append(str(Path(__file__).resolve().parents[1] / "docs"))
from coning_page import bundle

NODE = shutil.which("node")
ANGLE, FREQUENCY, DURATION = np.radians(2.0), 7.0, 30.0
pytestmark = pytest.mark.skipif(NODE is None, reason="no node on this machine; install it to run the page's script")


def in_the_browser(*runs):
    """Return what the page's simulation returns for the settings of each run, by node."""
    call = f"console.log(JSON.stringify({json.dumps(runs)}.map(simulate)));"
    command = [str(NODE), "-"]
    run = subprocess.run(command, input=bundle.simulation() + call, capture_output=True, text=True, check=True)
    return json.loads(run.stdout)


@pytest.mark.parametrize(
    ("algorithm", "rate", "noise"), [("one-sample", 100, 1.0), ("four-sample", 200, 1.0), ("one-sample", 100, 3.0)]
)
def test_without_noise_it_is_the_packages_filter(algorithm, rate, noise):
    """``noise`` scales the clock of the exported filter: in Python, the noise of the setup."""
    settings = {"angle": ANGLE, "frequency": FREQUENCY, "sampleRate": rate, "algorithm": algorithm, "noise": noise}
    (page,) = in_the_browser({**settings, "noiseless": True})
    cone = sd.motion.Coning(angle=ANGLE, frequency=FREQUENCY)
    time = np.arange(int(DURATION) * rate + 1) / rate
    seconds = np.arange(1.0, DURATION + 0.5)
    stars = []
    for sensor in bundle.sensors():
        reference = np.broadcast_to(sensor.reference_f, (len(seconds), 3))
        vector = sd.quaternion.rotate(sd.quaternion.conjugate(cone.attitude(seconds)), reference)
        stars.append(
            sd.vectors.VectorMeasurements(
                sensor=sensor.name,
                kind="direction",
                time=seconds,
                vector_b=vector,
                reference_f=reference,
                sigma=bundle.STAR_SIGMA,
            )
        )
    record = sd.records.ImuRecord(time=time, increments=cone.increments(time), vectors=tuple(stars))
    record = sd.records.compress(record, algorithm)
    plan = bundle.SETUP
    process = sd.ProcessNoise(
        angle_random_walk=plan.process_noise.angle_random_walk * noise,
        rate_random_walk=plan.process_noise.rate_random_walk * noise**3,
    )
    start = sd.estimation.initial_state(
        cone.attitude(0.0), attitude_sigma=plan.attitude_sigma, bias_sigma=plan.bias_sigma * noise**2
    )
    estimate = sd.estimation.run(record, process, start, full_covariance=True)
    np.testing.assert_allclose(page["time"][-1], DURATION)
    np.testing.assert_allclose(page["attitude"], estimate.attitude[-1], atol=1e-12)
    np.testing.assert_allclose(page["biasEstimate"], estimate.bias[-1], rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(page["biasSigma"][-1] ** 2, estimate.variance[-1, 5], rtol=1e-9)
    axis = sd.quaternion.rotate(sd.quaternion.conjugate(cone.attitude(DURATION)), np.array([0.0, 0.0, 1.0]))
    P = estimate.covariance[-1][:3, :3]
    np.testing.assert_allclose(page["sigma"][-1] ** 2, axis @ P @ axis, rtol=1e-9)
    error = sd.quaternion.log(
        sd.quaternion.multiply(sd.quaternion.conjugate(estimate.attitude[-1]), cone.attitude(DURATION))
    )
    np.testing.assert_allclose(page["error"][-1], error @ axis, atol=1e-12)
    assert page["status"] == 0
    expected = (
        sd.coning.drift.small_angle_drift(algorithm, 2.0 * np.pi * FREQUENCY / rate)
        * ANGLE**2
        * 2.0
        * np.pi
        * FREQUENCY
    )
    np.testing.assert_allclose(page["drift"], expected, rtol=1e-6)  # rounding of λ − sin λ


def test_its_noise_is_the_filters():
    """Over 40 seeds, error over σ at the end of a run is standard normal where the integration makes no error."""
    settings = {"angle": ANGLE, "frequency": FREQUENCY, "sampleRate": 50, "algorithm": "eight-sample", "noise": 2.0}
    pages = in_the_browser(*({**settings, "seed": seed} for seed in range(40)))
    ratios = [[page["error"][-1] / page["sigma"][-1], page["bias"][-1] / page["biasSigma"][-1]] for page in pages]
    mean_square = np.mean(np.square(ratios), axis=0)
    assert np.all((mean_square > 0.5) & (mean_square < 1.75))  # χ² of 40: 99.8 % within 0.44 and 1.84
