"""The textbook's tree search in plain Python: read it first; tests check the compiled one by it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from torchrl_hmcts.checks import instance
from torchrl_hmcts.planners.tree_policies import PUCT, UCT


@dataclass(eq=False)
class Node:
    """A state in the tree, with the step that led to it."""

    number: int  # of the nodes before it
    state: Any  # as the model gives it
    priors: dict[int, float]  # of the options that may be taken; none in a terminal state
    evaluation: float  # its value before anything was simulated from it
    parent: Node | None = None
    option: int = -1  # that led here
    reward: float = 0.0  # R of that option
    discount: float = 1.0  # its D, gamma ** k
    path_return: float = 0.0  # discounted reward from the root
    path_discount: float = 1.0
    visits: int = 1  # N, its own evaluation included
    children: dict[int, Node] = field(default_factory=dict)  # by option

    def __post_init__(self) -> None:
        self.value = self.evaluation  # V
        self.closed = not self.priors  # nothing below it is left to simulate

    @property
    def q(self) -> float:
        """The value of the option that led here, Q = R + D V."""
        return self.reward + self.discount * self.value


class ReferenceSearch:
    r"""Searches a model by one descent per simulation, over options that last several steps.

    A simulation descends from the root by the tree policy to an option that was never simulated
    (``expand="one"``), or to a node without simulated options (``expand="all"``). It adds the
    model's outcome as a node, and updates the values up to the root:

    .. math:: G \leftarrow R + \gamma^k G, \qquad
              V \leftarrow V + \frac{G - V}{N} \;\text{ or }\; \max_o Q(o), \qquad
              Q = R + \gamma^k V

    :class:`MCTSPlanner` and :func:`tree_search` do the same for many roots at once, compiled. Tests
    compare their trees with this one's, node by node.

    Args:
        root: the state to search from.
        model: ``model(state, option) -> (next state, reward, base steps, terminated)``.
        options: ``options(state)``, those that may be taken; none in a terminal state.
        gamma: discount per base step. Default 0.99.
        evaluate: ``evaluate(state) -> (priors, value)``, priors by option. Default: uniform
            priors and a value of 0.
        tree_policy: :class:`UCT` (default) or :class:`PUCT`.
        backup, expand, exhausted: as in :class:`SearchSettings`.

    Reference:
        Kocsis and Szepesvari 2006; dissertation, section 2.4.2.

    Example:
        >>> def model(state, option):  # a chain of five states; option 1 goes right
        ...     state = max(state + 2 * option - 1, 0)
        ...     return state, float(state == 4), 1, state == 4
        >>> search = ReferenceSearch(0, model, options=lambda state: [0, 1])
        >>> search.run(num_simulations=60)
        >>> round(search.best.path_return, 4), search.plan()
        (0.9703, [1, 1, 1, 1])
    """

    def __init__(
        self,
        root: Any,
        model: Callable[[Any, int], tuple[Any, float, int, bool]],
        options: Callable[[Any], Sequence[int]],
        *,
        gamma: float = 0.99,
        evaluate: Callable[[Any], tuple[Sequence[float] | None, float]] | None = None,
        tree_policy: UCT | PUCT | None = None,
        backup: Literal["mean", "max"] = "mean",
        expand: Literal["all", "one"] = "all",
        exhausted: Literal["skip", "revisit"] = "skip",
    ) -> None:
        self.model, self.options, self.evaluate, self.gamma = model, options, evaluate, gamma
        self.tree_policy = UCT() if tree_policy is None else tree_policy
        instance("ReferenceSearch", "tree_policy", self.tree_policy, UCT, PUCT)
        self.backup, self.expand, self.revisit = backup, expand, exhausted == "revisit"
        self.nodes: list[Node] = []
        self.root = self._node(root, terminal=not options(root))
        self.simulations = self.expansions = self.revisits = 0
        self.lowest, self.highest = math.inf, -math.inf  # Q anywhere in the tree so far
        self.best: Node | None = None  # end of the best plan

    def run(self, num_simulations: int | None = None, num_expansions: int | None = None) -> None:
        """Simulate until a number is reached or, unless leaves are revisited, nothing is left."""
        while self.expansions != num_expansions:
            if num_simulations is not None and self.simulations >= num_simulations:
                return
            if self.root.closed and not (self.revisit and num_simulations is not None):
                return
            self.simulate()

    def simulate(self) -> None:
        """Descend once, to new nodes or to a known terminal one."""
        node = self.root
        while node.priors:
            if self.expand == "all" and not node.children:
                self.expansions += 1
                for option in node.priors:
                    self._back_up(self._simulate_option(node, option))
                return
            option = self.choose(node)
            if option not in node.children:
                self.expansions += 1
                self._back_up(self._simulate_option(node, option))
                return
            node = node.children[option]
        node.visits += 1
        self.revisits += 1
        self._back_up(node)

    def choose(self, node: Node) -> int:
        """Return the open option of the highest score; ties go to the prior, then the index."""
        options = [
            option
            for option in node.priors
            if self.revisit or option not in node.children or not node.children[option].closed
        ]
        return max(options, key=lambda option: (self.score(node, option), node.priors[option]))

    def score(self, node: Node, option: int) -> float:
        """Return the score that UCT or PUCT maximises."""
        policy, child = self.tree_policy, node.children.get(option)
        if isinstance(policy, UCT):
            if child is None:
                return math.inf
            return child.q + policy.c * math.sqrt(math.log(node.visits) / child.visits)
        c, total = policy.c, sum(other.visits for other in node.children.values())
        if policy.c_base is not None:
            total = node.visits
            c += math.log((node.visits + policy.c_base + 1) / policy.c_base)
        tried = 0 if child is None else child.visits
        exploration = c * node.priors[option] * math.sqrt(total) / (1 + tried)
        return self._scaled(node, child, policy) + exploration

    def _scaled(self, node: Node, child: Node | None, policy: PUCT) -> float:
        """Q of an option in units of its siblings or of the whole tree."""
        if policy.normalize is None:
            return policy.unvisited_value if child is None else child.q
        if child is None:
            return 0.0
        low, high = self.lowest, self.highest
        if policy.normalize == "siblings":
            values = [node.value, *(other.q for other in node.children.values())]
            low, high = min(values), max(values)
        return (child.q - low) / max(high - low, 1e-8)

    def _node(self, state: Any, *, terminal: bool, **step: Any) -> Node:
        options = [] if terminal else list(self.options(state))
        priors, value = (None, 0.0) if self.evaluate is None else self.evaluate(state)
        weights = {a: 1.0 if priors is None else priors[a] for a in options}
        priors_of = {a: weight / sum(weights.values()) for a, weight in weights.items()}
        node = Node(len(self.nodes), state, priors_of, 0.0 if terminal else value, **step)
        self.nodes.append(node)
        return node

    def _simulate_option(self, parent: Node, option: int) -> Node:
        state, reward, base_steps, terminated = self.model(parent.state, option)
        discount = 0.0 if terminated else self.gamma**base_steps
        node = parent.children[option] = self._node(
            state,
            terminal=terminated,
            parent=parent,
            option=option,
            reward=reward,
            discount=discount,
            path_return=parent.path_return + parent.path_discount * reward,
            path_discount=parent.path_discount * discount,
        )
        if reward > 0.0 and (self.best is None or node.path_return > self.best.path_return):
            self.best = node
        return node

    def _back_up(self, node: Node) -> None:
        """Carry the value of a node up to the root."""
        self.simulations += 1
        gain = node.value
        while node.parent is not None:
            gain = node.reward + node.discount * gain
            self.lowest, self.highest = min(self.lowest, node.q), max(self.highest, node.q)
            node = node.parent
            children = node.children.values()
            node.visits += 1
            if self.backup == "max":
                node.value = max(child.q for child in children)
            else:
                node.value += (gain - node.value) / node.visits
            node.closed = len(children) == len(node.priors) and all(c.closed for c in children)

    def plan(self) -> list[int]:
        """Return the options of the best plan; none if no option earned a reward."""
        options, node = [], self.best
        while node is not None and node.parent is not None:
            options.append(node.option)
            node = node.parent
        return options[::-1]
