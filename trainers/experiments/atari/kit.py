"""A game as an experiment needs it: emulators to plan, play and learn in, starts and actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, SerialEnv, SignTransform, TransformedEnv, UnaryTransform

from torchrl_hmcts.envs import AtariOptionPool, AtariRAMEnv, OptionWorker, RepeatActions
from torchrl_hmcts.envs.atari.emulator import AtariEmulator, EmulatorSettings
from torchrl_hmcts.trainers.experiments.atari.memory import TrialMemory
from torchrl_hmcts.transforms import DisplacementTransform, SkillTransform

FRAMES_PER_STEP = 4
SPLITS = {"train": range(1, 240, 2), "test": range(2, 241, 2)}  # frames of doing nothing
_START_ACTIONS = 5  # random ones after these
Curve = Callable[[OptionWorker, int, int], object]
_STICKY_SEED = 7_654_321  # of emulators to play in, which the planner must not know


@dataclass(frozen=True)
class AtariKit:
    """An Atari game: its pools, training envs and starts.

    An episode begins with some frames of doing nothing, up to four seconds, and five random
    actions. The frames are an odd number in the split ``"train"``, where options are probed,
    learned, tried and chosen, and an even one in ``"test"``, whose episodes are scored: no start is
    in both.

    Args:
        game: e.g. ``"Breakout"``.
        gamma: discount per base step of 4 frames.
        max_frames: real frames after which an episode ends.
        num_processes: that emulate; 0: the calling one. Default: one for each core.
        seed: of starts, searches and networks.
        log: told what was found, a line at a time.
        memory: of trials that are not played again. Default: none.
        curve: called with a worker that learns, the samples it has learned from and the frames
            that these took, e.g. to measure it. Default: nothing is.

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
    curve: Curve | None = field(default=None, repr=False, compare=False)

    @property
    def action_names(self) -> list[str]:
        """Names of the game's own actions, by their index."""
        return list(AtariEmulator(EmulatorSettings(self.game)).action_names)

    def starts(self, split: str, num_starts: int) -> TensorDictBase:
        """Return states in which episodes begin, ``[num_starts]``, the first that a pool draws.

        Args:
            split: ``"train"`` or ``"test"``.
            num_starts: how many.
        """
        pool = replace(self, num_processes=0).make_pool(RepeatActions(1), 1, split=split)
        states = pool.reset(TensorDict(batch_size=[num_starts]))
        return states.select("emulator_state", "ram", "episode_frame")

    def make_pool(
        self,
        worker: OptionWorker,
        max_steps: int,
        *,
        split: str = "train",
        sticky: bool = False,
        record: bool = False,
        end_on_life_loss: bool = False,
    ) -> AtariOptionPool:
        """Make a pool of emulators.

        Args:
            worker: executes the options.
            max_steps: base steps of an option at most.
            split: of the starts.
            sticky: whether actions stick, with probability 0.25. Who plans there needs a seed of
                its own, by ``set_seed``.
            record: whether the steps inside an option are written, too.
            end_on_life_loss: whether an option ends when a life is lost.
        """
        return AtariOptionPool(
            self.game,
            worker,
            max_steps=max_steps,
            num_processes=self.num_processes,
            record=record,
            end_on_life_loss=end_on_life_loss,
            gamma=self.gamma,
            repeat_action_probability=0.25 if sticky else 0.0,
            **self._episode(split),
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
    ) -> tuple[TransformedEnv, Callable[[], int]]:
        """Make deterministic emulators in which a network learns options.

        Returns the env, and a function that counts the frames which it has emulated.

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
        made: list[AtariRAMEnv] = []

        def one() -> AtariRAMEnv:
            made.append(
                AtariRAMEnv(
                    self.game,
                    repeat_action_probability=0.0,
                    read_outs=("observation",),
                    include_state=False,
                    seed=self.seed,
                    **self._episode("train"),
                )
            )
            return made[-1]

        env = TransformedEnv(SerialEnv(num_envs, one), Compose(*parts))
        return env, lambda: sum(one.num_frames for one in made)

    def _episode(self, split: str) -> dict[str, Any]:
        """Return an emulator's settings of how an episode begins and how long it is."""
        if split not in SPLITS:
            raise ValueError(f"AtariKit has the splits {', '.join(SPLITS)}; got {split!r}.")
        return {
            "noop_max": SPLITS[split],
            "start_actions": _START_ACTIONS,
            "max_frames": self.max_frames,
        }

    def start_seed(self, episode: int | None = None, *, sticky: bool = False) -> int:
        """Return the seed of the pool in which an episode is played.

        Args:
            episode: its number, from 0. Default: that of a pool before its first episode.
            sticky: whether it is played with sticky actions.
        """
        seed = self.seed if episode is None else self.seed * 10_000 + episode
        return seed + (_STICKY_SEED if sticky else 0)
