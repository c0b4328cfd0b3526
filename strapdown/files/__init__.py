"""Files: every file is read through ``reading`` and written through ``writing``.

- ``reading``: Limits of size, errors that name the file, digests.
- ``writing``: Atomic writing, locks, digests.
- ``tables``: Frozen dataclasses as TOML and JSON tables with the unit in each key.
- ``extras``: Optional libraries.
"""

from __future__ import annotations

from strapdown.files.writing import (
    BAGS,
    HDF5,
    TABLES,
    atomic_write,
    json_text,
    locked,
    plain,
    seal,
    set_attributes,
    usable_folder,
    whole_hdf5,
    writable,
    write_json,
    write_text,
)
