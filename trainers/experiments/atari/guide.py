"""A prior and values that a network learns from the agent's own searches: expert iteration.

Letters: K examples, Z options.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_hmcts.checks import instance, whole_number
from torchrl_hmcts.objectives import ExpertIterationLoss
from torchrl_hmcts.planners import Evaluation, PolicyValueEvaluator, Search, search_examples


class _TwoHeads(nn.Module):
    """Logits ``[K, Z]`` and values ``[K, 1]`` in units of ``scale``, of RAM, uint8 ``[K, 128]``."""

    def __init__(self, num_options: int, hidden: Sequence[int]) -> None:
        super().__init__()
        widths = [128, *hidden]
        pairs = zip(widths[:-1], widths[1:], strict=True)
        layers = [layer for n, m in pairs for layer in (nn.Linear(n, m), nn.ReLU())]
        self.shared = nn.Sequential(*layers)
        self.heads = nn.Linear(widths[-1], num_options + 1)
        nn.init.zeros_(self.heads.weight)  # at first a uniform prior, and all values 0
        nn.init.zeros_(self.heads.bias)

    def forward(self, ram: Tensor) -> tuple[Tensor, Tensor]:
        out = self.heads(self.shared(ram.to(torch.float32) / 255.0))
        return out[..., :-1], out[..., -1:]


class SearchGuide:
    r"""Learns from every search of an agent, and guides the later ones.

    A network reads the RAM and gives the prior of PUCT and the values of leaves. After every
    decision the nodes of the tree with ``min_visits`` become examples: visits as the policy's
    target, the backed-up value in units of the greatest reward of an option so far as the value's;
    every ``learn_every`` decisions ``updates`` steps of Adam follow. It begins as a uniform prior
    and values of 0, with which the agent plans as without it. A planner's ``leaf_evaluator``, it is
    called with states that have ``"ram"``, uint8 ``[K, 128]``.

    Args:
        num_options (int): Z.
        values (bool): whether leaves are valued, too; else the prior only. Default False: under a
            max backup one value that is too high is believed.
        hidden (sequence of int): widths of the layers. Default: three of 128, the worker's.
        min_visits (int): of the nodes that are learned from. Default 8.
        learn_every (int): decisions between two trainings. Default 10.
        updates (int): of each training. Default 20.
        buffer_size (int): examples kept. Default 20,000.
        lr (float): Adam's learning rate. Default 1e-3.
        seed (int): of the initial weights and of the batches. Default 0.

    Attributes:
        scale (float): what a value of 1 is worth.
        num_examples (int): learned from so far.

    Raises:
        ValueError: if a number is out of range.

    Reference:
        Anthony, Tian and Barber, "Thinking fast and slow with deep learning and tree search", 2017,
        arXiv 1705.08439; Silver et al. 2017.

    Example:
        >>> from torchrl_hmcts.envs import AtariOptionPool, RepeatActions
        >>> from torchrl_hmcts.trainers import AtariAgent, AtariSearch, SearchGuide
        >>> pool = AtariOptionPool("Breakout", RepeatActions(4), max_steps=5, num_processes=0,
        ...                        seed=0)
        >>> guide = SearchGuide(4, min_visits=2, learn_every=1, updates=1)
        >>> agent = AtariAgent(pool, AtariSearch(ratio=4), guide=guide, seed=0)
        >>> _ = agent.play(decisions=2)
        >>> guide.num_examples > 0
        True
    """

    def __init__(
        self,
        num_options: int,
        *,
        values: bool = False,
        hidden: Sequence[int] = (128, 128, 128),
        min_visits: int = 8,
        learn_every: int = 10,
        updates: int = 20,
        buffer_size: int = 20_000,
        lr: float = 1e-3,
        seed: int = 0,
    ) -> None:
        self.min_visits, self.learn_every, self.updates = min_visits, learn_every, updates
        for name in ("min_visits", "learn_every", "updates"):
            whole_number("SearchGuide", name, getattr(self, name), least=1)
        whole_number("SearchGuide", "num_options", num_options, least=1)
        whole_number("SearchGuide", "buffer_size", buffer_size, least=1)
        seed = whole_number("SearchGuide", "seed", seed)
        instance("SearchGuide", "hidden", hidden, Sequence)
        self.values = bool(values)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = _TwoHeads(num_options, hidden)
        self._module = TensorDictModule(network, ["ram"], ["logits", "state_value"])
        self._loss = ExpertIterationLoss(self._module, value_loss="smooth_l1")
        self._optimizer = torch.optim.Adam(self._loss.parameters(), lr=lr)
        self._generator = torch.Generator().manual_seed(seed)
        self._buffer = ReplayBuffer(
            storage=LazyTensorStorage(buffer_size), batch_size=256, generator=self._generator
        )
        self._evaluator = PolicyValueEvaluator(self._module, uniform_share=0.25)
        self.in_keys = self._evaluator.in_keys
        self.scale = 1.0
        self.num_examples = 0
        self._searches = 0

    @torch.no_grad()
    def __call__(self, td: TensorDictBase) -> Evaluation:
        """Return priors ``[K, Z]``, and values ``[K, 1]`` of the reward if leaves are valued."""
        priors, values = self._evaluator(td)
        if values is None or not self.values:
            return Evaluation(priors)
        return Evaluation(priors, values * self.scale)

    def learn(self, search: Search, scale: float, option: int = -1) -> None:
        """Take examples from a search of one root, and train if it is time.

        Args:
            search: before its subtree is taken.
            scale: the greatest reward of an option so far, which a value of 1 is worth from now on.
            option: unused; the visits are learned.
        """
        examples = search_examples(
            search,
            plans=False,
            min_visits=self.min_visits,
            plan_share=0.0,
            tree_values=True,
            keys=["ram"],
        ).exclude("root", "node")
        self._buffer.extend(examples)
        self.num_examples += len(examples)
        self.scale = max(self.scale, float(scale))
        self._searches += 1
        if self._searches % self.learn_every == 0:
            self._train()

    @torch.enable_grad()
    def _train(self) -> None:
        for _ in range(self.updates):
            batch = self._buffer.sample()
            batch["value_target"] = batch["value_target"] / self.scale
            out = self._loss(batch)
            loss = out["loss_policy"] + (out["loss_value"] if self.values else 0.0)
            if not torch.isfinite(loss):
                raise FloatingPointError(f"The guide's loss is {loss.item()}. Lower its lr.")
            self._optimizer.zero_grad()
            loss.backward()
            self._optimizer.step()

    def state_dict(self) -> dict[str, Any]:
        """Return weights, optimiser, examples and counters, plain data and tensors."""
        size = len(self._buffer)
        stored = self._buffer.storage.get(slice(size)) if size else TensorDict(batch_size=[0])
        return {
            "network": self._module.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "examples": dict(stored.items()),
            "cursor": int(self._buffer.writer.state_dict()["_cursor"]),
            "generator": self._generator.get_state(),
            "scale": self.scale,
            "num_examples": self.num_examples,
            "searches": self._searches,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from where :meth:`state_dict` was called."""
        self._module.load_state_dict(state_dict["network"])
        self._optimizer.load_state_dict(state_dict["optimizer"])
        self._buffer.empty()
        examples = state_dict["examples"]
        if examples:
            self._buffer.extend(TensorDict(examples, [len(examples["ram"])]))
        self._buffer.writer.load_state_dict({"_cursor": state_dict["cursor"]})
        self._generator.set_state(state_dict["generator"])
        self.scale = float(state_dict["scale"])
        self.num_examples = int(state_dict["num_examples"])
        self._searches = int(state_dict["searches"])
