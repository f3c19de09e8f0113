"""The random numbers of DeepMind Lab: mt19937-64 and the distributions of libstdc++.

NumPy has the 32-bit generator of that family only.
"""

from __future__ import annotations

_MASK = (1 << 64) - 1
_N, _M = 312, 156
_MATRIX = 0xB5026F5AA96619E9
_UPPER, _LOWER = 0xFFFFFFFF80000000, 0x7FFFFFFF


class MersenneTwister64:
    """The 64-bit Mersenne Twister, with uniform integers and reals as libstdc++ draws them.

    Reference:
        Nishimura, "Tables of 64-bit Mersenne Twisters", 2000; Lemire, "Fast random integer
        generation in an interval", 2019 (the integers of libstdc++ since gcc 11).
    """

    def __init__(self, seed: int) -> None:
        if not 0 <= seed <= _MASK:
            raise ValueError(
                f"MersenneTwister64 needs a seed of 64 bits, 0 to 2**64 - 1; got {seed}."
            )
        state = [seed]
        for i in range(1, _N):
            last = state[-1]
            state.append((6364136223846793005 * (last ^ (last >> 62)) + i) & _MASK)
        self._state = state
        self._index = _N

    def next(self) -> int:
        """Return the next 64 random bits."""
        if self._index == _N:
            self._twist()
        x = self._state[self._index]
        self._index += 1
        x ^= (x >> 29) & 0x5555555555555555
        x ^= (x << 17) & 0x71D67FFFEDA60000
        x ^= (x << 37) & 0xFFF7EEE000000000
        return x ^ (x >> 43)

    def uniform_int(self, low: int, high: int) -> int:
        """Return a uniform integer from ``low`` to ``high``, both included."""
        if low > high:
            raise ValueError(f"uniform_int needs low <= high; got {low} and {high}.")
        count = high - low + 1
        product = self.next() * count
        if product & _MASK < count:
            threshold = (1 << 64) % count
            while product & _MASK < threshold:
                product = self.next() * count
        return low + (product >> 64)

    def uniform_real(self) -> float:
        """Return a uniform float in [0, 1)."""
        return min(self.next() / 18446744073709551616.0, 1.0 - 2.0**-53)

    def _twist(self) -> None:
        state = self._state
        for i in range(_N):
            x = (state[i] & _UPPER) | (state[(i + 1) % _N] & _LOWER)
            state[i] = state[(i + _M) % _N] ^ (x >> 1) ^ (_MATRIX if x & 1 else 0)
        self._index = 0
