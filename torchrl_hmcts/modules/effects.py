"""Effects in recorded episodes, as options that flip switches: a model to plan in.

Letters: T recorded steps, D numbers of an observation, F numbers of a place, K switches, A options,
*B batch.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_hmcts.checks import real_number

_MOST_SWITCHES = 24  # a table has 2^24 numbers


class EffectModel(nn.Module):
    r"""Options "make that change", found in recorded episodes: each flips some switches.

    A switch is a column of the observation that has two values, e.g. a lamp; of columns that always
    change together the first counts. An effect is a set of switches that change in one step.
    Effects that were recorded at least ``min_share`` as often as the most frequent one are options,

    .. math:: s' = s \oplus f_a,

    with the setting s of all switches (a number below :math:`2^K`) and the switches :math:`f_a` of
    effect a. Rarer effects are taken for accidents, e.g. two at once.

    :class:`LandmarkEnv` plans in it; a setting is its landmark. Build it by :meth:`fit`.

    Args:
        num_switches (int): K, at most 24.
        num_options (int): A.
        num_features (int): F.

    Attributes:
        columns: int64 ``[K]``, of the observation.
        middles: float32 ``[K]``, half-way between a column's two values.
        flips: int64 ``[A]``, a bit for each switch.
        places: float32 ``[A, F]``, where each effect was recorded (median).
        duration: float32 ``[]``, base steps from an effect to the next (median).

    Raises:
        ValueError: if there are more than 24 switches.

    Reference:
        This project's. Planning over the effects of options: Konidaris, Kaelbling and Lozano-Perez,
        "From skills to symbols", JAIR 61, 2018.

    Example:
        >>> lamps = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> model = EffectModel.fit(lamps, torch.tensor([False, False, False, True]))
        >>> model.flips.tolist(), model.settings(lamps).tolist()
        ([1, 2], [0, 1, 3, 2])
    """

    columns: Tensor
    middles: Tensor
    flips: Tensor
    places: Tensor
    duration: Tensor

    has_chance = False

    def __init__(self, num_switches: int, num_options: int, num_features: int = 0) -> None:
        super().__init__()
        if num_switches > _MOST_SWITCHES:
            raise ValueError(
                f"EffectModel plans with a table of all settings, so at most {_MOST_SWITCHES} "
                f"switches; got {num_switches}. Leave out columns that do not matter."
            )
        self.register_buffer("columns", torch.zeros(num_switches, dtype=torch.int64))
        self.register_buffer("middles", torch.zeros(num_switches))
        self.register_buffer("flips", torch.zeros(num_options, dtype=torch.int64))
        self.register_buffer("places", torch.zeros(num_options, num_features))
        self.register_buffer("duration", torch.ones(()))
        self.num_landmarks, self.num_options = 1 << num_switches, num_options
        self.num_features = num_switches  # of :meth:`position`

    @classmethod
    def fit(
        cls,
        observations: Tensor,
        ends: Tensor,
        places: Tensor | None = None,
        *,
        min_share: float = 0.2,
    ) -> EffectModel:
        """Build the model of recorded episodes.

        Args:
            observations (Tensor): float ``[T, D]``.
            ends (Tensor): bool ``[T]``, the last state of each episode.
            places (Tensor, optional): float ``[T, F]``, where the agent is. Default: F = 0.
            min_share (float): of the most frequent effect's count. Default 0.2.

        Raises:
            ValueError: if the sizes do not fit, or no effect is found.
        """
        real_number("EffectModel.fit", "min_share", min_share, above=0.0, most=1.0)
        if places is None:
            places = observations.new_zeros(len(observations), 0)
        shapes = [list(x.shape) for x in (observations, ends, places)]
        if [len(shape) for shape in shapes] != [2, 1, 2] or len({n for n, *_ in shapes}) > 1:
            raise ValueError(
                "EffectModel.fit needs observations [T, D], ends [T] and places [T, F]; got "
                f"{shapes[0]}, {shapes[1]} and {shapes[2]}."
            )
        columns, middles = _switches(observations)
        settings = _number(observations, columns, middles)
        changed = settings[1:] ^ settings[:-1]
        changed[ends[:-1]] = 0
        effects, counts = changed[changed != 0].unique(return_counts=True)
        if len(effects) == 0:
            raise ValueError(
                f"EffectModel.fit found no effect: of {observations.shape[1]} columns "
                f"{len(columns)} have two values, and none changes within an episode."
            )
        effects = effects[counts >= min_share * counts.max()]
        model = cls(len(columns), len(effects), places.shape[1])
        model.columns.copy_(columns)
        model.middles.copy_(middles)
        model.flips.copy_(effects)
        for a, effect in enumerate(effects):
            model.places[a] = places[1:][changed == effect].median(0).values
        at = torch.nonzero(changed).flatten()
        number = ends.cumsum(0)[at]
        between = (at[1:] - at[:-1])[number[1:] == number[:-1]]
        model.duration.fill_(float(between.median()) if len(between) else 1.0)
        return model

    def settings(self, observations: Tensor) -> Tensor:
        """Return the settings, int64 ``[*B]``, that observations ``[*B, D]`` show."""
        return _number(observations, self.columns, self.middles)

    def effect(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the options that made changes between settings, int64 ``[*B]``; -1: none did."""
        same = (before ^ after)[..., None] == self.flips
        return torch.where(same.any(-1), same.int().argmax(-1), -1)

    def position(self, landmark: Tensor) -> Tensor:
        """Return what the switches show, 0 or 1, float32 ``[*B, K]``."""
        bits = torch.arange(len(self.columns), device=landmark.device)
        return ((landmark[..., None] >> bits) & 1).float()

    def mask(self, landmark: Tensor) -> Tensor:
        """Return that all options can be taken, bool ``[*B, A]``."""
        return torch.ones(*landmark.shape, self.num_options, dtype=torch.bool, device=self.device)

    def lead(
        self, landmark: Tensor, option: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the settings after options, int64 ``[*B]``, and their base steps, float32."""
        return landmark ^ self.flips[option], self.duration.expand(landmark.shape)

    @property
    def device(self) -> torch.device:
        """Device of the model."""
        return self.flips.device

    def values(self, goal: Tensor, gamma: float) -> Tensor:
        r"""Return what all settings are worth on the way to one, by breadth first from there.

        .. math:: V(s) = \gamma^{k n(s)}

        with the least number n of options and the duration k: float32 ``[2^K]``, 0 where no options
        lead there. Flips lead back as they lead there.
        """
        flips = self.flips.cpu().numpy()
        options = np.full(self.num_landmarks, -1, np.int16)
        edge, depth = goal.reshape(1).cpu().numpy(), 0
        options[edge] = 0
        while len(edge):
            depth, parts = depth + 1, []
            for flip in flips:
                near = edge ^ flip
                near = near[options[near] < 0]
                options[near] = depth
                parts.append(near)
            edge = np.concatenate(parts)
        worth = gamma ** (float(self.duration) * np.arange(depth + 1))
        worth = np.append(worth, 0.0).astype(np.float32)  # -1: not reached
        return torch.from_numpy(worth[options]).to(self.device)


def _switches(observations: Tensor) -> tuple[Tensor, Tensor]:
    """Columns with two values, and what is half-way between these."""
    low, high = observations.min(0).values, observations.max(0).values
    either = (observations == low) | (observations == high)
    found = torch.nonzero(either.all(0) & (low < high)).flatten()
    kept: dict[bytes, int] = {}
    for column in found.tolist():
        bits = observations[:, column] == high[column]
        key = np.packbits((bits ^ bits[0]).cpu().numpy()).tobytes()
        kept.setdefault(key, column)
    columns = torch.tensor(list(kept.values()), dtype=torch.int64)
    return columns, ((low + high) / 2)[columns].float().cpu()


def _number(observations: Tensor, columns: Tensor, middles: Tensor) -> Tensor:
    on = observations[..., columns.to(observations.device)] > middles.to(observations.device)
    return (on.to(torch.int64) << torch.arange(len(columns), device=on.device)).sum(-1)
