"""A search tree in other forms: a networkx graph, TorchRL's ``Tree``, a text to read.

Letters: ``N`` nodes, ``A`` options.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_hmcts.planners.tree import (
    CLOSED,
    EXPANDED,
    FORBIDDEN,
    PRUNED,
    REWARDED,
    TERMINAL,
    TreeArrays,
)

if TYPE_CHECKING:
    from torchrl.data.map.tree import Tree

FLAGS = {
    "expanded": EXPANDED,
    "terminal": TERMINAL,
    "pruned": PRUNED,
    "closed": CLOSED,
    "rewarded": REWARDED,
}
_OF_NODES = ("visits", "value", "depth", "base_steps", "path_return", "twin")
_OF_OUTCOMES, _OF_OPTIONS = (
    ("option", "reward", "discount", "samples"),
    ("visits", "value", "prior"),
)
_MAX_OPTIONS = 24  # rows of the summary's table of options
_MAX_STEPS = 40  # rows of its plan
_LINE_WIDTH = 88
_BAR = 12
_NAME_WIDTH = 18


def check_root(tree: TreeArrays, root: int) -> int:
    """Return the number of nodes of a root, or say why there is none."""
    if not 0 <= root < tree.num_roots:
        raise IndexError(
            f"There is no root {root}: the search has {tree.num_roots}, counted from 0. Pass "
            f"root=0 ... {tree.num_roots - 1}."
        )
    return int(tree.num_nodes[root])


def best_plan(tree: TreeArrays, root: int) -> list[int]:
    """Return the nodes of the best plan, beginning at the root, or none."""
    best = int(tree.roots["best_node"][root])
    return tree.path(root, best) if best > 0 else []


def plan_size(tree: TreeArrays, root: int) -> str:
    """Return how long the best plan is, in options and base steps."""
    plan = best_plan(tree, root)
    steps = int(tree.nodes["base_steps"][root, plan[-1]])
    return f"{plural(len(plan) - 1, 'option')}, {plural(steps, 'base step')}"


def most_visited_path(tree: TreeArrays, root: int) -> list[int]:
    """Return the nodes along the options with most visits, then highest Q, from the root on."""
    path = [0]
    while True:
        edges = tree.edges[root, path[-1]]
        visits = np.where(edges["child"] >= 0, edges["visits"], 0)
        if not visits.any():
            return path
        most = np.flatnonzero(visits == visits.max())
        outcomes = tree.outcomes(root, int(most[edges["value"][most].argmax()]), path[-1])
        path.append(max(outcomes, key=lambda n: (int(tree.nodes["visits"][root, n]), -n)))


def shown_nodes(tree: TreeArrays, root: int, max_nodes: int | None) -> np.ndarray:
    """Return the most visited nodes, ascending, with the best plan as far as it fits."""
    count = check_root(tree, root)
    if max_nodes is not None and max_nodes < 1:
        raise ValueError(f"max_nodes must be at least 1, the root; got {max_nodes}.")
    # Each node has more visits than one below it, so that the first ones are a tree.
    visits = tree.nodes["visits"][root, :count].astype(np.int64)
    visits[best_plan(tree, root)[:max_nodes]] = np.iinfo(np.int64).max
    return np.sort(np.argsort(-visits, kind="stable")[:max_nodes])


def to_networkx(
    tree: TreeArrays, root: int = 0, *, max_nodes: int | None = None, states: bool = False
) -> Any:
    """Return the tree of one root as a directed graph of networkx, its nodes numbered as here.

    Args:
        tree: of a finished or interrupted search.
        root: which of the ``B`` roots. Default 0.
        max_nodes: how many nodes at most: those with most visits, and the best plan. Default: all.
        states: whether the nodes also have their ``state``, a dict of lists. Default False.

    Returns:
        A ``networkx.DiGraph``. Nodes have ``visits``, ``value``, ``depth``, ``base_steps``,
        ``path_return`` and ``twin`` as in :class:`TreeView`, and their flags as bools. Edges have
        the ``option``, its ``visits``, ``value`` and ``prior``, and ``reward``, ``discount`` and
        ``samples`` of the outcome. The graph has ``num_nodes`` and ``best_node``, the end of the
        best plan, -1 without one.

    Raises:
        ImportError: if networkx is missing.
        IndexError: if there is no such root.
        ValueError: if ``max_nodes`` is below 1, or states are asked for that the tree has not.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=3)
        >>> graph = MCTSPlanner(env, gamma=0.9).search(env.reset()).tree.to_networkx()
        >>> graph.nodes[6]["terminal"], graph.edges[2, 6]["option"], graph.edges[2, 6]["reward"]
        (True, 1, 1.0)
    """
    try:
        import networkx
    except ImportError as error:
        raise ImportError(
            "to_networkx needs networkx, which is missing here: pip install networkx."
        ) from error
    count = check_root(tree, root)
    if states and tree.states is None:
        raise ValueError(
            "This tree keeps no states (tree_search leaves them to its caller): pass states=False."
        )
    shown = shown_nodes(tree, root, max_nodes)
    nodes = tree.nodes[root, shown]
    graph = networkx.DiGraph(num_nodes=count, best_node=int(tree.roots["best_node"][root]))
    for index, node in zip(shown.tolist(), nodes, strict=True):
        named = {name: node[name].item() for name in _OF_NODES}
        named |= {name: bool(node["flags"] & bit) for name, bit in FLAGS.items()}
        graph.add_node(index, **named)
        if states:
            assert tree.states is not None
            graph.nodes[index]["state"] = {
                key: value.tolist() for key, value in tree.states[root, index].items(True, True)
            }
        if index == 0:
            continue
        edge = tree.edges[root, node["parent"], node["option"]]
        named = {name: node[name].item() for name in _OF_OUTCOMES}
        named |= {name: edge[name].item() for name in _OF_OPTIONS}
        graph.add_edge(int(node["parent"]), index, **named)
    return graph


def to_torchrl(tree: TreeArrays, root: int = 0) -> Tree:
    """Return the tree of one root as TorchRL's ``Tree``; nothing is shared with this one.

    A vertex is a node of this tree, and its fields hold:

    - ``count``: visits, int32. ``wins``: visits times value V, float32.
    - ``node_id`` and ``hash``: the node's number here. ``node_data``: its state.
    - ``rollout``: the macro-step that led to it, batch ``[1]``; None at the root. The parent's
      state, ``"action"`` (the option's index, int64) and ``"next"`` with the node's state,
      ``"reward"`` R, ``"discount"`` D, ``"duration"`` in base steps and the ends.
    - ``subtree``: a stack of its children, by option and then in the order they were drawn;
      ``index``: their numbers, int64. Both None where there are none.

    Args:
        tree: of a finished or interrupted search.
        root: which of the ``B`` roots. Default 0.

    Raises:
        IndexError: if there is no such root.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=3)
        >>> tree = MCTSPlanner(env, gamma=0.9).search(env.reset()).tree.to_torchrl()
        >>> tree.num_vertices(), tree.rollout_from_path((1, 1))["action"].tolist()
        (7, [1, 1])
    """
    from torchrl.data.map.tree import Tree

    count = check_root(tree, root)
    nodes = tree.nodes[root, :count]
    if tree.states is None:
        states: TensorDictBase = TensorDict({}, batch_size=[count])
    else:
        states = tree.states[root, :count].clone()
    parents = torch.from_numpy(np.maximum(nodes["parent"], 0).astype(np.int64))
    steps = nodes["base_steps"]
    done = (nodes["flags"] & TERMINAL) != 0

    def column(array: np.ndarray, dtype: torch.dtype) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(states.device, dtype).view(-1, 1, 1)

    transitions = states[parents].unsqueeze(1)
    after = states.clone().unsqueeze(1)
    # One number for each step, in the shape of the batch: as an env with a scalar action has it.
    transitions.set("action", column(nodes["option"], torch.int64).squeeze(-1))
    after.set("reward", column(nodes["reward"], torch.float32))
    after.set("discount", column(nodes["discount"], torch.float32))
    after.set("duration", column(steps - steps[parents.numpy()], torch.int64))
    after.set("done", column(done, torch.bool))
    after.set("terminated", column(done & (nodes["discount"] == 0.0), torch.bool))
    transitions.set("next", after)

    visits = torch.from_numpy(nodes["visits"].copy())
    wins = visits * torch.from_numpy(nodes["value"].copy())
    below: list[list[int]] = [[] for _ in range(count)]  # by option, in the order of their draw
    for n in np.argsort(nodes["option"], kind="stable")[1:].tolist():
        below[nodes["parent"][n]].append(n)
    vertices: list[Any] = [
        Tree(
            count=visits[n],
            wins=wins[n],
            node_id=n,
            hash=n,
            node_data=state,
            rollout=rollout if n else None,
            index=torch.tensor(below[n]) if below[n] else None,
        )
        for n, (state, rollout) in enumerate(
            zip(states.unbind(0), transitions.unbind(0), strict=True)
        )
    ]
    for n in reversed(range(count)):  # children stand behind their parents
        if below[n]:
            vertices[n].subtree = TensorDict.lazy_stack([vertices[child] for child in below[n]])
    return vertices[0]


def summary(tree: TreeArrays, root: int = 0, option_names: Sequence[str] | None = None) -> str:
    """Return what a search found as text: its size, the root's options, and the principal plan.

    The plan is the best one found, or else the path of most visits. ``steps`` and ``return``
    (discounted) count from the root. ``R`` is the reward of the option, ``Q`` its value, ``V`` the
    value of the node it led to.

    Args:
        tree: of a finished or interrupted search.
        root: which of the ``B`` roots. Default 0.
        option_names: one for each of the ``A`` options. Default: none.

    Returns:
        Lines of at most 88 characters.

    Raises:
        IndexError: if there is no such root.
        ValueError: if there are fewer names than options.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> env = ChainEnv(length=3)
        >>> tree = MCTSPlanner(env, gamma=0.9).search(env.reset()).tree
        >>> print(tree.summary(option_names=["left", "right"]))
        Search tree: 7 nodes, 3 expanded, 1 terminal; depth 2
        Root: 7 visits, value V = 0.1286
        <BLANKLINE>
        option   visits                              Q  prior
        1 right       3  50.0 % |######      |  0.3000  0.500
        0 left        3  50.0 % |######      |  0.0000  0.500
        <BLANKLINE>
        Best plan: 2 options, 2 base steps, return 0.9000
        <BLANKLINE>
          #  option   steps       R  return       Q       V  visits
          1  1 right      1  0.0000  0.0000  0.3000  0.3333       3
          2  1 right      2  1.0000  0.9000  1.0000  0.0000       1
    """
    count = check_root(tree, root)
    names = option_labels(tree.num_options, option_names, width=_NAME_WIDTH)
    nodes = tree.nodes[root, :count]
    counts = [f"{plural(count, 'node')}"]
    for name in ("expanded", "pruned", "terminal"):
        number = int(((nodes["flags"] & FLAGS[name]) != 0).sum())
        if name == "pruned":
            known = int((nodes["twin"] >= 0).sum())
            counts += [f"{known:,} of known states"] if known else []
            number -= known
        if number:
            counts.append(f"{number:,} {name}")
    size = f"Search tree: {', '.join(counts)}; depth {int(nodes['depth'].max()):,}"
    lines = textwrap.wrap(size, _LINE_WIDTH, subsequent_indent="  ")
    value = _numbers([nodes["value"][0]])[0].strip()
    lines.append(f"Root: {plural(int(nodes['visits'][0]), 'visit')}, value V = {value}")
    lines += ["", *_table_of_options(tree, root, names)]
    plan = best_plan(tree, root)
    if plan:
        gained = _numbers([nodes["path_return"][plan[-1]]])[0].strip()
        title = f"Best plan: {plan_size(tree, root)}, return {gained}"
    else:
        plan = most_visited_path(tree, root)
        title = "No plan found yet. Most visited path:"
    if len(plan) > 1:
        lines += ["", title, "", *_table_of_steps(tree, root, plan, names)]
    elif len(nodes) == 1:
        lines += ["", "Nothing has been simulated."]
    return "\n".join(line.rstrip() for line in lines)


def option_labels(
    num_options: int, option_names: Sequence[str] | None, *, width: int | None = None
) -> list[str]:
    """Return a label for each option: its number, and its name if there is one."""
    if option_names is None:
        return [str(option) for option in range(num_options)]
    if isinstance(option_names, str) or len(option_names) < num_options:
        raise ValueError(
            f"option_names needs one name for each of the {num_options} options; got "
            f"{option_names!r}."
        )
    labels = [f"{option} {option_names[option]}" for option in range(num_options)]
    return [_clip(label, width or len(label)) for label in labels]


def _table_of_options(tree: TreeArrays, root: int, names: list[str]) -> list[str]:
    edges = tree.edges[root, 0]
    forbidden, visits = edges["closed"] == FORBIDDEN, edges["visits"].astype(np.int64)
    order = np.lexsort((-edges["value"], -visits, forbidden))
    shown, left_out = order[:_MAX_OPTIONS], order[_MAX_OPTIONS:]
    shares, values = visits / max(int(visits.sum()), 1), _numbers(edges["value"])
    rows = []
    for a in shown:
        bar = f"{100 * shares[a]:.1f} % |{'#' * round(_BAR * shares[a]):{_BAR}}|"
        q = values[a] if edges["child"][a] >= 0 else "-"
        cells = (f"{visits[a]:,}", bar, q, f"{edges['prior'][a]:.3f}")
        rows.append((names[a], *(("not allowed", "", "", "") if forbidden[a] else cells)))
    lines = _table(("option", "visits", "", "Q", "prior"), rows)
    if len(left_out):
        number = int(visits[left_out].sum())
        lines.append(f"... and {plural(len(left_out), 'option')} with {plural(number, 'visit')}")
    return lines


def _table_of_steps(tree: TreeArrays, root: int, plan: list[int], names: list[str]) -> list[str]:
    nodes = tree.nodes[root, plan[1:]]
    edges = tree.edges[root, nodes["parent"], nodes["option"]]
    columns = (
        [f"{i + 1:>3}" for i in range(len(nodes))],
        [names[a] for a in nodes["option"]],
        [f"{int(n):,}" for n in nodes["base_steps"]],
        *map(_numbers, (nodes["reward"], nodes["path_return"], edges["value"], nodes["value"])),
        [f"{int(n):,}" for n in nodes["visits"]],
    )
    header = ("#", "option", "steps", "R", "return", "Q", "V", "visits")
    lines = _table(header, list(zip(*columns, strict=True)))
    if len(nodes) > _MAX_STEPS:
        head, tail = lines[: 1 + _MAX_STEPS // 2], lines[-_MAX_STEPS // 2 + 1 :]
        gap = f"... {plural(len(lines) - len(head) - len(tail), 'option')} left out ..."
        lines = [*head, f"     {gap}", *tail]
    twin = int(nodes["twin"][-1])
    if twin >= 0:
        where = ", ".join(names[a] for a in tree.options(root, twin))
        lines.append(f"It continues from the same state behind: {_clip(where, 48) or 'the root'}")
    return lines


def _table(header: Sequence[str], rows: list[Any]) -> list[str]:
    """Lines of a table, its header first; options are cut where it would be too wide."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    at = header.index("option")
    room = _LINE_WIDTH - sum(widths) - 2 * (len(widths) - 1)
    widths[at] = max(widths[at] + min(room, 0), len("option"))
    return [
        "  ".join(
            f"{_clip(cell, width):<{width}}" if i == at else f"{cell:>{width}}"
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in (header, *rows)
    ]


def _numbers(values: Any) -> list[str]:
    """Numbers of one column with the same decimals, at most 9 characters each."""
    array = np.atleast_1d(np.asarray(values, np.float64)) + 0.0  # no negative zeros
    largest = np.abs(array).max(initial=0.0)
    if largest != 0.0 and not 1e-3 <= largest < 99_999.0:
        return [f"{value:.2e}" for value in array]
    decimals = 4 if largest < 99.0 else 3 if largest < 999.0 else 2 if largest < 9999.0 else 1
    return [f"{value:.{decimals}f}" for value in array]


def plural(number: int, noun: str) -> str:
    """Return "1 node", "2 nodes"."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def _clip(text: str, width: int) -> str:
    return text if len(text) <= width else f"{text[: width - 3]}..."
