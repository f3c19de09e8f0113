"""Backups: how the value of a node follows from what was found below it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MeanBackup:
    r"""The value of a node is the mean of its own evaluation and all returns backed up through it.

    .. math:: V(s) \leftarrow V(s) + \frac{R + D\,V(s') - V(s)}{N(s)}

    Reference:
        Coulom, 2006; dissertation, section 2.4.2.

    Example:
        >>> MeanBackup()
        MeanBackup()
    """


@dataclass(frozen=True)
class MaxBackup:
    r"""The value of a node is that of its best option: exact in a deterministic simulator.

    .. math:: V(s) = \max_o\; R(s,o) + D(s,o)\,V(s')

    Reference:
        Coulom, "Efficient selectivity and backup operators in Monte-Carlo tree search", 2006.

    Example:
        >>> MaxBackup()
        MaxBackup()
    """


Backup = MeanBackup | MaxBackup
