"""The filter of :func:`strapdown.estimate` for an IMU in real time: :class:`LiveAhrs`."""

from __future__ import annotations

import math
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from strapdown import estimation
from strapdown.ahrs import headings, regions, starting
from strapdown.ahrs.parameters import AhrsParameters, of_motion
from strapdown.ahrs.preparing import GRAVITY
from strapdown.checks import Array, InputError, instance, non_negative, positive
from strapdown.estimation import live as estimation_live
from strapdown.estimation.forward import TooPreciseError
from strapdown.estimation.live import restart
from strapdown.kernels import headings as k_headings
from strapdown.kernels import live_imu as kernel
from strapdown.kernels import recording_steps
from strapdown.kernels.argument_tables import packed
from strapdown.kernels.live import TOO_PRECISE
from strapdown.kernels.machine import address_of, compiled, read_only
from strapdown.recordings.sensor_delays import ASSUMED_SIGMA, GIVEN_SIGMA
from strapdown.records.recording import LARGEST_RATE, Recording
from strapdown.vectors import VectorMeasurements

MAX_SAMPLES_RATIO = 4
"""Samples of a step, in multiples of the usual number, above which the declared interval is wrong."""


class LiveAhrs:
    """The filter of :func:`strapdown.estimate` for an IMU, sample by sample, in about two microseconds a sample.

    Parameters
    ----------
    interval : float
        Usual interval of the samples, s: the median of a recording of the unit.
    magnetometer : bool, default False
        Whether the samples have a field.
    parameters : AhrsParameters, optional
        The filter's model of the unit and of its motion, such as ``ahrs.of_motion("vehicle", magnetometer=True)``. Default: that of a unit
        in the hand.
    latency : float, optional
        Delay of the samples, s, as for :func:`strapdown.estimate`. Default: half the interval.

    Raises
    ------
    InputError
        If an argument is invalid.

    See Also
    --------
    strapdown.estimation.LiveFilter : The filter for any sensors and error states.

    Notes
    -----
    Attitude, bias and covariance after each sample equal, bit for bit, the online rows of :func:`strapdown.estimate` for a recording of
    these samples, except what that takes from the whole recording: ``interval`` must be the recording's median, its first
    sample must have a specific force and a field, and its samples no faults (truncation, clipping, gaps). The last row differs too, because
    the end of a recording ends a step of the filter. Samples before the first complete one are not used.

    The delay of the magnetometer relative to the gyro, which ``estimate`` finds, is taken as zero here.

    Examples
    --------
    >>> import strapdown as sd
    >>> live = sd.LiveAhrs(interval=0.01)  # doctest: +SKIP
    >>> live.update(0.01, gyro=[0.0, 0.0, 0.1], accelerometer=[0.0, 0.1, 9.8])  # doctest: +SKIP
    >>> live.attitude, live.variance[:3]  # doctest: +SKIP
    """

    def __init__(
        self,
        *,
        interval: float,
        magnetometer: bool = False,
        parameters: AhrsParameters | None = None,
        latency: float | None = None,
    ) -> None:
        self.interval = positive("interval", interval, unit="s")
        instance("magnetometer", magnetometer, bool, "give True or False")
        if parameters is not None:
            instance("parameters", parameters, AhrsParameters, 'such as ahrs.of_motion("vehicle", magnetometer=True)')
        self.magnetometer = magnetometer
        self.parameters = parameters or of_motion("hand", magnetometer=magnetometer)
        late = 0.5 * self.interval if latency is None else non_negative("latency", latency, unit="s")
        setup = self.parameters.setup
        kinds: list[tuple[str, Any, Array]] = [
            ("accelerometer", "vector", GRAVITY),
            ("magnetometer", "heading", headings.NORTH),
        ][: 1 + magnetometer]
        self._sensors = [
            VectorMeasurements(
                sensor=sensor,
                kind=kind,
                time=np.zeros(1),
                vector_b=reference[None],
                reference_f=reference,
                sigma=np.ones(1),
            )
            for sensor, kind, reference in kinds
        ]
        self._filter = estimation.LiveFilter(
            setup.process_noise,
            estimation.initial_state([1.0, 0.0, 0.0, 0.0], attitude_sigma=1.0, bias_sigma=1.0),
            ()
            if setup.states is None
            else setup.states.blocks({series.sensor: series.kind for series in self._sensors}),
            sensors=self._sensors,
        )
        sigma = ASSUMED_SIGMA if latency is None else GIVEN_SIGMA
        self._imu = self._arrays(late, sigma)
        self._call: Any = self._imu.filter.call.data
        self._table = packed(self._imu)
        dispatcher = compiled(kernel.take)
        self._kind = dispatcher.typeof_pyval(self._imu)
        self._take = dispatcher.compile(tuple(map(dispatcher.typeof_pyval, (self._kind, self._table, 0))))
        self._bias_variance = self.parameters.bias_sigma**2
        self._rests: list[tuple[Array, float]] = []
        self._rested = math.nan

    def _arrays(self, late: float, sigma: float) -> kernel.Imu:
        """Return the kernel's arrays."""
        k, parameters = recording_steps, self.parameters
        most = MAX_SAMPLES_RATIO * max(1, math.ceil(parameters.step / self.interval)) + 2
        parts, part = starting.rest_length(self.interval)
        span = parts * part
        time, rate, turned = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 4))
        force, frame, edge = np.zeros((most, 3)), np.zeros((most, 4)), np.zeros(2, np.int64)
        total, number, mean, turn = np.zeros((1, 3)), np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3))
        stamps = k.Stamps(np.zeros(2), np.zeros((2, 3)), np.zeros((2, 4)), np.full(2, late), np.zeros((2, 3)))
        shapes = (1, 4), (1, 3), (1, 6), (1, 6, 6), (1,), (1,), (1,), (1,)
        steps = k.Steps(np.zeros(1, np.int64), *(np.ones(shape) for shape in shapes))
        self._found = k.Carried(*(np.full((2, *shape), np.nan) for shape in ((4,), (3,), (6,), (6, 6))))
        steps.iron[:] = 0.0
        first, weight = regions.FIRST_LEVEL
        field, field_total, field_number = np.zeros((most, 3)), np.zeros((1, 3)), np.zeros(1)
        nis, field_level = np.zeros(1), np.full(1, first if self.magnetometer else 0.0)
        forgotten = parameters.heading_interval / regions.FIELD_MEMORY
        constants = headings.constants_of(parameters, max(parameters.step, self.interval))
        memory = headings.memory_of(constants)
        head_frame, head_end, head_length, head_time = np.zeros((1, 4)), np.zeros((1, 4)), np.zeros(1), np.zeros(1)
        of_step = (field_total, field_number, head_length, head_frame, total, number, head_end, head_time, np.zeros(1))
        head_steps = k_headings.Steps(*map(read_only, of_step))
        heading_out = k_headings.Outputs(np.zeros((1, 3)), np.zeros(1), np.zeros((1, 2)), np.zeros((1, 3)), np.zeros(1))
        shares = regions.shares_of(parameters, magnetometer=self.magnetometer)
        live, state, numbers, places = estimation_live.arrays_of(self._filter)
        carried = (
            k.Steps(steps.edge, *map(read_only, steps[1:])),
            k.Stamps(*map(read_only, stamps)),
            regions.limits(parameters, sigma),
            self._found,
        )
        return kernel.Imu(
            filter=live._replace(call=np.zeros(kernel.FIELD + 3)),
            magnetometer=int(self.magnetometer),
            follow=_routine(k.follow_gyro, read_only(time), read_only(rate), turned),
            average=_routine(k.average_samples, read_only(force), read_only(frame), edge, total, number),
            end=_routine(k.end_steps, read_only(frame), edge, total, number, mean, turn),
            scale=_routine(k.scale_factors, read_only(field_level), shares, steps.tilt, steps.floor, steps.heading),
            carry=_routine(k.carry_to_stamps, *carried),
            average_field=_routine(
                k.average_samples, read_only(field), read_only(frame), edge, field_total, field_number
            ),
            head=_routine(k_headings.heading_steps, constants, head_steps, memory, heading_out),
            field_mean=_routine(
                k.running_mean, read_only(nis), forgotten, np.array([first * weight, weight]), field_level
            ),
            interval=self.interval,
            step=parameters.step,
            noise=parameters.specific_force_noise,
            largest_rate=LARGEST_RATE,
            late=late,
            start=np.zeros(1),
            time=time,
            rate=rate,
            turned=turned,
            force=force,
            frame=frame,
            edge=edge,
            number=number,
            mean=mean,
            turn=turn,
            state=state,
            numbers=numbers,
            places=places,
            attitude=steps.attitude,
            bias=steps.bias,
            variance=steps.variance,
            covariance=steps.covariance,
            stamp_time=stamps.time,
            stamp_rate=stamps.rate,
            stamp_turned=stamps.turned,
            ahead=stamps.ahead,
            field=field,
            field_number=field_number,
            head_frame=head_frame,
            head_length=head_length,
            head_end=head_end,
            head_time=head_time,
            head_start=memory.start,
            direction=heading_out.direction,
            sigma=heading_out.sigma,
            iron_variance=heading_out.variance,
            iron=steps.iron,
            field_nis=nis,
            span_field=np.zeros((span, 3)),
            span_time=np.zeros(span),
            span_rate=np.zeros((span, 3)),
            span_force=np.zeros((span, 3)),
            in_span=np.zeros(1, np.int64),
        )

    # ---------------------------------------------------------------------------------------------------------------------- samples

    def update(
        self,
        time: float,
        gyro: ArrayLike,
        accelerometer: ArrayLike | None = None,
        magnetometer: ArrayLike | None = None,
    ) -> None:
        """Process a sample.

        Parameters
        ----------
        time : float
            Stamp of the sample, s.
        gyro : array_like (3,)
            Angular rate, rad/s, body axes.
        accelerometer : array_like (3,), optional
            Specific force, m/s² (not g), body axes. None, NaN or zero: missing.
        magnetometer : array_like (3,), optional
            Field, any unit, body axes. None, NaN or zero: missing.

        Raises
        ------
        InputError
            If the time is not after that of the last sample, or a number of the gyro is missing or infinite. The filter is then unchanged.
        """
        call, name, sample = self._call, "time", time
        rate: Any = gyro
        force: Any = accelerometer
        field: Any = magnetometer
        if field is not None and not self.magnetometer:
            raise InputError("magnetometer is given, but this filter has none; start LiveAhrs(magnetometer=True)")
        try:
            call[0] = time
            name, sample = "gyro", rate
            call[1], call[2], call[3] = rate.tolist() if type(rate) is np.ndarray else rate
            name, sample = "accelerometer", force
            if force is None:
                call[4] = call[5] = call[6] = math.nan
            else:
                call[4], call[5], call[6] = force.tolist() if type(force) is np.ndarray else force
            name, sample = "magnetometer", field
            if field is None:
                call[7] = call[8] = call[9] = math.nan
            else:
                call[7], call[8], call[9] = field.tolist() if type(field) is np.ndarray else field
        except (TypeError, ValueError, OverflowError):
            raise InputError(
                f"{name} is {sample!r}; give {'one number' if name == 'time' else 'three numbers'}"
            ) from None
        if math.isnan(self._rested):
            self._begin()
            return
        code = self._take(self._kind, self._table, kernel.SAMPLE)
        if code:
            self._take_flags(code)

    def _begin(self) -> None:
        """Start at the sample in the call, if it has a specific force and, with a magnetometer, a field."""
        time, *numbers = self._call
        sample = np.array(numbers).reshape(3, 3)
        size = np.linalg.norm(sample, axis=1)
        if not (0.0 < size[1] < math.inf and (not self.magnetometer or 0.0 < size[2] < math.inf)):
            return
        code = self._take(self._kind, self._table, kernel.FIRST_SAMPLE)
        if code >= 0:
            first = Recording(
                source="the first sample",
                time=np.array([time, time + self.interval]),
                rate=np.array([sample[0], sample[0]]),
                specific_force=np.array([sample[1], sample[1]]),
                magnetic_field=np.array([sample[2], sample[2]]) if self.magnetometer else None,
            )
            restart(self._filter, starting.start(first, np.array([[1.0, 0.0, 0.0, 0.0]] * 2), self.parameters), time)
            self._rested = time
            if self.magnetometer:
                self._imu.iron[0] = headings.first_variance(sample[1], sample[2], self.parameters)
            self._take(self._kind, self._table, kernel.START)
        if code:
            self._take_flags(code)

    def _take_flags(self, code: int) -> None:
        """Refuse a sample, or measure the bias at rest and correct it at the end of the step."""
        if code < 0:
            self._refuse(code)
        if code & kernel.REST and self.parameters.rest_bias_sigma > 0.0:
            self._find_rest()
        if code & kernel.STEP and self._rests:
            for rate, sigma in self._rests:
                restart(self._filter, starting.with_rate_at_rest(self._filter.state(), rate, sigma), self._call[0])
            self._rests.clear()

    def _find_rest(self) -> None:
        """Measure the bias, if the unit was at rest over the last span."""
        imu, parameters = self._imu, self.parameters
        parts, part = starting.rest_length(self.interval)
        mean, sigma = starting.mean_rates(imu.span_rate, parts, part, parameters)
        if not sigma[0] < starting.MAX_REST_SIGMA:
            return
        if starting.are_rests(imu.span_time[None], (imu.span_force[None], imu.span_field[None]), mean)[0]:
            time = self._call[0]
            measured = starting.bias_variance(self._bias_variance, time - self._rested, sigma[0], parameters)
            if measured is not None:
                self._bias_variance, self._rested = measured, time
                self._rests.append((mean[0], float(sigma[0])))

    def _refuse(self, code: int) -> NoReturn:
        """Raise the error for a sample that the kernel refuses."""
        if code == TOO_PRECISE:
            raise TooPreciseError()
        time, *numbers = self._call
        raise InputError(
            {
                kernel.NO_TIME: f"time is {time} s; give the time of the sample",
                kernel.BEHIND: f"time is {time:.9g} s, not after the last sample; give samples in order",
                kernel.NO_GYRO: "gyro has a NaN; omit the sample",
                kernel.INFINITE: f"gyro, accelerometer and magnetometer are {numbers}; give finite numbers, rates in rad/s",
                kernel.TOO_FAST: f"the interval of the samples is far below {self.interval:g} s, their usual interval",
            }[code]
        )

    # ------------------------------------------------------------------------------------------------------------------ the estimate

    @property
    def time(self) -> float:
        """Time of the estimate, s: that of the last sample."""
        return float(self._imu.time[1])

    @property
    def attitude(self) -> Array:
        """Attitude q_fb (4,), scalar first; NaN before the first sample of the accelerometer."""
        return np.array(self._found.attitude[1])

    @property
    def bias(self) -> Array:
        """Gyro bias (3,), rad/s, body axes."""
        return np.array(self._found.bias[1])

    @property
    def variance(self) -> Array:
        """Variances of the errors of attitude and bias (6,)."""
        return np.array(self._found.variance[1])

    @property
    def covariance(self) -> Array:
        """Covariance of these errors (6, 6)."""
        return np.array(self._found.covariance[1])


def arrays_of(live: LiveAhrs) -> tuple[kernel.Imu, list[VectorMeasurements]]:
    """Return the kernel's arrays, and the sensors."""
    return live._imu, live._sensors


def _routine(function: Any, *arguments: Any) -> kernel.Routine:
    """Return a kernel of recordings with its arguments."""
    return kernel.Routine(address_of(compiled(function), arguments), arguments)
