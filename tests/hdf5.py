"""Changing HDF5 files of the package on purpose."""

import contextlib

import h5py

from strapdown.files import seal


@contextlib.contextmanager
def changed(path):
    """An HDF5 file open for changes, with a digest that fits them afterwards."""
    with h5py.File(path, "r+") as file:
        yield file
    seal(path)
