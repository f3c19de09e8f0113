"""States of the Atari emulator as short rows of bytes, all of the same length, without loss.

ALE serialises a state into about 7,700 bytes. 6,700 of them are the text of a random generator that
is used when the console is switched on and never again, 384 are the upper bytes of the 128 RAM
cells, each written as an integer. A row keeps the rest, about 600 bytes.
"""

from __future__ import annotations

import re
import struct
import zlib

import numpy as np

_TRUE = struct.pack("<I", 0xFAB1FAB2)  # how the emulator writes a flag
_KEY_WORDS = 624  # of a Mersenne Twister
RNG_BYTES = 4 * _KEY_WORDS + 2
"""Bytes that a row with the state of the random generator has more."""

_HELD, _GAME, _KEPT = 0, slice(1, 4), 4  # held action, check sum of the game, then the state
_STOPPED = 1  # the bit of the processor's status that is set where the program ended its frame


class EmulatorStates:
    """Turns ALE's serialised states of one game into rows of equal length, and back.

    A row holds the held action (which ALE does not serialise, see ``held``), a check sum of the
    game, and every byte of the state that can differ from ``template``. What is left out is
    compared with the template each time: a row is exact, or there is an error.

    Args:
        template (bytes): ``ale.cloneState().serialize()`` after the first ``reset_game()``.
        game (str): its name, for messages.

    Raises:
        ValueError: if ``template`` has not the layout that this class knows.
    """

    def __init__(self, template: bytes, game: str) -> None:
        self.game = game
        self._template = np.frombuffer(template, np.uint8)
        text = re.search(rb"(?:\d+ ){624}\d+", template)
        ram = template.find(b"M6532")
        cpu = re.search(rb"M6502(Low|High)", template)
        if text is None or ram < 0 or cpu is None or template[ram + 5 : ram + 9] != b"\x80\0\0\0":
            raise ValueError(
                f"The serialised state of {game} ({len(template)} bytes) does not have the layout "
                "that ale-py 0.10 to 0.12 writes. Install one of these: pip install "
                "'ale-py<0.13'."
            )
        self._inner = 28  # the emulator's own state; before it six integers and its length
        self._cells = ram + 9
        # accumulator to program counter are six integers, then seven flags, then the status
        self._counter, self._status = cpu.end() + 20, cpu.end() + 52
        kept = np.ones(len(template), bool)
        kept[text.start() - 4 : text.end()] = False
        kept[self._inner - 4 : self._inner] = False
        for name in re.finditer(rb"[\x04-\x20]\0\0\0[A-Za-z0-9]{4,32}", template):
            if template[name.start()] <= name.end() - name.start() - 4:
                kept[name.start() : name.start() + 4 + template[name.start()]] = False
        cells = self._cells + 4 * np.arange(128)
        for upper in (1, 2, 3):
            kept[cells + upper] = False
        self._kept = np.flatnonzero(kept)
        self._left_out = np.flatnonzero(~kept)
        self._left_out_bytes = self._template[self._left_out].tobytes()
        md5 = template[self._inner + 4 : self._inner + 36]
        self._check = np.frombuffer(struct.pack("<I", zlib.crc32(md5)), np.uint8)[:3]
        self.width = _KEPT + len(self._kept)
        """Bytes of a row."""
        self.width_with_rng = self.width + RNG_BYTES
        """Bytes of a row that holds the random generator too."""

    def encode(self, state: bytes, held: int = 0, rng: np.ndarray | None = None) -> np.ndarray:
        """Return the row of a serialised state.

        Args:
            state: as ``cloneState(include_rng=False).serialize()`` gives it.
            held: the action that the emulator repeats where an action "sticks".
            rng: 624 words and the position of ALE's Mersenne Twister, uint32 ``[625]``, or None.

        Returns:
            uint8 ``[width]``, or ``[width_with_rng]``.
        """
        raw = np.frombuffer(state, np.uint8)
        if len(raw) != len(self._template) or raw[self._left_out].tobytes() != self._left_out_bytes:
            raise RuntimeError(
                f"A state of {self.game} differs from the game's first state in bytes that do not "
                f"change in any game known to us ({len(raw)} bytes against {len(self._template)}). "
                f"It cannot be stored without loss; please report the game and ale-py's version."
            )
        row = np.empty(self.width if rng is None else self.width_with_rng, np.uint8)
        row[_HELD], row[_GAME] = held, self._check
        np.take(raw, self._kept, out=row[_KEPT : self.width])
        if rng is not None:
            row[self.width : -2] = rng[:_KEY_WORDS].astype("<u4").view(np.uint8)
            row[-2:] = rng[_KEY_WORDS:].astype("<u2").view(np.uint8)
        return row

    def decode(self, row: np.ndarray) -> bytes:
        """Return the serialised state of a row, without the random generator."""
        if len(row) not in (self.width, self.width_with_rng) or (row[_GAME] != self._check).any():
            raise ValueError(
                f"This row is not a state of {self.game}: got {len(row)} bytes beginning with "
                f"{row[:4].tolist()}, not {self.width} (or {self.width_with_rng} with the random "
                f"generator) with {self._check.tolist()} at 1. Pass a row as the env wrote it."
            )
        raw = self._template.copy()
        raw[self._kept] = row[_KEPT : self.width]
        return raw.tobytes()

    def held(self, row: np.ndarray) -> int:
        """Return the action that was held."""
        return int(row[_HELD])

    def rng(self, row: np.ndarray) -> np.ndarray | None:
        """Return the random generator in a row, uint32 ``[625]``, or None if it has none."""
        if len(row) != self.width_with_rng:
            return None
        words = row[self.width : -2].view("<u4").astype(np.uint32)
        return np.append(words, row[-2:].view("<u2").astype(np.uint32))

    def with_rng(self, state: bytes, rng: np.ndarray) -> bytes:
        """Return a serialised state with a random generator in it, uint32 ``[625]``."""
        text = " ".join(map(str, rng.tolist())).encode()
        inner = state[self._inner : -12] + _TRUE + struct.pack("<i", len(text)) + text
        return state[: self._inner - 4] + struct.pack("<i", len(inner)) + inner + state[-8:]

    @staticmethod
    def rng_of(state: bytes) -> np.ndarray:
        """Return the random generator of ``cloneState(include_rng=True)``, uint32 ``[625]``."""
        begin = state.rfind(_TRUE) + 8
        return np.array(state[begin:-8].split(), dtype=np.uint32)

    def is_partial(self, state: bytes) -> bool:
        """Whether the emulator gave a frame up before the program had ended it."""
        return not state[self._status] & _STOPPED

    def endless(self, state: bytes) -> bytes:
        """Return a state whose next frame has no end: ``JMP $80`` at address ``$80``, forever."""
        changed = bytearray(state)
        for i, byte in enumerate((0x4C, 0x80, 0x00)):
            struct.pack_into("<I", changed, self._cells + 4 * i, byte)
        struct.pack_into("<I", changed, self._counter, 0x80)
        return bytes(changed)
