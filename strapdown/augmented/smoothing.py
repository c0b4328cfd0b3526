"""The fixed-interval smoother with optional states: attitude, bias and blocks at each edge from all measurements of the record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from strapdown import kinematics, mekf, quaternion
from strapdown.augmented import filtering
from strapdown.augmented import model as modelling
from strapdown.augmented.blocks import Block, LinearBlock
from strapdown.augmented.filtering import AugmentedEstimate
from strapdown.augmented.model import AugmentedState
from strapdown.checks import InputError, count
from strapdown.kernels import augmented_loop, smoother_loop
from strapdown.kernels.augmented_chain import LINKS
from strapdown.kernels.machine import compiled
from strapdown.mekf import ProcessNoise
from strapdown.records import ImuRecord
from strapdown.robustness import Gate, Robust


def recentred(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: mekf.State | AugmentedState,
    blocks: Sequence[Block] = (),
    *,
    passes: int = 2,
) -> AugmentedState:
    """Return the start moved to what the smoother makes of it, as uncertain as it was.

    From a start that is off by tenths of a radian the first measurements are linearised at the wrong place, and the filter believes for
    good to know what nothing has shown. Started anew from here it is linearised where it belongs. The record is used once for the place
    and once for the estimate, which counts the prior too little by ``1/s²`` of its information, s the singular value of
    :func:`strapdown.augmented.observability`: for records that show a state much better than the prior.
    """
    blocks = modelling.as_blocks(blocks)
    state = modelling.begin(initial, blocks)
    for _ in range(count("passes", passes)):
        whole = smooth(record, process_noise, state, blocks)
        # The prior's tangent space goes along: exp(a + ε) = exp(a) ⊗ exp(J_r(a) ε).
        carry = np.eye(len(state.covariance))
        a = quaternion.log(quaternion.multiply(quaternion.conjugate(state.attitude), whole.attitude[0]))
        carry[:3, :3] = kinematics.right_jacobian(a)
        state = AugmentedState(
            attitude=whole.attitude[0],
            bias=whole.bias[0],
            values=np.concatenate([np.empty(0), *(block.values[0] for block in whole.blocks.values())]),
            covariance=carry @ state.covariance @ carry.T,
        )
    return state


def smooth(
    record: ImuRecord,
    process_noise: ProcessNoise,
    initial: mekf.State | AugmentedState,
    blocks: Sequence[Block] = (),
    *,
    full_covariance: bool = False,
    gate: Gate | None = None,
    robust: Robust | None = None,
) -> AugmentedEstimate:
    """Return the smoother's estimate at every edge (Rauch, Tung & Striebel 1965, on the manifold and on triangular factors).

    Innovations are the filter's; ``gate`` and ``robust`` are as for :func:`strapdown.augmented.run`. Linear blocks only. Memory:
    8 (n (n + 1)/2 + n + 5) bytes for each gyro interval and measurement, n states: 1.7 kB at n = 18.
    """
    blocks = modelling.as_blocks(blocks)
    state = modelling.begin(initial, blocks)
    if modelling.general(blocks):
        names = [block.name for block in blocks if modelling.general((block,))]
        raise InputError(f"the smoother takes linear blocks only, not {', '.join(names)}; leave it out")
    events, model = filtering.prepared(record, blocks)
    segments = filtering.most_segments(record, model, len(events.time))
    forward, _, stored = filtering.run_events(
        record,
        events,
        model,
        process_noise,
        state,
        blocks,
        every=len(record.time),
        segments=segments,
        gate=gate,
        robust=robust,
    )
    edges, size, noise = len(record.time), 6 + model.states, model.noise_rows
    starts = np.empty(edges, np.int64)
    compiled(smoother_loop.locate_edges)(record.time, events.time, stored, len(stored) - 1, starts)
    attitude, x, variance = np.empty((edges, 4)), np.empty((edges, size - 3)), np.empty((edges, size))
    P = np.empty((edges if full_covariance else 0, size, size))
    compiled(augmented_loop.smooth_augmented)(
        stored,
        starts,
        process_noise.angle_random_walk**2,
        process_noise.rate_random_walk**2,
        model.decay,
        model.density,
        model.changing,
        model.gyro,
        model.gyro_use,
        tuple(model.force_f.tolist()),
        model.chains,
        np.empty((len(model.chains), LINKS)),
        np.empty(size - 3),
        np.empty((size + noise, size + noise)),
        np.empty(size - 3),
        np.empty((size + noise + 1, size)),
        np.empty((noise, size)),
        (np.empty((model.states, 3)), np.empty(model.states), np.empty((noise, size)), np.empty(size + noise)),
        attitude,
        x,
        variance,
        P,
    )
    found = filtering.packed(
        model,
        blocks,
        record.time,
        1,
        attitude,
        x,
        variance,
        P if full_covariance else None,
        forward.innovations,
        forward.skipped,
    )
    # The way back leaves what is known relative to the attitude relative to the filter's.
    turn = quaternion.multiply(attitude, quaternion.conjugate(stored[starts, 4:8]))
    told = {
        block.name: replace(found.blocks[block.name], values=block.retold(found.blocks[block.name].values, turn))
        for block in blocks
        if isinstance(block, LinearBlock)
    }
    return replace(found, blocks=told)
