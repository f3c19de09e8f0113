"""All settings of a search, in one object that a planner and its searches share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from torchrl_hmcts.checks import instance, no_class, whole_number
from torchrl_hmcts.planners.budget import ProgressiveWidening, TreeRollout
from torchrl_hmcts.planners.novelty import NoveltyTest
from torchrl_hmcts.planners.transpositions import Transpositions
from torchrl_hmcts.planners.tree import MAX_BACKUP, MEAN_BACKUP, PYTHON_SCORE, RECORD
from torchrl_hmcts.planners.tree_policies import UCT, CompiledPolicy, Gumbel, TreePolicy


@dataclass(frozen=True)
class SearchSettings:
    r"""Holds the parts and numbers of a search, checked once and never changed.

    A planner builds one from its keywords, ``planner.settings``; to assign one of its parts
    replaces it. A search takes the planner's new settings when it is resumed.

    Args:
        tree_policy: :class:`UCT` (default, ``c=1``), :class:`PUCT`, :class:`Gumbel`,
            :class:`TorchRLScore`, or a callable over :class:`NodeStatistics`.
        backup: how the value of a node is computed. ``"mean"`` (default): the mean of its own
            evaluation and all returns through it,
            :math:`V \leftarrow V + (R + D\,V' - V) / N` (Coulom 2006; dissertation, section
            2.4.2). ``"max"``: the value of its best option, :math:`V = \max_o R + D\,V'`, exact in
            a deterministic simulator.
        novelty: which new nodes are worth searching, e.g. ``RadiusNovelty("position", 0.35)``.
            Default: all.
        transpositions: which states are the same. Default: none are.
        chance: for a stochastic simulator, how often an option is simulated in a node. Default:
            once.
        rollout: continue from every new leaf for some options and keep them in the tree. Needs
            ``expand="one"``. Default: none.
        expand: ``"all"`` simulates every option of a leaf at once (default), ``"one"`` only the
            option that the tree policy chooses, as in the textbook.
        leaves_per_wave: leaves of each root that share a simulator call. More are faster for few
            roots and search less selectively. At most 255; default 1.
        waves_in_flight: waves that are simulated at a time, each chosen before the outcomes of the
            earlier ones are known: with 2 a pool of processes has work while the planner inserts
            and selects. The tree is the same on every simulator, unless the budget has
            ``seconds``. Times ``leaves_per_wave`` at most 255; default 1.
        exhausted: what a descent does with an option behind which nothing is left to simulate.
            ``"skip"`` (default): every simulation finds something new. ``"revisit"``: the known
            value is backed up once more, without the simulator, so that visits and mean values are
            those of the textbook. Always ``"revisit"`` with ``chance`` or ``Gumbel``.

    Raises:
        ValueError: if a number is out of range, or two parts do not go together.
        TypeError: if a part is of another kind.

    Example:
        >>> from torchrl_hmcts.planners import UCT, MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> planner = MCTSPlanner(ChainEnv(length=6), expand="one")
        >>> planner.tree_policy = UCT(c=5.0)
        >>> planner.settings.tree_policy, planner.settings.expand
        (UCT(c=5.0), 'one')
    """

    tree_policy: TreePolicy = field(default_factory=UCT)
    backup: Literal["mean", "max"] = "mean"
    novelty: NoveltyTest | None = None
    transpositions: Transpositions | None = None
    chance: ProgressiveWidening | None = None
    rollout: TreeRollout | None = None
    expand: Literal["all", "one"] = "all"
    leaves_per_wave: int = 1
    waves_in_flight: int = 1
    exhausted: Literal["skip", "revisit"] = "skip"

    def __post_init__(self) -> None:
        for name, allowed in (
            ("backup", ("mean", "max")),
            ("expand", ("all", "one")),
            ("exhausted", ("skip", "revisit")),
        ):
            value = getattr(self, name)
            if not isinstance(value, str) or value not in allowed:
                raise ValueError(f"{name} must be {allowed[0]!r} or {allowed[1]!r}; got {value!r}.")
        for name in ("leaves_per_wave", "waves_in_flight"):
            object.__setattr__(self, name, whole_number("A search", name, getattr(self, name)))
        leaves, waves = self.leaves_per_wave, self.waves_in_flight
        if min(leaves, waves) < 1 or leaves * waves > 255:
            raise ValueError(
                f"A search needs leaves_per_wave and waves_in_flight from 1 on, their product up "
                f"to 255; got leaves_per_wave={leaves}, waves_in_flight={waves}."
            )
        for name in ("tree_policy", "novelty"):
            no_class("A search", name, getattr(self, name))
        if not callable(self.tree_policy) and not isinstance(self.tree_policy, CompiledPolicy):
            raise TypeError(
                f"A search needs a tree policy: UCT(), PUCT(), Gumbel(), TorchRLScore(...) or a "
                f"callable over NodeStatistics; got {self.tree_policy!r}."
            )
        for name, kind in (
            ("transpositions", Transpositions),
            ("chance", ProgressiveWidening),
            ("rollout", TreeRollout),
        ):
            instance("A search", name, getattr(self, name), kind, type(None))
        if self.novelty is not None and not hasattr(self.novelty, "accept"):
            raise TypeError(
                f"novelty needs the members of NoveltyTest; got {self.novelty!r}. Write "
                f'novelty=RadiusNovelty("position", radius) or WidthNovelty("features").'
            )
        if self.rollout is not None and (self.expand != "one" or self.is_gumbel):
            raise ValueError(
                f"A TreeRollout continues from the one option that was simulated; got "
                f"expand={self.expand!r} and tree_policy={self.tree_policy!r}. Pass expand='one' "
                f"and UCT, PUCT or a policy of your own."
            )
        if self.chance is not None and self.transpositions is not None:
            raise ValueError(
                "Transpositions share the nodes after a state; chance draws these nodes each "
                "time. Use transpositions or chance, not both."
            )

    @property
    def is_gumbel(self) -> bool:
        """True if the search follows a schedule of simulations."""
        return isinstance(self.tree_policy, Gumbel)

    @property
    def revisit(self) -> bool:
        """True if descents land on what they know: chance never closes, Gumbel counts visits."""
        return self.exhausted == "revisit" or self.chance is not None or self.is_gumbel

    def check_simulations(self, num_simulations: int | None) -> None:
        """Refuse a number of simulations that ``Gumbel`` cannot plan."""
        if isinstance(self.tree_policy, Gumbel):
            at_once = self.leaves_per_wave, self.waves_in_flight
            self.tree_policy.check_simulations(num_simulations, self.expand, *at_once)

    def record(self) -> np.ndarray:
        """Return what the kernels read, ``[1]`` of ``tree.RECORD``."""
        record = np.zeros(1, RECORD)
        numbers: dict[str, Any] = {
            "backup": MAX_BACKUP if self.backup == "max" else MEAN_BACKUP,
            "expand_all": self.expand == "all",
            "leaves": self.leaves_per_wave,
            "revisit": self.revisit,
            "twins": self.transpositions is not None,
            "score": PYTHON_SCORE,
            "mark": True,
        }
        if self.chance is not None:
            numbers.update(widening=self.chance.k, widening_exponent=self.chance.alpha)
        if isinstance(self.tree_policy, CompiledPolicy):
            numbers.update(self.tree_policy.record())
            # Options on the way down are marked for other descents, and always for those in Python.
            numbers["mark"] = self.leaves_per_wave * self.waves_in_flight > 1
        for name, number in numbers.items():
            record[name] = number
        return record
