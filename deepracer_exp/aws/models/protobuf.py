"""The wire format of protobuf, as far as files of TensorFlow need it (protobuf.dev, Encoding)."""

from collections.abc import Iterator

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5


def varint(value: int) -> bytes:
    """Encode an integer as a varint; negative ones in 64-bit two's complement."""
    value &= 2**64 - 1
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def field(number: int, value: int | str | bytes) -> bytes:
    """Encode a field of a message: an integer as a varint; a text, bytes or a message as length-delimited."""
    if isinstance(value, int):
        return varint(number << 3 | VARINT) + varint(value)
    raw = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | BYTES) + varint(len(raw)) + raw


def read_varint(raw: memoryview, position: int) -> tuple[int, int]:
    """Decode the varint at a position; return it, and the position after it.

    Raises:
        ValueError: there is none.
    """
    value = 0
    for shift in range(0, 70, 7):
        if position >= len(raw):
            raise ValueError("ends early")
        byte = raw[position]
        position += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, position
    raise ValueError("holds a number of more than ten bytes")


def read_fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield number and value of each field: a number, or the bytes of anything else.

    Raises:
        ValueError: it is not a message.
    """
    position = 0
    while position < len(message):
        tag, position = read_varint(message, position)
        number, kind = tag >> 3, tag & 7
        if kind == VARINT:
            value, position = read_varint(message, position)
            yield number, value
            continue
        if kind not in (FIXED64, BYTES, FIXED32):
            raise ValueError("is not a protobuf message")
        size, position = (
            read_varint(message, position) if kind == BYTES else (8 if kind == FIXED64 else 4, position)
        )
        if size > len(message) - position:
            raise ValueError("ends early")
        yield number, message[position : position + size]
        position += size
