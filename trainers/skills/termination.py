"""Learning when Waterworld's options should end: the option-critic, with targets in hindsight.

Letters: C copies, T base steps of each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.modules import MLP
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_hmcts.checks import real_number, whole_number
from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.modules import TerminationNetwork
from torchrl_hmcts.objectives import IntraOptionQLoss, OptionTerminationLoss
from torchrl_hmcts.trainers.skills.hindsight import HindsightTransitions, MazeView
from torchrl_hmcts.transforms import SkillTransform

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


def learn_termination(
    worker: Callable[[TensorDictBase], TensorDictBase],
    num_options: int = 4,
    config: TerminationConfig | None = None,
    *,
    mazes: Tensor | None = None,
    data: TensorDictBase | None = None,
    progress: Callable[[int], Any] | None = None,
) -> tuple[TerminationNetwork, dict[str, list[float]]]:
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
        The network, which reads ``"view"`` of a :class:`MazeView` and ``"skill"``; and losses and
        diagnostics by name, every 100 updates.

    Reference:
        Bacon, Harb and Precup, "The option-critic architecture", 2017, arXiv 1609.05140; Harb et
        al., "When waiting is not an option", 2018, arXiv 1709.04571; Andrychowicz et al.,
        "Hindsight experience replay", 2017, arXiv 1707.01495.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> config = TerminationConfig(
        ...     base_steps=640, value_updates=2, termination_updates=2, copies=16)
        >>> network, history = learn_termination(worker, 4, config)
        >>> network.in_keys
        ['view', 'skill']
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
        values = TensorDictModule(
            MLP(
                in_features=view.num_features + 2,
                out_features=num_options,
                num_cells=[128, 128],
                activation_class=torch.nn.ReLU,
            ),
            in_keys=["view", "offset"],  # the offset: target minus position
            out_keys=["action_value"],
        )
    value_loss = IntraOptionQLoss(values, network, gamma=config.gamma)
    updater = SoftUpdate(value_loss, tau=config.tau)
    loss = OptionTerminationLoss(network, values, deliberation_cost=config.deliberation_cost)
    # The losses hold the parameters: those of the networks are the same tensors.
    value_optimizer = torch.optim.Adam(value_loss.parameters(), lr=config.value_lr, fused=True)
    optimizer = torch.optim.Adam(loss.parameters(), lr=config.termination_lr, fused=True)
    history: dict[str, list[float]] = {}

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
                history.setdefault(key, []).append(float(value))

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
    return network, history
