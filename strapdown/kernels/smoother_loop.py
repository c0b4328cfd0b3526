"""The smoother over whole records: backward passes over the segments that the filter stored."""

from __future__ import annotations

from strapdown.kernels.smoother_step import smooth


def locate_edges(edges, event_time, segments, number, starts_out):
    """Write for each edge the number of the segment that starts there; for the last edge, ``number``.

    Follows the filter's own steps (:func:`strapdown.kernels.filter_loop.run_filter`) in its own arithmetic, so nothing is compared within
    a tolerance: a stored dt that reaches the next event or edge is *equal* to the difference of the times.
    """
    e = 0
    k = 1
    now = edges[0]
    starts_out[0] = 0
    for j in range(number):
        while e < len(event_time) and event_time[e] <= now:
            e += 1
        stop = edges[k]
        if e < len(event_time) and event_time[e] < stop:
            stop = event_time[e]
        dt = segments[j, 0]
        now = stop if dt == stop - now else now + dt
        if now >= edges[k]:
            starts_out[k] = j + 1
            k += 1
    return k


def smooth_back(
    segments, starts, first, last, angle_variance, rate_variance, attitude_out, bias_out, variance_out, covariance_out
):
    """Run backward passes: pass p goes from the filtered state at edge ``last[p]`` to edge ``first[p]`` and writes every row on its way.

    ``segments`` is the filter's (dt, increment, state at its start), with one row more that holds the end state; ``starts[k]`` is the row
    that starts at edge k. Where passes overlap, the later pass stands.
    """
    for p in range(len(first)):
        k = last[p]
        j = starts[k]
        row = segments[j]
        q = (row[4], row[5], row[6], row[7])
        b = (row[8], row[9], row[10])
        A = (row[11], row[12], row[13], row[14], row[15], row[16])
        B = (row[17], row[18], row[19], row[20], row[21], row[22], row[23], row[24], row[25])
        C = (row[26], row[27], row[28], row[29], row[30], row[31])
        while True:
            if j == starts[k]:
                attitude_out[k, 0], attitude_out[k, 1], attitude_out[k, 2], attitude_out[k, 3] = q
                bias_out[k, 0], bias_out[k, 1], bias_out[k, 2] = b
                variance_out[k, 0], variance_out[k, 1], variance_out[k, 2] = A[0], A[3], A[5]
                variance_out[k, 3], variance_out[k, 4], variance_out[k, 5] = C[0], C[3], C[5]
                if k < len(covariance_out):
                    for i in range(6):
                        covariance_out[k, i] = A[i]
                        covariance_out[k, 15 + i] = C[i]
                    for i in range(9):
                        covariance_out[k, 6 + i] = B[i]
                if k == first[p]:
                    break
                k -= 1
            j -= 1
            row = segments[j]
            q, b, A, B, C = smooth(
                (row[4], row[5], row[6], row[7]),
                (row[8], row[9], row[10]),
                (row[11], row[12], row[13], row[14], row[15], row[16]),
                (row[17], row[18], row[19], row[20], row[21], row[22], row[23], row[24], row[25]),
                (row[26], row[27], row[28], row[29], row[30], row[31]),
                (row[1], row[2], row[3]),
                row[0],
                angle_variance,
                rate_variance,
                q,
                b,
                A,
                B,
                C,
            )
