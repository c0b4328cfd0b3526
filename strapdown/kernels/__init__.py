"""Kernels: plain scalar Python, one operation of the mathematics a function, on scalars and tuples of scalars.

Nothing here checks its input; the public modules above do. No module here imports numba: :mod:`strapdown.kernels.machine` compiles a
kernel when it is first needed. The same source runs as plain Python (the tests do so), as a compiled loop over one record, and over
the lanes of a vector value type. So that it can, a kernel is branch-free in the data, calls no ``math`` function that the lanes lack
(``sqrt`` goes through :func:`strapdown.kernels.algebra.square_root`), and never builds an array.
"""
