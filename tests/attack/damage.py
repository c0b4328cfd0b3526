"""Damage to files: bytes, text and structure. Each function takes a random generator and the content of a file, and returns it damaged."""

from __future__ import annotations

import io
import json
import random
import re

import h5py
import numpy as np

from strapdown.files.reading import BLOCK, SEAL
from strapdown.files.writing import _user_block

SECTOR = 512

VALUES = (
    *("nan", "inf", "-inf", "-1", "0", "1e400", "1e-400", "1e308", "5e-324", "9" * 400, "0x" + "f" * 300, "true", "false", "null", "[]"),
    *("{}", '""', '"x"', "[1, 2, 3]", "[0, 0, 1]", "[[1], [2, 3]]", '["a"]', "{a = 1}", '{"a": 1}', "1979-05-27T07:32:00Z", "'", '"', ","),
    *("1,5", "\N{MINUS SIGN}1", "\u0661", "1_000", "\ufeff", "#", "[" * 3000, "{a=" * 300, "a." * 3000 + "a = 1", "x" * 200_000),
)  # fmt: skip
"""Replacements of a word of text."""


def flip_bits(chance: random.Random, content: bytes) -> bytes:
    changed = bytearray(content)
    for _ in range(chance.choice((1, 1, 3, 30))):
        changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
    return bytes(changed)


def zero_sector(chance: random.Random, content: bytes) -> bytes:
    start = chance.randrange(-(-len(content) // SECTOR)) * SECTOR
    return content[:start] + bytes(len(content[start : start + SECTOR])) + content[start + SECTOR :]


def truncate(chance: random.Random, content: bytes) -> bytes:
    return content[: chance.randrange(len(content))]


def insert(chance: random.Random, content: bytes) -> bytes:
    place = chance.randrange(len(content) + 1)
    return content[:place] + chance.randbytes(chance.choice((1, 7, 512))) + content[place:]


def copy_part(chance: random.Random, content: bytes) -> bytes:
    length = chance.choice((1, 8, 64, 512))
    start, place = (chance.randrange(len(content)) for _ in range(2))
    return content[:place] + content[start : start + length] + content[place + length :]


BYTES = (flip_bits, zero_sector, truncate, insert, copy_part)

_WORD = re.compile(rb"[\w.+-]+|\"[^\"\n]*\"|[^\s\w]")


def replace_word(chance: random.Random, content: bytes) -> bytes:
    words = list(_WORD.finditer(content))
    if not words:
        return content
    word = chance.choice(words)
    return content[: word.start()] + chance.choice(VALUES).encode() + content[word.end() :]


def damage_lines(chance: random.Random, content: bytes) -> bytes:
    lines = content.split(b"\n")
    a, b = (chance.randrange(len(lines)) for _ in range(2))
    match chance.randrange(5):
        case 0:
            del lines[a]
        case 1:
            lines.insert(a, lines[b])
        case 2:
            lines[a], lines[b] = lines[b], lines[a]
        case 3:
            lines[a] += chance.choice((b",", b",,,", b"\r", b" ", b"\0", b"\xff\xfe", b"\xe2\x80\xa8"))
        case _:
            return b"\xef\xbb\xbf" + content.replace(b"\n", chance.choice((b"\r\n", b"\r")))
    return b"\n".join(lines)


TEXT = (replace_word, replace_word, replace_word, damage_lines, *BYTES)


def replace_node(chance: random.Random, content: bytes) -> bytes:
    """Replace a value somewhere in a JSON file by one of another type, or delete it."""
    tree = json.loads(content)
    node = tree
    while True:
        key = chance.choice(list(node) if isinstance(node, dict) else range(len(node)))
        if not isinstance(node[key], (dict, list)) or not node[key] or chance.random() < 0.3:
            break
        node = node[key]
    if chance.random() < 0.2:
        del node[key]
    else:
        node[key] = chance.choice(
            (None, True, -1, 0, 1e308, 10**400, "", "x", [], {}, [1, 2, 3], {"a": 1}, [[None]], "\ud800")
        )
    return json.dumps(tree).encode()


# ---------------------------------------------------------------------------------------------------------------------- HDF5


def change_hdf5(chance: random.Random, content: bytes) -> bytes:
    """Change the structure of an HDF5 file and update its digest: types, shapes, values, links, bombs."""
    held = io.BytesIO(content)
    with h5py.File(held, "r+") as file:
        nodes = [file]
        file.visititems(lambda name, node: nodes.append(node))
        arrays = [node for node in nodes if isinstance(node, h5py.Dataset)]
        if chance.random() < 0.5:
            _change_attribute(chance, chance.choice((file, file, *nodes)))
        else:
            _change_array(chance, chance.choice(arrays))
    changed = held.getvalue()
    return _user_block(changed[BLOCK:]) + changed[BLOCK:] if content.startswith(SEAL) else changed


def _change_attribute(chance: random.Random, node: h5py.HLObject) -> None:
    names = list(node.attrs)
    if not names:
        return
    name = chance.choice(names)
    value = chance.choice(
        ("", "x", "[" * 5000, b"\xff\xfe", 5, -1, 2**62, 0.5, float("nan"), float("inf"), [1.0, 2.0], ["a", "b"], True, "{}", "null",
         "[filter]\n", h5py.Empty("f8"), np.void(b"abc"), h5py.Reference(), np.zeros((2, 3, 4)), "a." * 5000 + "a = 1")
    )  # fmt: skip
    del node.attrs[name]
    if chance.random() < 0.9:
        node.attrs[name] = value


def _change_array(chance: random.Random, node: h5py.Dataset) -> None:
    value, name, parent = np.asarray(node[()]), node.name, node.parent
    what = chance.randrange(12)
    if what == 0 and value.size:
        flat = value.reshape(-1).copy()
        flat[chance.randrange(flat.size)] = (
            chance.choice((-1, 0, 2**62))
            if flat.dtype.kind == "i"
            else chance.choice((np.nan, np.inf, -1.0, 0.0, 1e308, 1e-320))
        )
        node[...] = flat.reshape(value.shape)
        return
    del parent[name]
    if what == 2:
        parent.create_group(name)
    elif what == 3:
        parent[name] = h5py.ExternalLink("other.h5", "/x")
    elif what == 4:
        parent[name] = h5py.SoftLink("/time")
    elif what == 5:
        layout = h5py.VirtualLayout(shape=(10,), dtype="f8")
        layout[:] = h5py.VirtualSource("other.h5", "x", shape=(10,))
        parent.create_virtual_dataset(name, layout)
    elif what == 6:
        parent.create_dataset(name, shape=(10,), dtype="f8", external=[("/etc/hostname", 0, 80)])
    elif what == 7:
        parent.create_dataset(name, shape=(300_000_000, *value.shape[1:]), dtype="f8", chunks=True)
    elif what == 8:
        parent[name] = value.reshape(-1)[: chance.randrange(value.size + 1)]
    elif what == 9:
        parent[name] = value[..., None]
    elif what == 10:
        parent[name] = value.astype(chance.choice(("S8", "c16", "f4", "u1", "i8", "bool")) if value.size else "f4")
    elif what == 11:
        parent[name] = chance.choice((1.0, "text", h5py.Empty("f8"), np.zeros(0), np.zeros((2, 0)), ["a", "b"]))


# ------------------------------------------------------------------------------------------------------- Parquet


def change_parquet(chance: random.Random, content: bytes) -> bytes:
    """Change columns, types, units and metadata of a Parquet file."""
    import pyarrow as arrow
    from pyarrow import parquet

    table = parquet.read_table(io.BytesIO(content))
    k = chance.randrange(table.num_columns)
    field, n = table.field(k), table.num_rows
    match chance.randrange(6):
        case 0:
            unit = chance.choice((b"\xff\xfe", b"", b"deg/s", b"x" * 10_000, "\u202e".encode()))
            table = table.set_column(k, field.with_metadata({b"unit": unit}), table.column(k))
        case 1:
            table = table.append_column(field, table.column(k))
        case 2:
            values = chance.choice(
                ([None] * n, ["x"] * n, [[1.0, 2.0]] * n, [{"a": 1}] * n, [b"\xff"] * n, [True] * n, [2**62] * n, [float("nan")] * n)
            )  # fmt: skip
            table = table.set_column(k, field.name, arrow.array(values))
        case 3:
            table = table.remove_column(k)
        case 4:
            table = table.rename_columns(
                [chance.choice(("", "x\0", "gx", "time", name)) for name in table.column_names]
            )
        case _:
            table = table.slice(0, chance.randrange(3))
    changed = io.BytesIO()
    parquet.write_table(table, changed, compression=chance.choice(("none", "snappy", "zstd")))
    return changed.getvalue()
