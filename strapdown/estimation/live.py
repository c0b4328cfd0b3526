"""The compiled filter for data in real time: :class:`LiveFilter`.

Each gyro interval is treated as a record by :mod:`strapdown.kernels.walk`, with the state in the same arrays from one to the next. If
measurements may be late, the filter keeps the state before
each interval of its look-back, returns to the interval of a late measurement, and repeats from there.
"""

from __future__ import annotations

import copy
import functools
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from strapdown.checks import Array, InputError, array, finite, non_negative, one_of, positive, unit_quaternions
from strapdown.estimation import forward
from strapdown.estimation.error_states import ErrorStates
from strapdown.estimation.forward import Judge, Options, gate_events
from strapdown.estimation.gating import Gate, Robust
from strapdown.estimation.states import ProcessNoise, State, check_arguments
from strapdown.kernels import gate, gate_rules, structure
from strapdown.kernels.machine import compiled, read_only
from strapdown.kernels.measurement import KIND_CODES, Measurements
from strapdown.kernels.walk import walk
from strapdown.records import LARGEST_TURN, Event, ImuRecord, Innovations
from strapdown.vectors import KINDS, VectorMeasurements, VectorSensor, need_level, triad
from strapdown.vectors.sensors import UNIT_TOLERANCE

MOST = 64
"""Maximum number of measurements within one gyro interval."""
UNIT = 2.0 * UNIT_TOLERANCE
"""A measured direction whose squared length differs from 1 by less than this is used without normalisation, as in a record."""
UPPER = np.triu_indices(3)


class LiveFilter:
    """Multiplicative extended Kalman filter for one sample at a time, compiled: a few microseconds per sample.

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
        Maximum delay of a measurement, s. The states of this span are kept in memory.
    time : float, default 0.0
        Time of the initial state, s.

    Raises
    ------
    InputError
        If an argument is invalid, or an error state needs the whole record: a lever arm, a varying field magnitude.

    See Also
    --------
    StepFilter : The same filter on filterpy, two hundred times slower, for inspection of its steps.

    Notes
    -----
    For the samples of a record, the estimate equals that of :func:`strapdown.estimation.run`: bit for bit with error states or a gate,
    otherwise to rounding, because without them the state of a record stays in registers. Late measurements within the look-back give the
    same bits as those in order. A filter is not thread-safe and cannot be copied; start another one from its :meth:`state`.

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
        series = [_template(one, self._time) for one in sensors]
        self._sensors = {one.sensor: _Sensor.of(one, place) for place, one in enumerate(series)}
        if len(self._sensors) < len(series):
            raise InputError(f"sensors has a name twice: {', '.join(one.sensor for one in series)}")
        # The kernels process each interval as a record; this one, without rotation, defines its arrays.
        record = ImuRecord(time=self._time + np.arange(2.0), increments=np.zeros((1, 3)), vectors=tuple(series))
        self._problem = forward.prepared(record, process_noise, initial, error_states)
        if self._problem.model.levers.any() or self._problem.model.varying:
            raise InputError(
                "lever arms, and effects relative to a varying field magnitude, need the whole record; use estimation.run for them"
            )
        self._judge = Judge(self._problem, Options(gate=gate, robust=robust))
        self._judged = gate is not None or robust is not None
        self._prepare()
        self._headings = {one.place for one in self._sensors.values() if one.kind == "heading"}
        self._missing = dict.fromkeys(self._sensors, 0)
        self._closed: tuple[Event, ...] = ()
        self._last: Sequence[_Measured] = ()
        self._intervals: deque[_Interval] = deque()
        self.late = 0
        self.repeated = 0
        if self.look_back:
            self._process(self._time, None, ())

    def _prepare(self) -> None:
        """Make the arrays that the kernels work on, and load the kernel."""
        sensors, model = len(self._sensors), self._problem.model
        body, judge = forward.filter_body(self._problem, {}), self._judge
        kernels = forward.instance_of(model)
        # All that changes lies in one array, of which a copy is a snapshot. Continuing lock-outs are the last rows of the array in which
        # the kernel reports new ones.
        slots = np.zeros((sensors, 4))
        parts = [slots, body.x, body.P, judge.counters, judge.memory, np.zeros((sensors, 2))]
        sizes = np.cumsum([0, *(part.size for part in parts)])
        whole = np.zeros(4 * MOST + sizes[-1])
        self._state = whole[4 * MOST :]
        views = [self._state[a:b].reshape(part.shape) for a, b, part in zip(sizes, sizes[1:], parts, strict=False)]
        for view, part in zip(views, parts, strict=True):
            view[...] = part
        self._slots, x, P, judge.counters, judge.memory, self._counts = views
        self._body = body._replace(x=x, P=P, length=np.ones(MOST))
        self._edges, self._increment = np.full(2, self._time), np.zeros(3)
        self._gyro_stores: Any = self._edges.data, self._increment.data
        self._at = _Slots(anisotropic=not all(one.row.isotropic for one in self._sensors.values()))
        series = [[0, 0, 0, KIND_CODES[one.kind], 0, 1] for one in self._sensors.values()]
        self._series = read_only(np.array(series, np.int64).reshape(-1, 6))
        size = 6 + model.states
        self._innovation, self._weight = np.zeros((MOST, 6)), np.ones(MOST)
        self._weights: Any = self._weight.data
        self._recoveries, self._lock_outs = np.zeros((MOST, 4)), whole[: 4 * (MOST + sensors)].reshape(-1, 4)
        out: Any = structure.Outputs(
            x=np.empty((1, size + 1)),
            variance=np.empty((1, size)),
            covariance=np.empty((0, size, size)),
            whole_variance=np.empty((0, 6)),
            whole_covariance=np.empty((0, 6, 6)),
            innovation=self._innovation,
            segments=np.empty((0, 0)),
        )
        self._given: Any = self._body
        dispatcher = compiled(walk, kernels)
        if self._judged:
            out = gate.Outputs(form=out, weight=self._weight, recoveries=self._recoveries, lock_outs=self._lock_outs)
            self._given = judge.body(self._body)
            dispatcher = compiled(walk, gate, kernels)
        self._out = out
        self._arguments = functools.cache(self._new_arguments)
        # The dispatcher's type inference for sixty arrays takes longer than the update itself.
        self._kernel = dispatcher.compile(tuple(map(dispatcher.typeof_pyval, self._arguments(0, 1))))

    def _new_arguments(self, number: int, intervals: int) -> tuple[Any, ...]:
        """Return the kernel's arguments for this number of measurements and zero or one interval."""
        edges = read_only(self._edges[: intervals + 1])
        increments = read_only(self._increment.reshape(1, 3)[:intervals])
        return edges, increments, self._at.measurements(number, self._series), 1 << 30, self._given, self._out

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
            heading is ignored. None or NaN: missing.

        Raises
        ------
        InputError
            If a sensor is unknown, a number infinite, or a time out of order. The filter is then unchanged.
        """
        now = self._time
        if not math.isfinite(time):
            raise InputError(f"time is {time} s; give the time of the sample")
        increment = None
        if gyro is not None or delta_theta is not None:
            increment = self._increment_to(time, gyro, delta_theta)
        elif time > now:
            raise InputError(f"time is {time:.9g} s, after the filter's {now:.9g} s; give the gyro sample up to it")
        events = self._events(time, measured, sigma, reference_f)
        if increment is not None and time > now:
            self._process(time, increment, events)
            return
        self.repeated += increment is not None
        if events and not self.look_back and time == now:
            self._process(now, None, events)
        elif events:
            self._go_back(time, events)

    def _increment_to(self, time: float, gyro: ArrayLike | None, delta_theta: ArrayLike | None) -> _Three:
        """Return the gyro's increment up to a time."""
        dt = time - self._time
        if dt < 0.0:
            raise InputError(f"time is {time:.9g} s, before the filter's {self._time:.9g} s; give samples in order")
        if gyro is not None and delta_theta is not None:
            raise InputError("both gyro and delta_theta are given; give the rate or its integral")
        name = "delta_theta" if gyro is None else "gyro"
        given = _three(name, delta_theta if gyro is None else gyro)
        if given is None:
            raise InputError(f"{name} has a NaN; omit the sample; the next one then covers both intervals")
        x, y, z = given
        if gyro is not None:
            x, y, z = x * dt, y * dt, z * dt
        if not max(abs(x), abs(y), abs(z)) <= LARGEST_TURN:
            raise InputError(f"{name} is {given}, too large for the rotation between two samples; check the unit")
        return x, y, z

    def _events(
        self,
        time: float,
        measured: dict[str, Any],
        sigma: Mapping[str, float] | None,
        reference: Mapping[str, ArrayLike] | None,
    ) -> list[_Measured]:
        """Return the measurements of a call in the order of the sensors, without missing ones."""
        sensors = self._sensors
        if sigma or reference or not measured.keys() <= sensors.keys():
            for name in (*measured, *(sigma or ()), *(reference or ())):
                one_of("sensor", name, sensors)
            changed = {*(sigma or ()), *(reference or ())}
            sensors = sensors | {
                name: sensors[name].changed((sigma or {}).get(name), (reference or {}).get(name)) for name in changed
            }
        events, missing = [], []
        for name, value in measured.items():
            event = None if value is None else sensors[name].measured(time, value)
            if event is None:
                missing.append(name)
            else:
                events.append(event)
        for name in missing:  # only after all of them have passed the checks
            self._missing[name] += 1
        if len(events) > 1:
            events.sort(key=_order)
        return events

    def _go_back(self, time: float, events: list[_Measured]) -> None:
        """Update with measurements of the past, and repeat the later intervals."""
        past = self._intervals
        later: list[_Interval] = []
        # A measurement at the start of an interval belongs to the one before.
        if not past or time < past[0].start or time == past[0].start < past[0].end:
            self.late += len(events)
            return
        while len(past) > 1 and past[-1].start >= time:
            later.append(past.pop())
        here = past.pop()
        if len(here.events) + len(events) > MOST:
            past.extend([here, *reversed(later)])
            raise InputError(f"there are more than {MOST} measurements in one gyro interval; give gyro samples between")
        (self._state[:], self._closed), self._time = here.before, here.start
        self._process(here.end, here.increment, sorted([*here.events, *events], key=_order))
        for one in reversed(later):
            self._process(one.end, one.increment, one.events)

    def _process(self, end: float, increment: _Three | None, events: Sequence[_Measured]) -> None:
        """Walk over an interval from the present state, and store it while a measurement may still arrive in it."""
        number = len(events)
        if number > MOST:
            raise InputError(f"there are more than {MOST} measurements in one gyro interval; give gyro samples between")
        if self.look_back:
            past, oldest = self._intervals, end - self.look_back - 4.0 * math.ulp(end)
            while past and past[0].end < oldest:
                past.popleft()
            past.append(_Interval(self._time, end, increment, events, (self._state.copy(), self._closed)))
        edges, turn = self._gyro_stores
        edges[0], edges[1] = self._time, end
        if increment is not None:
            turn[0], turn[1], turn[2] = increment
        if number:
            self._at.fill(events, self._body.length)
        result = self._kernel(*self._arguments(number, 0 if increment is None else 1))
        self._time = end
        self._last = events
        if number and (self._judged or self._headings):
            self._count(events)
        if self._judged and (result[1] or result[2]):
            self._report(*result[1:])

    def _count(self, events: Sequence[_Measured]) -> None:
        """Count refused measurements and headings of vertical vectors."""
        for k, (_, sensor, *_) in enumerate(events):
            if sensor in self._headings and math.isnan(self._innovation[k, 0]):
                self._counts[sensor, 1] += 1.0
            elif self._judged and self._weights[k] == 0.0:
                self._counts[sensor, 0] += 1.0

    def _report(self, recovered: int, locked: int) -> None:
        """Store the events that the gate reports."""
        self._closed += self._reported(self._recoveries[:recovered], self._slots[:0])
        opened = self._judge.counters[:, gate_rules.REPORTED]
        for k, row in enumerate(self._lock_outs[:locked]):
            sensor = int(row[2])
            self._closed += self._reported(self._recoveries[:0], self._slots[sensor : sensor + 1])
            self._slots[sensor] = row
            if opened[sensor] == k:  # if it continues, the kernel finds it in that row
                opened[sensor] = MOST + sensor

    def _reported(self, recoveries: Array, lock_outs: Array) -> tuple[Event, ...]:
        return tuple(gate_events(recoveries, lock_outs, tuple(self._sensors)))

    # ------------------------------------------------------------------------------------------------------------------ the estimate

    @property
    def time(self) -> float:
        """Time of the estimate, s: the end of the last gyro sample."""
        return self._time

    @property
    def attitude(self) -> Array:
        """Attitude q_fb (4,), scalar first."""
        return np.array(self._body.x[0, :4])

    @property
    def bias(self) -> Array:
        """Gyro bias (3,), rad/s, body axes."""
        return np.array(self._body.x[0, 4:7])

    @property
    def values(self) -> Array:
        """Error states (m,), in the order of their declarations."""
        return np.array(self._body.x[0, 7:])

    @property
    def covariance(self) -> Array:
        """P (6 + m, 6 + m) of the errors (δθ, δb, δc)."""
        return forward.covariance_at(self._body, 0)

    @property
    def events(self) -> tuple[Event, ...]:
        """Recoveries and lock-outs up to now, in order of time."""
        found = self._closed + self._reported(self._recoveries[:0], self._slots)
        return tuple(sorted(found, key=lambda event: event.start))

    @property
    def refused(self) -> dict[str, int]:
        """Number of measurements of each sensor that the gate has refused."""
        return {name: int(n) for name, n in zip(self._sensors, self._counts[:, 0], strict=True)}

    @property
    def skipped(self) -> dict[str, int]:
        """Number of measurements of each sensor that were missing, or headings of a vertical vector."""
        return {n: self._missing[n] + int(k) for n, k in zip(self._sensors, self._counts[:, 1], strict=True)}

    @property
    def innovations(self) -> dict[str, Innovations]:
        """Innovations of the measurements in the last gyro interval, by sensor."""
        found = {}
        for place, (name, sensor) in enumerate(self._sensors.items()):
            rows = [k for k, one in enumerate(self._last) if one[1] == place]
            part = self._innovation[rows, : 2 * KINDS[sensor.kind]]
            if rows:
                found[name] = Innovations(
                    time=np.array([self._last[k][0] for k in rows]),
                    innovation=part[:, 0::2],
                    variance=part[:, 1::2],
                    weight=self._weight[rows] if self._judged else None,
                )
        return found

    def state(self) -> State:
        """Return the present state, from which another filter, live or over a record, can continue.

        Returns
        -------
        State
            Attitude, bias, error states and covariance at ``time``, and the gate's state.
        """
        model, memory = self._problem.model, self._judge.memory
        candidate = forward.candidate_of(self._body, model) if memory[gate_rules.CANDIDATE] else None
        return copy.deepcopy(forward.state_of(self._body, model, self._judge.remembered(candidate), {}))

    def __reduce__(self) -> Any:
        """Raise an error: a copy would share the arrays of the compiled kernel."""
        raise TypeError("a LiveFilter cannot be copied or pickled; start another one from its state()")


# ----------------------------------------------------------------------------------------------------------- measurements, one by one

_Three = tuple[float, float, float]


class _Row(NamedTuple):
    """Data of a measurement for the kernels, except its value."""

    frame: tuple[float, ...]
    """Triad of the reference by rows (9), or the measured quaternion and zeros."""
    length: float
    """Length of the reference of a whole vector; else 1."""
    sigma: float
    """σ over that length."""
    noise: tuple[float, ...]
    """Upper triangle of the covariance in body axes over the squared length (6)."""
    variances: _Three
    """Variances of the body axes; the value of an attitude."""
    isotropic: bool
    """Whether σ, or for an attitude the variances of the axes, define the noise completely."""


_Measured = tuple[float, int, _Three, _Row]
"""A measurement: time, index of its sensor, value and further data."""


def _order(one: _Measured) -> tuple[float, int]:
    return one[0], one[1]


@dataclass(frozen=True, eq=False)
class _Sensor:
    """Declaration of a sensor."""

    name: str
    kind: str
    place: int
    reference_f: Array
    covariance: Array
    sigma: float
    row: _Row

    @staticmethod
    def of(series: VectorMeasurements, place: int) -> _Sensor:
        reference, noise, sigma = series.references_f[0], series.covariances[0], float(series.sigma[0])
        row = _row(series.kind, reference, noise, not series.anisotropic, sigma)
        return _Sensor(series.sensor, series.kind, place, reference, noise, sigma, row)

    def changed(self, sigma: float | None, reference: ArrayLike | None) -> _Sensor:
        """Return the sensor with another σ or reference."""
        r = self.reference_f
        if reference is not None:
            given = _three(f"{self.name}: reference_f", reference)
            if given is None or not any(given):
                raise InputError(f"{self.name}: reference_f is {reference}; give a direction")
            r = np.array(given if self.kind == "vector" else _unit(given))
            if self.kind == "heading":
                need_level(f"{self.name}: reference_f", r)
        s, covariance = self.sigma, self.covariance
        if sigma is not None:
            s = positive(f"{self.name}: sigma", sigma)
            covariance = s**2 * np.eye(3)
        return replace(self, row=_row(self.kind, r, covariance, self.row.isotropic, s))

    def measured(self, time: float, value: Any) -> _Measured | None:
        """Return a measurement; None if it is missing, or a direction of length zero."""
        row = self.row
        if self.kind == "attitude":
            q = np.asarray(value, np.float64)
            if q.shape == (4,) and np.isnan(q).any():
                return None
            frame = (*unit_quaternions(self.name, array(self.name, q, (4,))).tolist(), 0.0, 0.0, 0.0, 0.0, 0.0)
            return time, self.place, row.variances, row._replace(frame=frame)
        z = _three(self.name, value)
        if z is None:
            return None
        if self.kind == "vector":
            return time, self.place, (z[0] / row.length, z[1] / row.length, z[2] / row.length), row
        x, y, w = z
        squared = x * x + y * y + w * w
        if not -UNIT < squared - 1.0 < UNIT:
            if squared == 0.0:
                return None
            z = _unit(z)
        return time, self.place, z, row


def _template(sensor: VectorSensor | VectorMeasurements, time: float) -> VectorMeasurements:
    """Return one measurement of a sensor as declared."""
    if isinstance(sensor, VectorSensor):
        r = sensor.reference_f
        # The σ of a heading is that across the direction, divided by the horizontal part.
        level = math.hypot(r[0], r[1]) if sensor.kind == "heading" else 1.0
        given: dict[str, Any] = {"vector_b": r[None], "reference_f": r, "sigma": sensor.sigma / level}
        return VectorMeasurements(sensor=sensor.name, kind=sensor.kind, time=np.array([time]), **given)
    if not isinstance(sensor, VectorMeasurements):
        raise InputError(f"sensors has {sensor!r}; give vectors.VectorSensor, or the vectors of a record")
    if not len(sensor.time):
        raise InputError(f"{sensor.sensor}: the series is empty, so its noise is unknown; give one with a sample")
    return replace(sensor.taken(slice(0, 1)), time=np.array([time]), arrival=None)


def _row(kind: str, reference_f: Array, covariance: Array, isotropic: bool, sigma: float) -> _Row:
    """Return the row of a measurement with this noise."""
    length = float(np.linalg.norm(reference_f)) if kind == "vector" else 1.0
    x, y, z = np.diag(covariance).tolist()
    return _Row(
        frame=(0.0,) * 9 if kind == "attitude" else tuple(triad(reference_f).ravel().tolist()),
        length=length,
        sigma=sigma / length,
        noise=tuple((covariance / np.square(length))[UPPER].tolist()),
        variances=(x, y, z),
        isotropic=isotropic,
    )


def _three(name: str, value: Any) -> _Three | None:
    """Return three numbers, or None if one is NaN."""
    try:
        x, y, z = value.tolist() if isinstance(value, np.ndarray) else value
        total = x + y + z
        if math.isfinite(total):
            return x, y, z
        infinite = math.isinf(x) or math.isinf(y) or math.isinf(z)
    except (TypeError, ValueError):
        raise InputError(f"{name} is {value!r}; give three numbers") from None
    if infinite:
        raise InputError(f"{name} is {value}; give finite numbers, or NaN for a missing measurement")
    return None


def _unit(vector: _Three) -> _Three:
    x, y, z = vector
    norm = math.hypot(x, y, z)
    return x / norm, y / norm, z / norm


class _Interval(NamedTuple):
    """A gyro sample and the measurements in it; with a look-back, the first has no duration."""

    start: float
    end: float
    increment: _Three | None
    events: Sequence[_Measured]
    before: tuple[Array, tuple[Event, ...]]
    """State and closed events before it."""


class _Slots:
    """Arrays of the measurements of an interval, one after the other, for the kernels."""

    def __init__(self, *, anisotropic: bool) -> None:
        self.time, self.sigma = np.zeros(MOST), np.ones(MOST)
        self.sensor = np.zeros(MOST, np.uint8)
        self.value, self.frame = np.zeros(3 * MOST), np.zeros((MOST, 9))
        self.noise = np.zeros((MOST if anisotropic else 0, 6))
        self.place = np.arange(MOST, dtype=np.uint32)
        # Writing to a memory view takes half the time of writing to an array.
        self.stores: Any = self.time.data, self.sensor.data, self.value.data
        self.rows: list[_Row | None] = [None] * MOST
        """Data of the last measurement in each slot, except its value."""

    def measurements(self, number: int, series: np.ndarray) -> Measurements:
        """Return the first measurements as the kernels' arguments."""
        return Measurements(
            time=read_only(self.time[:number]),
            place=read_only(self.place[:number]),
            sensor=read_only(self.sensor[:number]),
            value=read_only(self.value),
            sigma=read_only(self.sigma),
            noise=read_only(self.noise),
            series=series,
            triads=read_only(self.frame),
        )

    def fill(self, events: Sequence[_Measured], length: Array) -> None:
        """Write measurements, and to ``length`` the divisors of their effects."""
        (times, sensors, value), rows = self.stores, self.rows
        for k, (time, sensor, z, row) in enumerate(events):
            times[k] = time
            sensors[k] = sensor
            i = 3 * k
            value[i], value[i + 1], value[i + 2] = z
            if rows[k] is not row:
                rows[k] = row
                self.frame[k], self.sigma[k], length[k] = row.frame, row.sigma, row.length
                if len(self.noise):
                    self.noise[k] = row.noise
