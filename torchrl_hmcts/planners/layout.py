"""The layout of a tree in layers.

Letters: ``N`` nodes.
"""

from __future__ import annotations

import numpy as np


def layered_layout(parents: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Place the nodes of a tree across: parents over the middle of their children, no overlaps.

    Nodes of one layer are at least 1 apart, and subtrees as close as that allows. The mean of the
    layouts packed from the left and from the right: mirrored trees are drawn as mirror images.

    Args:
        parents: int64 ``[N]``, row of the node above, which comes first; -1 for the root, row 0.
        order: int64 ``[N]``, all rows, those of siblings from left to right.

    Returns:
        float64 ``[N]``, the root at 0.

    Reference:
        Reingold and Tilford, "Tidier drawings of trees", 1981.

    Example:
        >>> layered_layout(np.array([-1, 0, 0, 1, 1]), np.arange(5))
        array([ 0. , -0.5,  0.5, -1. ,  0. ])
    """
    return (_pack(parents, order) - _pack(parents, order[::-1])) / 2.0


def _pack(parents: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Place subtrees from left to right, each as far to the left as it goes."""
    below: list[list[int]] = [[] for _ in parents]
    for row in order.tolist():
        if parents[row] >= 0:
            below[parents[row]].append(row)
    offsets = np.zeros(len(parents))  # from the node above
    edges: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # left and right outline, by layer
    for row in reversed(range(len(parents))):
        rows = below[row]
        if not rows:
            edges[row] = np.zeros(1), np.zeros(1)
            continue
        left, right = edges.pop(rows[0])
        places = [0.0]
        for child in rows[1:]:
            child_left, child_right = edges.pop(child)
            common = min(len(right), len(child_left))
            gaps = np.full(common, 1.3)  # between cousins; 1 between sisters
            gaps[0] = 1.0
            place = float((right[:common] - child_left[:common] + gaps).max())
            left = np.concatenate((left, child_left[len(left) :] + place))
            right = np.concatenate((child_right + place, right[len(child_right) :]))
            places.append(place)
        middle = (places[0] + places[-1]) / 2.0
        offsets[rows] = np.array(places) - middle
        edges[row] = (
            np.concatenate(([0.0], left - middle)),
            np.concatenate(([0.0], right - middle)),
        )
    across = np.zeros(len(parents))
    for row in range(1, len(parents)):
        across[row] = across[parents[row]] + offsets[row]
    return across
