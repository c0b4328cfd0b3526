"""Error states as the kernels' arrays, and the states in both orders.

The external order is attitude, bias, then the error states in the order of their declarations. In the kernels the states that change come
before the constant ones, which then cost the prediction almost nothing (:mod:`strapdown.kernels.triangle`).
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from strapdown.checks import Array, InputError, array, one_of
from strapdown.estimation.error_states import Effect, ErrorStates, check, spans
from strapdown.estimation.states import Candidate, State, check_arguments
from strapdown.kernels import error_state_step
from strapdown.kernels.chains import CHAIN, chain_start
from strapdown.kernels.error_state_step import CARRIED, FIXED, FORCE, LEVER, OFFSET, SCALE

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
    blocks = as_blocks(blocks)
    check(blocks)
    size = sum(block.size for block in blocks)
    P = np.zeros((6 + size, 6 + size))
    P[:6, :6] = initial.covariance
    for block, own in spans(blocks):
        P[6:, 6:][own, own] = block.covariance
    return State(attitude=initial.attitude, bias=initial.bias, values=np.zeros(size), covariance=P)


def begin(initial: State, blocks: tuple[ErrorStates, ...]) -> State:
    """Return the initial state; if it has no error states, with those declared, at their prior."""
    check_arguments(initial=initial)
    check(blocks)
    size = sum(block.size for block in blocks)
    if size and not len(initial.values):
        return with_error_states(initial, blocks)
    if len(initial.values) != size:
        raise InputError(
            f"initial has {len(initial.values)} error states, but {size} are declared; declare the same ones"
        )
    return initial


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """Declarations of error states as arrays, in the kernels' order."""

    order: np.ndarray
    """External index of each of the kernels' error states (m,)."""
    decay: Array
    density: Array
    chains: Array
    """Coupling of each state to the next, PSD that drives a chain (then not in ``density``), and for x components of vectors that are
    carried the number of states to the next component (m, 3); no rows if there are neither chains nor carried states."""
    changing: int
    """Number of leading states that decay, are driven, belong to a chain or are carried."""
    limit: float
    """Longest step, s."""
    gyro: Array
    gyro_use: np.ndarray
    sensors: Array
    sensor_use: np.ndarray
    force_f: Array
    """Specific force for the gyro's sensitivity to it (3,), m/s²; zero: not used."""
    varying: frozenset[str] = frozenset()
    """Sensors with effects that are constant in the sensor's own unit."""

    @property
    def levers(self) -> np.ndarray:
        """Which sensors have a lever arm among the states (sensors,), bool."""
        return np.asarray((self.sensor_use & LEVER > 0).any(axis=1))

    @property
    def states(self) -> int:
        """Number of error states."""
        return len(self.order)

    @property
    def loose(self) -> int:
        """Number of leading rows of the factor that a correction leaves non-triangular (:func:`strapdown.kernels.root_form.loose`)."""
        return 6 + self.changing if len(self.chains) else 3

    @property
    def noise_rows(self) -> int:
        """Number of rows of process noise of a step."""
        chained = sum(int(k - chain_start(self.chains, k) + 1) for k in np.flatnonzero(self.chains[:, 1]))
        return 6 + int(np.sum(self.density > 0.0)) + chained

    @property
    def whole_order(self) -> np.ndarray:
        """External index of each of the kernels' states (6 + m,)."""
        return np.concatenate([np.arange(6), 6 + self.order])


def _stack(blocks: Sequence[ErrorStates], name: str, shape: tuple[int, ...]) -> Array:
    return np.concatenate([array(f"{one.name}: {name}", getattr(one, name), (one.size, *shape)) for one in blocks])


def assemble(blocks: tuple[ErrorStates, ...], kinds: Mapping[str, str]) -> Model:
    """Return the model of error states for the named sensors of the given kinds."""
    if not blocks:
        return _empty(len(kinds))
    decay, density = _stack(blocks, "decay", ()), _stack(blocks, "density", ())
    for name, values in (("decay", decay), ("density", density)):
        if np.any(values < 0.0):
            raise InputError(f"{name} of error state {int(np.argmax(values < 0.0))} is negative; give zero or more")
    scales, forces = (_stack(blocks, name, (3, 3)).reshape(-1, 9) for name in ("gyro_scale", "gyro_force"))
    gyro = np.concatenate([_stack(blocks, "gyro_offset", (3,)), scales + forces], axis=1)
    force_f = _force(blocks, np.any(scales != 0.0, axis=1) & np.any(forces != 0.0, axis=1))
    seen = _on_sensors(blocks, kinds, len(decay))
    feed = _feeds(blocks)
    fed = np.append(False, feed != 0.0)[: len(feed)]
    linked = (feed != 0.0) | fed
    moves = (decay > 0.0) | (density > 0.0) | linked | seen.bound
    order = np.argsort(~moves, kind="stable")
    gyro_use = _uses(gyro[:, :3], scales) + FORCE * np.any(forces != 0.0, axis=1)
    if np.any(linked & (gyro_use != 0)):
        raise InputError(
            f"error state {int(np.argmax(linked & (gyro_use != 0)))} belongs to a chain and enters the gyro; give it a feed of 0, or no "
            "effect on the gyro"
        )
    chains = np.stack([feed, np.where(fed, density, 0.0), seen.stride], axis=1)
    quickened = np.where(gyro_use & OFFSET, 5.0, 1.0)
    fastest = float(np.max(decay * quickened, initial=0.0))
    return Model(
        order=order,
        decay=decay[order],
        density=np.where(fed, 0.0, density)[order],
        chains=chains[order] if np.any(linked | seen.bound) else np.empty((0, 3)),
        changing=int(np.sum(moves)),
        limit=MAX_DECAY / fastest if fastest > 0.0 else np.inf,
        gyro=np.ascontiguousarray(gyro[order]),
        gyro_use=gyro_use[order],
        sensors=np.ascontiguousarray(seen.sensors[:, order]),
        sensor_use=np.ascontiguousarray(seen.use[:, order]),
        force_f=force_f,
        varying=seen.varying,
    )


class _Seen(NamedTuple):
    """Effects of the states on the sensors and their use as in :class:`Model`, in the external order."""

    sensors: Array
    use: np.ndarray
    stride: Array
    """The last column of a model's chains."""
    bound: np.ndarray
    """Which states are carried (m,), bool."""
    varying: frozenset[str]


def _on_sensors(blocks: Sequence[ErrorStates], kinds: Mapping[str, str], states: int) -> _Seen:
    sensors = np.zeros((len(kinds), states, 15))
    carried, levered = np.zeros((2, len(kinds), states), bool)
    stride, bound = np.zeros(states), np.zeros(states, bool)
    varying = set()
    names = list(kinds)
    for block, own in spans(blocks):
        for sensor, effect in block.effects.items():
            one_of(f"{block.name}: sensor", sensor, names)
            if kinds[sensor] == "attitude" and (effect.offset_f is not None or effect.scale is not None):
                raise InputError(
                    f"{block.name}: {sensor} gives whole attitudes, for which only an offset_b can be estimated; "
                    "use VectorBias for its mounting"
                )
            _check_lever(block, sensor, kinds[sensor], effect)
            place = names.index(sensor), own
            sensors[place] = _numbers(block, effect)
            carried[place] = effect.carried
            if effect.carried and effect.offset_f is not None:
                _check_carried(block, effect)
                stride[own.start : own.start + block.size // 3] = block.size // 3
                bound[own] = True
            levered[place] = effect.lever is not None
            if effect.varying and kinds[sensor] in ("direction", "heading"):
                varying.add(sensor)
    use = _uses(sensors[..., :3], sensors[..., 6:], sensors[..., 3:6])
    use += (LEVER - OFFSET) * (levered & (use & OFFSET > 0))
    use += CARRIED * (carried & (use & FIXED > 0))
    return _Seen(sensors, use, stride, bound, frozenset(varying))


@functools.cache
def _empty(sensors: int) -> Model:
    """Return the model of a filter without error states."""
    none, unused = np.empty(0), np.empty(0, np.int64)
    return Model(
        order=unused,
        decay=none,
        density=none,
        chains=np.empty((0, 3)),
        changing=0,
        limit=np.inf,
        gyro=np.empty((0, 12)),
        gyro_use=unused,
        sensors=np.empty((sensors, 0, 15)),
        sensor_use=np.empty((sensors, 0), np.int64),
        force_f=np.zeros(3),
    )


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
    for one in known[1:]:
        if not np.array_equal(one, known[0]):
            raise InputError(
                f"two error states give forces {known[0].tolist()} and {one.tolist()}; give both the same gravity_f"
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
            given = array(f"{block.name}: {name}", value, (block.size, *shape)).reshape(block.size, -1)
            rows[:, place : place + given.shape[1]] = given
    return rows


def _uses(offset: Array, scale: Array, fixed: Array | None = None) -> np.ndarray:
    bits = OFFSET * np.any(offset != 0.0, axis=-1) + SCALE * np.any(scale != 0.0, axis=-1)
    if fixed is not None:
        bits = bits + FIXED * np.any(fixed != 0.0, axis=-1)
    return np.asarray(bits, np.int64)


def lower_root(P: Array) -> Array:
    """Return F, lower triangular, with ``P = Fᵀ F``."""
    return np.ascontiguousarray(np.linalg.cholesky(P[::-1, ::-1])[::-1, ::-1].T)


def triangle(state: State | Candidate, model: Model) -> Array:
    """Return F, lower triangular, with ``P = Fᵀ F`` in the kernels' order."""
    order = model.whole_order
    if state.factor is None:
        return lower_root(state.covariance[np.ix_(order, order)])
    root = state.factor[:, order]
    if np.array_equal(root[:, model.loose :], np.tril(root)[:, model.loose :]):  # unchanged, bit for bit
        return np.ascontiguousarray(root)
    return lower(root)


def lower(root: Array) -> Array:
    """Return the lower triangle F with the same ``Fᵀ F``."""
    if np.array_equal(root, np.tril(root)):
        return root
    return np.ascontiguousarray(np.asarray(np.linalg.qr(root[:, ::-1], mode="r"))[::-1, ::-1])


def turning_matrix(chains: Array, size: int, before: Array, after: Array) -> Array:
    """Return the matrix (size, size) by which a correction of the attitude from one q_fb to another transforms the states."""
    T = np.eye(size)
    if len(chains):
        # Rotate the columns of the rows of the identity: this gives Tᵀ row by row.
        error_state_step.turn_columns(chains, error_state_step.fixed_turn(tuple(before), tuple(after)), T, size)
    return T.T


def aged_prior(
    error_states: tuple[ErrorStates, ...], values: Array, covariance: Array, dt: float
) -> tuple[Array, Array]:
    """Return values (m,) and covariance (m, m) of the error states after dt, s, without measurements."""
    transition, driven = np.zeros((2, len(values), len(values)))
    for one, own in spans(error_states):
        transition[own, own], driven[own, own] = one.transition(dt), one.process_noise(dt)
    return transition @ values, transition @ covariance @ transition.T + driven
