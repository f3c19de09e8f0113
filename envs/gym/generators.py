"""NumPy's generators: their state as bytes, in microseconds less than NumPy takes."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np


def generator_state(generator: Any) -> bytes | Any:
    """Return the state of a generator: 40 bytes for NumPy's default one, else itself."""
    if generator is None or type(generator.bit_generator) is not np.random.PCG64:
        return generator
    state = generator.bit_generator.state
    inner = state["state"]
    return (
        inner["state"].to_bytes(16, "little")
        + inner["inc"].to_bytes(16, "little")
        + state["has_uint32"].to_bytes(4, "little")
        + state["uinteger"].to_bytes(4, "little")
    )


def set_generator_state(generator: np.random.Generator, stored: bytes) -> None:
    """Put NumPy's default generator into a state of :func:`generator_state`, 40 bytes."""
    number = [int.from_bytes(stored[a:b], "little") for a, b in ((0, 16), (16, 32))]
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": number[0], "inc": number[1]},
        "has_uint32": int.from_bytes(stored[32:36], "little"),
        "uinteger": int.from_bytes(stored[36:40], "little"),
    }


def generator_memory(generator: Any) -> tuple[memoryview, memoryview] | None:
    """Return where a generator keeps its state: 32 bytes, and 8 of a number half used.

    None where it is not NumPy's default one, or keeps it in another way than NumPy has done since
    1.17: a pointer to two numbers of 128 bits, then the rest. The address is of NumPy's public
    interface, ``bit_generator.ctypes``; the bytes are compared with the public state.
    """
    bits: Any = getattr(generator, "bit_generator", None)
    if type(bits) is not np.random.PCG64:
        return None
    inside = range(id(bits), id(bits) + type(bits).__basicsize__ - 31)  # where 32 bytes begin
    at = bits.ctypes.state_address
    if at not in inside:
        return None
    pointer = ctypes.c_uint64.from_address(at).value
    if pointer not in inside:
        return None
    words = memoryview((ctypes.c_uint8 * 32).from_address(pointer)).cast("B")
    rest = memoryview((ctypes.c_uint8 * 8).from_address(at + 8)).cast("B")
    return (words, rest) if bytes(words) + bytes(rest) == generator_state(generator) else None
