"""The filter of :func:`strapdown.estimate` for an IMU in real time: :class:`LiveAhrs`."""

from __future__ import annotations

import functools
import math
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from strapdown import estimation
from strapdown.ahrs import headings, regions, starting
from strapdown.ahrs.parameters import AhrsParameters, error_states, of_motion
from strapdown.ahrs.preparing import GRAVITY
from strapdown.checks import Array, InputError, instance, non_negative, positive
from strapdown.estimation import live as estimation_live
from strapdown.estimation.forward import TooPreciseError
from strapdown.estimation.live import change, restart
from strapdown.kernels import live_imu as kernel
from strapdown.kernels.alignment import UNKNOWN
from strapdown.kernels.alignment import Outputs as Aligned
from strapdown.kernels.alignment import Steps as Alignable
from strapdown.kernels.argument_tables import packed
from strapdown.kernels.live import TOO_PRECISE
from strapdown.kernels.machine import address_of, compiled, read_only
from strapdown.kernels.recording_steps import Carried, Stamps, Steps
from strapdown.recordings.sensor_delays import ASSUMED_SIGMA, GIVEN_SIGMA
from strapdown.records.recording import LARGEST_FORCE, LARGEST_RATE, Recording
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
        The filter's model of the unit and of its motion, such as ``ahrs.MOTIONS["vehicle"][0]``, without a magnetometer ``[1]``.
        Default: that of a unit in the hand.
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
    sample must have a specific force and a field, and its samples no faults (truncation, clipping, gaps, damaged rates). The last row
    differs too, because the end of a recording ends a step of the filter. Samples before the first complete one are not used, nor a damaged
    specific force or field: more than 16 g on an axis, or six times the usual field, for a moment, unless that comes again within ten
    seconds. A damaged rate turns the attitude, and so do zeros or repeated samples in place of lost ones; omit such samples.

    Over a gap the rotation is as uncertain as the rate of the seconds before changes; after one of more than half a second the attitude is
    treated as unknown, and is aligned again by the next samples. ``estimate`` knows the change of the rate from the whole recording.

    The delay of the magnetometer relative to the gyro, which ``estimate`` finds, is taken as zero here. If a short one, τ, is known, such
    as the ``magnetometer_delay`` of a calibration, give the field ``m - τ * np.cross(gyro, m)``.

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
        if not 1e-6 <= self.interval <= starting.QUIET_SPAN:  # the filter holds all samples of a step
            raise InputError(f"interval is {interval:g} s; give that of the samples, 1e-6 to 1 s: 0.01 for 100 Hz")
        instance("magnetometer", magnetometer, bool, "give True or False")
        if parameters is not None:
            instance("parameters", parameters, AhrsParameters, 'such as ahrs.MOTIONS["vehicle"][0]')
        self.magnetometer = magnetometer
        self.parameters = parameters or of_motion("hand", magnetometer=magnetometer)
        late = 0.5 * self.interval if latency is None else non_negative("latency", latency, unit="s")
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
            self.parameters.setup.process_noise,
            estimation.initial_state([1.0, 0.0, 0.0, 0.0], attitude_sigma=1.0, bias_sigma=1.0),
            error_states(self.parameters, *((sensor, kind) for sensor, kind, _ in kinds)),
            sensors=self._sensors,
        )
        self._sample = np.zeros(10)
        self._imu = self._kernel_input(late, ASSUMED_SIGMA if latency is None else GIVEN_SIGMA)
        self._call: Any = self._sample.data
        self._table = packed(self._imu)
        dispatcher = compiled(kernel.take)
        self._kind = dispatcher.typeof_pyval(self._imu)
        self._take = dispatcher.compile(tuple(map(dispatcher.typeof_pyval, (self._kind, self._table, 0))))

    def _kernel_input(self, late: float, delay_sigma: float) -> kernel.Imu:
        """Return the kernel's input before the first sample."""
        parameters, step = self.parameters, max(self.parameters.step, self.interval)
        constants = headings.constants_of(parameters, step)
        self._memory, self._rests = headings.memory_of(constants), starting.memory_of(self.interval, parameters)
        self._at_sample = Carried(*(np.full((2, *shape), np.nan) for shape in ((4,), (3,), (6,), (36,))))
        live, state, numbers, places = estimation_live.arrays_of(self._filter)
        time, gyro, force, field = (x.reshape(-1, 3) if len(x) > 1 else x for x in np.split(self._sample, [1, 4, 7]))
        imu = kernel.Imu(
            filter=live,
            magnetometer=int(self.magnetometer),
            rests=int(parameters.rest_bias_sigma > 0.0),
            interval=self.interval,
            step=parameters.step,
            noise=parameters.specific_force_noise,
            largest_rate=LARGEST_RATE,
            largest_force=LARGEST_FORCE,
            late=late,
            time=time,
            gyro=gyro,
            accelerometer=force,
            magnetic=field,
            arrays=self._first_arrays(step),
            resting=self._rests.resting,
            first=self._memory.start,
            routines=kernel.KERNELS,
            state=state,
            numbers=numbers,
            places=places,
            refused=np.zeros(1, np.int64),
            attitude=np.ones((1, 4)),
            bias=np.ones((1, 3)),
            variance=np.ones((1, 6)),
            covariance=np.ones((1, 6, 6)),
        )
        routines = (
            kernel.Routine(address_of(compiled(function), values), values)
            for function, values in zip(kernel.KERNELS, self._arguments(imu, constants, delay_sigma), strict=True)
        )
        return imu._replace(routines=kernel.Routines(*routines))

    def _first_arrays(self, step: float) -> Any:
        """Return the arrays of the samples before the first one."""
        parameters = self.parameters
        most = MAX_SAMPLES_RATIO * max(1, math.ceil(parameters.step / self.interval)) + 2
        shapes = {
            name: ([most if n == kernel.MOST else n for n in shape], np.int64 if kind == "int" else float)
            for name, (shape, kind, _) in (kernel.LASTING | kernel.PASSING).items()
        }
        arrays: Any = kernel.Arrays(**{name: np.zeros(shape, kind) for name, (shape, kind) in shapes.items()})
        arrays.alignment[:] = starting.alignment_memory(unknown=False)
        arrays.rate_change[0] = kernel.FIRST_RATE_CHANGE
        arrays.force_density[0] = regions.FIRST_DENSITY[0]
        arrays.field_density[0] = regions.FIRST_DENSITY[0]
        arrays.force_averages[:] = regions.first_memory(2, step)
        arrays.field_averages[:] = regions.first_memory(1, parameters.heading_interval)
        return arrays

    def _arguments(self, imu: kernel.Imu, constants: headings.kernel.Constants, delay_sigma: float) -> kernel.Routines:
        """Return the arguments of the kernels of a recording, for one step or one stamp."""
        parameters, a, r = self.parameters, imu.arrays, read_only
        of_force, of_field = map(regions.averages, (max(parameters.step, self.interval), parameters.heading_interval))
        scales = regions.scales_of(parameters, magnetometer=self.magnetometer)
        limits = regions.limits(parameters, delay_sigma, magnetometer=self.magnetometer)
        a.known_before[:] = limits.tilt, limits.heading
        of_heading = a.field_density if self.magnetometer else a.force_density
        estimate = imu.attitude, imu.bias, imu.variance, imu.covariance
        at_step = Steps(
            np.zeros(1, np.int64), *map(r, (*estimate, a.tilt, a.heading, a.iron_variance, a.turned_by_gap))
        )
        stamps = Stamps(r(a.times), r(a.rates), r(a.turns), imu.late, r(a.ahead))
        of_step = a.field_total, a.field_number, a.length, a.middle, a.total, a.number, a.end, a.now, a.turn_variance
        heading = a.heading_direction, a.heading_sigma, a.usual_field, a.subtracted_iron, a.heading_iron_variance
        samples = imu.time, imu.gyro, imu.accelerometer, imu.magnetic if self.magnetometer else imu.magnetic[:0]
        at_rest = starting.kernel.Means(a.rate_at_rest, a.rate_at_rest_variance, a.bias_gained, a.bias_by_rests)
        return kernel.Routines(
            follow=(r(a.times), r(a.rates), a.turns),
            average=(r(a.force), r(a.frame), a.edge, a.total, a.number),
            end=(r(a.frame), a.edge, a.total, a.number, a.mean, a.turn),
            align=(
                starting.alignment_constants(self.interval, parameters),
                Alignable(*map(r, (a.total, a.number, a.field_total[: self.magnetometer], a.field_number, a.end))),
                a.alignment,
                Aligned(a.aligned_force, a.aligned_field, a.aligned_variance),
            ),
            judge=(r(a.force_innovation), of_force, a.force_averages, a.force_density),
            scale=(r(a.force_density), r(of_heading), scales, a.tilt, a.heading),
            carry=(
                at_step,
                stamps,
                limits,
                a.known_before,
                self._at_sample,
            ),
            average_field=(r(a.field), r(a.frame), a.edge, a.field_total, a.field_number),
            head=(
                constants,
                headings.kernel.Steps(*map(r, (*of_step, self._rests.rest_bias))),
                self._memory,
                headings.kernel.Outputs(*heading),
            ),
            judge_field=(r(a.field_innovation), of_field, a.field_averages, a.field_density),
            watch=(
                starting.constants_of(self.interval, parameters, magnetometer=self.magnetometer),
                *map(r, samples),
                self._rests,
                at_rest,
            ),
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
            If the time is not after that of the last sample, or by more than an hour, a number of the gyro is missing, a number is
            infinite, or the specific force is above 1000 m/s². The filter is then unchanged.
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
            wanted = "one number" if name == "time" else "three numbers"
            raise InputError(f"{name} is {sample!r}; give {wanted}") from None
        if self._imu.arrays.count[0] == 0:
            self._begin()
            return
        code = self._take(self._kind, self._table, kernel.SAMPLE)
        if code < 0:
            self._refuse(code)
        if code & kernel.RESTED:
            rests = self._rests
            rate, sigma, gained = rests.rest_rate[0], math.sqrt(rests.rest_variance[0]), float(rests.rest_gained[0])
            measured = {"rate": rate, "sigma": sigma, "gained": gained}
            change(self._filter, functools.partial(starting.take_rate_at_rest, **measured))
            self._imu.resting[1] = 0
        if code & kernel.ALIGNED:
            arrays = self._imu.arrays
            force, field, tilt = arrays.aligned_force[0], arrays.aligned_field[0], float(arrays.aligned_variance[0])
            mean = {"force": force, "field": field, "tilt": tilt, "parameters": self.parameters}
            unknown = arrays.alignment[UNKNOWN] > 0.0
            change(self._filter, functools.partial(starting.align, **mean, unknown=unknown))
            arrays.aligned_variance[0] = 0.0

    def _begin(self) -> None:
        """Start at the sample in the call, if it has a specific force and, with a magnetometer, a field."""
        time, *numbers = self._call
        sample = np.array(numbers).reshape(3, 3)
        size = np.linalg.norm(sample, axis=1)
        if not (0.0 < size[1] < math.inf and (not self.magnetometer or 0.0 < size[2] < math.inf)):
            return
        code = self._take(self._kind, self._table, kernel.CHECK)
        if code < 0:
            self._refuse(code)
        first = Recording(
            source="the first sample",
            time=np.array([time, time + self.interval]),
            rate=np.array([sample[0], sample[0]]),
            specific_force=np.array([sample[1], sample[1]]),
            magnetic_field=np.array([sample[2], sample[2]]) if self.magnetometer else None,
        )
        restart(self._filter, starting.start(first, np.array([[1.0, 0.0, 0.0, 0.0]] * 2), self.parameters), time)
        if self.magnetometer:
            self._imu.arrays.iron_variance[0] = headings.first_variance(sample[1], sample[2], self.parameters)
        self._rests.rest_clock[1] = time
        self._take(self._kind, self._table, kernel.START)

    def _refuse(self, code: int) -> NoReturn:
        """Raise the error for a sample that the kernel refuses."""
        if code == TOO_PRECISE:
            raise TooPreciseError()
        time, *numbers = self._call
        raise InputError(
            {
                kernel.NO_TIME: f"time is {time} s; give the time of the sample",
                kernel.BEHIND: f"time is {time:.9g} s, not after the last sample; give samples in order",
                kernel.AHEAD: f"time is {time:.9g} s, more than an hour after the last sample; start a new LiveAhrs if its clock jumped",
                kernel.NO_GYRO: "gyro has a NaN; omit the sample",
                kernel.INFINITE: f"gyro, accelerometer and magnetometer are {numbers}; give finite numbers, rates in rad/s, "
                f"specific force in m/s² below {LARGEST_FORCE:g}",
                kernel.TOO_FAST: f"the interval of the samples is far below {self.interval:g} s, their usual interval",
            }[code]
        )

    # ------------------------------------------------------------------------------------------------------------------ the estimate

    @property
    def time(self) -> float:
        """Time of the estimate, s: that of the last sample."""
        return float(self._imu.arrays.clock[0])

    @property
    def attitude(self) -> Array:
        """Attitude q_fb (4,), scalar first; NaN before the first sample of the accelerometer."""
        return np.array(self._at_sample.attitude[1])

    @property
    def bias(self) -> Array:
        """Gyro bias (3,), rad/s, body axes."""
        return np.array(self._at_sample.bias[1])

    @property
    def variance(self) -> Array:
        """Variances of the errors of attitude and bias (6,)."""
        return np.array(self._at_sample.variance[1])

    @property
    def covariance(self) -> Array:
        """Covariance of these errors (6, 6)."""
        return np.array(self._at_sample.covariance[1].reshape(6, 6))


def arrays_of(
    live: LiveAhrs,
) -> tuple[kernel.Imu, headings.kernel.Memory, starting.kernel.Memory, list[VectorMeasurements]]:
    """Return the kernel's arrays, the memory of the field and of rests, and the sensors."""
    return live._imu, live._memory, live._rests, live._sensors
