"""Kernels: plain scalar Python, one mathematical operation per function, on scalars and tuples of scalars.

They do not check their input; the public modules do. No module here imports numba: :mod:`strapdown.kernels.machine` compiles a kernel when
it is first needed. The same source runs as plain Python (in tests), as a compiled loop over one record, and on the lanes of SIMD vectors,
one record per lane. For that a kernel has no branches that depend on the data, calls no ``math`` function that the lanes lack (``sqrt`` is
:func:`strapdown.kernels.algebra.square_root`), and creates no arrays.
"""
