"""Atari 2600 games on the console's RAM, as a TorchRL environment whose state can be set."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_hmcts.checks import real_number
from torchrl_hmcts.envs.atari.emulator import AtariEmulator, EmulatorSettings


class AtariRAMEnv(EnvBase):
    r"""Play an Atari 2600 game on its 128 bytes of RAM.

    A step sends an action for ``frame_skip`` frames. In each of them, with the probability
    ``repeat_action_probability``, the console sees the action held before instead (sticky actions).
    With the defaults and the same seed, the trajectory is that of Gymnasium's ``ALE/<game>-v5``
    with ``obs_type="ram"``, from ``set_seed(seed)`` and ``reset()`` to the episode's end. Later
    episodes load the game again with seeds of their own, so that an episode does not depend on the
    one before.

    ``reset(td, set_state=True)`` continues from the state in ``td``, also of another env of
    the same game: exactly, where nothing is drawn or the state has the random generators
    (``include_rng=True``). Without it, which is what a planner may be given of a
    game with sticky actions, the coming draws are others.

    Writes ``"ram"`` (uint8 ``[128]``), ``"observation"`` (float32 ``[128]``, RAM / 255),
    ``"lives"`` and ``"episode_frame"`` (int64 ``[1]``), and ``"emulator_state"`` (uint8 ``[about
    530]``, 2,498 more with the generator, and 37 where ``frame_skip`` is drawn).
    Attributes: ``num_frames``, all frames emulated so far; ``action_names``; ``settings``.

    Args:
        game (str): e.g. ``"Breakout"`` or ``"SpaceInvaders"``.
        frame_skip (int or pair of int): frames per step. Default 4, as in Gymnasium; planning
            papers use 5. Of a pair ``(low, high)`` each step's number is drawn, ``high``
            excluded, as in Gymnasium: then a state is continued exactly only with
            ``include_rng=True``.
        repeat_action_probability (float): Default 0.25, as in Gymnasium and recommended by
            Machado et al.; 0 is the deterministic protocol.
        full_action_space (bool): all 18 actions instead of those that the game has. Default False.
        noop_max (int or range, optional): an episode begins with 1 to ``noop_max`` frames of doing
            nothing; 0 for none. Of a range one of its numbers is drawn. Default: none where actions
            are sticky, as in Gymnasium, else 30.
        start_actions (int): random actions after these, which are no part of the episode's reward.
            Default 0.
        terminal_on_life_loss (bool): whether a lost life ends the episode. Default False, as
            Machado et al. recommend.
        life_loss_penalty (float): taken off the reward for every life lost, e.g. in the env in
            which is planned. Default 0.
        reward_clip (float, optional): rewards are clipped to ``[-reward_clip, reward_clip]``,
            before the penalty. Default: not clipped.
        max_frames (int): of an episode, then ``truncated``. Default 108,000; planning papers use
            18,000.
        mode, difficulty (int, optional): the console's switches. Default: the game's.
        read_outs (sequence of str): which of ``"ram"`` and ``"observation"`` to write. Default:
            both.
        include_state (bool): whether ``"emulator_state"`` is written. Default True; it takes a
            tenth of a step's time.
        include_rng (bool): whether it has the random generators. Default False.
        seed (int, optional): of starts, sticky actions and frames per step.
        device (torch.device, optional): of all tensors; the emulator runs on the CPU.

    Raises:
        ImportError: if ale-py is not installed.
        ValueError: if there is no such game, or an argument is out of range.

    Reference:
        Bellemare et al., "The Arcade Learning Environment", 2013, arXiv 1207.4708; Machado et al.,
        "Revisiting the Arcade Learning Environment", 2018, arXiv 1709.06009; dissertation, ch. 5.

    Example:
        >>> from torchrl_hmcts.envs import AtariRAMEnv
        >>> env = AtariRAMEnv("Breakout", repeat_action_probability=0.0, seed=0)
        >>> env.action_names
        ['NOOP', 'FIRE', 'RIGHT', 'LEFT']
        >>> td = env.rollout(8)
        >>> td["ram"].shape, td["next", "episode_frame"][-1].item() - td["episode_frame"][0].item()
        (torch.Size([8, 128]), 32)
        >>> again = env.step(env.reset(td[5], set_state=True).set("action", td["action"][5]))
        >>> again["next", "ram"].equal(td["next", "ram"][5])
        True
    """

    _supports_set_state = True
    _has_frame_skip = True  # else TorchRL skips frames a second time, by a transform
    metadata = {"render_modes": ["rgb_array"], "render_fps": 60}

    def __init__(
        self,
        game: str,
        *,
        frame_skip: int | tuple[int, int] = 4,
        repeat_action_probability: float = 0.25,
        full_action_space: bool = False,
        noop_max: int | range | None = None,
        start_actions: int = 0,
        terminal_on_life_loss: bool = False,
        life_loss_penalty: float = 0.0,
        reward_clip: float | None = None,
        max_frames: int = 108_000,
        mode: int | None = None,
        difficulty: int | None = None,
        read_outs: Sequence[str] = ("ram", "observation"),
        include_state: bool = True,
        include_rng: bool = False,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        name = "AtariRAMEnv"
        self.life_loss_penalty = real_number(name, "life_loss_penalty", life_loss_penalty, least=0)
        if reward_clip is not None:
            reward_clip = real_number(name, "reward_clip", reward_clip, above=0.0)
        unknown = sorted(set(read_outs) - {"ram", "observation"})
        if unknown or isinstance(read_outs, str):
            raise ValueError(
                f'AtariRAMEnv has the read_outs ("ram", "observation"); got {read_outs!r}.'
            )
        self.settings = EmulatorSettings(
            game,
            frame_skip,
            repeat_action_probability,
            full_action_space,
            noop_max,
            start_actions,
            max_frames,
            mode,
            difficulty,
        )
        emulator = AtariEmulator(self.settings)
        super().__init__(device=device, batch_size=torch.Size(()))
        self.game = emulator.game
        self.repeat_action_probability = float(repeat_action_probability)
        self.terminal_on_life_loss = bool(terminal_on_life_loss)
        self.reward_clip = reward_clip
        self.action_names = emulator.action_names
        self.include_state, self.include_rng = bool(include_state), bool(include_rng)
        self._read_outs = tuple(read_outs)
        self._emulator = emulator
        self._ram = np.zeros(128, np.uint8)
        self._set_specs()
        self.set_seed(int(torch.empty((), dtype=torch.int64).random_()) if seed is None else seed)

    def _set_specs(self) -> None:
        def numbers(width: int, dtype: torch.dtype, high: float) -> Bounded:
            return Bounded(0, high, shape=(width,), dtype=dtype, device=self.device)

        emulator = self._emulator
        width = emulator.width_with_rng if self.include_rng else emulator.states.width
        observed = {
            "lives": numbers(1, torch.int64, 255),
            "episode_frame": numbers(1, torch.int64, 2**31),
            "ram": numbers(128, torch.uint8, 255),
            "observation": numbers(128, torch.float32, 1.0),
        }
        for name in {"ram", "observation"} - set(self._read_outs):
            del observed[name]
        state = {}
        if self.include_state:
            state["emulator_state"] = numbers(width, torch.uint8, 255)
            observed["emulator_state"] = state["emulator_state"].clone()
        self.state_spec = Composite(state, device=self.device)
        self.observation_spec = Composite(observed, device=self.device)
        self.action_spec = Categorical(self._emulator.num_actions, shape=(), device=self.device)
        self.reward_spec = Unbounded((1,), dtype=torch.float32, device=self.device)
        done = {key: Binary(1, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(done, device=self.device)

    @property
    def frame_skip(self) -> int | tuple[int, int]:
        """Frames per step."""
        return self.settings.frame_skip

    @property
    def num_frames(self) -> int:
        """Frames emulated since construction."""
        return self._emulator.num_frames

    def _set_seed(self, seed: int | None) -> None:
        # As Gymnasium's Atari env does, so that a seed means the same in both.
        words = np.random.SeedSequence(seed).generate_state(2)
        self._generator = np.random.default_rng(int(words[0]))
        self._first_seed: int | None = int(words[1].astype(np.int32))

    # ---------------------------------------------------------------- playing

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        emulator = self._emulator
        if kwargs.get("set_state"):
            row = None if tensordict is None else tensordict.get("emulator_state", None)
            if row is None:
                raise ValueError(
                    'AtariRAMEnv is set to the state under "emulator_state", which the tensordict '
                    "lacks. Pass a tensordict that an env with include_state=True wrote."
                )
            emulator.set_state(row.numpy(force=True))
        else:
            seed, self._first_seed = self._first_seed, None
            emulator.reset(self._generator, seed)
        return self._observed()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        emulator = self._emulator
        gained, lost = emulator.act(int(tensordict.get("action")))
        reward = float(gained)
        if self.reward_clip is not None:
            reward = max(-self.reward_clip, min(self.reward_clip, reward))
        reward -= self.life_loss_penalty * lost
        terminated = emulator.terminated or (self.terminal_on_life_loss and lost > 0)
        truncated = emulator.truncated
        out = self._observed()
        device = self.device
        out.set("reward", torch.tensor([reward], dtype=torch.float32, device=device))
        out.set("terminated", torch.tensor([terminated], device=device))
        out.set("truncated", torch.tensor([truncated], device=device))
        out.set("done", torch.tensor([terminated or truncated], device=device))
        return out

    def _observed(self) -> TensorDict:
        emulator = self._emulator
        emulator.read_ram(self._ram)
        ram = torch.from_numpy(self._ram.copy())
        entries = {
            "lives": torch.tensor([emulator.lives]),
            "episode_frame": torch.tensor([emulator.episode_frame]),
        }
        if "ram" in self._read_outs:
            entries["ram"] = ram
        if "observation" in self._read_outs:
            entries["observation"] = ram.to(torch.float32) / 255.0
        if self.include_state:
            row = emulator.state(include_rng=self.include_rng)
            entries["emulator_state"] = torch.from_numpy(row)
        out = TensorDict(entries, ())
        return out if self.device is None else out.to(self.device)

    def render(self, tensordict: TensorDictBase | None = None) -> np.ndarray:
        """Return the screen, uint8 ``[210, 160, 3]``.

        A state has no picture: where the env was set to a state and not stepped since, or for a
        state in ``tensordict``, the picture is that of one frame later, in which nothing is done.
        The game that is played is not touched.

        Args:
            tensordict (TensorDictBase, optional): with ``"emulator_state"``. Default: the env's
                present state.
        """
        row = None if tensordict is None else tensordict.get("emulator_state", None)
        if row is None and not self._emulator.screen_is_stale:
            return self._emulator.screen()
        return self._emulator.draw(self._emulator.state() if row is None else row.numpy(force=True))
