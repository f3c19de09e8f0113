"""Goals on bytes of the RAM: bring one byte to another plus an offset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ByteGoal:
    r"""Bring byte c to byte b plus an offset o.

    .. math:: a = \begin{cases}
        \text{raise} & x_c - x_b - o < -\delta \\ \text{lower} & x_c - x_b - o > \delta \\
        \text{stay} & \text{otherwise} \end{cases}

    Attributes:
        controlled: c, a byte that actions move.
        target: b, a byte that moves.
        offset: o.
        raising, lowering, staying: index of the action that raises c, lowers it, leaves it.
        dead_zone: :math:`\delta`, within which nothing is to be done.

    Raises:
        ValueError: if a byte is none of the RAM.

    Reference:
        This project's; goals of a worker as in chapter 3 of the dissertation.

    Example:
        >>> import numpy as np
        >>> goal = ByteGoal(controlled=72, target=99, offset=-12, raising=2, lowering=3)
        >>> ram = np.zeros(128, np.uint8)
        >>> ram[72], ram[99] = 100, 120
        >>> goal.action(ram)  # 100 is below 120 - 12
        2
    """

    controlled: int
    target: int
    offset: int
    raising: int
    lowering: int
    staying: int = 0
    dead_zone: int = 3

    def __post_init__(self) -> None:
        if not (0 <= self.controlled < 128 and 0 <= self.target < 128):
            raise ValueError(f"The RAM has the bytes 0 to 127; got {self}.")

    def action(self, ram: np.ndarray) -> int:
        """Return the index of the action, seeing the RAM, uint8 ``[128]``."""
        missing = int(ram[self.controlled]) - int(ram[self.target]) - self.offset
        if missing < -self.dead_zone:
            return self.raising
        return self.lowering if missing > self.dead_zone else self.staying
