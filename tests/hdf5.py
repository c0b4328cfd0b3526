"""Deliberate changes of the HDF5 files of the package."""

import contextlib

import h5py

from strapdown.files import seal


@contextlib.contextmanager
def changed(path):
    """Open an HDF5 file for changes, and update its digest afterwards."""
    with h5py.File(path, "r+") as file:
        yield file
    seal(path)
