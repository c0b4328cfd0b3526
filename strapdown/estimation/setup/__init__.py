"""Filter setups: noise model of the gyro and of each sensor, initial uncertainty, integration algorithm, gate and error states.

One object for the command line, the Monte Carlo and the tuning. As a file it is the table ``[filter]`` of a TOML document, units in the
names of its keys; a setup read back is equal to the last bit.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from strapdown import coning, estimation, gyro, quaternion, units, vectors
from strapdown.checks import Array, InputError, known_keys, one_of, positive
from strapdown.estimation import Observability, filters
from strapdown.estimation.filters.own import Own, OwnFilter, as_own
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.setup import matching
from strapdown.estimation.setup import states as optional
from strapdown.estimation.setup.states import SensorStates, States
from strapdown.estimation.states import ProcessNoise, State
from strapdown.files import reading, tables
from strapdown.gyro import GyroSpec
from strapdown.kernels.lane_values import WIDTH
from strapdown.randomness import generator
from strapdown.records import Estimate, ImuRecord, Origin, compress
from strapdown.results import ByValue
from strapdown.vectors import VectorMeasurements

if TYPE_CHECKING:
    from strapdown.scenarios import Scenario

__all__ = [
    "FilterSetup",
    "SensorStates",
    "States",
    "initial_state",
    "read_setup",
    "run",
    "smooth",
]

ATTITUDE_SIGMA = 1.0 * units.DEGREE
"""Standard deviation of the initial attitude error where nobody says, each axis, rad; less where the sensors are very fine."""
LINEAR_SHARE = 0.2
"""The second-order error of a first measurement, half the square of the initial error, may be about this share of half its σ."""
COMMUTATION_SHARE = 0.1
"""Part of the σ of a constant rate, by white noise over the record; a one-sample drift above it calls for a better algorithm."""
ACCURATE_ALGORITHM = "matched-1-8-8"
"""The integration algorithm chosen then: one step a sample."""
MIN_SAMPLES = 32
"""Fewest gyro samples for which the commutation error is estimated."""
MIN_BIAS_SIGMA = 0.1 * units.DEGREE_PER_HOUR
"""Standard deviation of the initial bias error of a gyro whose specification has no bias, rad/s."""
MEKF = "mekf"
"""The estimator that all of this package works with; others run over records, and can be judged."""
MAX_MEMORY = 8e9
"""Largest memory for the smoother's forward pass, bytes."""

Sigma = float | tuple[float, float, float]
"""σ of a sensor: one number, or one about (of whole vectors along) each body axis x, y, z."""


def _sigma(name: str, value: Any) -> Sigma:
    """Return one number above zero, or three."""
    if not isinstance(value, (list, tuple)) and not (isinstance(value, np.ndarray) and value.ndim):
        return positive(name, value)
    if len(value) != 3:
        raise InputError(f"{name} has {len(value)} numbers; give one, or three of the body axes x, y, z")
    x, y, z = (positive(f"{name}: {axis}", one) for axis, one in zip("xyz", value, strict=True))
    return x, y, z


@dataclass(frozen=True, kw_only=True, eq=False)
class FilterSetup(ByValue):
    """The filter's model, its initial uncertainty, and the integration of the gyro.

    Parameters
    ----------
    process_noise : ProcessNoise
        Angle random walk and rate random walk of the gyro, as the filter models them.
    attitude_sigma : float, default 1°
        Standard deviation of the initial attitude error, each axis, rad; a Monte Carlo draws the true error from it.
    bias_sigma : float
        Standard deviation of the initial bias error, each axis, rad/s; a Monte Carlo draws the true error from it.
    integration : strapdown.coning.Algorithm, default "one-sample"
        Coning algorithm that turns its N gyro samples into one filter step.
    measurement_sigma_factor : float, default 1.0
        Factor on the record's σ of every sensor.
    sigma : mapping of str to float or tuple (3,), default empty
        σ of a sensor, by its name, instead of the record's: rad, or for whole vectors the unit of their reference. One
        number, or one for each body axis (of a direction the part across it counts; a heading has one). Where the
        record's σ varies, this is its root mean square and the ratios between samples are kept.
    gate : Gate, optional
        Refuses improbable measurements, and recovers. Default: all are used.
    robust : Robust, optional
        Weighs measurements by the size of their innovations. Default: all alike.
    states : States, optional
        Error states beside attitude and bias. Default: none. With drifts among them, the estimated bias includes them.
    estimator : str, Own, filter or callable, default MEKF
        Filter that processes a record: a name of :data:`strapdown.estimation.filters.FILTERS`, or a filter of one's own
        (:mod:`strapdown.estimation.filters.own`), which starts with the two σ above and does not use ``process_noise``.
    """

    process_noise: ProcessNoise
    attitude_sigma: float = ATTITUDE_SIGMA
    bias_sigma: float
    integration: coning.Algorithm = field(default_factory=lambda: coning.ALGORITHMS["one-sample"])
    measurement_sigma_factor: float = 1.0
    sigma: Mapping[str, Sigma] = field(default_factory=dict)
    gate: Gate | None = None
    robust: Robust | None = None
    states: States | None = None
    estimator: str | Own | OwnFilter | Callable[[ImuRecord, State], Estimate] = MEKF

    def __post_init__(self) -> None:
        """Check every number."""
        if self.states is not None and not isinstance(self.states, States):
            raise InputError(f"states is {self.states!r}; it must be states.States, or None")
        positive("attitude_sigma", self.attitude_sigma, unit="rad")
        positive("bias_sigma", self.bias_sigma, unit="rad/s")
        positive("measurement_sigma_factor", self.measurement_sigma_factor)
        sigma = {str(name): _sigma(f"sigma[{name!r}]", s) for name, s in self.sigma.items()}
        object.__setattr__(self, "sigma", sigma)
        self._check_estimator()

    def _check_estimator(self) -> None:
        if isinstance(self.estimator, str):
            one_of("estimator", self.estimator, filters.FILTERS)
        else:
            object.__setattr__(self, "estimator", as_own(self.estimator))
        if self.estimator != MEKF and (self.gate, self.robust, self.states) != (None, None, None):
            raise InputError(
                f"gate, robust and states are options of the mekf, and the estimator is {self.estimator_name}; leave them out"
            )

    @property
    def estimator_name(self) -> str:
        """Name of the estimator."""
        return self.estimator.name if isinstance(self.estimator, Own) else str(self.estimator)

    @classmethod
    def for_scenario(
        cls, scenario: Scenario, *, attitude_sigma: float | None = None, states: bool | Sequence[str] | None = False
    ) -> FilterSetup:
        """Return the filter setup that matches a scenario: the noise of its gyro, and the sensors' own σ.

        Parameters
        ----------
        scenario : Scenario
            Its gyro, its sensors and its motion determine the setup.
        attitude_sigma, states : optional
            As of :meth:`for_record`.

        Returns
        -------
        FilterSetup
            Setup whose noise model is that of the scenario.

        Raises
        ------
        InputError
            If the gyro has no angle random walk.

        Examples
        --------
        >>> from strapdown import scenarios
        >>> from strapdown.estimation import setup
        >>> print(setup.to_toml(setup.FilterSetup.for_scenario(scenarios.load_scenario("two-stars"))))  # doctest: +SKIP
        """
        from strapdown.scenarios import simulate  # and every motion

        return cls.for_record(simulate(scenario), attitude_sigma=attitude_sigma, states=states)

    @classmethod
    def for_record(
        cls,
        record: ImuRecord,
        spec: GyroSpec | None = None,
        *,
        attitude_sigma: float | None = None,
        states: bool | Sequence[str] | None = False,
    ) -> FilterSetup:
        """Return the filter setup that matches what a record's ``origin`` specifies of its gyro and sensors.

        Flicker noise, which is no random walk, is matched in the attitude at the record's rate and quality of measurements
        (:func:`strapdown.gyro.matched_process_noise`); without measurements it is bounded over the record's length. Errors without a state
        (scale factor, misalignment, quantisation, hard iron) are not covered: :func:`unmodelled_errors` names them.

        Parameters
        ----------
        record : ImuRecord
            Its rate, its length and the σ of its measurements determine the noise that stands for flicker.
        spec : GyroSpec, optional
            Specification of the gyro. Default: that of the record's origin.
        attitude_sigma : float, optional
            σ of the initial attitude error, each axis, rad. Default: 1°, or less where the finest sensor is so fine that its first
            measurement would not be linear in the error; an extended filter's covariance does not hold beyond that.
        states : bool, None or sequence of str, default False
            True: with an error state for each error that the gyro or the origin's sensors specify: scale factor, misalignment,
            g-sensitivity, slope of the bias over the record's temperature, flicker and Gauss–Markov drift, hard iron, a sensor's bias,
            correlated noise, lever arm. Each is modelled as one draw of a normal distribution whose σ is the error's size. Where
            one-sample integration would leave a noticeable commutation error, an integration algorithm of the same rate with less is
            chosen. Names such as ``"gyro.scale"``: with these of them alone. None: with all where an error is specified that the filter
            would have no state for.

        Returns
        -------
        FilterSetup
            Setup with the noise of the gyro, and with error states if asked for.

        Raises
        ------
        InputError
            If the gyro is not specified or has no angle random walk, or a name is of no error that is specified.
        """
        origin = record.origin or Origin()
        spec = spec or origin.gyro
        if spec is None:
            raise InputError(
                "the record does not specify its gyro; give the gyro's noise (--gyro; noise= in Python) or a filter (--filter; setup=)"
            )
        walk = np.max(np.square(spec.bias_instability) * np.log(1e3)) / np.pi  # flicker over three decades of time
        tau = spec.markov_correlation_time
        stationary = 0.5 * np.square(spec.markov_noise) * tau if np.isfinite(tau) else 0.0
        spread = np.max(np.square(spec.turn_on_bias) + np.square(spec.turn_on_bias_sigma) + stationary) + walk
        plain = cls(
            process_noise=ProcessNoise(**_noise(spec, record)),
            attitude_sigma=_linear_sigma(record) if attitude_sigma is None else attitude_sigma,
            bias_sigma=float(max(np.sqrt(spread), MIN_BIAS_SIGMA)),
        )
        sensors, gravity_f = specified(origin)
        if states is False or (
            states is None and not (origin.gyro and unmodelled_errors(origin.gyro, sensors, gravity_f=gravity_f))
        ):
            return plain
        found = matching.matched(spec, record, sensors, np.asarray(gravity_f), measurement_density(record))
        noise = ProcessNoise(**_noise_beside_states(spec, found.white))
        algorithm = ACCURATE_ALGORITHM if _commutes_badly(record, noise.angle_random_walk) else "one-sample"
        kept = found.states
        if not isinstance(states, bool) and states is not None:
            kept = found.states.chosen(tuple(states)) if states else States()
        return replace(
            plain,
            process_noise=noise
            if "gyro.drift" in kept.names
            else plain.process_noise,  # flicker is a state or in the noise
            integration=coning.ALGORITHMS[algorithm],
            states=kept if kept.names else None,
        )


def specified(origin: Origin) -> tuple[Sequence[Any], Sequence[float]]:
    """Return the sensors, whose errors are specified, and gravity in the fixed frame, as far as they are known."""
    scenario = origin.scenario
    return ((), vectors.GRAVITY_F) if scenario is None else (scenario.sensors, scenario.gravity_f)


def _noise_beside_states(spec: GyroSpec, white: float) -> dict[str, float]:
    """Return the two noises of a filter that has drifts as states, ``white`` being the PSD of what of them is too quick, rad²/s."""
    walk = np.max(np.square(spec.rate_random_walk))
    if not np.isfinite(spec.markov_correlation_time):
        walk = np.max(np.square(spec.rate_random_walk) + np.square(spec.markov_noise))
    noise = {
        "angle_random_walk": float(np.sqrt(np.max(np.square(spec.angle_random_walk)) + white)),
        "rate_random_walk": float(np.sqrt(walk)),
    }
    _need_white(noise)
    return noise


def _commutes_badly(record: ImuRecord, white: float) -> bool:
    """Return whether a turn at constant rate over each sample drifts by more than the record can leave unnoticed."""
    better = coning.ALGORITHMS[ACCURATE_ALGORITHM]
    if len(record.increments) < MIN_SAMPLES:
        return False
    one = coning.integrate(record.increments, coning.ALGORITHMS["one-sample"])[-1]
    other = coning.integrate(record.increments, better, edges=record.time)[-1]
    length = float(record.time[-1] - record.time[0])
    drift = float(np.linalg.norm(quaternion.log(quaternion.multiply(quaternion.conjugate(one), other)))) / length
    return bool(drift > COMMUTATION_SHARE * white / np.sqrt(length))


def unmodelled_errors(
    spec: GyroSpec,
    sensors: Sequence[Any] = (),
    states: States | None = None,
    *,
    gravity_f: Sequence[float] = vectors.GRAVITY_F,
) -> tuple[str, ...]:
    """Return, in words with their size, the specified errors of gyro and sensors that a filter has no state for.

    Where there are any, a filter that models the noise alone is overconfident.

    Examples
    --------
    >>> from strapdown import GyroSpec
    >>> from strapdown.estimation import setup
    >>> setup.unmodelled_errors(GyroSpec(angle_random_walk=1e-5, scale_factor=(1e-4, 0.0, 0.0)))
    ("the gyro's scale factor of 100 ppm",)
    """
    scale, asymmetry, misalignment, flicker = (
        float(np.max(np.abs(getattr(spec, name))))
        for name in ("scale_factor", "asymmetry", "misalignment", "bias_instability")
    )
    found: list[tuple[Any, str, str]] = [
        (scale, "gyro.scale", f"the gyro's scale factor of {scale / 1e-6:.3g} ppm"),
        (asymmetry, "", f"the gyro's asymmetry of {asymmetry / 1e-6:.3g} ppm"),
        (misalignment, "gyro.misalignment", f"the gyro's misalignment of {misalignment / 1e-3:.3g} mrad"),
        (
            flicker,
            "gyro.drift",
            f"the gyro's flicker of {flicker / units.DEGREE_PER_HOUR:.3g} °/h, covered in the attitude but not in the bias",
        ),
        (np.any(gravity_f) * spec.g_sensitivity, "gyro.force", "the gyro's sensitivity to acceleration"),
        (spec.temperature is not None, "gyro.temperature", "the gyro's bias over temperature"),
        (np.max(spec.quantization) + np.max(spec.rate_resolution), "", "the gyro's quantisation"),
    ]
    for sensor in sensors:
        name, faults = sensor.name, getattr(sensor, "faults", vectors.Faults())
        accelerated = getattr(sensor, "acceleration_f", None) is not None
        found += [
            (getattr(sensor, "hard_iron", 0.0), f"{name}.bias", f"the hard iron of the {name}"),
            (getattr(sensor, "soft_iron", 0.0), "", f"the soft iron of the {name}"),
            (getattr(sensor, "bias", 0.0), f"{name}.bias", f"the bias of the {name}"),
            (
                getattr(sensor, "lever_arm_b", 0.0),
                f"{name}.lever",
                f"the accelerations that the {name} feels at its lever arm",
            ),
            (accelerated, f"{name}.velocity", f"the acceleration of the point that the {name} is at"),
            (faults.correlated_sigma, f"{name}.correlated", f"the correlated noise of the {name}"),
            (faults.outlier_probability, "", f"the outliers of the {name}"),
        ]
    known = () if states is None else states.names
    return tuple(words for size, state, words in found if np.any(size) and state not in known)


def _linear_sigma(record: ImuRecord) -> float:
    finest = min((_finest(series) for series in record.vectors if len(series.time)), default=np.inf)
    return float(min(ATTITUDE_SIGMA, np.sqrt(LINEAR_SHARE * finest))) if finest > 0.0 else ATTITUDE_SIGMA


def _finest(series: VectorMeasurements) -> float:
    """Return the least σ of a series, rad."""
    if series.kind == "vector":
        return float(np.min(series.sigma / np.linalg.norm(series.references_f, axis=1)))
    return float(np.min(series.sigma if series.sigma_axes is None else series.sigma_axes))


def _noise(spec: GyroSpec, record: ImuRecord) -> dict[str, float]:
    if not np.any(np.asarray(spec.bias_instability) > 0.0):
        noise = gyro.process_noise(spec)
    else:
        density = measurement_density(record)
        if np.isfinite(density):
            noise = gyro.matched_process_noise(spec, density)
        else:
            noise = gyro.process_noise(spec, bandwidth=2.0 * np.pi / float(record.time[-1] - record.time[0]))
    _need_white(noise)
    return noise


def _need_white(noise: Mapping[str, float]) -> None:
    if noise["angle_random_walk"] == 0.0:
        raise InputError(
            "the gyro's specification has no angle random walk, and a filter needs one greater than zero; "
            "give it, or a filter setup of your own"
        )


def measurement_density(record: ImuRecord) -> float:
    """Return the variance of a measurement about an axis times the interval between measurements, rad² s, over all sensors and axes."""
    information = sum(_information(series) for series in record.vectors)
    length = float(record.time[-1] - record.time[0])
    return length / information if information > 0.0 else float("inf")


def _information(series: VectorMeasurements) -> float:
    """Return Σ 1/σ² about an axis, the mean over the three axes, 1/rad²."""
    if series.attitude is not None:
        assert series.sigma_axes is not None
        return float(np.sum(series.sigma_axes**-2.0)) / 3.0
    seen = np.isfinite(series.vector_b).all(axis=1)
    length = np.linalg.norm(series.references_f, axis=1) if series.kind == "vector" else np.ones(len(series.time))
    share = 1.0 / 3.0 if series.kind == "heading" else 2.0 / 3.0
    return share * float(np.sum((length[seen] / series.sigma[seen]) ** 2))


def modelled_record(record: ImuRecord, setup: FilterSetup) -> ImuRecord:
    """Return the record as the filter of this setup processes it: at the rate of its integration algorithm, with the setup's σ."""
    names = [series.sensor for series in record.vectors]
    for name in setup.sigma:
        one_of("sigma: sensor", name, names)
    used = (
        record
        if setup.integration.samples == 1 and setup.integration.name == "one-sample"
        else compress(record, setup.integration)
    )
    if setup.measurement_sigma_factor == 1.0 and not setup.sigma:
        return used
    return replace(used, vectors=tuple(_modelled_series(series, setup) for series in record.vectors))


def _modelled_series(series: VectorMeasurements, setup: FilterSetup) -> VectorMeasurements:
    factor = setup.measurement_sigma_factor
    if series.sensor in setup.sigma:
        given = setup.sigma[series.sensor]
        if isinstance(given, tuple):
            return _by_axis(series, given, factor)
        own = float(np.sqrt(np.mean(series.sigma**2))) if len(series.time) else 0.0
        if own == 0.0:
            if series.attitude is not None:
                return replace(series, sigma_axes=np.full(3, factor * given))
            return replace(series, sigma=np.full(len(series.time), factor * given))
        factor *= given / own
    return series if factor == 1.0 else series.noise_scaled(factor)


def _by_axis(series: VectorMeasurements, given: tuple[float, float, float], factor: float) -> VectorMeasurements:
    """Return the series with a σ of its own about each body axis; from sample to sample they vary as its own does."""
    if series.kind == "heading":
        raise InputError(
            f"sigma: {series.sensor} is {given}, three numbers, and a heading has one degree of freedom; give one number"
        )
    m = len(series.time)
    own = float(np.sqrt(np.mean(series.sigma**2))) if m else 0.0
    level = series.sigma / own if own > 0.0 else np.ones(m)
    # The root mean square over the axes is made from them.
    return replace(
        series, sigma=np.zeros(m), sigma_axes=factor * level[:, None] * np.asarray(given)[None], covariance=None
    )


def run(record: ImuRecord, setup: FilterSetup, initial: State, **options: Any) -> Estimate:
    """Run the filter of a setup over a record.

    Parameters
    ----------
    record : ImuRecord
        At the gyro's rate; the setup's integration algorithm and σ are applied.
    setup : FilterSetup
        Filter whose noise, σ, error states, gate and integration algorithm are applied.
    initial : State
        State at the first edge.
    **options
        Of :func:`strapdown.estimation.run`; ``gate`` and ``robust`` replace the setup's. Other estimators than the
        mekf take ``every`` and ``full_covariance`` alone.

    Returns
    -------
    Estimate
        With ``error_states`` where the setup has any.
    """
    if setup.estimator != MEKF:
        return _run_other(modelled_record(record, setup), setup, initial, **options)
    chosen = {"gate": setup.gate, "robust": setup.robust, **options}
    if setup.states is not None:
        return optional.run(modelled_record(record, setup), setup.process_noise, initial, setup.states, **chosen)
    return estimation.run(modelled_record(record, setup), setup.process_noise, initial, **chosen)


def runs_at_once(setup: FilterSetup) -> int:
    """Return how many records :func:`run_together` filters at once: 1 for a filter that it is not for."""
    judged = setup.gate is not None or setup.robust is not None
    return WIDTH if setup.estimator == MEKF and setup.states is not None and not judged else 1


def run_together(
    records: Sequence[ImuRecord], setup: FilterSetup, initials: Sequence[State], every: int
) -> list[Estimate]:
    """Run the filter of a setup over several records, and keep every ``every``-th state with its covariance.

    The filter is one that :func:`runs_at_once` allows. A record's estimate has the same bits whatever the records beside it, and agrees
    with that of :func:`run` to rounding.
    """
    assert setup.states is not None
    modelled = [modelled_record(record, setup) for record in records]
    return optional.run_together(modelled, setup.process_noise, initials, setup.states, every)


def _run_other(
    record: ImuRecord, setup: FilterSetup, initial: State, *, every: int = 1, full_covariance: bool = False
) -> Estimate:
    if isinstance(setup.estimator, Own):
        return setup.estimator(record, initial, times=None if every == 1 else record.time[::every])
    return filters.run(
        setup.estimator_name, record, setup.process_noise, initial, every=every, full_covariance=full_covariance
    )


def need_mekf(setup: FilterSetup, what: str) -> None:
    """Refuse a setup of another estimator for ``what`` works with the mekf alone."""
    if setup.estimator != MEKF:
        raise InputError(
            f"{what} works with the mekf, and the estimator is {setup.estimator_name}; take a setup with estimator='mekf'"
        )


def smooth(record: ImuRecord, setup: FilterSetup, initial: State, **options: Any) -> Estimate:
    """Run the fixed-interval smoother of a setup over a record.

    Parameters
    ----------
    record, setup, initial : ImuRecord, FilterSetup, State
        As of :func:`run`.
    **options
        Of :func:`strapdown.estimation.smooth`.

    Returns
    -------
    Estimate
        Smoothed estimate at the edges of the filter's steps.

    Raises
    ------
    InputError
        If it would need more memory than :data:`MAX_MEMORY`.
    """
    need_mekf(setup, "the smoother")
    chosen = {"gate": setup.gate, "robust": setup.robust, **options}
    modelled = modelled_record(record, setup)
    states = setup.states or States()
    n = 6 + sum(one.size for one in states.blocks({series.sensor: series.kind for series in modelled.vectors}))
    segments = len(modelled.increments) + sum(len(series.time) for series in modelled.vectors)
    need = 8 * (n * (n + 1) // 2 + n + 5) * segments
    if states.gyro_drift_sigma:
        need += 8 * n * n * len(modelled.time)
    if need > MAX_MEMORY:
        raise InputError(
            f"smoothing {len(modelled.increments)} samples with {n} states takes {need / 1e9:.3g} GB, more than {MAX_MEMORY / 1e9:g}; "
            "cut the record, or do not smooth"
        )
    return optional.smooth(modelled, setup.process_noise, initial, states, **chosen)


def observability(record: ImuRecord, setup: FilterSetup, initial: State) -> Observability:
    """Return what a record shows of each state of this setup's filter (:func:`strapdown.estimation.observability`)."""
    need_mekf(setup, "observability")
    modelled = modelled_record(record, setup)
    if setup.states is None:
        return estimation.observability(modelled, setup.process_noise, initial)
    blocks = setup.states.blocks({series.sensor: series.kind for series in modelled.vectors})
    start = optional.initial_state(initial, blocks, setup.states.gyro_fast_bias_sigma)
    return estimation.observability(modelled, setup.process_noise, start, blocks)


def initial_state(
    setup: FilterSetup, attitude: Array, bias: Array | tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> State:
    """Return the state that the filter starts from, with the setup's σ.

    Parameters
    ----------
    setup : FilterSetup
        Filter whose initial σ of attitude and bias are used.
    attitude : array_like (4,)
        q_fb.
    bias : array_like (3,), default zero
        Gyro bias, rad/s, body axes.

    Returns
    -------
    State
        Attitude and bias with independent errors of these σ.
    """
    return estimation.initial_state(
        attitude, bias=bias, attitude_sigma=setup.attitude_sigma, bias_sigma=setup.bias_sigma
    )


def drawn_state(
    setup: FilterSetup,
    record: ImuRecord,
    seed: int,
    run: int = 0,
    *,
    sigmas: tuple[float, float] | None = None,
    fixed_errors: tuple[Array, Array] = (np.zeros(3), np.zeros(3)),
) -> State:
    """Return the true initial state of a record, off by errors drawn from the setup's σ (or ``sigmas``) and by fixed ones."""
    if record.truth is None:
        raise InputError("record has no truth to start from; simulate one, or give an initial state")
    attitude_sigma, bias_sigma = sigmas or (setup.attitude_sigma, setup.bias_sigma)
    draw = generator(seed, run, "initial error").standard_normal(6)
    turn = quaternion.exp(-attitude_sigma * draw[:3] - fixed_errors[0])
    bias = record.truth.bias[0] - bias_sigma * draw[3:] - fixed_errors[1]
    return initial_state(setup, quaternion.multiply(record.truth.attitude[0], turn), bias)


_NOISE_FORM: tables.Form = {name: gyro.FORM[name] for name in ("angle_random_walk", "rate_random_walk")}
_FORM: tables.Form = {
    "attitude_sigma": tables.DEGREES,
    "bias_sigma": tables.DEGREES_PER_HOUR,
    "measurement_sigma_factor": tables.RATIO,
}
_GATE_FORM: tables.Form = {
    "probability": tables.RATIO,
    "recovery": tables.PLAIN,
    "restart_attitude_sigma": tables.DEGREES,
    "restart_bias_sigma": tables.DEGREES_PER_HOUR,
}
_ROBUST_FORM: tables.Form = {
    "kind": tables.PLAIN,
    "probability": tables.RATIO,
    "degrees_of_freedom": tables.RATIO,
    "iterations": tables.PLAIN,
}
_PARTS = ("integration", "sigma", "gate", "robust", "states", "estimator")
NEVER = 0
"""Value of ``recovery`` in a file for a gate that never recovers, as TOML has no null."""


def to_table(setup: FilterSetup) -> dict[str, Any]:
    """Return a setup as the table that its file holds."""
    table = {**tables.encode(setup.process_noise, _NOISE_FORM), **tables.encode(setup, _FORM)}
    own = setup.integration.name not in coning.ALGORITHMS
    table["integration"] = setup.integration.to_table() if own else setup.integration.name
    if setup.sigma:
        table["sigma"] = {name: list(s) if isinstance(s, tuple) else s for name, s in setup.sigma.items()}
    if setup.gate is not None:
        table["gate"] = tables.encode(setup.gate, _GATE_FORM)
        if setup.gate.recovery is None:
            table["gate"]["recovery"] = NEVER
    if setup.robust is not None:
        table["robust"] = tables.encode(setup.robust, _ROBUST_FORM)
    if setup.states is not None:
        table["states"] = optional.to_table(setup.states)
    if setup.estimator != MEKF:
        table["estimator"] = setup.estimator.table if isinstance(setup.estimator, Own) else setup.estimator
    return table


def from_table(table: Mapping[str, Any], place: str = "filter") -> FilterSetup:
    """Return the setup in a table; an unknown key is an error that names the nearest known one."""
    known_keys(place, table, {*tables.keys(_NOISE_FORM), *tables.keys(_FORM), *_PARTS})
    own = tables.keys(_NOISE_FORM)
    parts: dict[str, Any] = {}
    if "integration" in table:
        algorithm = table["integration"]
        if isinstance(algorithm, Mapping):
            parts["integration"] = coning.Algorithm.from_table(algorithm, f"{place}: integration")
        else:
            parts["integration"] = coning.ALGORITHMS[one_of(f"{place}: integration", algorithm, coning.ALGORITHMS)]
    if "sigma" in table:
        sigma = _part(table, "sigma", place)
        parts["sigma"] = {name: _sigma(f"{place}: sigma: {name}", value) for name, value in sigma.items()}
    if "gate" in table:
        content = _part(table, "gate", place)
        never = {name: None for name in ("recovery",) if content.get(name) == NEVER}
        given = {key: value for key, value in content.items() if key not in never}
        parts["gate"] = tables.build(Gate, given, _GATE_FORM, f"{place}: gate", **never)
    if "robust" in table:
        parts["robust"] = tables.build(Robust, _part(table, "robust", place), _ROBUST_FORM, f"{place}: robust")
    if "states" in table:
        parts["states"] = optional.from_table(_part(table, "states", place), f"{place}: states")
    if "estimator" in table:
        estimator = table["estimator"]  # a table describes a filter of one's own, whose code no file holds
        parts["estimator"] = (
            Own(estimator) if isinstance(estimator, Mapping) and "name" in estimator else str(estimator)
        )
    return tables.build(  # type: ignore[no-any-return]
        FilterSetup,
        {key: value for key, value in table.items() if key not in own and key not in _PARTS},
        _FORM,
        place,
        process_noise=tables.build(ProcessNoise, {k: v for k, v in table.items() if k in own}, _NOISE_FORM, place),
        **parts,
    )


def need_angles(setup: FilterSetup, kinds: Mapping[str, str], place: str) -> None:
    """Raise an error for a σ beyond half a turn of a sensor that measures angles: it must have been meant in another unit than rad."""
    for name, sigma in setup.sigma.items():
        largest = float(np.max(sigma))
        if kinds.get(name, "vector") != "vector" and largest > np.pi:
            raise InputError(
                f"{place}: sigma: {name} is {largest:g} rad, beyond half a turn; sigma is in rad, and {largest:g} arcsec would be "
                f"{largest * units.ARCSECOND:.4g}"
            )


def _part(table: Mapping[str, Any], name: str, place: str) -> Mapping[str, Any]:
    if not isinstance(table[name], Mapping):
        raise InputError(f"{place}: {name} is {table[name]!r}; it must be a table, [{place}.{name}]")
    return table[name]  # type: ignore[no-any-return]


def to_toml(setup: FilterSetup) -> str:
    """Return a setup as TOML text with the table ``[filter]``, units in the names of its keys; :func:`read_setup` reads it back."""
    import tomli_w

    sensors = setup.sigma or (setup.states is not None and setup.states.sensors)
    note = (
        "# sigma of sensors: rad, or of one that measures whole vectors the unit of its reference\n" if sensors else ""
    )
    return note + tomli_w.dumps({"filter": to_table(setup)})


def from_toml(text: str, place: str = "filter") -> FilterSetup:
    """Return the setup in the table ``[filter]`` of a TOML text, such as :func:`to_toml` gives."""
    table = reading.from_toml(text, place).get("filter")
    if not isinstance(table, dict):
        raise InputError(f"{place} has no table [filter]")
    return from_table(table, place)


def read_setup(path: str | os.PathLike[str]) -> FilterSetup:
    """Read the table ``[filter]`` of a TOML file, such as ``strapdown tune`` writes; other tables are ignored.

    Parameters
    ----------
    path : path
        The TOML file; keys have their units in their names.

    Returns
    -------
    FilterSetup
        Setup of the table, in SI units and radians.
    """
    return tables.read(path, "filter", "`strapdown tune` writes one", from_table)
