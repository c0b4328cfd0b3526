"""Files: every one that is read passes ``reading``, every one that is written passes ``writing``.

- ``reading``: Limits, names of files in errors, digests.
- ``writing``: Files that are never half written, locked while written, sealed with a digest.
- ``tables``: Frozen dataclasses as TOML and JSON tables with the unit in each key.
"""

from __future__ import annotations

from strapdown.files.writing import json_text as json_text
from strapdown.files.writing import locked as locked
from strapdown.files.writing import output_file as output_file
from strapdown.files.writing import plain as plain
from strapdown.files.writing import seal as seal
from strapdown.files.writing import set_attributes as set_attributes
from strapdown.files.writing import usable_folder as usable_folder
from strapdown.files.writing import whole_hdf5 as whole_hdf5
from strapdown.files.writing import write_json as write_json
from strapdown.files.writing import written_beside as written_beside
