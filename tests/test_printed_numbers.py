"""What commands print, computed again from the files they wrote by h5py, NumPy and SciPy alone, in the words of the literature."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, f, norm

from strapdown import estimation, gyro, motion, scenarios, vectors
from strapdown.estimation import setup

DEGREE_PER_HOUR = math.pi / 180.0 / 3600.0


def rotations(quaternions):
    return Rotation.from_quat(np.roll(quaternions, -1, axis=-1))


def errors(file):
    """Rotation vector from the estimate to the truth in body axes, and true minus estimated bias (m, 6)."""
    turn = rotations(file["attitude"][:]).inv() * rotations(file["truth/attitude"][:])
    return np.hstack([turn.as_rotvec(), file["truth/bias"][:] - file["bias"][:]])


def nees(error, covariance):
    return np.einsum("mi,mij,mj->m", error, np.linalg.inv(covariance), error)


@pytest.fixture
def run(run, monkeypatch):
    """Run ``strapdown ARGUMENTS``, which must go well, and return what it says, on one line."""
    monkeypatch.setenv("COLUMNS", "300")

    def call(*arguments, status=0):
        ended, said, error = run(*arguments)
        assert (ended, error) == (status, "")
        return " ".join(said.split())

    return call


@pytest.fixture
def estimated(run):
    run("simulate", "two-stars")
    return run("estimate", "two-stars.h5")


def test_errors_and_nis_of_estimate(estimated):
    with h5py.File("estimate-results/estimate.h5") as file:
        error, covariance = errors(file), file["covariance"][:]
        rms = np.sqrt(np.mean(error**2, axis=0) @ np.kron(np.eye(2), np.ones((3, 1))))
        sigma = np.sqrt(np.einsum("mii->i", covariance).reshape(2, 3).sum(axis=1) / len(error))
        rates = f"RMS error {rms[1] / DEGREE_PER_HOUR:.4g} °/h, σ {sigma[1] / DEGREE_PER_HOUR:.4g} °/h"
        assert f"Gyro bias: {rates}, of three axes together." in estimated
        size = np.linalg.norm(error[:, :3], axis=1)
        P = covariance[:, :3, :3]
        squares = np.einsum("mi,mi->m", error[:, :3], np.linalg.solve(P, error[:, :3, None])[:, :, 0])
        angles = " ".join(f"{math.degrees(value):.4g}" for value in (rms[0], np.median(size), size.max()))
        inside = f"{100.0 * np.mean(squares <= chi2.ppf(0.95, 3)):.1f} %"
        assert f"as given total {angles} {inside} {math.sqrt(squares.mean() / 3.0):.3g} " in estimated
        for number, name in enumerate(("star 1", "star 2")):
            held = file[f"innovations/{number:06d}"]
            nis = np.mean(held["innovation"][:] ** 2 / held["variance"][:])
            assert f"{name}: {len(held['time'])} measurements, mean NIS per degree of freedom {nis:.3g}" in estimated


def hosking(z, lags):
    """The portmanteau statistic as traces (Hosking 1980), for a known mean of zero."""
    n, m = z.shape
    C0 = np.linalg.inv(z.T @ z / n)
    C = [z[lag:].T @ z[:-lag] / n for lag in range(1, lags + 1)]
    return n * (n + 2.0 / m) * sum(np.trace(c.T @ C0 @ c @ C0) / (n - lag) for lag, c in enumerate(C, start=1))


def test_every_statistic_and_cause_of_check(run, estimated):
    said = run("check", "estimate-results/estimate.h5", "--record", "two-stars.h5", "--json", "check.json", status=3)
    saved = json.loads(Path("check.json").read_text())
    findings = {(finding["name"], finding["of"]): finding for finding in saved["findings"]}
    assert not any(finding["rejected"] for finding in findings.values())
    level = 0.005 / len(saved["findings"])  # all tests together, causes included, two-sided

    def agrees(name, of, value, p, rel=1e-6):
        finding = findings[name, of]
        assert finding["value"] == pytest.approx(value, rel=rel), name
        assert finding["p_value"] == pytest.approx(p, rel=max(rel, 1e-6), abs=1e-12), name
        assert f"{name} {of} {finding['value']:.4g} " in said
        return finding

    with h5py.File("estimate-results/estimate.h5") as file:
        error, covariance = errors(file), file["covariance"][:]
        white = {
            held.attrs["sensor"].decode(): held["innovation"][:] / np.sqrt(held["variance"][:])
            for held in file["innovations"].values()
        }
    for star, z in white.items():
        n, m = z.shape
        total = np.sum(z**2)
        nis = agrees("NIS", star, total / (n * m), 2.0 * min(chi2.cdf(total, n * m), chi2.sf(total, n * m)))
        assert [nis["low"], nis["high"]] == pytest.approx(chi2.ppf([level, 1.0 - level], n * m) / (n * m))
        lags = n // 50
        Q = hosking(z, lags)
        agrees("whiteness", star, Q / (m * m * lags), chi2.sf(Q, m * m * lags))
        x = np.sort(((z - z.mean(axis=0)) / z.std(axis=0, ddof=1)).ravel())
        a = findings["normality", star]
        odd = 2.0 * np.arange(len(x)) + 1.0
        square = -len(x) - np.mean(odd * (norm.logcdf(x) + norm.logsf(x[::-1])))
        assert a["value"] == pytest.approx(square * (1.0 + 0.75 / len(x) + 2.25 / len(x) ** 2))
        # D'Agostino & Stephens (1986), table 4.7: points of A²* of 10, 5 and 2.5 %.
        for point, share in ((0.631, 0.10), (0.752, 0.05), (0.873, 0.025)):
            assert (a["value"] > point) == (a["p_value"] < share)
        S = np.cov(z.T)
        T2 = n * z.mean(axis=0) @ np.linalg.solve(S, z.mean(axis=0))
        agrees("mean innovation", star, np.linalg.norm(z.mean(axis=0)), f.sf(T2 * (n - m) / (m * (n - 1)), m, n - m))
    # Both stars are seen at once: Bartlett's test of canonical correlations, of the means known to be zero.
    x, y = white["star 1"], white["star 2"]
    n = len(x)
    product = np.linalg.solve(x.T @ x, x.T @ y) @ np.linalg.solve(y.T @ y, y.T @ x)
    bartlett = -(n - 2.5) * np.log(np.linalg.det(np.eye(2) - product))
    largest = np.max(np.abs(x.T @ y / np.sqrt(np.outer(np.sum(x**2, axis=0), np.sum(y**2, axis=0)))))
    agrees("cross-correlation", "star 1, star 2", largest, chi2.sf(bartlett, 4))
    for of, states in (("state", slice(0, 6)), ("attitude", slice(0, 3)), ("bias", slice(3, 6))):
        k = states.stop - states.start
        square = float(nees(error[-1:, states], covariance[-1:, states, states])[0])
        agrees("NEES at the end", of, square / k, 2.0 * min(chi2.cdf(square, k), chi2.sf(square, k)), 1e-4)
    square = float(np.mean(nees(error[:, :3], covariance[:, :3, :3]))) / 3.0
    assert findings["time-averaged NEES", "attitude"]["value"] == pytest.approx(square, rel=0.02)  # every eighth epoch
    causes = saved["diagnosis"]["causes"]
    assert len(causes) > 15
    for cause in causes:  # the p-value of its gain
        degrees = 1 if cause["name"] == "commutation" else len(cause["estimate"])
        assert cause["log_p"] == pytest.approx(float(chi2.logsf(max(cause["gain"], 0.0), degrees)), rel=1e-9, abs=1e-12)


def test_bounds_of_montecarlo(run):
    said = run("montecarlo", "two-stars", "--runs", "64", status=3)
    # Two-sided at 1 % together: NEES and ln NEES of three subsets, both at 20 epochs, mean error, coverage, NIS of two sensors.
    for degrees, epochs in ((6 * 64, 20), (3 * 64, 20), (2 * 64 * 300, 1)):
        low, high = chi2.ppf([0.005 / 10 / epochs, 1.0 - 0.005 / 10 / epochs], degrees) / degrees
        assert f"{low:.4g} to {high:.4g}" in said
    inside = [100.0 * (1.0 - 2.0 * norm.sf(k)) for k in (1, 2, 3)]
    assert " ".join(f"{x:.2f} %" for x in inside) in said


def test_error_of_integrate(run, tmp_path):
    brief = replace(scenarios.load_scenario("two-stars"), duration=20.0)
    (tmp_path / "brief.toml").write_text(scenarios.scenario_to_toml(brief), encoding="utf-8")
    run("simulate", "brief.toml")
    said = run("integrate", "brief.h5", "--algorithm", "one-sample")
    with h5py.File("brief.h5") as file:
        turn = rotations(file["truth/attitude"][0])
        truth, increments = rotations(file["truth/attitude"][:]), Rotation.from_rotvec(file["increments"][:])
    size = [0.0]
    for k in range(len(increments)):
        turn = turn * increments[k]
        size.append((turn.inv() * truth[k + 1]).magnitude())
    end, most = (float(x) for x in re.search(r"final ([\d.e+-]+)°, maximum ([\d.e+-]+)°", said).groups())
    assert end == pytest.approx(math.degrees(size[-1]), rel=1e-3)
    assert most == pytest.approx(math.degrees(max(size)), rel=1e-3)


def test_constants_of_algorithms_and_drifts_of_coning_budget(run, tmp_path):
    """(M!)²/(2 (2M + 1)!) of the compressed ones; −½ sin²β ω (1 − sin λ/λ) and −c β² ω λ^2M about the third axis."""
    said = run("algorithms", "--no-time")
    for name, m in (("one-sample", 1), ("two-sample", 2), ("three-sample", 3), ("four-sample-previous-3", 7)):
        constant = math.factorial(m) ** 2 / (2.0 * math.factorial(2 * m + 1))
        assert re.search(rf"{name} \d 0 \d {2 * m} {re.escape(f'{constant:.3g}')} ", said)
    (tmp_path / "lines.csv").write_text("frequency_hz,angle_deg,angle_across_deg,phase_deg\n20,0.1,0.1,90\n")
    said = run(
        "coning-budget", "--psd", "lines.csv", "--rate", "500", "--algorithm", "one-sample", "--algorithm", "two-sample"
    )
    beta, omega = math.radians(0.1), 2.0 * math.pi * 20.0
    lam = omega / 500.0
    drifts = {name: float(re.search(rf"{name} 500 ([-\d.e]+)", said)[1]) for name in ("one-sample", "two-sample")}
    exact = 0.5 * math.sin(beta) ** 2 * omega * (1.0 - math.sin(lam) / lam) / DEGREE_PER_HOUR
    assert abs(drifts["one-sample"]) == pytest.approx(exact, rel=1e-3)
    assert abs(drifts["two-sample"]) == pytest.approx(beta**2 * omega * lam**4 / 60.0 / DEGREE_PER_HOUR, rel=0.02)


def test_error_budget_of_covariance(run, tmp_path):
    """A Kalman filter written here: the gains from all noise, then each source alone through the same gains."""
    body = motion.ConstantRate(rate=(0.02, -0.03, 0.05))
    stars = {"star 1": ([1.0, 0.0, 0.0], 2e-4), "star 2": ([0.0, 0.6, 0.8], 3e-4)}
    scenario = scenarios.Scenario(
        name="turning",
        motion=body,
        gyro=gyro.GyroSpec(angle_random_walk=1e-4, rate_random_walk=3e-6),
        sensors=tuple(
            vectors.VectorSensor(name=name, reference_f=np.array(r), sigma=s, rate=1.0)
            for name, (r, s) in stars.items()
        ),
        rate=4.0,
        duration=60.0,
    )
    noise = estimation.ProcessNoise(angle_random_walk=1e-4, rate_random_walk=3e-6)
    filter_setup = setup.FilterSetup(process_noise=noise, attitude_sigma=1e-3, bias_sigma=1e-4)
    (tmp_path / "turning.toml").write_text(scenarios.scenario_to_toml(scenario))
    (tmp_path / "filter.toml").write_text(setup.to_toml(filter_setup))
    said = run("covariance", "turning.toml", "--filter", "filter.toml")

    def skew(v):
        return np.cross(np.eye(3), v)

    dt = 0.25
    A = np.block([[-skew(np.array(body.rate)), -np.eye(3)], [np.zeros((3, 6))]])
    density = {
        "angle random walk": np.diag([1e-8] * 3 + [0.0] * 3),
        "rate random walk": np.diag([0.0] * 3 + [9e-12] * 3),
    }

    def discrete(D):  # Van Loan (1978)
        M = expm(np.block([[-A, D], [np.zeros((6, 6)), A.T]]) * dt)
        return M[6:, 6:].T @ M[:6, 6:]

    F = expm(A * dt)
    Q = {name: discrete(D) for name, D in density.items()}
    parts = dict.fromkeys((*Q, *stars), np.zeros((6, 6)))
    parts["initial attitude"], parts["initial bias"] = np.diag([1e-6] * 3 + [0.0] * 3), np.diag([0.0] * 3 + [1e-8] * 3)
    P = parts["initial attitude"] + parts["initial bias"]
    for k in range(1, 241):
        P = F @ P @ F.T + sum(Q.values())
        parts = {name: F @ S @ F.T + Q.get(name, 0.0) for name, S in parts.items()}
        if k % 4:
            continue
        R_bf = rotations(body.attitude(k * dt)).as_matrix().T
        for star, (reference, sigma) in stars.items():
            H = np.hstack(
                [skew(R_bf @ np.array(reference)), np.zeros((3, 3))]
            )  # of the whole vector: its length carries no information
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + sigma**2 * np.eye(3))
            keep = np.eye(6) - K @ H
            P = keep @ P @ keep.T + sigma**2 * K @ K.T
            parts = {name: keep @ S @ keep.T + (name == star) * sigma**2 * K @ K.T for name, S in parts.items()}

    def row(S):
        return [
            math.sqrt(np.trace(S[:3, :3]) / 3.0) * 648000.0 / math.pi,
            math.sqrt(np.trace(S[3:, 3:]) / 3.0) / DEGREE_PER_HOUR,
        ]

    expected = {f"{name} random": row(S) for name, S in parts.items()}
    expected |= {"actual error all": row(sum(parts.values())), "the filter's own σ": row(P)}
    for name, values in expected.items():
        numbers = re.search(rf"{name} ([\d.e-]+) ([\d.e-]+)", said)
        assert [float(x) for x in numbers.groups()] == pytest.approx(values, rel=0.006), name
