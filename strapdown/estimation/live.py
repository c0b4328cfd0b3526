"""The compiled filter for data in real time: :class:`LiveFilter`.

Each gyro interval is treated as a record by :mod:`strapdown.kernels.live`, with the state in the same arrays from one to the next. If
measurements may be late, the filter keeps the state before each interval of its look-back, returns to the interval of a late measurement,
and repeats from there.
"""

from __future__ import annotations

import copy
import math
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import (
    Array,
    InputError,
    array,
    finite,
    instance,
    non_negative,
    one_of,
    positive,
    unit_quaternions,
)
from strapdown.estimation import forward
from strapdown.estimation import model as modelling
from strapdown.estimation.error_states import ErrorStates, temperature_slopes
from strapdown.estimation.features import refuse
from strapdown.estimation.forward import Judge, Options, gate_events, last_lock_outs
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.states import Change, ProcessNoise, State, check_arguments, covariance_matrices
from strapdown.kernels import filter, gate, six_states
from strapdown.kernels import live as kernel
from strapdown.kernels.argument_tables import packed
from strapdown.kernels.machine import address_of, compiled, read_only
from strapdown.kernels.measurement import KIND_CODES, Measurements
from strapdown.kernels.walk import walk
from strapdown.records import Event, ImuRecord, Innovations
from strapdown.vectors import KINDS, VectorMeasurements, VectorSensor, need_level, triad
from strapdown.vectors.measurements import direction

MAX_MEASUREMENTS = 64
"""Maximum number of measurements within one gyro interval."""
ONE_ROW = 1 << 30
"""Number of steps to the next stored row: only the first one is."""
RESERVED = ("self", "time", "gyro", "delta_theta", "sigma", "reference_f")
"""Arguments of :meth:`LiveFilter.update` that are no measurements."""
UPPER = np.triu_indices(3)


class LiveFilter:
    """Multiplicative extended Kalman filter for one sample at a time, compiled: about two microseconds per sample.

    Parameters
    ----------
    process_noise : ProcessNoise
        Noise of the gyro.
    initial : State
        Initial state. The end state of :func:`strapdown.estimation.run_part` continues that run; give its time.
    error_states : sequence of ErrorStates, default ()
        Error states of the gyro and the sensors in addition to attitude and bias.
    sensors : sequence of VectorSensor or VectorMeasurements
        Sensors that :meth:`update` accepts: name, kind, reference and noise (of a series, those of its first sample); for example the
        ``vectors`` of a record. Measurements of one time are processed in this order.
    gate : Gate, optional
        Gate that refuses outliers and recovers from a wrong state.
    robust : Robust, optional
        Robust updates, which weight measurements by their residuals.
    look_back : float, default 0.0
        Maximum delay of a measurement, s. The states of this span are kept in memory. Older measurements are ignored, and counted in
        ``late``.
    time : float, default 0.0
        Time of the initial state, s. The first gyro sample covers the interval from it.

    Raises
    ------
    InputError
        If an argument is invalid, or an error state needs the whole record: a lever arm, a varying field magnitude.

    See Also
    --------
    strapdown.ahrs.LiveAhrs : The same for an IMU, with what :func:`strapdown.estimate` does with its recording.
    StepFilter : The same filter on filterpy, five hundred times slower, for inspection of its steps.

    Notes
    -----
    For the samples of a record, the estimate equals that of :func:`strapdown.estimation.run` bit for bit: the same machine code is called
    for each interval. Late measurements within the look-back give the same bits as those in order. A filter is not thread-safe and cannot
    be copied; start another one from its :meth:`state`.

    Examples
    --------
    >>> import strapdown as sd
    >>> noise = sd.ProcessNoise(angle_random_walk=1e-4, rate_random_walk=1e-6)
    >>> start = sd.initial_state([1.0, 0.0, 0.0, 0.0], attitude_sigma=0.1, bias_sigma=1e-3)
    >>> up = sd.VectorSensor(name="accelerometer", reference_f=[0.0, 0.0, 1.0], sigma=0.02, rate=100.0)
    >>> live = sd.LiveFilter(noise, start, sensors=[up])  # doctest: +SKIP
    >>> live.update(0.01, [0.0, 0.0, 0.1], accelerometer=[0.0, 0.1, 9.8])  # doctest: +SKIP
    >>> live.attitude  # doctest: +SKIP
    """

    def __init__(
        self,
        process_noise: ProcessNoise,
        initial: State,
        error_states: Sequence[ErrorStates] = (),
        *,
        sensors: Sequence[VectorSensor | VectorMeasurements],
        gate: Gate | None = None,
        robust: Robust | None = None,
        look_back: float = 0.0,
        time: float = 0.0,
    ) -> None:
        check_arguments(gate=gate, robust=robust)
        self._time = finite("time", time, unit="s")
        self.look_back = non_negative("look_back", look_back, unit="s")
        instance("sensors", sensors, Sequence, "give a list of sensors")
        series = [template(sensor, self._time) for sensor in sensors]
        for reserved in {vectors.sensor for vectors in series} & set(RESERVED):
            raise InputError(f"a sensor is named {reserved!r}, as an argument of update; give it another name")
        self._sensors = {vectors.sensor: vectors for vectors in series}
        if len(self._sensors) < len(series):
            raise InputError(f"sensors has a name twice: {', '.join(vectors.sensor for vectors in series)}")
        # The kernels process each interval as a record; this one, without rotation, defines its arrays.
        record = ImuRecord(time=self._time + np.arange(2.0), increments=np.zeros((1, 3)), vectors=tuple(series))
        self._problem = forward.prepared(record, process_noise, initial, error_states)
        driven = temperature_slopes(self._problem.error_states) is not None
        refuse("a filter of single samples", record=self._problem.model.of_record, temperature=driven)
        options = Options(every=ONE_ROW, gate=gate, robust=robust)
        self._judge, self._judged = Judge(self._problem, options), options.judged
        self._writers = {
            vectors.sensor: (float(place), vectors.kind == "attitude") for place, vectors in enumerate(series)
        }
        self._prepare(options)
        self._closed: tuple[Event, ...] = ()
        self._intervals: deque[_Interval] = deque()
        self.late = 0
        self.repeated = 0
        if self.look_back:
            self._keep(self._time, 0)

    def _prepare(self, options: Options) -> None:
        """Make the arrays that the kernels work on, and load the kernels."""
        judge, model, sensors = self._judge, self._problem.model, len(self._sensors)
        most = max(MAX_MEASUREMENTS, sensors)
        self._whole = not forward.fits_registers(self._problem, options)
        filter_: Any = (
            forward.filter_body(self._problem, {}) if self._whole else forward.body_in_registers(self._problem)
        )
        # All that changes lies in one array, of which a copy is a snapshot.
        own = [filter_.x, filter_.P] if self._whole else [filter_.state]
        parts = [judge.counters, judge.memory, np.zeros((sensors, 2)), *own]
        sizes = np.cumsum([0, *(part.size for part in parts)])
        self._state = np.zeros(sizes[-1])
        views = [self._state[a:b].reshape(part.shape) for a, b, part in zip(sizes, sizes[1:], parts, strict=False)]
        for view, part in zip(views, parts, strict=True):
            view[...] = part
        judge.counters, judge.memory, self._counts, *own = views
        self._innovation, self._weight = np.zeros((most, 6)), np.ones(most)
        self._events = np.zeros((2 * most + sensors, 5))
        length = np.ones(most)
        self._x: Array
        if self._whole:
            self._x, self._body = own[0][0], filter_._replace(x=own[0], P=own[1], length=length)
        else:
            self._x, self._body = own[0][:7], filter_._replace(state=own[0])
        outputs = forward.outputs if self._whole else forward.outputs_in_registers
        body: Any = self._body
        out: Any = outputs(self._problem, options)[0]._replace(innovation=self._innovation)
        if options.judged:
            out = gate.Outputs(filter=out, weight=self._weight, events=self._events)
            body = judge.body(body)
        kernels = forward.instance_of(model, gate if options.judged else filter) if self._whole else six_states
        self._arrays = self._live(compiled(walk, kernels), body, out, length, 2 if options.judged else 1)
        # Writing to a memory view takes half the time of writing to an array.
        self._call: Any = self._arrays.call.data
        self._report: Any = self._arrays.report.data
        self._table = packed(self._arrays)
        dispatcher = compiled(kernel.step)
        self._kind = dispatcher.typeof_pyval(self._arrays)
        types = dispatcher.typeof_pyval(self._kind), *map(dispatcher.typeof_pyval, (self._table, 0, 0))
        self._step = dispatcher.compile(types)

    def _live(self, dispatcher: Any, body: Any, out: Any, length: Array, results: int) -> kernel.Live:
        """Return the kernel's arrays."""
        sensors, most = list(self._sensors.values()), len(length)
        declared = np.array([_row(vectors, place) for place, vectors in enumerate(sensors)]).reshape(-1, kernel.ROW)
        series = np.array([[KIND_CODES[vectors.kind], 0, 0, 1] for vectors in sensors], np.int64).reshape(-1, 4)
        noisy = most if any(vectors.anisotropic for vectors in sensors) else 0
        edges, increment = np.full(2, self._time), np.zeros(3)
        time, sensor, value = np.zeros(most), np.zeros(most, np.uint8), np.zeros(3 * most)
        sigma, noise, frame = np.ones(most), np.zeros((noisy, 6)), np.zeros((most, 9))
        place = np.arange(most, dtype=np.uint32)
        measured = Measurements(
            *(read_only(column) for column in (time, place, sensor, value, sigma, noise, series, frame))
        )
        arguments = read_only(edges), read_only(increment.reshape(1, 3)), measured, ONE_ROW, body, out
        return kernel.Live(
            address=address_of(dispatcher, arguments),
            arguments=arguments,
            result=(0,) * results,
            holds=int(self.look_back > 0.0),
            call=np.zeros(kernel.FIRST + kernel.STRIDE * len(sensors)),
            clock=np.full(1, self._time),
            edges=edges,
            increment=increment,
            time=time,
            sensor=sensor,
            value=value,
            sigma=sigma,
            noise=noise,
            frame=frame,
            length=length,
            rows=np.zeros((most, kernel.ROW)),
            declared=declared,
            state=self._state,
            before=self._state.copy(),
            counts=self._counts,
            missing=np.zeros(len(sensors)),
            missing_now=np.zeros(len(sensors)),
            innovation=self._innovation,
            weight=self._weight,
            report=np.zeros(5, np.int64),
        )

    # ---------------------------------------------------------------------------------------------------------------------- updates

    def update(
        self,
        time: float,
        gyro: ArrayLike | None = None,
        *,
        delta_theta: ArrayLike | None = None,
        sigma: Mapping[str, float] | None = None,
        reference_f: Mapping[str, ArrayLike] | None = None,
        **measured: ArrayLike | None,
    ) -> None:
        """Propagate by a gyro sample to its time, and update with the measurements of that time.

        Parameters
        ----------
        time : float
            End of the gyro's sample interval, s, and time of the measurements. Without a gyro sample, any time within the last
            ``look_back`` seconds.
        gyro : array_like (3,), optional
            Angular rate over the interval since the last sample, rad/s, body axes.
        delta_theta : array_like (3,), optional
            Alternative to ``gyro``: the rate integrated over the interval, rad. Default: no gyro sample, only measurements.
        sigma : mapping of str to float, optional
            σ of a sensor's measurement in this call, by name, instead of the declared noise.
        reference_f : mapping of str to array_like (3,), optional
            Reference of a sensor's measurement in this call, instead of the declared one.
        **measured : array_like (3,) or (4,)
            Measured vector of each sensor, by name, body axes; for kind ``"attitude"`` the quaternion q_fb. The length of a direction or
            heading is ignored, but not zero. None or NaN: missing.

        Raises
        ------
        InputError
            If a sensor is unknown, a number infinite, a direction zero, a measurement too precise for double precision, or a time out of
            order. The filter is then unchanged.
        """
        if sigma or reference_f:
            self._update_as(time, gyro, delta_theta, sigma or {}, reference_f or {}, measured)
            return
        call, turn, at = self._call, kernel.NO_TURN, kernel.FIRST
        name: str = "time"
        sample: Any = time
        try:
            call[0] = time
            if gyro is not None:
                name, sample, turn = "gyro", gyro, kernel.RATE
                call[1], call[2], call[3] = sample.tolist() if type(sample) is np.ndarray else sample
            if delta_theta is not None:
                name, sample, turn = "delta_theta", delta_theta, turn + kernel.INCREMENT
                call[1], call[2], call[3] = sample.tolist() if type(sample) is np.ndarray else sample
            for name, sample in measured.items():
                call[at], whole = self._writers[name]
                if sample is None:
                    call[at + 1] = math.nan
                elif whole:
                    call[at + 1], call[at + 2], call[at + 3], call[at + 4] = _quaternion(name, sample)
                else:
                    call[at + 1], call[at + 2], call[at + 3] = sample.tolist() if type(sample) is np.ndarray else sample
                at += kernel.STRIDE
        except KeyError:
            one_of("sensor", name, self._sensors)
        except InputError:  # of a quaternion
            raise
        except (TypeError, ValueError, OverflowError):
            raise InputError(
                f"{name} is {sample!r}; give {'one number' if name == 'time' else 'three numbers'}"
            ) from None
        if turn > kernel.INCREMENT:
            raise InputError("both gyro and delta_theta are given; give the rate or its integral")
        code = self._step(self._kind, self._table, len(measured), turn)
        if code < 0:
            self._refuse(code, ("delta_theta", delta_theta) if gyro is None else ("gyro", gyro), measured)
        if turn != kernel.NO_TURN:
            now, self._time = self._time, call[0]
            if self._time == now:
                self.repeated += 1
            elif self.look_back:
                self._keep(now, self._report[kernel.LAST])
        if code == kernel.REPORT:
            self._take_report()
        elif code == kernel.PENDING:
            self._go_back(call[0])

    def _update_as(
        self,
        time: float,
        gyro: ArrayLike | None,
        delta_theta: ArrayLike | None,
        sigma: Mapping[str, float],
        reference: Mapping[str, ArrayLike],
        measured: dict[str, Any],
    ) -> None:
        """Update with another σ or reference of some sensors."""
        for name in (*measured, *sigma, *reference):
            one_of("sensor", name, self._sensors)
        declared = self._arrays.declared
        kept = declared.copy()
        try:
            for name in {*sigma, *reference}:
                place = int(self._writers[name][0])
                declared[place] = _row(_changed(self._sensors[name], sigma.get(name), reference.get(name)), place)
            self.update(time, gyro, delta_theta=delta_theta, **measured)
        finally:
            declared[:] = kept

    def _refuse(self, code: int, gyro: tuple[str, Any], measured: dict[str, Any]) -> NoReturn:
        """Raise the error for a sample that the kernel refuses."""
        time, now, (name, sample) = self._call[0], self._time, gyro
        if code == kernel.TOO_PRECISE:
            raise forward.TooPreciseError()
        if code in (kernel.INFINITE, kernel.NO_DIRECTION):
            name = list(self._sensors)[self._report[kernel.CULPRIT]]
            sample = measured[name]
        raise InputError(
            {
                kernel.NO_TIME: f"time is {time} s; give the time of the sample",
                kernel.AHEAD: f"time is {time:.9g} s, after the filter's {now:.9g} s; give the gyro sample up to it",
                kernel.BEHIND: f"time is {time:.9g} s, before the filter's {now:.9g} s; give samples in order",
                kernel.NO_GYRO: f"{name} has a NaN; omit the sample; the next one then covers both intervals",
                kernel.INFINITE_GYRO: f"{name} is {sample}; give finite numbers",
                kernel.LARGE_GYRO: f"{name} is {sample}, too large for the rotation over {time - now:.6g} s from the last sample at "
                f"{now:.9g} s; check the unit, and that time is that of the initial state",
                kernel.INFINITE: f"{name} is {sample}; give finite numbers, or NaN for a missing measurement",
                kernel.NO_DIRECTION: f"{name} is {sample}, which has no direction; give NaN for a missing measurement",
            }[code]
        )

    def _keep(self, start: float, number: int) -> None:
        """Store the last interval while a measurement may still arrive in it."""
        past, arrays, oldest = self._intervals, self._arrays, self._time - self.look_back - 4.0 * math.ulp(self._time)
        while past and past[0].end < oldest:
            past.popleft()
        rows, increment, before = arrays.rows[:number].copy(), arrays.increment.copy(), arrays.before.copy()
        past.append(_Interval(start, self._time, increment, rows, before, self._closed))

    def _go_back(self, time: float) -> None:
        """Update with the measurements in the rows, which are of the past, and repeat the later intervals."""
        past, number = self._intervals, self._report[kernel.NUMBER]
        # A measurement at the start of an interval belongs to the one before.
        if not past or time < past[0].start or time == past[0].start < past[0].end:
            self.late += number
            return
        first = len(past) - 1
        while first > 0 and past[first].start >= time:
            first -= 1
        here, state, closed = past[first], self._state.copy(), self._closed
        rows = np.concatenate([here.rows, self._arrays.rows[:number]])
        rows = rows[np.lexsort((rows[:, kernel.SENSOR], rows[:, kernel.TIME]))]
        if len(rows) > len(self._weight):
            raise InputError(
                f"there are more than {len(self._weight)} measurements in one gyro interval; give gyro samples between"
            )
        self._intervals = deque(past[k] for k in range(first))
        self._state[:], self._closed = here.before, here.closed
        try:
            for interval in (here._replace(rows=rows), *(past[k] for k in range(first + 1, len(past)))):
                self._repeat(interval)
        except InputError:
            self._intervals, self._closed, self._time, self._state[:] = past, closed, past[-1].end, state
            self._arrays.clock[0] = self._time
            raise

    def _repeat(self, interval: _Interval) -> None:
        """Process an interval again."""
        arrays, number = self._arrays, len(interval.rows)
        arrays.clock[0], self._call[0], arrays.increment[:], arrays.rows[:number] = (
            interval.start,
            interval.end,
            interval.increment,
            interval.rows,
        )
        code = self._step(self._kind, self._table, number, kernel.AGAIN)
        if code == kernel.TOO_PRECISE:
            raise forward.TooPreciseError()
        self._time = interval.end
        self._keep(interval.start, number)
        if code == kernel.REPORT:
            self._take_report()

    def _take_report(self) -> None:
        """Store the events that the gate reports."""
        self._closed += tuple(gate_events(self._events[: self._report[1]], tuple(self._sensors)))

    # ------------------------------------------------------------------------------------------------------------------ the estimate

    @property
    def time(self) -> float:
        """Time of the estimate, s: the end of the last gyro sample."""
        return self._time

    @property
    def attitude(self) -> Array:
        """Attitude q_fb (4,), scalar first."""
        return np.array(self._x[:4])

    @property
    def bias(self) -> Array:
        """Gyro bias (3,), rad/s, body axes."""
        return np.array(self._x[4:7])

    @property
    def values(self) -> Array:
        """Error states (m,), in the order of their declarations."""
        return np.array(self._x[7:])

    @property
    def covariance(self) -> Array:
        """P (6 + m, 6 + m) of the errors (δθ, δb, δc)."""
        if self._whole:
            return forward.covariance_at(self._body, 0)
        return forward.state_of_numbers(self._body.state).covariance

    @property
    def events(self) -> tuple[Event, ...]:
        """Recoveries and lock-outs up to now, in order of time."""
        return forward.in_order([*self._closed, *last_lock_outs(self._judge.counters, self._sensors)])

    @property
    def refused(self) -> dict[str, int]:
        """Number of measurements of each sensor that the gate has refused."""
        return {name: int(n) for name, n in zip(self._sensors, self._counts[:, 0], strict=True)}

    @property
    def skipped(self) -> dict[str, int]:
        """Number of measurements of each sensor that were missing, or headings of a vertical vector."""
        return dict(zip(self._sensors, map(int, self._arrays.missing + self._counts[:, 1]), strict=True))

    @property
    def innovations(self) -> dict[str, Innovations]:
        """Innovations of the measurements in the last gyro interval, by sensor."""
        innovations, number = {}, self._report[kernel.LAST]
        for place, (name, sensor) in enumerate(self._sensors.items()):
            rows = np.flatnonzero(self._arrays.sensor[:number] == place)
            part = self._innovation[rows, : 2 * KINDS[sensor.kind]]
            if len(rows):
                innovations[name] = Innovations(
                    time=self._arrays.time[rows],
                    innovation=part[:, 0::2],
                    variance=part[:, 1::2],
                    weight=self._weight[rows] if self._judged else None,
                )
        return innovations

    def state(self) -> State:
        """Return the present state, from which another filter, live or over a record, can continue.

        Returns
        -------
        State
            Attitude, bias, error states and covariance at ``time``, and the gate's state.
        """
        if not self._whole:
            return forward.state_of_numbers(self._body.state.copy())
        return copy.deepcopy(forward.state_of(self._body, self._judge.gate_memory(self._body), {}))

    def __reduce__(self) -> Any:
        """Raise an error: a copy would share the arrays of the compiled kernel."""
        raise TypeError("a LiveFilter cannot be copied or pickled; start another one from its state()")


def restart(live: LiveFilter, state: State, time: float) -> None:
    """Continue a filter without gate and look-back from another state, of six or of all states, at another time, s."""
    forward.put_state(live._body, modelling.begin(state, live._problem.error_states))
    live._time = live._arrays.clock[0] = time


def change(live: LiveFilter, by: Change) -> None:
    """Change the state of a filter without gate and look-back."""
    forward.change_state(live._body, by)


def arrays_of(live: LiveFilter) -> tuple[kernel.Live, Array, Array, Array]:
    """Return the kernel's arrays; attitude, bias and error states; the numbers of P, and the place in them of its first elements (6, 6)."""
    numbers = live._body.P[0] if live._whole else live._body.state[7:]
    place = np.arange(len(numbers), dtype=np.float64)
    n = len(live._x) - 1
    places = place.reshape(n, -1)[:6, :6] if live._whole else covariance_matrices(place)
    return live._arrays, live._x, numbers, np.ascontiguousarray(places, np.int64)


class _Interval(NamedTuple):
    """A gyro sample and the measurements in it; with a look-back, the first has no duration."""

    start: float
    end: float
    increment: Array
    rows: Array
    before: Array
    """State before it."""
    closed: tuple[Event, ...]
    """Closed events before it."""


# ----------------------------------------------------------------------------------------------------------- what the sensors declare


def template(sensor: VectorSensor | VectorMeasurements, time: float) -> VectorMeasurements:
    """Return one measurement of a sensor as declared."""
    if isinstance(sensor, VectorSensor):
        r = sensor.reference_f
        # The σ of a heading is that across the direction, divided by the horizontal part.
        level = math.hypot(r[0], r[1]) if sensor.kind == "heading" else 1.0
        columns: dict[str, Any] = {"vector_b": r[None], "reference_f": r, "sigma": sensor.sigma / level}
        return VectorMeasurements(sensor=sensor.name, kind=sensor.kind, time=np.array([time]), **columns)
    if not isinstance(sensor, VectorMeasurements):
        raise InputError(f"sensors has {sensor!r}; give vectors.VectorSensor, or the vectors of a record")
    if not len(sensor.time):
        raise InputError(f"{sensor.sensor}: the series is empty, so its noise is unknown; give one with a sample")
    return replace(sensor.taken(slice(0, 1)), time=np.array([time]), arrival=None)


def _changed(series: VectorMeasurements, sigma: float | None, reference: ArrayLike | None) -> VectorMeasurements:
    """Return one measurement of a sensor with another σ or reference."""
    name, changes = series.sensor, dict[str, Any]()
    if reference is not None:
        unit = direction(f"{name}: reference_f", reference)
        r = array(f"{name}: reference_f", reference, (3,)) if series.kind == "vector" else unit
        if series.kind == "heading":
            need_level(f"{name}: reference_f", r)
        changes["reference_f"] = r
    if sigma is not None:
        s = positive(f"{name}: sigma", sigma)
        if not sys.float_info.min <= s * s < math.inf:
            raise InputError(f"{name}: sigma is {s:g}, whose square is beyond double precision; check the unit")
        changes |= {"sigma": np.array([s]), "sigma_axes": None, "covariance": None}
    return replace(series, **changes)


def _row(series: VectorMeasurements, place: int) -> list[float]:
    """Return a measurement for the kernel, as far as its sensor declares it."""
    reference, covariance = series.references_f[0], series.covariances[0]
    length = float(np.linalg.norm(reference)) if series.kind == "vector" else 1.0
    attitude = series.kind == "attitude"
    return [
        *(0.0, float(place)),
        *(np.diag(covariance) if attitude else np.zeros(3)),
        *(np.zeros(9) if attitude else triad(reference).ravel()),
        float(series.sigma[0]) / length,
        *(covariance / np.square(length))[UPPER],
        length,
    ]


def _quaternion(name: str, value: Any) -> list[float]:
    """Return a measured quaternion; NaN if it is missing."""
    q = array(name, value, (4,), allow_nan=True)
    return [math.nan] * 4 if np.isnan(q).any() else list(unit_quaternions(name, q).tolist())
