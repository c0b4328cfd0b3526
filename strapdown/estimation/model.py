"""Declarations of error states as the structure and the numbers of the compiled filter."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from strapdown import quaternion
from strapdown.checks import Array, InputError, array, one_of
from strapdown.estimation.error_states import Effect, ErrorStates, check, spans, temperature_slopes
from strapdown.estimation.states import State, check_arguments
from strapdown.kernels.chains import CHAIN, chain_start
from strapdown.kernels.measurement import KIND_CODES
from strapdown.kernels.structure import GyroState, Sensor, SensorState, Structure

MAX_DECAY = 0.5
"""Maximum λ dt of one step, for a well conditioned backward step; 0.1 for states that enter the gyro, where Gauss's rule is exact."""


def as_blocks(blocks: Sequence[ErrorStates]) -> tuple[ErrorStates, ...]:
    """Return the declarations as a tuple; a single declaration is refused."""
    if isinstance(blocks, ErrorStates):
        raise InputError(f"error_states is the single declaration {blocks.name}; give a tuple, (…,)")
    if not isinstance(blocks, Iterable):
        raise InputError(f"error_states is {blocks!r}; give a tuple of declarations, () for none")
    return tuple(blocks)


def with_error_states(initial: State, blocks: Sequence[ErrorStates]) -> State:
    """Return a state with error states of zero added, with their declared covariance, independent of attitude and bias."""
    prior = _prior(as_blocks(blocks))
    P = np.zeros((6 + len(prior), 6 + len(prior)))
    P[:6, :6], P[6:, 6:] = initial.covariance, prior
    return State(attitude=initial.attitude, bias=initial.bias, values=np.zeros(len(prior)), covariance=P)


@functools.lru_cache(maxsize=16)
def _prior(blocks: tuple[ErrorStates, ...]) -> Array:
    """Return the covariance of error states with these declarations, which are checked."""
    check(blocks)
    P = np.zeros((sum(block.size for block in blocks),) * 2)
    for block, own in spans(blocks):
        P[own, own] = block.covariance
    return P


def begin(initial: State, blocks: tuple[ErrorStates, ...]) -> State:
    """Return the initial state; if it has no error states, with those declared, at their prior."""
    check_arguments(initial=initial)
    size = len(_prior(blocks))
    if size and not len(initial.values):
        return with_error_states(initial, blocks)
    if len(initial.values) != size:
        raise InputError(
            f"initial has {len(initial.values)} error states, but {size} are declared; declare the same ones"
        )
    return initial


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """Declarations of error states in the form of the kernels: their structure, and its numbers."""

    structure: Structure
    numbers: Array
    """Values of the entries of the structure that are neither 0 nor 1."""
    shape: np.ndarray
    """Index in the sensors of the structure of each sensor."""
    decay: Array
    """λ of each state (m,), 1/s."""
    chains: Array
    """Coupling of each state to the next, and PSD of its driving noise (m, 2)."""
    last: np.ndarray
    """Last error state of the chain of each set of coefficients."""
    limit: float
    """Longest step, s."""
    offsets: Array
    """Effect of each state on the gyro as an offset (m, 3)."""
    force_f: Array
    """Specific force for the gyro's sensitivity to it (3,), m/s²; zero: not used."""
    levers: np.ndarray
    """Which sensors have a lever arm among the states (sensors,), bool."""
    varying: frozenset[str] = frozenset()
    """Sensors with effects that are constant in the sensor's own unit."""

    @property
    def states(self) -> int:
        """Number of error states."""
        return len(self.decay)

    @property
    def of_record(self) -> bool:
        """Whether effects need the whole record: a lever arm, or a measured magnitude that varies."""
        return bool(self.levers.any() or self.varying)

    def turning_matrix(self, before: Array, after: Array) -> Array:
        """Return the matrix (n, n) by which a correction of the attitude from one q_fb to another transforms the other states."""
        T = np.eye(self.structure.n)
        for v in self.structure.vectors:
            turn = quaternion.multiply(after, quaternion.conjugate(before))
            T[np.ix_(v, v)] = quaternion.to_matrix(turn)
        return T


def _stack(blocks: Sequence[ErrorStates], name: str, shape: tuple[int, ...]) -> Array:
    parts = [array(f"{block.name}: {name}", getattr(block, name), (block.size, *shape)) for block in blocks]
    return np.concatenate([np.empty((0, *shape)), *parts])


class _Numbers:
    """Entries of a structure, and the array of the numbers to which they refer; ``generic``: each number but 0 has its own place."""

    def __init__(self, *, generic: bool) -> None:
        self.values: list[float] = []
        self.places: dict[float, int] = {}
        self.generic = generic

    def entries(self, numbers: Array) -> tuple[int | tuple[int], ...]:
        """Return the entry of each number."""
        return tuple(self._entry(x) if x else 0 for x in np.ravel(numbers).tolist())

    def _entry(self, x: float) -> int | tuple[int]:
        if x == 1.0 and not self.generic:
            return 1
        if self.generic or x not in self.places:
            self.places[x] = len(self.values)
            self.values.append(x)
        return (self.places[x],)


def assemble(
    blocks: tuple[ErrorStates, ...], kinds: Mapping[str, str], *, isotropic: bool = True, generic: bool = False
) -> Model:
    """Return the model of error states for the named sensors of the given kinds.

    ``isotropic``: whether one σ gives the noise of each sensor, or three variances that of an attitude. ``generic``: a structure that does
    not depend on the numbers except on which of them are zero; the slopes of the gyro's bias over temperature are an offset of 1 K.

    Without error states, the structure has sensors of all kinds, so that its kernels are compiled only once.
    """
    return _assembled(blocks, tuple(kinds.items()), isotropic, generic)


@functools.lru_cache(maxsize=16)
def _assembled(
    blocks: tuple[ErrorStates, ...], sensors_and_kinds: tuple[tuple[str, str], ...], isotropic: bool, generic: bool
) -> Model:
    """Return the model that :func:`assemble` describes: short records need one model again and again."""
    kinds = dict(sensors_and_kinds)
    decay, density = _not_negative(blocks, "decay"), _not_negative(blocks, "density")
    offsets = _stack(blocks, "gyro_offset", (3,))
    slopes = temperature_slopes(blocks)
    if generic and slopes is not None:
        offsets[slopes] = np.eye(3)
    scales, forces = _stack(blocks, "gyro_scale", (3, 3)), _stack(blocks, "gyro_force", (3, 3))
    force_f = _force(blocks, np.any(scales != 0.0, axis=(1, 2)) & np.any(forces != 0.0, axis=(1, 2)))
    feed = _feeds(blocks)
    entering = np.any(offsets != 0.0, axis=1)
    of_the_gyro = entering | np.any(scales != 0.0, axis=(1, 2)) | np.any(forces != 0.0, axis=(1, 2))
    _need_apart(feed, of_the_gyro)
    numbers = _Numbers(generic=generic)
    groups = np.concatenate([np.full(block.size, generic * i) for i, block in enumerate(blocks)] or [np.empty(0)])
    chains, last, sets = _chains(decay, density, feed, groups)
    gyro = tuple(
        GyroState(
            state=6 + k,
            offset=numbers.entries(offsets[k]),
            decay=sets.get(k, -1) if entering[k] else -1,
            scale=numbers.entries(scales[k]),
            force=numbers.entries(forces[k]),
        )
        for k in np.flatnonzero(of_the_gyro).tolist()
    )
    sensors, vectors, varying = _on_sensors(blocks, kinds, numbers, isotropic=isotropic)
    # Sorted, so that the order of the sensors makes no other structure, whose kernels would be compiled again.
    shapes = tuple(sorted(set(sensors), key=repr))
    if not blocks:
        shapes = tuple(Sensor(code, isotropic, ()) for code in KIND_CODES.values())
    fastest = float(np.max(decay * np.where(entering, 5.0, 1.0), initial=0.0))
    return Model(
        structure=Structure(
            6 + len(decay), gyro, chains, vectors, shapes, 0 if generic or slopes is None else 6 + slopes.start
        ),
        numbers=np.array(numbers.values or [0.0]),
        shape=np.array([shapes.index(sensor) for sensor in sensors], np.int64),
        decay=decay,
        chains=np.stack([feed, density], axis=1),
        last=last,
        limit=MAX_DECAY / fastest if fastest > 0.0 else np.inf,
        offsets=offsets,
        force_f=force_f,
        levers=np.array([any(state.lever for state in sensor.states) for sensor in sensors], bool),
        varying=varying,
    )


def _not_negative(blocks: Sequence[ErrorStates], name: str) -> Array:
    """Return decay or density of each state, checked."""
    values = _stack(blocks, name, ())
    if np.any(values < 0.0):
        raise InputError(f"{name} of error state {int(np.argmax(values < 0.0))} is negative; give zero or more")
    return values


def _need_apart(feed: Array, of_the_gyro: np.ndarray) -> None:
    """Raise an error if a state of a chain enters the gyro."""
    linked = (feed != 0.0) | np.append(False, feed != 0.0)[: len(feed)]
    if np.any(linked & of_the_gyro):
        raise InputError(
            f"error state {int(np.argmax(linked & of_the_gyro))} belongs to a chain and enters the gyro; give it a feed of 0, or no "
            "effect on the gyro"
        )


def _chains(
    decay: Array, density: Array, feed: Array, groups: Array
) -> tuple[tuple[tuple[tuple[int, ...], int], ...], np.ndarray, dict[int, int]]:
    """Return chains and their sets of coefficients, the last state of each set, and the set of each single state.

    Chains of a group with the same numbers share a set.
    """
    chains: list[tuple[tuple[int, ...], int]] = []
    last: list[int] = []
    sets: dict[tuple[tuple[float, ...], ...], int] = {}
    single: dict[int, int] = {}
    k = 0
    while k < len(decay):
        end = k
        while feed[end] != 0.0:
            end += 1
        if end > k or decay[k] > 0.0 or density[k] > 0.0:
            columns = (decay, density, feed, groups)
            key = tuple(zip(*(values[k : end + 1].tolist() for values in columns), strict=True))
            if key not in sets:
                sets[key] = len(last)
                last.append(end)
            chains.append((tuple(range(6 + k, 7 + end)), sets[key]))
            if end == k:
                single[k] = sets[key]
        k = end + 1
    return tuple(chains), np.array(last, np.int64), single


def _on_sensors(
    blocks: Sequence[ErrorStates], kinds: Mapping[str, str], numbers: _Numbers, *, isotropic: bool
) -> tuple[list[Sensor], tuple[tuple[int, int, int], ...], frozenset[str]]:
    """Return each sensor with the states that enter it, the vectors of carried states, and the sensors whose effects vary."""
    states: dict[str, list[SensorState]] = {name: [] for name in kinds}
    vectors: dict[tuple[int, int, int], None] = {}
    varying = set()
    for block, own in spans(blocks):
        for sensor, effect in block.effects.items():
            one_of(f"{block.name}: sensor", sensor, list(kinds))
            if kinds[sensor] == "attitude" and (effect.offset_f is not None or effect.scale is not None):
                raise InputError(
                    f"{block.name}: {sensor} gives whole attitudes, for which only an offset_b can be estimated; "
                    "use VectorBias for its mounting"
                )
            _check_lever(block, sensor, kinds[sensor], effect)
            carried = effect.carried and effect.offset_f is not None
            if carried:
                _check_carried(block, effect)
                third = block.size // 3
                for k in range(6 + own.start, 6 + own.start + third):
                    vectors[(k, k + third, k + 2 * third)] = None
            for k, row in enumerate(_numbers(block, effect)):
                if np.any(row):
                    entries, lever = numbers.entries(row), effect.lever is not None
                    states[sensor].append(
                        SensorState(6 + own.start + k, entries[:3], lever, entries[3:6], carried, entries[6:])
                    )
            if effect.varying and kinds[sensor] in ("direction", "heading"):
                varying.add(sensor)
    sensors = [Sensor(KIND_CODES[kind], isotropic, tuple(sorted(states[name]))) for name, kind in kinds.items()]
    return sensors, tuple(sorted(vectors)), frozenset(varying)


def _feeds(blocks: tuple[ErrorStates, ...]) -> Array:
    """Return the coupling of each state to the next, after a check that chains stay within their declaration."""
    feed = _stack(blocks, "feed", ())
    for block, place in spans(blocks):
        own = feed[place]
        if block.size and own[-1] != 0.0:
            raise InputError(f"{block.name}: feed of the last state is {own[-1]:g}, but no state follows it; give 0")
        longest = max((k - chain_start(own[:, None], k) + 1 for k in range(block.size)), default=0)
        if longest > CHAIN:
            raise InputError(f"{block.name}: a chain of {longest} states; a chain has at most {CHAIN}")
    return feed


def _force(blocks: tuple[ErrorStates, ...], both: np.ndarray) -> Array:
    """Return the specific force of the declarations, which must be the same for all."""
    if both.any():
        raise InputError(f"error state {int(np.argmax(both))} has a gyro_scale and a gyro_force; declare two states")
    known = [np.asarray(b.force_f, np.float64) for b in blocks if np.any(b.force_f)]
    for force in known[1:]:
        if not np.array_equal(force, known[0]):
            raise InputError(
                f"two error states give forces {known[0].tolist()} and {force.tolist()}; give both the same gravity_f"
            )
    return array("force_f", known[0], (3,)) if known else np.zeros(3)


def _check_carried(block: ErrorStates, effect: Effect) -> None:
    """Raise an error unless the states are equal for the three axes, so that a rotation does not change the model."""
    rows = np.asarray(effect.offset_f)
    alike = block.size % 3 == 0 and np.array_equal(rows, np.kron(np.eye(3), rows[: block.size // 3, :1]))
    for name in ("decay", "density", "feed"):
        values = np.asarray(getattr(block, name))
        alike = alike and np.array_equal(values, np.tile(values[: block.size // 3], 3))
    if not alike:
        raise InputError(
            f"{block.name}: carried states rotate with the attitude and must be equal for the axes x, y and z, in this order; give "
            "offset_f as kron(I, a) with the same decay, density and feed for each, or carried=False"
        )


def _check_lever(block: ErrorStates, sensor: str, kind: str, effect: Effect) -> None:
    if effect.lever is None:
        return
    if kind not in ("direction", "vector"):
        raise InputError(
            f"{block.name}: {sensor} is of kind {kind!r}, which a lever arm does not affect; leave these states out"
        )
    if effect.offset_b is not None or effect.offset_f is not None or effect.scale is not None:
        raise InputError(f"{block.name}: a lever arm cannot be combined with another effect; declare both separately")


def _numbers(block: ErrorStates, effect: Effect) -> Array:
    """Return an effect as rows (size, 15)."""
    rows = np.zeros((block.size, 15))
    for name, place, shape in (
        ("offset_b", 0, (3,)),
        ("lever", 0, (3,)),
        ("offset_f", 3, (3,)),
        ("scale", 6, (3, 3)),
    ):
        value = getattr(effect, name)
        if value is not None:
            numbers = array(f"{block.name}: {name}", value, (block.size, *shape)).reshape(block.size, -1)
            rows[:, place : place + numbers.shape[1]] = numbers
    return rows
