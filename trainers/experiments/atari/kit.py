"""A game as an experiment needs it: emulators to plan, play and learn in, starts and actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from torchrl.envs import Compose, SerialEnv, SignTransform, TransformedEnv, UnaryTransform

from torchrl_hmcts.envs import AtariOptionPool, AtariRAMEnv, OptionWorker
from torchrl_hmcts.envs.atari.emulator import AtariEmulator
from torchrl_hmcts.trainers.experiments.atari.memory import TrialMemory
from torchrl_hmcts.transforms import DisplacementTransform, SkillTransform

FRAMES_PER_STEP = 4
_STICKY_SEED = 7_654_321  # of emulators to play in, which the planner must not know


@dataclass(frozen=True)
class AtariKit:
    """An Atari game: what a search for options, a training and an agent make of it.

    Args:
        game: e.g. ``"Breakout"``.
        gamma: discount per base step of 4 frames.
        max_frames: real frames after which an episode ends.
        num_processes: that emulate; 0: the calling one. Default: one for each core.
        seed: of starts, searches and networks.
        log: told what was found, a line at a time.
        memory: of trials that are not played again. Default: none.

    Example:
        >>> from torchrl_hmcts.envs import RepeatActions
        >>> from torchrl_hmcts.trainers import AtariKit
        >>> kit = AtariKit("Breakout", num_processes=0)
        >>> kit.action_names
        ['NOOP', 'FIRE', 'RIGHT', 'LEFT']
        >>> kit.make_pool(RepeatActions(4), max_steps=10).num_options
        4
    """

    game: str
    gamma: float = 0.99
    max_frames: int = 108_000
    num_processes: int | None = None
    seed: int = 0
    log: Callable[[str], object] = field(default=print, repr=False, compare=False)
    memory: TrialMemory | None = field(default=None, repr=False, compare=False)

    @property
    def action_names(self) -> list[str]:
        """Names of the game's own actions, by their index."""
        return list(AtariEmulator(self.game).action_names)

    def make_pool(
        self, worker: OptionWorker, max_steps: int, *, sticky: bool = False, record: bool = False
    ) -> AtariOptionPool:
        """Make a pool of emulators.

        Args:
            worker: executes the options.
            max_steps: base steps of an option at most.
            sticky: whether actions stick, with probability 0.25: to play in, not to plan.
            record: whether the steps inside an option are written, too.
        """
        return AtariOptionPool(
            self.game,
            worker,
            max_steps=max_steps,
            num_processes=0 if sticky else self.num_processes,
            record=record,
            gamma=self.gamma,
            repeat_action_probability=0.25 if sticky else 0.0,
            max_frames=self.max_frames,
            seed=self.start_seed(sticky=sticky) if sticky else self.seed,
        )

    def make_training_env(
        self,
        num_options: int,
        *,
        option_steps: int,
        num_envs: int = 8,
        bytes_seen: Sequence[int] | None = None,
        clip_reward: bool = False,
    ) -> TransformedEnv:
        """Make deterministic emulators in which a network learns options.

        Args:
            num_options: one is drawn for each mini-episode.
            option_steps: base steps of a mini-episode.
            num_envs: emulators that play at a time.
            bytes_seen: of which ``"displacement"`` since the option began is written; None: none.
            clip_reward: whether the game's reward is replaced by its sign.
        """
        parts: list[Any] = [SkillTransform(num_options, max_skill_steps=option_steps)]
        if clip_reward:
            parts.append(SignTransform(in_keys=["reward"]))
        if bytes_seen is not None:
            seen = list(bytes_seen)
            parts.append(UnaryTransform(["observation"], ["seen"], fn=lambda x: x[..., seen]))
            parts.append(DisplacementTransform("seen"))
        one = partial(AtariRAMEnv, self.game, repeat_action_probability=0.0, seed=self.seed)
        return TransformedEnv(SerialEnv(num_envs, one), Compose(*parts))

    def start_seed(self, episode: int | None = None, *, sticky: bool = False) -> int:
        """Return the seed of the pool in which an episode is played.

        Args:
            episode: its number, from 0. Default: that of a pool before its first episode.
            sticky: whether it is played with sticky actions.
        """
        seed = self.seed if episode is None else self.seed * 10_000 + episode
        return seed + (_STICKY_SEED if sticky else 0)
