"""Kernels: plain scalar Python, one mathematical operation per function, on numbers, tuples, and arrays of the caller.

They do not check their input; the public modules do. :mod:`strapdown.kernels.machine` compiles a kernel when it is first needed. Of the
modules here only those that compile import numba: ``machine``, ``cache``, ``compiler``, ``tracing``, ``packed``, ``lanes``, ``addresses``.
The same source runs as plain Python (in tests and in the step-by-step filter), as a compiled loop over one record, and on the lanes of SIMD
vectors, one record per lane. A function for lanes has no branches that depend on the data, calls no function of ``math`` that the lanes
lack (``sqrt`` is :func:`strapdown.kernels.algebra.square_root`), and creates no arrays; others say that they are for scalars only.

- One loop over a record, whose functions other modules define: ``walk``.
- These modules: ``filter`` (N error states), ``gate`` (the same, gated), ``six_states``, ``analysis``, ``likelihood`` (also with
  ``likelihood_outliers``), ``montecarlo_run`` (noise too, with the filter of ``montecarlo_six`` or ``montecarlo_filter``).
- The filter of N error states: arrays in ``layout``, prediction in ``model``, rows of measurements in ``rows``, updates in ``update``.
- These and the modules that use them are templates: their sizes are known while compiling, and
  :func:`strapdown.kernels.machine.instance` makes copies with these constants.
"""
