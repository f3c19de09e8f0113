"""Learning when Waterworld's options should end: the option-critic, with targets in hindsight.

Letters: C copies, T base steps of each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv
from torchrl.modules import MLP
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_hmcts.checks import real_number, whole_number
from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.modules import (
    AnyTermination,
    LearnedTermination,
    StallTermination,
    TerminationNetwork,
)
from torchrl_hmcts.objectives import IntraOptionQLoss, OptionTerminationLoss
from torchrl_hmcts.trainers.skills.hindsight import HindsightTransitions, MazeView
from torchrl_hmcts.transforms import OptionTransform, SkillTransform, StallTransform

_STALL_TOLERANCE = 0.005  # tiles per base step, a twentieth of the top speed
_EPISODE_STEPS = 200  # base steps in a maze before the next one


@dataclass
class TerminationConfig:
    """How a termination is learned.

    Raises:
        ValueError: if a number is below 1, or ``every`` is above ``option_steps``.

    Example:
        >>> TerminationConfig(seed=1).base_steps
        20000
    """

    base_steps: int = 20_000
    """Base steps of options executed in training mazes: all the experience there is."""
    copies: int = 32
    """Mazes played at once."""
    option_steps: int = 50
    """Base steps of an option in that experience."""
    every: int = 5
    """Base steps between two chances to end; those that a transition spans."""
    horizon: int = 100
    """Base steps within which a place that was reached serves as a target in hindsight."""
    gamma: float = 0.98
    """Discount per base step of the values; shorter-sighted than the manager, and less noisy."""
    initial_probability: float = 0.05
    """Chance to end, each time it is asked, of the options whose values are learned first."""
    rounds: int = 1
    """How often values are learned under the termination, and the termination from the values."""
    value_updates: int = 5_000
    """Updates of the values in a round."""
    termination_updates: int = 500
    """Updates of the termination in a round."""
    batch_size: int = 256
    """Transitions of an update."""
    deliberation_cost: float = 0.04
    """What ending an option costs, in units of return (a target at once is worth 1)."""
    value_lr: float = 1e-3
    """Learning rate of the values."""
    termination_lr: float = 1e-3
    """Learning rate of the termination."""
    tau: float = 0.01
    """Share by which the target values follow in an update."""
    seed: int = 0
    """Of mazes, networks and batches."""

    def __post_init__(self) -> None:
        for column in fields(self):
            name, value = column.name, getattr(self, column.name)
            if isinstance(column.default, int):
                whole_number("TerminationConfig", name, value, least=0 if name == "seed" else 1)
            else:
                real_number("TerminationConfig", name, value, least=0.0)
        if self.every > self.option_steps:
            raise ValueError(
                f"Options of option_steps={self.option_steps} hold no piece of "
                f"every={self.every} base steps; ask more often."
            )


def collect_option_steps(
    worker: Callable[[TensorDictBase], TensorDictBase],
    num_options: int,
    config: TerminationConfig,
    mazes: Tensor | None = None,
) -> TensorDictBase:
    """Let the worker execute random options in random mazes, of the training split by default.

    Returns:
        Base transitions ``[C, T]`` with the option under ``"skill"`` and the base steps it has
        taken before under ``"skill_step"``.
    """
    env = TransformedEnv(
        WaterworldMazeEnv(
            mazes,
            observation=False,
            batch_size=[config.copies],
            max_steps=_EPISODE_STEPS,
            seed=config.seed,
        ),
        SkillTransform(num_options, max_skill_steps=config.option_steps, seed=config.seed),
    )
    steps = config.base_steps // config.copies
    return env.rollout(steps, worker, break_when_any_done=False)


@dataclass
class TerminationResult:
    """The outcome of :func:`learn_termination`."""

    network: TerminationNetwork
    """Reads ``"view"`` and ``"skill"``."""
    values: TensorDictModuleBase
    """Reads ``"view"`` and ``"offset"`` (target minus position), writes ``"action_value"``."""
    base_steps: int
    """Base steps that were simulated for it."""
    history: dict[str, list[float]] = field(default_factory=dict)
    """Every 100 updates: losses and diagnostics, by name."""


def learn_termination(
    worker: Callable[[TensorDictBase], TensorDictBase],
    num_options: int = 4,
    config: TerminationConfig | None = None,
    *,
    mazes: Tensor | None = None,
    data: TensorDictBase | None = None,
    progress: Callable[[int], Any] | None = None,
) -> TerminationResult:
    """Learn when options should end, from random options and targets in hindsight.

    Values Q(s, o, target) are learned for options that end with the probability of the termination
    as it is, from pieces of options (:class:`~torchrl_hmcts.objectives.IntraOptionQLoss`), for
    targets that were reached. The termination, which does not see the target, is then learned from
    states met under an option that was the best for its target where it began
    (:class:`~torchrl_hmcts.objectives.OptionTerminationLoss`): it ends options where, over all
    targets, continuing loses more than the deliberation cost, as at the mouth of a side passage.

    Args:
        worker: reads ``"velocity"`` and ``"skill"``, writes ``"action"``.
        num_options: number of options.
        config: see :class:`TerminationConfig`.
        mazes: bool ``[M, H, W]`` to learn in. Default: the training split.
        data: base transitions as :func:`collect_option_steps` gives them, in the same mazes.
            Default: collected here.
        progress: called with 1 after every update, e.g. ``tqdm(...).update``.

    Returns:
        Networks, history and the base steps it took.

    Reference:
        Bacon, Harb and Precup, "The option-critic architecture", 2017, arXiv 1609.05140; Harb et
        al., "When waiting is not an option", 2018, arXiv 1709.04571; Andrychowicz et al.,
        "Hindsight experience replay", 2017, arXiv 1707.01495.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> config = TerminationConfig(
        ...     base_steps=640, value_updates=2, termination_updates=2, copies=16)
        >>> learn_termination(worker, 4, config).base_steps
        640
    """
    config = TerminationConfig() if config is None else config
    mazes = maze_pool("train") if mazes is None else mazes
    if data is None:
        data = collect_option_steps(worker, num_options, config, mazes)
    view = MazeView(mazes)
    transitions = HindsightTransitions(
        data,
        view,
        touch=WaterworldMazeEnv.PLAYER_RADIUS + WaterworldMazeEnv.TARGET_RADIUS,
        every=config.every,
        horizon=config.horizon,
        gamma=config.gamma,
        seed=config.seed,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = TerminationNetwork(
            view.num_features,
            num_options,
            in_keys=["view"],
            initial_probability=config.initial_probability,
        )
        values = _make_values(view.num_features, num_options)
    value_loss = IntraOptionQLoss(values, network, gamma=config.gamma)
    updater = SoftUpdate(value_loss, tau=config.tau)
    loss = OptionTerminationLoss(network, values, deliberation_cost=config.deliberation_cost)
    # The losses hold the parameters: those of the networks are the same tensors.
    value_optimizer = torch.optim.Adam(value_loss.parameters(), lr=config.value_lr, fused=True)
    optimizer = torch.optim.Adam(loss.parameters(), lr=config.termination_lr, fused=True)
    result = TerminationResult(network, values, data.numel())

    def step(
        part: LossModule, adam: torch.optim.Optimizer, name: str, batch: TensorDictBase, update: int
    ) -> None:
        out = part(batch)
        adam.zero_grad()
        out[name].backward()
        adam.step()
        if progress is not None:
            progress(1)
        if update % 100 == 99:
            for key, value in out.detach().items():
                result.history.setdefault(key, []).append(float(value))

    for _ in range(config.rounds):
        for update in range(config.value_updates):
            batch = transitions.sample(config.batch_size)
            step(value_loss, value_optimizer, "loss_qvalue", batch, update)
            updater.step()
        for update in range(config.termination_updates):
            batch = transitions.sample(config.batch_size)
            with torch.no_grad():
                best = values(batch["begin"])["action_value"].argmax(-1)
            batch = batch[best == batch["skill"]]  # on-policy: options that would be chosen
            if len(batch):
                step(loss, optimizer, "loss_termination", batch, update)
    return result


def make_terminating_env(
    worker: Any,
    mazes: Tensor | None = None,
    *,
    network: TerminationNetwork | None = None,
    every: int = 5,
    stall_steps: int | None = 3,
    num_options: int = 4,
    max_steps: int = 100,
    gamma: float = 0.99,
    seed: int | None = None,
) -> TransformedEnv:
    """Build a Waterworld whose options end by themselves, for planning and for acting.

    Args:
        worker: reads ``"velocity"`` and ``"skill"``, writes ``"action"``.
        mazes: bool ``[M, H, W]``. Default: the training split.
        network: ends an option where it says so, see :func:`learn_termination`. Default: none.
        every: base steps between two questions to the network.
        stall_steps: base steps in a row without movement that end an option; None for any number.
            From rest the disc does not move in its first base step, so at least 2.
        num_options: number of options.
        max_steps: base steps of an option at most. Default: the dissertation's 100.
        gamma: discount per base step.
        seed: of the env.

    Returns:
        The macro environment, stateless and without batch size.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> make_terminating_env(worker).rollout(2)["next", "duration"].shape
        torch.Size([2, 1])
    """
    base = WaterworldMazeEnv(mazes, observation=False, seed=seed)
    conditions: list[Callable[[TensorDictBase], Tensor]] = []
    transforms: list[Any] = []
    if stall_steps is not None:
        transforms.append(StallTransform("position", _STALL_TOLERANCE))
        conditions.append(StallTermination(stall_steps))
    if network is not None:
        seen = TensorDictSequential(MazeView(base.mazes), network)
        conditions.append(LearnedTermination(seen, every=every))
    termination = AnyTermination(*conditions) if conditions else None
    transforms.append(OptionTransform(worker, num_options, max_steps, gamma, termination))
    return TransformedEnv(base, Compose(*transforms))


def _make_values(num_features: int, num_options: int) -> TensorDictModule:
    network = MLP(
        in_features=num_features + 2,
        out_features=num_options,
        num_cells=[128, 128],
        activation_class=torch.nn.ReLU,
    )
    return TensorDictModule(network, in_keys=["view", "offset"], out_keys=["action_value"])
