"""Files: every file is read through ``reading`` and written through ``writing``.

- ``reading``: Limits of size, errors that name the file, digests.
- ``writing``: Atomic writing, locks, digests.
- ``tables``: Frozen dataclasses as TOML and JSON tables with the unit in each key.
- ``extras``: Optional libraries.
"""

from __future__ import annotations

from strapdown.files.writing import atomic_write as atomic_write
from strapdown.files.writing import json_text as json_text
from strapdown.files.writing import locked as locked
from strapdown.files.writing import plain as plain
from strapdown.files.writing import seal as seal
from strapdown.files.writing import set_attributes as set_attributes
from strapdown.files.writing import usable_folder as usable_folder
from strapdown.files.writing import whole_hdf5 as whole_hdf5
from strapdown.files.writing import writable as writable
from strapdown.files.writing import write_json as write_json
from strapdown.files.writing import write_text as write_text
