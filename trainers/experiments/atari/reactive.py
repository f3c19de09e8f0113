"""A manager that plays without search, learned by PPO in practice and from searches.

Letters: N emulators, T decisions of each between updates, Z options, K states.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import MLP
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_hmcts.checks import instance, real_number, whole_number
from torchrl_hmcts.envs import AtariOptionPool
from torchrl_hmcts.objectives import use_durations
from torchrl_hmcts.planners import Evaluation, Search

_STATE = ("emulator_state", "ram")


class _RAMFeatures(nn.Module):
    """Features of the RAM, ``[K, 1152]``: each byte from -2 to 2, and its bits."""

    width = 128 * 9

    def forward(self, ram: Tensor) -> Tensor:
        bits = (ram.to(torch.int32).unsqueeze(-1) >> torch.arange(8, device=ram.device)) & 1
        return torch.cat([ram.float() / 63.75 - 2.0, bits.flatten(-2).float()], -1)


class ReactiveManager:
    r"""Chooses options by a network that reads the RAM; learns from practice and from searches.

    **Practice**: N emulators play options drawn from the policy, and TorchRL's ``ClipPPOLoss``
    improves it, with GAE over the options' durations. Rewards are in units of the mean reward of
    an option that earns any, ``scale``; a lost life ends the return. **Searches**: the option that
    an :class:`AtariAgent` executes becomes a label of the state it was in; each update of PPO adds

    .. math:: -\lambda\, \mathbb{E}_{s, o} \log \pi_\theta(o \mid s)

    over such labels. As the agent's ``guide`` it is called with the RAM, uint8 ``[K, 128]``, and
    gives the prior of PUCT ``[K, Z]``, a share of it uniform, and the values of leaves ``[K, 1]``,
    in the game's score. It plays alone by :meth:`act`, or under ``AtariSearch(ratio=0)``.

    Args:
        num_options (int): Z.
        hidden (sequence of int): widths of the two networks. Default 256, 256.
        num_envs (int): N. Default 32.
        steps (int): T. Default 32.
        epochs, batch_size (int): of an update. Default 4 and 256.
        lr (float): Adam's learning rate. Default 3e-4.
        gamma (float): discount per base step. Default 0.99.
        entropy_coeff (float): Default 0.01.
        imitation_coeff (float): :math:`\lambda`. Default 0.1.
        uniform_share (float): of the prior. Default 0.25.
        buffer_size (int): labels kept. Default 20,000.
        seed (int): of weights, batches and draws. Default 0.

    Attributes:
        practised (int): frames of practice so far.
        num_labels (int): learned from searches so far.
        scores (list of float): of the latest 100 practice episodes.

    Raises:
        ValueError: if a number is out of range.

    Reference:
        Schulman et al., "Proximal policy optimization algorithms", 2017, arXiv 1707.06347; Guo et
        al., "Deep learning for real-time Atari game play using offline Monte-Carlo tree search
        planning", 2014, for the labels.

    Example:
        >>> from torchrl_hmcts.envs import AtariOptionPool, RepeatActions
        >>> from torchrl_hmcts.trainers import ReactiveManager
        >>> pool = AtariOptionPool("Breakout", RepeatActions(4), max_steps=5, num_processes=0,
        ...                        end_on_life_loss=True, seed=0)
        >>> manager = ReactiveManager(4, num_envs=2, steps=4)
        >>> manager.practise(pool, frames=160) >= 160
        True
        >>> manager.act(pool.reset(), seed=0).shape
        torch.Size([1])
    """

    in_keys = ["ram"]

    def __init__(
        self,
        num_options: int,
        *,
        hidden: Sequence[int] = (256, 256),
        num_envs: int = 32,
        steps: int = 32,
        epochs: int = 4,
        batch_size: int = 256,
        lr: float = 3e-4,
        gamma: float = 0.99,
        entropy_coeff: float = 0.01,
        imitation_coeff: float = 0.1,
        uniform_share: float = 0.25,
        buffer_size: int = 20_000,
        seed: int = 0,
    ) -> None:
        name = "ReactiveManager"
        for key, number in (
            ("num_options", num_options), ("num_envs", num_envs), ("steps", steps),
            ("epochs", epochs), ("batch_size", batch_size), ("buffer_size", buffer_size),
        ):  # fmt: skip
            whole_number(name, key, number, least=1)
        self.seed = whole_number(name, "seed", seed)
        instance(name, "hidden", hidden, Sequence)
        self.imitation_coeff = real_number(name, "imitation_coeff", imitation_coeff, least=0.0)
        self.uniform_share = real_number(name, "uniform_share", uniform_share, least=0.0, most=1.0)
        real_number(name, "lr", lr, above=0.0)
        real_number(name, "gamma", gamma, above=0.0, most=1.0)
        real_number(name, "entropy_coeff", entropy_coeff, least=0.0)
        self.num_options, self.num_envs, self.steps = num_options, num_envs, steps
        self.epochs, self.batch_size = epochs, batch_size
        widths = list(hidden)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            actor = MLP(_RAMFeatures.width, num_options, num_cells=widths, activation_class=nn.ReLU)
            critic = MLP(_RAMFeatures.width, 1, num_cells=widths, activation_class=nn.ReLU)
        for parameter in actor[-1].parameters():  # at first a uniform policy
            nn.init.zeros_(parameter)
        features = TensorDictModule(_RAMFeatures(), ["ram"], ["features"])
        self.policy = ProbabilisticTensorDictSequential(
            features,
            TensorDictModule(actor, ["features"], ["logits"]),
            ProbabilisticTensorDictModule(["logits"], ["option"], distribution_class=Categorical),
        )
        self.critic = TensorDictSequential(
            features, TensorDictModule(critic, ["features"], ["state_value"])
        )
        self.loss = ClipPPOLoss(
            self.policy, self.critic, entropy_coeff=entropy_coeff, normalize_advantage=True
        )
        self.loss.set_keys(action="option", sample_log_prob="log_prob")
        self.advantage = use_durations(
            GAE(gamma=gamma, lmbda=0.95, value_network=self.critic, average_gae=False)
        )
        self._networks = nn.ModuleList([actor, critic])
        self.optimizer = torch.optim.Adam(self._networks.parameters(), lr=lr, eps=1e-5)
        self._generators = [torch.Generator().manual_seed(seed) for _ in range(2)]
        self._generator, generator = self._generators
        self._labels = ReplayBuffer(
            storage=LazyTensorStorage(buffer_size), batch_size=batch_size, generator=generator
        )
        self.practised, self.num_labels, self.scores = 0, 0, list[float]()
        self._earned, self._earning = 0.0, 0  # sum and number of the rewards that are not 0
        self._places: TensorDictBase | None = None  # where the practice stands

    @property
    def scale(self) -> float:
        """The game's score that a value of 1 is worth."""
        return self._earned / self._earning if self._earning else 1.0

    # ---------------------------------------------------------------- acting

    @torch.no_grad()
    def __call__(self, td: TensorDictBase) -> Evaluation:
        """Return priors ``[K, Z]``, and values ``[K, 1]`` of the game's score."""
        td = self.critic(self.policy.get_dist_params(td.select("ram")))
        priors = td["logits"].softmax(-1)
        priors = priors.lerp(torch.full_like(priors, 1.0 / self.num_options), self.uniform_share)
        return Evaluation(priors, td["state_value"] * self.scale)

    @torch.no_grad()
    def act(self, td: TensorDictBase, seed: int) -> Tensor:
        """Draw options, int64 ``[K]``, in states with ``"ram"``, uint8 ``[K, 128]``."""
        shares = self.policy.get_dist(td.select("ram").reshape(-1)).probs
        return torch.multinomial(shares, 1, generator=torch.Generator().manual_seed(seed))[:, 0]

    # ---------------------------------------------------------------- learning

    def learn(self, search: Search, scale: float, option: int) -> None:
        """Take the label of a search of one root.

        Args:
            search: whose root is the state.
            scale: unused; the manager has a scale of its own.
            option: that was chosen.
        """
        assert search.tree.states is not None
        root = search.tree.states[:1, 0].select("ram").clone()
        self._labels.extend(root.set("label", torch.tensor([option])))
        self.num_labels += 1

    def practise(self, pool: AtariOptionPool, frames: int) -> int:
        """Play options and improve the policy until ``frames`` have been emulated.

        Args:
            pool: whose options end with a life, in the starts of the split ``"train"``.
            frames: at least; the update under way is finished.

        Returns:
            The frames emulated.
        """
        before = pool.num_frames
        if self._places is None:
            self._places = self._begin(pool, self.num_envs)
            self._places["sum"] = torch.zeros(self.num_envs, 1)
        while pool.num_frames - before < frames:
            self._update(self._collect(pool))
        self.practised += pool.num_frames - before
        return pool.num_frames - before

    @staticmethod
    def _begin(pool: AtariOptionPool, count: int) -> TensorDictBase:
        return pool.reset(TensorDict(batch_size=[count])).select(*_STATE)

    @torch.no_grad()
    def _collect(self, pool: AtariOptionPool) -> TensorDictBase:
        """Return transitions ``[N, T]`` with advantages."""
        rows, td = [], self._places
        assert td is not None
        for _ in range(self.steps):
            dist = self.policy.get_dist(td.select("ram"))
            option = torch.multinomial(dist.probs, 1, generator=self._generator)[:, 0]
            after = pool.step(td.select("emulator_state").set("option", option))["next"]
            lost, over = after["life_losses"] > 0, after["done"]
            ends = {
                "ram": after["ram"].clone(),
                "reward": after["score"].clone(),
                "duration": after["duration"].clone(),
                "terminated": after["terminated"] | lost,
                "done": over | lost,
            }
            row = {"ram": td["ram"], "option": option, "log_prob": dist.log_prob(option)}
            rows.append(TensorDict({**row, "next": ends}, [self.num_envs]))
            new = after.select(*_STATE).clone()
            new["sum"] = td["sum"] + after["score"]
            if (at := over.flatten()).any():
                self.scores = [*self.scores, *new["sum"][at].flatten().tolist()][-100:]
                new[at] = self._begin(pool, int(at.sum())).set("sum", torch.zeros(int(at.sum()), 1))
            td = new
        self._places = td
        batch: TensorDictBase = torch.stack(rows, 1)  # type: ignore[assignment]
        reward = batch["next", "reward"]
        self._earned += float(reward.abs().sum())
        self._earning += int((reward != 0).sum())
        batch["next", "reward"] = reward / self.scale
        self.advantage(batch)
        return batch.exclude("next", "features").reshape(-1)

    @torch.enable_grad()
    def _update(self, batch: TensorDictBase) -> None:
        for _ in range(self.epochs):
            order = torch.randperm(len(batch), generator=self._generator)
            for rows in order.split(self.batch_size):
                losses = self.loss(batch[rows])
                total = sum(v for k, v in losses.items() if k.startswith("loss_"))
                if self.imitation_coeff and len(self._labels) >= self.batch_size:
                    labels = self._labels.sample()
                    logits = self.policy.get_dist_params(labels.select("ram"))["logits"]
                    imitation = nn.functional.cross_entropy(logits, labels["label"])
                    total = total + self.imitation_coeff * imitation
                if not torch.isfinite(total):
                    raise FloatingPointError(f"The manager's loss is {total.item()}. Lower its lr.")
                self.optimizer.zero_grad()
                total.backward()
                nn.utils.clip_grad_norm_(self._networks.parameters(), 0.5)
                self.optimizer.step()

    # ---------------------------------------------------------------- state

    def state_dict(self) -> dict[str, Any]:
        """Return all that is needed to continue, plain data and tensors."""
        size = len(self._labels)
        labels = self._labels.storage.get(slice(size)) if size else TensorDict(batch_size=[0])
        cursor = int(self._labels.writer.state_dict()["_cursor"])
        return {
            "networks": self._networks.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "labels": {**labels.select("ram", "label", strict=False)},
            "cursor": cursor,
            "generators": [g.get_state() for g in self._generators],
            "places": None if self._places is None else dict(self._places.items()),
            **{name: getattr(self, name) for name in _COUNTERS},
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from where :meth:`state_dict` was called."""
        self._networks.load_state_dict(state_dict["networks"])
        self.optimizer.load_state_dict(state_dict["optimizer"])
        if state_dict["labels"]:
            self._labels.extend(
                TensorDict(state_dict["labels"], [len(state_dict["labels"]["label"])])
            )
            self._labels.writer.load_state_dict({"_cursor": state_dict["cursor"]})
        for generator, state in zip(self._generators, state_dict["generators"], strict=True):
            generator.set_state(state)
        places = state_dict["places"]
        self._places = None if places is None else TensorDict(places, [self.num_envs])
        for name in _COUNTERS:
            setattr(self, name, state_dict[name])


_COUNTERS = ("practised", "num_labels", "scores", "_earned", "_earning")
