"""Random errors of gyro and sensors as sources of covariance."""

from __future__ import annotations

from typing import Any

import numpy as np

from strapdown.checks import Array
from strapdown.gyro import GyroSpec, flicker
from strapdown.kernels import analysis
from strapdown.scenarios import Scenario


def by_axis(value: Any) -> Array:
    """Return one number per axis (3,)."""
    return np.broadcast_to(np.asarray(value, np.float64), 3).copy()


def diagonal(attitude_sigma: float, bias_sigma: float) -> Array:
    """Return a diagonal covariance of attitude and bias (6, 6)."""
    return np.diag([attitude_sigma**2] * 3 + [bias_sigma**2] * 3)


class RandomSources:
    """Sources of random error, as the kernel takes them."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.angle: list[Array] = []
        self.rate: list[Array] = []
        self.initial: list[Array] = []
        """Covariance of attitude and bias at the first edge (6, 6)."""
        self.rates: list[tuple[int, Array, Array, Array, Array]] = []
        """Source, amplitude (3,), gains, poles and X g of each coloured bias."""
        self.noises: list[tuple[int, int, float, float]] = []
        """Source, sensor, σ and correlation time of the noise of sensors; zero of white noise."""

    def add(self, name: str, *, angle: Any = 0.0, rate: Any = 0.0, initial: Array | None = None) -> int:
        """Add a source: white densities of angle and bias, or an initial covariance; return its index."""
        self.names.append(name)
        self.angle.append(by_axis(angle))
        self.rate.append(by_axis(rate))
        self.initial.append(np.zeros((6, 6)) if initial is None else initial)
        return len(self.names) - 1

    def add_gyro(self, spec: GyroSpec, sample_interval: float, samples: int) -> None:
        """Add the noise terms of a gyro."""
        markov, tau = by_axis(spec.markov_noise), spec.markov_correlation_time
        walk = by_axis(spec.rate_random_walk) ** 2 + (0.0 if np.isfinite(tau) else markov**2)
        if np.any(by_axis(spec.angle_random_walk) > 0.0):
            self.add("angle random walk", angle=by_axis(spec.angle_random_walk) ** 2)
        if np.any(walk > 0.0):
            self.add("rate random walk", rate=walk)
        instability = by_axis(spec.bias_instability)
        if np.any(instability > 0.0):
            shaping = flicker.shaping(samples)
            self._add_rate("flicker", instability, shaping.gains, shaping.poles, shaping.covariance @ shaping.gains)
        if np.isfinite(tau) and np.any(markov > 0.0):
            pole = np.array([np.exp(-sample_interval / tau)])
            self._add_rate("Gauss–Markov bias", markov * np.sqrt(0.5 * tau), np.ones(1), pole, np.ones(1))

    def _add_rate(self, name: str, amplitude: Array, gains: Array, poles: Array, power: Array) -> None:
        source = self.add(name, initial=np.diag([0.0, 0.0, 0.0, *(amplitude**2 * (gains @ power))]))
        self.rates.append((source, amplitude, gains, poles, power))

    def add_sensor(self, number: int, sensor: Any) -> None:
        """Add the noise terms of a sensor."""
        self.noises.append((self.add(sensor.name), number, 0.0, 0.0))
        faults = sensor.faults
        if faults.correlated_sigma > 0.0:
            source = self.add(f"{sensor.name}, correlated")
            self.noises.append((source, number, faults.correlated_sigma, faults.correlation_time))

    def coloured_rates(self, n: int) -> analysis.Rates:
        """Return the coloured biases for the kernel, for n states.

        The filter's initial bias differs by its prior from the *whole* true bias, so its initial bias error contains −f.
        """
        number, most = len(self.rates), max([1, *(len(gains) for _, _, gains, _, _ in self.rates)])
        table = np.zeros((3, number, most))
        amplitudes, cross = np.zeros((number, 3)), np.zeros((number, 3, most, n))
        for c, (_, amplitude, gains, poles, power) in enumerate(self.rates):
            m = len(gains)
            table[:, c, :m] = gains, poles, power
            amplitudes[c] = amplitude
            for a in range(3):
                cross[c, a, :m, 3 + a] = -(amplitude[a] ** 2) * power
        sources = np.array([source for source, *_ in self.rates], np.int64)
        return analysis.Rates(amplitudes, table[0], table[1], table[2], cross, sources)

    def sensor_noises(self, n: int, start: float) -> analysis.Noises:
        """Return the noises of sensors for the kernel, for n states."""
        table, number = np.array(self.noises).reshape(-1, 4), len(self.noises)
        return analysis.Noises(
            sensor=table[:, 1].astype(np.int64),
            sigma=table[:, 2].copy(),
            time=table[:, 3].copy(),
            cross=np.zeros((number, 3, n)),
            source=table[:, 0].astype(np.int64),
            last=np.full(number, start),
        )


def random_sources(scenario: Scenario, attitude_sigma: float, bias_sigma: float) -> RandomSources:
    """Return the random errors of a scenario, with these σ of the initial errors, rad and rad/s."""
    edges = scenario.edges
    random = RandomSources()
    random.add("initial attitude", initial=diagonal(attitude_sigma, 0.0))
    random.add("initial bias", initial=diagonal(0.0, bias_sigma))
    random.add_gyro(scenario.gyro, float(edges[1] - edges[0]), len(edges) - 1)
    for i, sensor in enumerate(scenario.sensors):
        random.add_sensor(i, sensor)
    return random
