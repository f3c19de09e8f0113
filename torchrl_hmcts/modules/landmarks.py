"""Landmarks of recorded episodes, and options between them: a model to plan in.

Letters: T recorded steps, F numbers of a place, N landmarks, A options of a landmark, K outcomes
of an option, *B batch of a tensordict.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_hmcts.checks import real_number, whole_number
from torchrl_hmcts.modules.effects import EffectModel

_SAMPLES = 20_000  # states among which landmarks are chosen
_SHARE = 0.2  # quantile of the times between two landmarks: recorded ways are not the straightest


class LandmarkModel(nn.Module):
    r"""Options "go to that landmark", their base steps and outcomes, from recorded episodes.

    Landmarks are recorded places, each at least ``radius`` from the others (farthest-point
    sampling). Where episodes passed from landmark i to j, on the way over at most ``hops`` others
    and at least ``min_count`` times, there is an option; it takes the time that a fifth of the
    passages took at most.

    A step ten times as long as the median (``jump_factor``) is a jump, e.g. a teleporter's, which
    no action aims at. Places before jumps become landmarks of their own. There the one option is to
    jump, and its outcomes are those that were recorded, as often as they were,

    .. math:: P(j \mid p) = n_{pj} / n_p.

    So the model does not take a lucky jump for a reliable path, as relabelling goals in hindsight
    does.

    Build it by :meth:`fit`.

    Args:
        num_landmarks (int): N, those of jumps included.
        num_features (int): F.
        num_options (int): A, of the landmark that has most.
        num_outcomes (int): K, of the option that has most.

    Attributes:
        places: float32 ``[N, F]``.
        is_jump: bool ``[N]``, places before jumps.
        jump: float32 ``[]``, distance from which on a step is a jump, in units of the places.
        targets: int64 ``[N, A]``, to which landmark an option goes; -1: there is no such option,
            and it stays.
        durations: float32 ``[N, A]``, base steps.
        outcomes: int64 ``[N, A, K]``, landmarks.
        probabilities: float32 ``[N, A, K]``, of the outcomes.

    Reference:
        Places as nodes: Savinov, Dosovitskiy and Koltun, "Semi-parametric topological memory for
        navigation", 2018, arXiv 1803.00653. Jumps are this project's.

    Example:
        >>> places = torch.arange(0.0, 10.0, 0.1)[:, None]  # one episode, a walk to the right
        >>> ends = torch.arange(100) == 99
        >>> model = LandmarkModel.fit(places, ends, radius=3.0, min_count=1)
        >>> model.num_landmarks, model.has_chance
        (3, False)
    """

    places: Tensor
    is_jump: Tensor
    jump: Tensor
    targets: Tensor
    durations: Tensor
    outcomes: Tensor
    probabilities: Tensor

    def __init__(
        self, num_landmarks: int, num_features: int, num_options: int, num_outcomes: int = 1
    ) -> None:
        super().__init__()
        n, a = num_landmarks, num_options
        self.register_buffer("places", torch.zeros(n, num_features))
        self.register_buffer("is_jump", torch.zeros(n, dtype=torch.bool))
        self.register_buffer("jump", torch.tensor(torch.inf))
        self.register_buffer("targets", torch.full((n, a), -1))
        self.register_buffer("durations", torch.ones(n, a))
        own = torch.arange(n)[:, None, None].expand(n, a, num_outcomes).clone()
        self.register_buffer("outcomes", own)
        self.register_buffer("probabilities", torch.zeros(n, a, num_outcomes))
        self.probabilities[..., 0] = 1.0
        self.num_landmarks, self.num_options = num_landmarks, num_options
        self.num_features = num_features

    @classmethod
    def fit(
        cls,
        places: Tensor,
        ends: Tensor,
        *,
        radius: float,
        hops: int = 3,
        min_count: int = 3,
        max_steps: float = float("inf"),
        jump_factor: float = 10.0,
        seed: int = 0,
    ) -> LandmarkModel:
        """Build the model of recorded episodes.

        Args:
            places (Tensor): float ``[T, F]``, where each recorded state is.
            ends (Tensor): bool ``[T]``, the last state of each episode.
            radius (float): least distance of two landmarks.
            hops (int): landmarks that an option may pass at most. Default 3.
            min_count (int): passages that make an option. Default 3.
            max_steps (float): longest option, base steps; as far as the goals lie ahead by which
                the worker was trained. Default: as long as it takes.
            jump_factor (float): median steps from which on a step is a jump; infinite: none is.
            seed (int): of the states among which landmarks are chosen. Default 0.

        Raises:
            ValueError: if a number is out of range, the sizes do not fit, or no option is found.
        """
        owner = "LandmarkModel.fit"
        radius = real_number(owner, "radius", radius, above=0.0)
        hops = whole_number(owner, "hops", hops, least=0)
        min_count = whole_number(owner, "min_count", min_count, least=1)
        real_number(owner, "max_steps", max_steps, least=1.0, finite=False)
        real_number(owner, "jump_factor", jump_factor, above=0.0, finite=False)
        if places.dim() != 2 or ends.shape != places.shape[:1] or len(places) < 2:
            raise ValueError(
                f"{owner} needs places [T, F] and ends [T], T >= 2; got {list(places.shape)} and "
                f"{list(ends.shape)}."
            )
        x, last = places.float().cpu(), ends.bool().cpu().clone()
        last[-1] = True
        shortest = _shortest_jump(x, last, jump_factor)
        jumps = _far_steps(x, last, shortest)
        generator = torch.Generator().manual_seed(seed)
        plain = _spread(x[~jumps], radius, generator)
        found = [plain]
        if jumps.any():
            found.append(_spread(x[jumps], 2 * radius, generator))
        labels = _nearest(x, plain)
        if jumps.any():
            labels[jumps] = len(plain) + _nearest(x[jumps], found[1])
        passages = _passages(labels.numpy(), (last | jumps).numpy(), hops + 1)
        exits: dict[int, dict[int, int]] = {}
        before = torch.nonzero(jumps).flatten()
        for i, j in zip(labels[before].tolist(), labels[before + 1].tolist(), strict=True):
            exits.setdefault(i, {})[j] = exits.get(i, {}).get(j, 0) + 1
        options: list[list[tuple[int, int]]] = [[] for _ in range(sum(map(len, found)))]
        for (i, j), times in passages.items():
            steps = max(1, round(float(np.quantile(times, _SHARE))))
            if len(times) >= min_count and steps <= max_steps and i < len(plain):
                options[i].append((j, steps))
        if not any(options):
            raise ValueError(
                f"{owner} found no two of {len(options)} landmarks between which {min_count} "
                f"passages were recorded. Use a smaller radius or min_count."
            )
        for p in exits:
            options[p].append((p, 1))
        width = max(map(len, options))
        most = max((len(after) for after in exits.values()), default=1)
        model = cls(len(options), x.shape[1], width, most)
        model.places.copy_(torch.cat(found))
        model.is_jump[len(plain) :] = True
        model.jump.fill_(shortest)
        for i, known in enumerate(options):
            for a, (j, steps) in enumerate(sorted(known)):
                after = exits[i] if i == j else {j: 1}
                shares = torch.tensor(list(after.values()), dtype=torch.float32)
                model.targets[i, a] = j
                model.durations[i, a] = steps
                model.outcomes[i, a, : len(after)] = torch.tensor(list(after))
                model.probabilities[i, a, : len(after)] = shares / shares.sum()
        return model

    @property
    def device(self) -> torch.device:
        """Device of the model."""
        return self.places.device

    def position(self, landmark: Tensor) -> Tensor:
        """Return the places of landmarks, float32 ``[*B, F]``."""
        return self.places[landmark]

    def mask(self, landmark: Tensor) -> Tensor:
        """Return which options there are, bool ``[*B, A]``."""
        return self.targets[landmark] >= 0

    def lead(
        self, landmark: Tensor, option: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return where options lead, drawn where there is chance, and base steps, both ``[*B]``."""
        shares = self.probabilities[landmark, option]
        if shares.shape[-1] == 1:
            which = torch.zeros_like(landmark)
        else:
            draws = torch.rand((*landmark.shape, 1), generator=generator).to(self.device)
            most = (shares > 0.0).sum(-1) - 1
            which = torch.minimum((shares.cumsum(-1) <= draws).sum(-1), most)
        after = self.outcomes[landmark, option].gather(-1, which[..., None]).squeeze(-1)
        return after, self.durations[landmark, option]

    @property
    def has_chance(self) -> bool:
        """True if an option has more outcomes than one."""
        return bool((self.probabilities > 0.0).sum(-1).max() > 1)

    def values(self, goal: Tensor, gamma: float) -> Tensor:
        r"""Return the values of all landmarks for one goal landmark, by value iteration.

        .. math:: V(i) = \max_a \gamma^{k_{ia}} \sum_j P(j \mid i, a)\, V(j), \qquad V(g) = 1

        for the goal g: float32 ``[N]``; 0 where no option leads on.
        """
        weights = gamma ** self.durations[..., None] * self.probabilities
        values = torch.zeros(self.num_landmarks, device=self.places.device)
        values[goal] = 1.0
        for _ in range(self.num_landmarks):
            better = (weights * values[self.outcomes]).sum(-1).max(-1).values
            better[goal] = 1.0
            if bool((better - values).abs().max() < 1e-6):
                break
            values = better
        return values

    def nearest(self, places: Tensor, *, goal: bool = False) -> Tensor:
        """Return the landmark nearest to each place ``[m, F]``, int64 ``[m]``.

        Of those with options and without jumps; for a ``goal``, of those to which options lead.
        """
        useful = (self.targets >= 0).any(1)
        if goal:
            useful = torch.zeros_like(useful)
            useful[self.targets[self.targets >= 0]] = True
        useful = torch.nonzero(useful & ~self.is_jump).flatten()
        return useful[_nearest(places.float(), self.places[useful])]


def find_jumps(places: Tensor, ends: Tensor, jump_factor: float = 10.0) -> Tensor:
    """Return which recorded states are followed by a jump.

    States are ``places`` ``[T, F]``, ``ends`` (bool ``[T]``) closes episodes; a step of
    ``jump_factor`` times the median is a jump.

    Args:
        places, ends, jump_factor: as in :meth:`LandmarkModel.fit`.

    Returns:
        bool ``[T]``.

    Reference:
        This project's.

    Example:
        >>> places = torch.tensor([[0.0], [1.0], [2.0], [30.0]])
        >>> find_jumps(places, torch.zeros(4, dtype=torch.bool))
        tensor([False, False,  True, False])
    """
    return _far_steps(places, ends, _shortest_jump(places, ends, jump_factor))


def _shortest_jump(places: Tensor, ends: Tensor, jump_factor: float) -> float:
    steps = (places[1:] - places[:-1]).norm(dim=1)[~ends[:-1]]
    return jump_factor * float(steps.median()) if len(steps) else float("inf")


def _far_steps(places: Tensor, ends: Tensor, shortest: float) -> Tensor:
    far = torch.zeros_like(ends)
    far[:-1] = ~ends[:-1] & ((places[1:] - places[:-1]).norm(dim=1) > shortest)
    return far


def _spread(places: Tensor, radius: float, generator: torch.Generator) -> Tensor:
    """Places at least a radius apart, within which all others are."""
    rows = torch.randperm(len(places), generator=generator)[:_SAMPLES]
    places = places[rows]
    chosen = [0]
    far = (places - places[0]).norm(dim=1)
    while far.max() > radius:
        chosen.append(int(far.argmax()))
        far = torch.minimum(far, (places - places[chosen[-1]]).norm(dim=1))
    return places[chosen]


def _nearest(places: Tensor, landmarks: Tensor) -> Tensor:
    """The row of the nearest landmark."""
    parts = [torch.cdist(part, landmarks).argmin(1) for part in places.split(_SAMPLES)]
    return torch.cat(parts)


def _passages(labels: np.ndarray, ends: np.ndarray, most: int) -> dict[tuple[int, int], list[int]]:
    """Base steps of each passage from a landmark to another, up to ``most`` landmarks on.

    Episodes begin between landmarks: what is recorded from there counts where nothing else is.
    """
    begins = np.ones(len(labels), np.bool_)
    first = np.append(True, ends[:-1])
    begins[1:] = (labels[1:] != labels[:-1]) | first[1:]
    at = np.flatnonzero(begins)
    who, episode, partial = labels[at], np.cumsum(first)[at], first[at]
    whole: dict[tuple[int, int], list[int]] = {}
    rest: dict[tuple[int, int], list[int]] = {}
    for on in range(1, most + 1):
        same = (episode[on:] == episode[:-on]) & (who[on:] != who[:-on])
        pairs = np.stack([who[:-on][same], who[on:][same]], 1).tolist()
        steps = (at[on:] - at[:-on])[same].tolist()
        for pair, taken, cut in zip(pairs, steps, partial[:-on][same].tolist(), strict=True):
            (rest if cut else whole).setdefault(tuple(pair), []).append(taken)
    return {pair: whole.get(pair) or rest[pair] for pair in whole | rest}


class LandmarkEnv(EnvBase):
    r"""The macro environment of a :class:`LandmarkModel` or :class:`EffectModel`, to plan in.

    A step goes to a landmark (a setting); at the goal's it pays 1 and ends. With chance an outcome
    is drawn. Stateless, batched and settable: ``"landmark"`` and ``"goal"`` (int64 ``[*B]``) are
    its state. It writes ``"position"`` (float32 ``[*B, F]``), ``"action_mask"`` (bool ``[*B, A]``)
    and ``"duration"`` (int64 ``[*B, 1]``, base steps) too.

    Args:
        model (LandmarkModel or EffectModel): read live.
        gamma (float): discount per base step; the planner takes it over. Default 0.99.
        seed (int, optional): of the draws. Default: from torch's global generator.

    Raises:
        ValueError: if ``gamma`` is out of range.

    Reference:
        This project's.

    Example:
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> places = torch.arange(0.0, 10.0, 0.1)[:, None]
        >>> model = LandmarkModel.fit(places, torch.arange(100) == 99, radius=2.0, min_count=1)
        >>> env = LandmarkEnv(model)
        >>> start, goal = model.nearest(torch.tensor([[0.0], [9.9]]))
        >>> td = env.reset(TensorDict(landmark=start, goal=goal), set_state=True)
        >>> env.rollout(9, MCTSPlanner(env), tensordict=td, auto_reset=False)["next", "done"][-1]
        tensor([True])
    """

    batch_locked = False
    _supports_set_state = True

    def __init__(
        self, model: LandmarkModel | EffectModel, *, gamma: float = 0.99, seed: int | None = None
    ) -> None:
        super().__init__(device=model.device, batch_size=[])
        self.model = model
        self.gamma = real_number("LandmarkEnv", "gamma", gamma, above=0.0, most=1.0)
        n, a = model.num_landmarks, model.num_options
        one = (1,)
        state = {name: Categorical(n, dtype=torch.int64) for name in ("landmark", "goal")}
        self.state_spec = Composite(**state)
        self.observation_spec = Composite(
            **{name: spec.clone() for name, spec in state.items()},
            position=Unbounded((model.num_features,)),
            action_mask=Binary(a, dtype=torch.bool),
            duration=Unbounded(one, dtype=torch.int64),
        )
        self.action_spec = Categorical(a, dtype=torch.int64)
        self.reward_spec = Unbounded(one)
        self.done_spec = Composite(
            done=Binary(1, shape=one, dtype=torch.bool),
            terminated=Binary(1, shape=one, dtype=torch.bool),
        )
        self._generator = torch.Generator()
        self.set_seed(seed)

    def _shown(self, landmark: Tensor, goal: Tensor, duration: Tensor) -> TensorDict:
        model = self.model
        return TensorDict(
            landmark=landmark,
            goal=goal,
            position=model.position(landmark),
            action_mask=model.mask(landmark),
            duration=duration,
            batch_size=landmark.shape,
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        given = TensorDict() if tensordict is None else tensordict
        shape = given.batch_size
        drawn = torch.randint(self.model.num_landmarks, (2, *shape), generator=self._generator)
        landmark, goal = drawn.to(self.device)
        if kwargs.get("set_state"):
            landmark, goal = given.get("landmark"), given.get("goal")
        duration = torch.zeros(*shape, 1, dtype=torch.int64, device=self.device)
        out = self._shown(landmark, goal, duration)
        flag = torch.zeros(*shape, 1, dtype=torch.bool, device=self.device)
        return out.update({"done": flag, "terminated": flag.clone()})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        landmark, goal = tensordict.get("landmark"), tensordict.get("goal")
        option = tensordict.get("action")
        after, steps = self.model.lead(landmark, option, self._generator)
        duration = steps.to(torch.int64)[..., None]
        out = self._shown(after, goal, duration)
        reached = (after == goal)[..., None]
        return out.update({"reward": reached.float(), "done": reached, "terminated": reached})

    def _set_seed(self, seed: int | None) -> None:
        drawn = torch.empty((), dtype=torch.int64).random_() if seed is None else seed
        self._generator.manual_seed(int(drawn))
