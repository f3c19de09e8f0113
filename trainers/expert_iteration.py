"""Training of the manager: search, learn from the search, search with what was learned."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from types import NoneType
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule
from torchrl.trainers import LRSchedulerHook

from torchrl_hmcts.checks import instance, real_number, whole_number
from torchrl_hmcts.objectives import ExpertIterationLoss
from torchrl_hmcts.planners import (
    PUCT,
    MCTSPlanner,
    NoveltyTest,
    PolicyValueEvaluator,
    SearchBudget,
    search_examples,
)
from torchrl_hmcts.trainers.collectors import LocalCollector
from torchrl_hmcts.trainers.off_policy import OffPolicyTrainer, Progress

_TARGETS = ("policy_target", "policy_weight", "value_target", "value_weight", "action_mask")
_GROUP = 100  # searches side by side


def make_guided_planner(
    env: EnvBase,
    network: TensorDictModuleBase,
    *,
    c: float = 0.3,
    uniform_share: float = 0.05,
    novelty: NoveltyTest | None = None,
    expand: Literal["all", "one"] = "one",
    budget: SearchBudget | None = None,
    **planner_kwargs: Any,
) -> MCTSPlanner:
    """Build a planner that a network guides: PUCT with its prior, and its values at the leaves.

    Args:
        env: the macro environment.
        network: writes ``"logits"`` and ``"state_value"`` from entries of the env.
        c: exploration constant of PUCT, in units of the return; for returns up to 1.
        uniform_share: share of the prior that is spread over all options.
        novelty: which new nodes are worth searching. Default: all. Choose a test much stricter on
            what it calls equal than without a network (in Waterworld a radius of 0.2 tiles instead
            of 0.7).
        expand: ``"one"`` simulates only the option that PUCT chooses.
        budget: Default: 4,000 expansions, of one option each.
        **planner_kwargs: passed to ``MCTSPlanner``.

    Returns:
        The planner. Values are backed up by their maximum, which is exact in a deterministic env.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_hmcts.envs import WaterworldMazeEnv
        >>> from torchrl_hmcts.trainers.expert_iteration import make_guided_planner
        >>> env = WaterworldMazeEnv(observation=False)  # plans base steps, for example
        >>> network = TensorDictModule(
        ...     lambda velocity: (torch.zeros(*velocity.shape[:-1], 4), velocity[..., :1]),
        ...     ["velocity"], ["logits", "state_value"])
        >>> make_guided_planner(env, network).num_options
        4
    """
    guide = PolicyValueEvaluator(network, uniform_share=uniform_share)
    if budget is None:
        budget = SearchBudget(expansions=4_000)
    return MCTSPlanner(
        env,
        tree_policy=PUCT(c=c),
        leaf_evaluator=guide,
        backup="max",
        novelty=novelty,
        expand=expand,
        budget=budget,
        **planner_kwargs,
    )


class SearchCollector(LocalCollector):
    """Yields one batch of examples per iteration, from searches at fresh starts of an env.

    A frame is an example. What the searches of each iteration cost is in ``base_steps`` and
    ``simulations`` of options; ``solved`` counts those that found a plan.
    """

    def __init__(
        self,
        env: EnvBase,
        first_planner: MCTSPlanner,
        planner: MCTSPlanner,
        *,
        iterations: int,
        searches: int,
        keys: Sequence[NestedKey],
        seed: int,
        example_kwargs: Mapping[str, Any],
    ) -> None:
        self.env = env
        self.planners = (first_planner, planner)
        self.iterations, self.searches = iterations, searches
        self.keys = list(keys)
        self.seed = seed
        self.example_kwargs = dict(example_kwargs)
        self.base_steps: list[int] = []
        self.simulations: list[int] = []
        self.solved: list[int] = []
        for planner in self.planners:
            planner.simulator.keep([k for k in self.keys if k not in planner.simulator.kept_keys])

    def __iter__(self) -> Iterator[TensorDictBase]:
        while len(self.solved) < self.iterations:
            yield self.collect()

    def collect(self) -> TensorDictBase:
        """Search once at each start of the next iteration, and return the examples ``[K]``."""
        iteration = len(self.solved)
        planner = self.planners[min(iteration, 1)]
        self.env.set_seed(self.seed + iteration)
        starts = self.env.reset(TensorDict(batch_size=[self.searches]))
        examples, counts = [], np.zeros(3, np.int64)
        for some in starts.split(_GROUP):
            search = planner.search(some, seed=iteration)
            found = search_examples(search, keys=self.keys, **self.example_kwargs)
            examples.append(found.select(*self.keys, *_TARGETS))
            counts += (
                search.num_base_steps.sum(),
                search.num_simulations.sum(),
                (search.best_node >= 0).sum(),
            )
        planner.last_search = None  # its trees are large
        self.base_steps.append(int(counts[0]))
        self.simulations.append(int(counts[1]))
        self.solved.append(int(counts[2]))
        return torch.cat(examples)

    def state_dict(self) -> dict[str, Any]:
        """Return what was counted, and with it the iteration."""
        return {name: list(getattr(self, name)) for name in ("base_steps", "simulations", "solved")}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue after the iterations of another collector."""
        for name, values in state_dict.items():
            setattr(self, name, list(values))


class ExpertIterationTrainer(OffPolicyTrainer):
    """Trains the network that guides a planner, on the planner's own results.

    Per iteration: search at fresh starts, store the examples, and make ``updates_per_iteration``
    updates with Adam, whose learning rate falls to zero by a cosine over all updates. Iteration 0
    searches without the network.

    Args:
        env (EnvBase): the macro environment of the training mazes.
        network (TensorDictModuleBase): reads entries of the env's states, writes ``"logits"`` and
            ``"state_value"``.
        first_planner (MCTSPlanner): over ``env``, for iteration 0.
        planner (MCTSPlanner, optional): for the iterations after it. Default:
            :func:`make_guided_planner` with at most 400 expansions.
        loss_module (ExpertIterationLoss, optional): Default: ``value_loss="log"`` with
            ``value_coeff=4``, Huber's loss of the base steps to the goal.
        iterations, searches_per_iteration, updates_per_iteration (int): how many, and of what in
            each.
        batch_size, buffer_size (int): examples per update, and those that are kept.
        lr (float): Adam's learning rate at the start.
        clip_norm (float): bound of the gradient's norm.
        example_kwargs (dict, optional): passed to
            :func:`~torchrl_hmcts.planners.search_examples`. Default ``{"roots": False}``: the
            states from which a plan was found.
        progress (callable, optional): called with ``total=`` the updates it returns a progress bar.
        seed (int): of the starts and of the batches.
        **trainer_kwargs: passed to :class:`ResumableTrainer` (``logger``, ``save_dir``, ...).

    Attributes:
        collector: lists with an entry per iteration: ``solved`` (searches that found a plan),
            ``base_steps`` and ``simulations`` (simulated by its searches).

    Raises:
        ValueError: if a number is out of range.

    Reference:
        Anthony, Tian and Barber, "Thinking fast and slow with deep learning and tree search", 2017,
        arXiv 1705.08439.

    Example:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> from torchrl_hmcts.trainers import ExpertIterationTrainer
        >>> class TwoHeads(torch.nn.Linear):
        ...     def forward(self, state):
        ...         out = super().forward(state.float().reshape(-1, 1))
        ...         return out[:, :2], out[:, 2:].sigmoid()
        >>> net = TensorDictModule(TwoHeads(1, 3), ["state"], ["logits", "state_value"])
        >>> env = ChainEnv(length=5)
        >>> trainer = ExpertIterationTrainer(
        ...     env, net, MCTSPlanner(env), iterations=2, searches_per_iteration=1,
        ...     updates_per_iteration=60)
        >>> trainer.train()
        >>> trainer.collector.solved, trainer.collector.simulations[0]  # plans, options simulated
        ([1, 1], 30)
    """

    def __init__(
        self,
        env: EnvBase,
        network: TensorDictModuleBase,
        first_planner: MCTSPlanner,
        *,
        planner: MCTSPlanner | None = None,
        loss_module: ExpertIterationLoss | None = None,
        iterations: int = 4,
        searches_per_iteration: int = 400,
        updates_per_iteration: int = 200,
        batch_size: int = 256,
        buffer_size: int = 50_000,
        lr: float = 5e-3,
        clip_norm: float = 5.0,
        example_kwargs: Mapping[str, Any] | None = None,
        progress: Callable[..., Progress] | None = None,
        seed: int = 0,
        **trainer_kwargs: Any,
    ) -> None:
        owner = "ExpertIterationTrainer"
        instance(owner, "env", env, EnvBase)
        instance(owner, "network", network, TensorDictModuleBase)
        instance(owner, "first_planner", first_planner, MCTSPlanner)
        instance(owner, "planner", planner, MCTSPlanner, NoneType)
        instance(owner, "loss_module", loss_module, LossModule, NoneType)
        instance(owner, "example_kwargs", example_kwargs, Mapping, NoneType)
        whole_number(owner, "iterations", iterations, least=1)
        whole_number(owner, "searches_per_iteration", searches_per_iteration, least=1)
        updates = whole_number(owner, "updates_per_iteration", updates_per_iteration, least=1)
        seed = whole_number(owner, "seed", seed)
        real_number(owner, "lr", lr, above=0.0)
        if planner is None:
            # What is not found soon is left out: a search of thousands costs more than it teaches.
            planner = make_guided_planner(env, network, budget=SearchBudget(expansions=400))
        if loss_module is None:
            loss_module = ExpertIterationLoss(network, value_loss="log", value_coeff=4.0)
        optimizer = torch.optim.Adam(loss_module.parameters(), lr=lr)
        collector = partial(
            SearchCollector,
            env,
            first_planner,
            planner,
            iterations=iterations,
            searches=searches_per_iteration,
            keys=list(network.in_keys),
            seed=seed,
            example_kwargs={"roots": False} if example_kwargs is None else example_kwargs,
        )
        super().__init__(
            collector,
            loss_module,
            optimizer,
            total_frames=torch.iinfo(torch.int64).max,  # the collector knows when to end
            optim_steps_per_batch=updates,
            batch_size=batch_size,
            buffer_size=buffer_size,
            buffer_options={"generator": torch.Generator().manual_seed(seed)},
            clip_norm=clip_norm,
            settings={
                "searches_per_iteration": searches_per_iteration,
                "updates_per_iteration": updates,
            },
            progress=progress,
            progress_total=iterations * updates,
            **trainer_kwargs,
        )
        self.network, self.planner = network, planner
        self.schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations * updates)
        LRSchedulerHook(self.schedule, interval="optim").register(self)
        self.register_op("post_optim", self.move_progress)

    def progress_position(self) -> int:
        """Return the number of updates."""
        return int(self.schedule.last_epoch)

    def progress_figures(self) -> dict[str, str]:
        counts, searches = self.collector, self.collector.searches
        figures = {
            "solved": f"{counts.solved[-1]}/{searches}",
            "steps": f"{counts.base_steps[-1] / searches:.0f}",
        }
        for accuracy in self.history.get("policy_accuracy", [])[-1:]:
            figures["accuracy"] = f"{accuracy:.3f}"
        return figures
