"""Skills that are added while they are of use.

Letters: B searches, Z skills there is room for.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from tensordict import TensorDictBase
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_hmcts.checks import instance, real_number, whole_number
from torchrl_hmcts.modules import GrowingSkillPrior, SkillPrior
from torchrl_hmcts.planners import MCTSPlanner, Search
from torchrl_hmcts.planners.tree import PRUNED

_MIN_RISE = 0.01  # of the accuracy, below which it has stopped to rise
_COLUMNS = ("base_steps", "num_active", "accuracy", "coverage", "gain", "better")


class SearchCoverage:
    r"""Counts the places that searches of a fixed budget reach with the skills that are on.

    .. math:: C = \frac{1}{B} \sum_{b < B} \bigl|\{\text{nodes of tree } b
        \text{ that its novelty test accepted}\}\bigr|

    C measures the area within reach. Give the planner a budget of simulated base steps: every skill
    costs some in every expansion, so that a skill which leads nowhere new lowers C.

    Args:
        planner (MCTSPlanner): over the worker's skills, with a novelty test that keeps its radius
            (``max_relaxations=0``) and a budget that does not end at the first plan
            (``until_plan=False``).
        starts (TensorDictBase): states ``[B]`` to search from, all of them in every call.
        prior (SkillPrior, optional): which skills are on, written into the starts under the
            planner's mask key.

    Returns:
        From ``coverage()``: C, a float. The attribute ``base_steps`` adds up what was simulated.

    Raises:
        ValueError: if the planner has no novelty test, or ends at its first plan.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty, SearchBudget
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> from torchrl_hmcts.trainers.skills.growing import SearchCoverage
        >>> env = ChainEnv(length=5)
        >>> planner = MCTSPlanner(
        ...     env,
        ...     novelty=RadiusNovelty("state", 1.0, max_relaxations=0),
        ...     budget=SearchBudget(base_steps=20, until_plan=False),
        ... )
        >>> SearchCoverage(planner, env.reset().unsqueeze(0))()
        5.0
    """

    def __init__(
        self, planner: MCTSPlanner, starts: TensorDictBase, prior: SkillPrior | None = None
    ) -> None:
        if planner.novelty is None or planner.budget.until_plan:
            raise ValueError(
                "SearchCoverage counts the nodes that a novelty test accepts while the budget "
                "lasts; the planner has novelty="
                f"{planner.novelty} and until_plan={planner.budget.until_plan}. Build it with e.g. "
                "novelty=RadiusNovelty('position', 0.7), budget=SearchBudget(..., "
                "until_plan=False)."
            )
        self.planner = planner
        self.starts = starts
        self.prior = prior
        self.base_steps = 0

    def __call__(self) -> float:
        starts = self.starts.clone()
        key = self.planner.simulator.mask_key
        if self.prior is not None and key is not None:
            active = self.prior.active()
            starts.set(key, active.expand(*starts.batch_size, len(active)).clone())
        search = self.planner.search(starts, seed=0)
        self.base_steps += int(search.num_base_steps.sum())
        return float(_num_places(search).mean())


def _num_places(search: Search) -> np.ndarray:
    """Nodes of each tree that its novelty test accepted, int64 ``[B]``."""
    used = np.arange(search.tree.capacity) < search.tree.num_nodes[:, None]
    accepted: np.ndarray = (search.tree.nodes["flags"] & PRUNED) == 0
    return (accepted & used).sum(-1)


class GrowSkills(TrainerHookBase):
    r"""Switches on one skill after the other while they add coverage, then returns to the best.

    .. math:: C_n \ge (1 + g_{\min})\, C_{n^*} \;\Rightarrow\; n^* \leftarrow n

    :math:`C_n` is the coverage with n skills, measured once the discriminator's accuracy has
    stopped to rise, between ``min_base_steps`` and ``max_base_steps`` after the last change. When
    ``patience`` skills in a row have added nothing, after one that did, they are switched off
    again, the networks get back the weights with which :math:`n^*` was measured, and the rest of
    training is spent on these skills. With ``prune``, a skill without which coverage is no smaller
    is dropped before. The replay buffer is emptied at every change: it holds the new skill hardly
    at all, so that the new skill would do what an old one does.

    A hook of any TorchRL ``Trainer`` (of one process) whose loss has the prior, which it saves.

    Args:
        prior (GrowingSkillPrior): that ``SkillTransform``, skill objective and
            ``SkillMaskTransform`` read.
        coverage (callable): ``coverage() -> float`` with the skills that are on, more is better: a
            :class:`SearchCoverage`, or your own.
        min_gain (float): :math:`g_{\min}`, the share of coverage that more skills must add.
        patience (int): skills in a row that may add nothing before growing ends. A third skill on a
            plane often has to wait for the fourth.
        prune (bool): drop useless skills among the :math:`n^*` when growing ends.
        min_base_steps, max_base_steps (int): base steps that a number of skills is trained before
            it is judged, at least and at most.
        window (int): batches over which the mean ``discriminator_accuracy`` must have stopped to
            rise, from the first half to the second; where a loss has none, ``max_base_steps``
            decides.

    Attributes:
        history: dict of lists, one entry per judgement: ``base_steps`` of training, ``num_active``
            skills judged, ``accuracy``, ``coverage``, ``gain`` over the best before (NaN for the
            first), ``better``.
        dropped (list of int): the skills that pruning has dropped, in order.
        finished (bool): the number of skills will not change any more.

    Raises:
        ValueError: if a number is out of its range.

    Reference:
        This project's, for what section 6.2 of Bartley 2023 leaves to the future. Adding skills as
        the discriminator's accuracy saturates: the curriculum of Achiam et al., "Variational Option
        Discovery Algorithms", 2018, arXiv 1807.10299.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv
        >>> from torchrl_hmcts.modules import GrowingSkillPrior
        >>> from torchrl_hmcts.trainers.diayn import DIAYNTrainer
        >>> from torchrl_hmcts.trainers.skills.growing import GrowSkills
        >>> from torchrl_hmcts.transforms import DisplacementTransform, SkillTransform
        >>> prior = GrowingSkillPrior(8, num_active=2)
        >>> env = TransformedEnv(
        ...     WaterworldMazeEnv(batch_size=[32], observation=False),
        ...     Compose(SkillTransform(8, 50, prior=prior), DisplacementTransform()),
        ... )
        >>> loss = DIAYNTrainer.make_loss(env, num_skills=8, seed=0, prior=prior)
        >>> trainer = DIAYNTrainer(env, loss, total_frames=256, seed=0)
        >>> coverages = iter([1.0, 2.0, 2.0])  # of 2, 3 and 4 skills
        >>> grow = GrowSkills(
        ...     prior, lambda: next(coverages), patience=1, prune=False,
        ...     min_base_steps=64, max_base_steps=64)
        >>> grow.register(trainer)
        >>> trainer.train()
        >>> grow.history["num_active"], grow.history["better"], int(prior.num_active)
        ([2, 3, 4], [True, True, False], 3)
    """

    def __init__(
        self,
        prior: GrowingSkillPrior,
        coverage: Callable[[], float],
        *,
        min_gain: float = 0.05,
        patience: int = 2,
        prune: bool = True,
        min_base_steps: int = 3_200,
        max_base_steps: int = 4_800,
        window: int = 40,
    ) -> None:
        owner = "GrowSkills"
        instance(owner, "prior", prior, GrowingSkillPrior)
        instance(owner, "coverage", coverage, Callable)
        instance(owner, "prune", prune, bool)
        self.prior = prior
        self.coverage = coverage
        self.min_gain = real_number(owner, "min_gain", min_gain, least=0.0)
        self.patience = whole_number(owner, "patience", patience, least=1)
        self.prune = prune
        self.min_base_steps = whole_number(owner, "min_base_steps", min_base_steps, least=1)
        self.max_base_steps = whole_number(
            owner, "max_base_steps", max_base_steps, least=self.min_base_steps
        )
        self.window = whole_number(owner, "window", window, least=2)
        self.finished = False
        self.history: dict[str, list[Any]] = {key: [] for key in _COLUMNS}
        self.dropped: list[int] = []
        self._changed_at = 0  # base steps of training at the last change
        self._best: dict[str, Any] = {}  # number, coverage and weights of the best skills so far
        self._fruitless = 0  # skills in a row that added nothing
        self._accuracies: list[float] = []  # since the last change, at most a window
        self._trainer: Trainer | None = None

    def register(self, trainer: Trainer, name: str = "grow_skills") -> None:
        self._trainer = trainer
        trainer.register_op("post_optim_complete_log", self.watch)
        trainer.register_op("post_steps", self)
        trainer.register_module(name, self)

    def watch(self, optim_steps: int, losses: TensorDictBase | None) -> dict[str, float]:
        """Notes a batch's accuracy; returns what to log."""
        accuracy = None if losses is None else losses.get("discriminator_accuracy", None)
        if accuracy is not None:
            self._accuracies = [*self._accuracies, float(accuracy)][-self.window :]
        return {"num_active_skills": float(self.prior.active().sum())}

    def saturated(self) -> bool:
        """Returns whether the accuracy no longer rises."""
        if len(self._accuracies) < self.window:
            return False
        half = self.window // 2
        first, second = self._accuracies[:half], self._accuracies[half:]
        return float(np.mean(second) - np.mean(first)) < _MIN_RISE

    def __call__(self) -> None:
        if self._trainer is None:
            raise RuntimeError("GrowSkills runs inside a Trainer: call grow.register(trainer).")
        now = int(self._trainer.collected_frames)
        since = now - self._changed_at
        if self.finished or since < self.min_base_steps:
            return
        if self.saturated() or since >= self.max_base_steps:
            self._judge(self._trainer, now)

    def _judge(self, trainer: Trainer, base_steps: int) -> None:
        """Measures the coverage; then switches a skill on, or those off that add nothing."""
        number = int(self.prior.num_active)
        coverage = float(self.coverage())
        gain = float("nan")
        if self._best:
            before = self._best["coverage"]
            gain = coverage / before - 1.0 if before else float("inf")
        better = not self._best or gain >= self.min_gain
        accuracy = float(np.mean(self._accuracies)) if self._accuracies else float("nan")
        row = (base_steps, number, accuracy, coverage, gain, better)
        for key, value in zip(_COLUMNS, row, strict=True):
            self.history[key].append(value)
        if better:
            weights = {n: copy.deepcopy(p.state_dict()) for n, p in _parts(trainer).items()}
            self._best = {"number": number, "coverage": coverage, "weights": weights}
        self._fruitless = 0 if better else self._fruitless + 1
        helped = any(self.history["better"][1:])
        ripe = helped and self._fruitless >= self.patience
        self.finished = ripe or number == self.prior.num_skills
        if not self.finished:
            self.prior.set_num_active(number + 1)
        else:
            if not better:
                self.prior.set_num_active(self._best["number"])
                for name, part in _parts(trainer).items():
                    part.load_state_dict(copy.deepcopy(self._best["weights"][name]))
            if self.prune:
                self._drop_useless_skills()
            self._best.pop("weights")
            if better and not self.dropped:
                return  # nothing has changed
        self._changed_at = base_steps
        self._accuracies = []
        if trainer.replay_buffer is not None:
            trainer.replay_buffer.empty()

    def _drop_useless_skills(self) -> None:
        """Drops skills while coverage without them is no smaller."""
        coverage = self._best["coverage"]
        while int(self.prior.active().sum()) > 2:
            without = {}
            for skill in self.prior.active().nonzero().flatten().tolist():
                self.prior.drop(skill)
                without[skill] = float(self.coverage())
                self.prior.drop(skill, dropped=False)
            useless = max(without, key=lambda skill: without[skill])
            if without[useless] < coverage:
                return
            coverage = without[useless]
            self.prior.drop(useless)
            self.dropped.append(useless)

    def state_dict(self) -> dict[str, Any]:
        """Returns the prior's state, the progress of growing, the best weights, the history."""
        return {
            "prior": self.prior.state_dict(),
            "finished": self.finished,
            "changed_at": self._changed_at,
            "best": dict(self._best),
            "fruitless": self._fruitless,
            "dropped": list(self.dropped),
            "accuracies": list(self._accuracies),
            "history": {key: list(values) for key, values in self.history.items()},
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continues from what :meth:`state_dict` returned."""
        self.prior.load_state_dict(state_dict["prior"])
        self.finished = bool(state_dict["finished"])
        self._changed_at = int(state_dict["changed_at"])
        self._best = dict(state_dict["best"])
        self._fruitless = int(state_dict["fruitless"])
        self.dropped = list(state_dict["dropped"])
        self._accuracies = list(state_dict["accuracies"])
        self.history = {key: list(state_dict["history"][key]) for key in _COLUMNS}


def _parts(trainer: Trainer) -> dict[str, Any]:
    """What training changes, and what goes back to where it was best."""
    parts = {"loss_module": trainer.loss_module, "optimizer": trainer.optimizer}
    return {name: part for name, part in parts.items() if part is not None}
