"""Plans of a search as tensors, and reports while it runs.

Letters: *B batch of roots, L length of the longest plan.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorClass, TensorDictBase
from torch import Tensor

from torchrl_hmcts import notebook
from torchrl_hmcts.planners.drawing import option_color
from torchrl_hmcts.planners.search import Search


class Plan(TensorClass, metaclass=notebook.KeepsDocstring):
    """The best plan of each root: options that earn a reward one after the other.

    Attributes:
        options (Tensor): ``[*B, L]`` int64, -1 behind a plan's end.
        lengths (Tensor): ``[*B]`` int64, 0 where no plan was found.
        found (Tensor): ``[*B]`` bool.
        returns (Tensor): ``[*B]`` float32, discounted return of the plan, 0 without one.
        durations (Tensor): ``[*B]`` int64, base steps of the plan in the simulator.
        states (TensorDictBase): ``[*B, L + 1]`` states between the options, the last one repeated.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=4)
        >>> plan = MCTSPlanner(env, gamma=0.9).plan(env.reset())
        >>> plan.options.tolist(), plan.found.item(), round(plan.returns.item(), 2)
        ([1, 1, 1], True, 0.81)
    """

    options: Tensor
    lengths: Tensor
    found: Tensor
    returns: Tensor
    durations: Tensor
    states: TensorDictBase

    def __repr__(self) -> str:
        if self.batch_size:
            found = f"{int(self.found.sum())} of {self.found.numel()} found"
            return f"Plan(batch_size={list(self.batch_size)}, {found})"
        if not self.found:
            return "Plan(found=False)"
        options = self.options[: int(self.lengths)].tolist()
        steps, value = int(self.durations), float(self.returns)
        return f"Plan(options={options}, {steps} base steps, return {value:.4g})"

    def _repr_html_(self) -> str:
        if self.batch_size or not self.found:
            return notebook.shown(repr(self))
        options = self.options[: int(self.lengths)].tolist()
        size = (0.4 * len(options) + 0.2, 0.5)

        def draw(axes: Any) -> None:  # a box for each option
            colors = [option_color(option) for option in options]
            axes.barh(0, 1, left=range(len(options)), color=colors, edgecolor="white")
            for i, option in enumerate(options):
                axes.text(i + 0.5, 0, str(option), color="white", ha="center", va="center")
            axes.set_axis_off()

        return notebook.shown(repr(self), draw, figsize=size, layout=None)


def extract_plans(search: Search) -> Plan:
    """Read the best plan of each root out of a search, batch ``[B]``.

    Args:
        search (Search): a search that has ended, of B roots.

    Returns:
        The plans, batch ``[B]``; ``found`` is False where no option earned a reward.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=4)
        >>> search = MCTSPlanner(env).search(env.reset())
        >>> extract_plans(search).options
        tensor([[1, 1, 1]])
    """
    tree, best = search.tree, search.best_node
    paths = [
        np.array(tree.path(b, node) if node >= 0 else [0], np.int64)
        for b, node in enumerate(best.tolist())
    ]
    lengths = np.array([len(path) - 1 for path in paths], np.int64)
    width = int(lengths.max(initial=0))
    nodes = np.zeros((search.num_roots, width + 1), np.int64)
    for row, path in zip(nodes, paths, strict=True):
        row[:] = np.pad(path, (0, width + 1 - len(path)), "edge")
    rows = np.arange(search.num_roots)[:, None]
    options = tree.nodes[rows, nodes[:, 1:]]["option"].astype(np.int64)
    options[np.arange(width) >= lengths[:, None]] = -1
    last = tree.nodes[np.arange(search.num_roots), nodes[:, -1]]
    assert tree.states is not None
    return Plan(
        options=torch.from_numpy(options),
        lengths=torch.from_numpy(lengths),
        found=torch.from_numpy(best >= 0),
        returns=torch.from_numpy(last["path_return"].copy()),
        durations=torch.from_numpy(last["base_steps"].astype(np.int64)),
        states=tree.states[torch.from_numpy(rows), torch.from_numpy(nodes)],
        batch_size=[search.num_roots],
    )


@dataclass(frozen=True)
class SearchProgress:
    """Report to a progress display after every wave.

    Attributes:
        num_roots (int): roots of the search.
        num_active (int): roots whose search continues.
        num_found (int): roots with a plan.
        expansions (int): nodes expanded so far, of all roots.
        base_steps (int): base steps simulated so far, of all roots.
        seconds (float): since the search began.
        search (Search): the search so far, of B roots; ``extract_plans(search)`` returns its best
            plans.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env, told = ChainEnv(length=4), []
        >>> _ = MCTSPlanner(env, progress=told.append).plan(env.reset())
        >>> told[-1].num_found, told[-1].num_roots
        (1, 1)
    """

    num_roots: int
    num_active: int
    num_found: int
    expansions: int
    base_steps: int
    seconds: float
    search: Search
