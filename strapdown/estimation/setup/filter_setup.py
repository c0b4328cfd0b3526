"""The setup of a filter: its model, initial uncertainty, integration, gate and error states."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from strapdown import coning, units
from strapdown.checks import Hint, InputError, half_turn, instance, one_of, positive
from strapdown.estimation.filters import MEKF
from strapdown.estimation.filters.own import Own, OwnFilter, as_own
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.setup import matching
from strapdown.estimation.setup.states import States
from strapdown.estimation.setup.unmodelled import specified, specified_errors
from strapdown.estimation.states import ProcessNoise, State
from strapdown.gyro import GyroSpec
from strapdown.records import Estimate, ImuRecord, Origin
from strapdown.results import ByValue

if TYPE_CHECKING:
    from strapdown.scenarios import Scenario

MIN_BIAS_SIGMA = 0.1 * units.DEGREE_PER_HOUR
"""Standard deviation of the initial bias error for a gyro whose specification has no bias, rad/s."""

Sigma = float | tuple[float, float, float]
"""σ of a sensor: one number, or one about (for whole vectors along) each body axis x, y, z."""


def sensor_sigma(name: str, value: Any) -> Sigma:
    """Return one or three numbers, after a check that they are above zero."""
    if not isinstance(value, (list, tuple)) and not (isinstance(value, np.ndarray) and value.ndim):
        return positive(name, value)
    if len(value) != 3:
        raise InputError(f"{name} has {len(value)} numbers; give one, or three for the body axes x, y, z")
    x, y, z = (positive(f"{name}: {axis}", sigma) for axis, sigma in zip("xyz", value, strict=True))
    return x, y, z


@dataclass(frozen=True, kw_only=True, eq=False)
class FilterSetup(ByValue):
    """The filter's model, its initial uncertainty, and the integration of the gyro.

    Parameters
    ----------
    process_noise : ProcessNoise
        Angle random walk and rate random walk of the gyro, as the filter models them.
    attitude_sigma : float, default 1°
        Standard deviation of the initial attitude error, rad, per axis, at most π; a Monte Carlo draws the true error from it.
    bias_sigma : float
        Standard deviation of the initial bias error, rad/s, per axis; a Monte Carlo draws the true error from it.
    integration : strapdown.coning.Algorithm, default "one-sample"
        Coning algorithm that converts its N gyro samples into one filter step.
    measurement_sigma_factor : float, default 1.0
        Factor on the σ of every sensor in the record.
    sigma : mapping of str to float or tuple (3,), default empty
        σ of a sensor, by its name, instead of the record's: rad, or for whole vectors the unit of their reference. One
        number, or one for each body axis (for a direction the part across it counts; a heading has one). If the record's
        σ varies, this is its root mean square and the ratios between samples are kept.
    gate : Gate, optional
        Gate that refuses improbable measurements, and recovers. Default: all are used.
    robust : Robust, optional
        Robust updates, which weight measurements by their residuals. Default: all equally.
    states : States, optional
        Error states in addition to attitude and bias. Default: none. If they include drifts, so does the estimated bias.
    estimator : str, Own, filter or callable, default MEKF
        Filter that processes a record: the package's, or a filter of your own
        (:mod:`strapdown.estimation.filters.own`), which starts with the two σ above and does not use ``process_noise``.
    """

    process_noise: ProcessNoise
    attitude_sigma: float = matching.ATTITUDE_SIGMA
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
        instance("process_noise", self.process_noise, ProcessNoise, "give the random walks of the gyro")
        instance("integration", self.integration, coning.Algorithm, 'give one of coning.ALGORITHMS["name"]')
        if self.states is not None:
            instance("states", self.states, States, "or None")
        half_turn("attitude_sigma", positive("attitude_sigma", self.attitude_sigma, unit="rad"))
        positive("bias_sigma", self.bias_sigma, unit="rad/s")
        positive("measurement_sigma_factor", self.measurement_sigma_factor)
        sigma = {str(name): sensor_sigma(f"sigma[{name!r}]", s) for name, s in self.sigma.items()}
        object.__setattr__(self, "sigma", sigma)
        if isinstance(self.estimator, str):
            one_of("estimator", self.estimator, (MEKF,))
        else:
            object.__setattr__(self, "estimator", as_own(self.estimator))
        if self.estimator != MEKF and (self.gate, self.robust, self.states) != (None, None, None):
            raise InputError(
                f"gate, robust and states are options of the mekf, but the estimator is {self.estimator_name}; leave them out"
            )

    @property
    def rejects(self) -> bool:
        """Whether a gate or robust weights keep outliers out."""
        return self.gate is not None or self.robust is not None

    @property
    def estimator_name(self) -> str:
        """Name of the estimator."""
        return self.estimator.name if isinstance(self.estimator, Own) else str(self.estimator)

    @classmethod
    def for_scenario(
        cls, scenario: Scenario, *, attitude_sigma: float | None = None, states: bool | Sequence[str] | None = None
    ) -> FilterSetup:
        """Return the filter setup that matches a scenario: the noise of its gyro, the σ of its sensors, and states for its errors.

        Parameters
        ----------
        scenario : Scenario
            Scenario whose gyro, sensors and motion determine the setup.
        attitude_sigma : optional
            As for :meth:`for_record`.
        states : bool, None or sequence of str, default None
            As for :meth:`for_record`. None: with error states if an error is specified that the filter would not model without them, so
            that the filter is consistent; False: attitude and bias only.

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
        from strapdown.scenarios import simulate  # imports every motion

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
        """Return the filter setup that matches the specifications of gyro and sensors in a record's ``origin``.

        Flicker noise is replaced by random walks that match it in the attitude at the rate and precision of the record's measurements
        (:func:`strapdown.gyro.matched_process_noise`); without measurements it is bounded over the record's duration. Errors without a
        state (scale factor, misalignment, quantisation, hard iron) are not covered: :func:`unmodelled_errors` lists them.

        Parameters
        ----------
        record : ImuRecord
            Record whose rate, duration and σ of measurements determine the noise that replaces flicker.
        spec : GyroSpec, optional
            Specification of the gyro. Default: that of the record's origin.
        attitude_sigma : float, optional
            σ of the initial attitude error, rad, per axis. Default: 1°, or less if the first measurement of the most precise sensor would
            not be linear in that error; the covariance of an extended filter is not valid beyond that.
        states : bool, None or sequence of str, default False
            True: with an error state for each specified error of the gyro and the origin's sensors: scale factor, misalignment,
            g-sensitivity, slope of the bias over the record's temperature, flicker and Gauss–Markov drift, hard iron, a sensor's bias,
            correlated noise, lever arm. Each is modelled as one draw of a normal distribution whose σ is the error's size. If one-sample
            integration would cause a noticeable commutation error, a more accurate integration algorithm of the same rate is chosen.
            Names such as ``"gyro.scale"``: only with these. None: with all if any error is specified that the filter would have no state
            for.

        Returns
        -------
        FilterSetup
            Setup with the noise of the gyro, and with error states if requested.

        Raises
        ------
        InputError
            If the gyro is not specified or has no angle random walk, or a name is not that of a specified error.
        """
        origin = record.origin or Origin()
        spec = spec or origin.gyro
        if spec is None:
            raise InputError(
                f"the record does not specify its gyro; give the gyro's noise, {Hint('noise')}, or a filter, {Hint('setup')}"
            )
        walk = np.max(np.square(spec.bias_instability) * np.log(1e3)) / np.pi  # flicker over three decades of time
        tau = spec.markov_correlation_time
        stationary = 0.5 * np.square(spec.markov_noise) * tau if np.isfinite(tau) else 0.0
        spread = np.max(np.square(spec.turn_on_bias) + np.square(spec.turn_on_bias_sigma) + stationary) + walk
        plain = cls(
            process_noise=ProcessNoise(**matching.noise(spec, record)),
            attitude_sigma=matching.linear_sigma(record) if attitude_sigma is None else attitude_sigma,
            bias_sigma=float(max(np.sqrt(spread), MIN_BIAS_SIGMA)),
        )
        if states is False or (states is None and not specified_errors(origin)):
            return plain
        sensors, gravity_f = specified(origin)
        kept, white = matching.matched(
            spec, record, sensors, np.asarray(gravity_f), matching.measurement_density(record)
        )
        noise = ProcessNoise(**matching.noise_beside_states(spec, white))
        accurate = matching.commutes_badly(record, noise.angle_random_walk)
        if not isinstance(states, bool) and states is not None:
            if isinstance(states, str):
                raise InputError(f"states is {states!r}, a text; give a list of names, as in [{states!r}]")
            kept = kept.select(tuple(states)) if states else States()
        return replace(
            plain,
            # Flicker is a state, or in the noise.
            process_noise=noise if "gyro.drift" in kept.names else plain.process_noise,
            integration=coning.ALGORITHMS[matching.ACCURATE_ALGORITHM if accurate else "one-sample"],
            states=kept if kept.names else None,
        )


def need_mekf(setup: FilterSetup, what: str) -> None:
    """Raise an error for a setup of another estimator, as ``what`` needs the mekf."""
    if setup.estimator != MEKF:
        raise InputError(
            f"{what} needs the mekf, but the estimator is {setup.estimator_name}; use a setup with estimator='mekf'"
        )


def need_setup(setup: object) -> None:
    """Raise an error for a filter of another class."""
    instance("setup", setup, FilterSetup, "give estimation.setup.FilterSetup, as of FilterSetup.for_scenario")


def need_angles(setup: FilterSetup, kinds: Mapping[str, str], place: str) -> None:
    """Raise an error for a σ of more than π rad of a sensor that measures angles: it must have been meant in another unit."""
    for name, sigma in setup.sigma.items():
        largest = float(np.max(sigma))
        if kinds.get(name, "vector") != "vector" and largest > np.pi:
            raise InputError(
                f"{place}: sigma: {name} is {largest:g} rad, more than half a rotation; sigma is in rad, and {largest:g} arcsec would be "
                f"{largest * units.ARCSECOND:.4g}"
            )
