"""Record loops of the Allan variance: the phase of a rate record, and second differences of the phase."""

from __future__ import annotations


def accumulate(rate, mean, phase):
    """Fill phase (n + 1,) with the running sum of rate (n,) − mean, from 0.

    The rounding error of the sum is accumulated in a second word (Knuth's two-sum), so every stored value is the exact sum, rounded once; a
    plain running sum loses √n to n units in the last place.
    """
    high = 0.0
    low = 0.0
    phase[0] = 0.0
    for k in range(rate.shape[0]):
        value = rate[k] - mean
        total = high + value
        back = total - high
        low += (high - (total - back)) + (value - back)
        high = total
        phase[k + 1] = high + low


def second_difference_squares(phase, multiples, lanes, carries, squares):
    """Fill squares with Σ (x[k + 2m] − 2 x[k + m] + x[k])² over all k, for each m of multiples.

    ``lanes`` and ``carries``, one per multiple, are scratch. The record is read once, in blocks that stay in the cache for all m. Each lane
    sums every len(lanes)-th square of a block, so the inner loop runs at vector width; the blocks are summed with compensation (Kahan). The
    rounding error is a few units in the last place for any length.
    """
    width = lanes.shape[0]
    stretch = 32 * width
    for j in range(multiples.shape[0]):
        squares[j] = 0.0
        carries[j] = 0.0
    for first in range(0, phase.shape[0], stretch):
        for j in range(multiples.shape[0]):
            m = multiples[j]
            last = min(first + stretch, phase.shape[0] - 2 * m)
            if last <= first:
                continue
            for i in range(width):
                lanes[i] = 0.0
            for start in range(first, last, width):
                length = min(width, last - start)
                a = phase[start : start + length]
                b = phase[start + m : start + m + length]
                c = phase[start + 2 * m : start + 2 * m + length]
                for i in range(length):
                    d = (c[i] - b[i]) - (b[i] - a[i])
                    lanes[i] += d * d
            total = 0.0
            for i in range(width):
                total += lanes[i]
            total -= carries[j]
            raised = squares[j] + total
            carries[j] = (raised - squares[j]) - total
            squares[j] = raised
