"""Checkpoints of TensorFlow 1 (bundle V2), read and written without TensorFlow.

`NAME.index` is a sorted table of LevelDB: name -> type, shape, place and checksum of each tensor.
`NAME.data-00000-of-00001` has the tensors one after the other. Sources: TensorFlow,
`core/util/tensor_bundle/tensor_bundle.cc`, `core/protobuf/tensor_bundle.proto`, `core/lib/io/format.cc`,
`block_builder.cc`. An index equals, byte for byte, that of a checkpoint that the AWS console wrote in 2020.
"""

import math
import struct
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import google_crc32c
import numpy as np
import numpy.typing as npt

from deepracer_exp.errors import BadInput

from .protobuf import field, read_fields, read_varint, varint

Array = npt.NDArray[np.float32]

INDEX, DATA, META = ".index", ".data-00000-of-00001", ".meta"
"""Endings of a checkpoint's files."""
INDEX_BYTES = 2**20
"""The service's has 1.2 KB."""
DATA_BYTES = 2**30
"""Most bytes that deepracer-on-aws accepts; the largest network of the service needs 460 MB."""
_MOST_TENSORS = 1000
_MAGIC = bytes.fromhex("57fb808b247547db")
_RESTART_EVERY = 16
_FOOTER_BYTES = 48
_FLOAT = 1  # types.proto
_HEADER = field(1, 1) + field(3, field(1, 1))
"""BundleHeaderProto: one shard, little-endian, version 1."""


class Entry(NamedTuple):
    """Position, type and shape of a tensor (BundleEntryProto)."""

    shape: tuple[int, ...]
    offset: int
    size: int
    """Bytes."""
    crc: int
    """Masked CRC-32C of its bytes."""
    dtype: int = _FLOAT
    """Number of the type in types.proto."""


def read_index(raw: bytes, where: str) -> dict[str, Entry]:
    """Return the entries of an `.index` by name, in the order of the names.

    `raw` is its content, at most `INDEX_BYTES`; `where` is the file, for messages.

    Raises:
        BadInput: it is not an index, is corrupt, or describes tensors that no network of the service has.
    """
    try:
        entries = dict(_entries(memoryview(raw)))
        _check_places(entries)
    except (ValueError, struct.error) as error:
        raise BadInput(where, error, "the .index of a TensorFlow checkpoint") from error
    return entries


def read_tensors(entries: Mapping[str, Entry], data: bytes, where: str) -> dict[str, Array]:
    """Return the float32 tensors of a data file, views of its bytes; those of other types are counters.

    Raises:
        BadInput: the file is not the one of the index, or corrupt.
    """
    size = max(entry.offset + entry.size for entry in entries.values())
    if len(data) != size:
        raise BadInput(where, f"has {len(data):,} bytes", f"the {size:,} of the checkpoint's index")
    tensors = {}
    for name, entry in entries.items():
        part = memoryview(data)[entry.offset : entry.offset + entry.size]
        if masked_crc32c(part) != entry.crc:
            raise BadInput(where, f"{name}: corrupt, its checksum is wrong; copy the file again")
        if entry.dtype == _FLOAT:
            tensors[name] = np.frombuffer(part, "<f4").reshape(entry.shape)
    return tensors


def write_checkpoint(tensors: Mapping[str, Array]) -> tuple[bytes, bytes]:
    """Return index and data file of tensors by name."""
    entries, parts, offset = {}, [], 0
    for name in sorted(tensors):
        part = np.ascontiguousarray(tensors[name], "<f4").tobytes()
        crc = masked_crc32c(part)
        entries[name] = Entry(tensors[name].shape, offset, len(part), crc)
        parts.append(part)
        offset += len(part)
    return write_index(entries), b"".join(parts)


def write_index(entries: Mapping[str, Entry]) -> bytes:
    """Return the `.index` of entries by name: one block, as TensorFlow fills it up to 256 KiB."""
    rows = [(b"", _HEADER), *sorted((name.encode(), _entry_bytes(entry)) for name, entry in entries.items())]
    out = bytearray()

    def append(block: bytes) -> bytes:
        """Append a block and return where it is."""
        handle = varint(len(out)) + varint(len(block))
        out.extend(block + b"\0" + struct.pack("<I", masked_crc32c(block + b"\0")))
        return handle

    data = append(_block(rows))
    meta = append(_block([]))
    # The shortest key after all others.
    last = append(_block([(bytes([rows[-1][0][0] + 1]), data)]))
    return bytes(out + (meta + last).ljust(_FOOTER_BYTES - len(_MAGIC), b"\0") + _MAGIC)


def masked_crc32c(data: bytes | memoryview) -> int:
    """Return the checksum of bytes as LevelDB stores it."""
    crc: int = google_crc32c.value(bytes(data))
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def _entries(raw: memoryview) -> Iterator[tuple[str, Entry]]:
    if len(raw) < _FOOTER_BYTES or raw[-len(_MAGIC) :] != _MAGIC:
        raise ValueError("is incomplete or no index")
    footer = raw[-_FOOTER_BYTES:]
    _, position = _handle(footer, 0)
    place, _ = _handle(footer, position)
    number, header = 0, None
    for _, handle in _rows(_checked_block(raw, *place)):
        (offset, size), _ = _handle(handle, 0)
        for key, value in _rows(_checked_block(raw, offset, size)):
            if not key:
                header = bytes(value)
                continue
            number += 1
            if number > _MOST_TENSORS:
                raise ValueError(f"lists more than {_MOST_TENSORS:,} tensors")
            name = key.decode("utf-8", "replace")
            yield name, _entry(name, value)
    if header != _HEADER:
        raise ValueError("is not of one little-endian data file")
    if not number:
        raise ValueError("lists no tensors")


def _handle(raw: memoryview, position: int) -> tuple[tuple[int, int], int]:
    offset, position = read_varint(raw, position)
    size, position = read_varint(raw, position)
    return (offset, size), position


def _checked_block(raw: memoryview, offset: int, size: int) -> memoryview:
    end = offset + size + 1
    if end + 4 > len(raw) - _FOOTER_BYTES:
        raise ValueError("ends early")
    (crc,) = struct.unpack_from("<I", raw, end)
    if masked_crc32c(raw[offset:end]) != crc:
        raise ValueError("is corrupt: the checksum of a block is wrong")
    if raw[end - 1] != 0:
        raise ValueError("is compressed")
    return raw[offset : end - 1]


def _rows(block: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Yield keys and values; keys are stored prefix-compressed against the one before."""
    (restarts,) = struct.unpack_from("<I", block, len(block) - 4)
    end = len(block) - 4 * (restarts + 1)
    key, position = b"", 0
    if end < 0:
        raise ValueError("is corrupt: a block has no place for its restarts")
    block = block[:end]
    while position < end:
        shared, position = read_varint(block, position)
        unshared, position = read_varint(block, position)
        size, position = read_varint(block, position)
        if shared > len(key) or unshared + size > end - position:
            raise ValueError("is corrupt: a key or a value is longer than its block")
        key = key[:shared] + bytes(block[position : position + unshared])
        yield key, block[position + unshared : position + unshared + size]
        position += unshared + size


def _block(rows: list[tuple[bytes, bytes]]) -> bytes:
    out, restarts, before = bytearray(), [0], b""
    for number, (key, value) in enumerate(rows):
        shared = 0
        if number and number % _RESTART_EVERY == 0:
            restarts.append(len(out))
        else:
            while shared < min(len(before), len(key)) and before[shared] == key[shared]:
                shared += 1
        out += varint(shared) + varint(len(key) - shared) + varint(len(value)) + key[shared:] + value
        before = key
    return bytes(out) + struct.pack(f"<{len(restarts) + 1}I", *restarts, len(restarts))


def _entry(name: str, value: memoryview) -> Entry:
    numbers = dict.fromkeys((1, 3, 4, 5), 0)
    crc, shape = 0, list[int]()
    for number, content in read_fields(value):
        if number == 2 and isinstance(content, memoryview):
            shape = [_dimension(part) for kind, part in read_fields(content) if kind == 2]
            if any(kind != 2 for kind, _ in read_fields(content)):
                raise ValueError(f"{name}: has a shape that is not known")
        elif number == 6 and isinstance(content, memoryview):
            (crc,) = struct.unpack("<I", content)
        elif number in numbers and isinstance(content, int):
            numbers[number] = content
        else:
            raise ValueError(f"{name}: is stored in a way that the service does not use")
    dtype, shard, offset, size = numbers.values()
    if shard:
        raise ValueError(f"{name}: is in another data file")
    if dtype == _FLOAT and 4 * math.prod(shape) != size:
        raise ValueError(f"{name}: {size} bytes for a tensor of shape {shape}")
    return Entry(tuple(shape), offset, size, crc, dtype)


def _dimension(content: int | memoryview) -> int:
    fields = read_fields(content) if isinstance(content, memoryview) else ()
    size = next((size for number, size in fields if number == 1), 0)
    if not isinstance(size, int) or not 0 < size < 2**31:
        raise ValueError(f"a dimension of {size}")
    return size


def _check_places(entries: Mapping[str, Entry]) -> None:
    """Refuse tensors that overlap or leave gaps: then memory is bounded by the size of the file."""
    end = 0
    for name, entry in sorted(entries.items(), key=lambda item: (item[1].offset, item[1].size)):
        if entry.offset != end:
            raise ValueError(f"{name}: begins at byte {entry.offset}, not where the one before ends")
        end += entry.size
    if end > DATA_BYTES:
        raise ValueError(f"describes {end:,} bytes of tensors; the service has at most {DATA_BYTES:,}")


def _entry_bytes(entry: Entry) -> bytes:
    """Return a BundleEntryProto; fields that are zero are left out."""
    shape = b"".join(field(2, field(1, size)) for size in entry.shape)
    out = field(1, entry.dtype) + field(2, shape)
    if entry.offset:
        out += field(4, entry.offset)
    return out + field(5, entry.size) + b"\x35" + struct.pack("<I", entry.crc)
