"""A pool of Atari emulators as a macro environment: one step is a whole option.

Letters: *B batch of the tensordict, T ``max_steps``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_hmcts.checks import real_number, whole_number
from torchrl_hmcts.envs.atari.emulator import AtariEmulator, EmulatorSettings
from torchrl_hmcts.envs.gym.option_run import OptionRun, OptionWorker
from torchrl_hmcts.envs.gym.process_pool import ProcessPool

_BEFORE = "before emulator_state"


class AtariRun(OptionRun):
    """Runs options on an emulator.

    Args:
        settings: of the emulator.
        worker, max_steps, gamma, end_on_life_loss, record: as in :class:`AtariOptionPool`.
    """

    def __init__(
        self,
        settings: EmulatorSettings,
        worker: OptionWorker,
        max_steps: int,
        gamma: float,
        end_on_life_loss: bool,
        record: bool,
    ) -> None:
        super().__init__(worker, max_steps, gamma)
        self.arguments = (settings, worker, max_steps, gamma, end_on_life_loss, record)
        self.emulator = AtariEmulator(settings)
        self.record = record
        if end_on_life_loss:
            self.ends = self._ends_with_a_life
        byte, number, real = np.dtype(np.uint8), np.dtype(np.int64), np.dtype(np.float32)
        self.state_keys = ["emulator_state"]
        self.outputs = {
            "emulator_state": ((self.emulator.states.width,), byte),
            "ram": ((128,), byte),
            "lives": ((1,), number),
            "episode_frame": ((1,), number),
            "score": ((1,), real),
            "life_losses": ((1,), real),
        }
        if record:
            self.outputs["inner_ram"] = ((max_steps, 128), byte)  # before each action
            self.outputs["inner_action"] = ((max_steps,), number)
            self.outputs["inner_reward"] = ((max_steps,), real)
        self._ram = np.zeros(128, np.uint8)
        self.step = self._step
        self._start(None, 0)

    def _start(self, slots: dict[str, np.ndarray] | None, index: int) -> None:
        """Begin to sum up what an option gains."""
        self._slots, self._index, self._steps = slots, index, 0
        self._score = self._life_losses = 0.0
        self._discount, self._lost = 1.0, 0

    def _ends_with_a_life(self, ram: np.ndarray, option: int, steps: int) -> bool:
        ends = getattr(self.worker, "ends", None)
        return self._lost > 0 or (ends is not None and ends(ram, option, steps))

    def reset(self, generator: np.random.Generator, seed: int | None) -> np.ndarray:
        self._start(None, 0)
        self.emulator.reset(generator, seed)
        return self.first_observation()

    def first_observation(self) -> np.ndarray:
        ram = np.zeros(128, np.uint8)
        self.emulator.read_ram(ram)
        return ram

    def begin(
        self, slots: dict[str, np.ndarray], index: int
    ) -> tuple[np.ndarray, np.random.Generator]:
        state = slots[_BEFORE][index]
        seed = self.seed_of(slots, index, state.tobytes())
        generator = np.random.default_rng(seed)
        self._start(slots, index)
        self._frames = self.emulator.num_frames
        self.emulator.set_state(state, seed & 0x7FFFFFFF)
        self._ram = slots["after ram"][index]
        self.emulator.read_ram(self._ram)
        return self._ram, generator

    def _step(self, action: int) -> tuple[np.ndarray, int, bool, bool, None]:
        emulator, ram = self.emulator, self._ram
        gained, lost = emulator.act(action)
        self.work[0] += emulator.num_frames - self._frames - 1  # who takes the step counts one
        self._frames = emulator.num_frames
        if self.record and self._slots is not None:
            self._slots["after inner_ram"][self._index, self._steps] = ram
            self._slots["after inner_action"][self._index, self._steps] = action
            self._slots["after inner_reward"][self._index, self._steps] = gained
        emulator.read_ram(ram)
        self._steps += 1
        self._score += gained
        self._life_losses += self._discount * lost
        self._discount *= self.gamma
        self._lost = lost
        over = emulator.ale.game_over()
        return ram, gained, over and emulator.terminated, over and emulator.truncated, None

    def write(self, slots: dict[str, np.ndarray], index: int, observation: Any) -> None:
        slots["after ram"][index] = observation
        slots["after emulator_state"][index] = self.emulator.state()
        slots["after lives"][index] = self.emulator.lives
        slots["after episode_frame"][index] = self.emulator.episode_frame
        slots["after score"][index] = self._score
        slots["after life_losses"][index] = self._life_losses

    def check_action(self, action: Any) -> str:
        emulator = self.emulator
        if isinstance(action, (int, np.integer)) and 0 <= action < emulator.num_actions:
            return ""
        names = ", ".join(emulator.action_names)
        return f"{emulator.game} has the actions 0 to {emulator.num_actions - 1}: {names}"

    def render(self, slots: dict[str, np.ndarray], index: int) -> np.ndarray:
        return self.emulator.draw(slots[_BEFORE][index])


class AtariOptionPool(ProcessPool):
    r"""Options of an Atari game, taken by a worker inside processes that emulate.

    The action is an option. A step takes each state of the batch to the end of its option: the
    worker acts on the RAM until ``max_steps``, its own ``ends``, or the end of the game. With
    :math:`r_{i+1}` the game's rewards, :math:`l_{i+1}` the lives lost, :math:`p` the
    ``life_loss_penalty`` and :math:`k` the steps taken, it writes

    .. math:: \text{reward} = \sum_{i<k} \gamma^i (r_{i+1} - p\, l_{i+1}), \qquad
        \text{duration} = k.

    Stateless: the state is in the tensordict, ``"emulator_state"`` (uint8 ``[*B, about 530]``), of
    :class:`AtariRAMEnv` or of a pool, and any batch can be stepped, so a planner searches in it and
    an agent plays in it. ``num_processes`` emulate at a time: a wave of the planner wants
    ``leaves_per_wave`` a few times as large.

    An outcome is a function of state, option, the worker's weights and the pool's seed, whichever
    process finds it: the worker's random choices and sticky actions are drawn from these. So a
    search can be repeated, and in the deterministic protocol what was planned is what happens. With
    ``determinised=False`` every call draws again, for a planner that samples options more than once
    (``chance=ProgressiveWidening()``).

    Processes that die or hang, copies, threads and tickets are as in :class:`OptionPool`.
    ``num_frames`` counts all emulated frames, also those that were lost.

    Writes, besides the entries of :class:`AtariRAMEnv`: ``"duration"`` (int64 ``[*B, 1]``, steps of
    ``frame_skip`` frames), ``"score"`` (float32 ``[*B, 1]``, :math:`\sum r_{i+1}`, undiscounted and
    without penalty) and ``"life_losses"`` (float32 ``[*B, 1]``, discounted sum of :math:`l`).

    Args:
        game (str): e.g. ``"Breakout"``.
        worker (OptionWorker): ``worker.act(ram, option, generator)`` gives the next action, by its
            index, e.g. :class:`SharedMLP`. It is sent to each process once; weights in
            shared memory stay shared, so that updates are seen at once.
        max_steps (int): T.
        num_processes (int, optional): 0 runs the options in the calling process. Default: one for
            each core.
        gamma (float): discount per step; the planner takes it over. Default 0.99.
        life_loss_penalty (float): p; an attribute of the same name may be changed at any time, e.g.
            to the greatest reward seen. For planning: play without. Default 0.
        end_on_life_loss (bool): whether an option ends when a life is lost. Default False.
        determinised (bool): see above. Default True.
        record (bool): also write the steps inside the option: ``"inner_ram"`` (uint8 ``[*B, T,
            128]``, before each action), ``"inner_action"`` (int64 ``[*B, T]``) and
            ``"inner_reward"`` (float32 ``[*B, T]``); of them the first ``duration`` have a meaning.
            Default False.
        read_outs: as in :class:`AtariRAMEnv`.
        start_method, step_seconds: as in :class:`OptionPool`.
        batch_size (sequence of int): of ``reset()`` without a tensordict. Default none.
        seed (int, optional): of starts and of the draws inside options.
        **emulator: ``frame_skip``, ``repeat_action_probability``, ``full_action_space``,
            ``noop_max``, ``start_actions``, ``max_frames``, ``mode`` and ``difficulty``, as in
            :class:`AtariRAMEnv`. Here ``repeat_action_probability`` is 0 by default, for planning.
            To play under sticky actions make another pool with 0.25 and a seed that the planner
            does not know.

    Raises:
        ImportError: if ale-py is not installed.
        ValueError: if an argument is out of range; when stepping, if an option is.
        RuntimeError: when stepping, if the worker raises an error, or processes die or hang again
            and again.
        OSError: if there is too little shared memory or too few file descriptors, or when stepping,
            if processes cannot be started.

    Reference:
        Sutton, Precup and Singh, "Between MDPs and semi-MDPs", 1999; dissertation, chapter 5.

    Example:
        >>> from torchrl_hmcts.envs import AtariOptionPool, RepeatActions
        >>> from torchrl_hmcts.planners import PUCT, MCTSPlanner, SearchBudget
        >>> worker = RepeatActions(4)
        >>> pool = AtariOptionPool("Breakout", worker, max_steps=5, num_processes=0, seed=0)
        >>> planner = MCTSPlanner(pool, tree_policy=PUCT(), expand="one", leaves_per_wave=4,
        ...                       budget=SearchBudget(base_steps=100, until_plan=False))
        >>> td = pool.rollout(3, policy=planner)
        >>> td["next", "duration"].flatten().tolist()
        [5, 5, 5]
        >>> pool.close()
    """

    _has_frame_skip = True
    metadata = {"render_modes": ["rgb_array"], "render_fps": 60}

    def __init__(
        self,
        game: str,
        worker: OptionWorker,
        *,
        max_steps: int,
        num_processes: int | None = None,
        gamma: float = 0.99,
        life_loss_penalty: float = 0.0,
        end_on_life_loss: bool = False,
        determinised: bool = True,
        record: bool = False,
        read_outs: Sequence[str] = ("ram", "observation"),
        start_method: Literal["forkserver", "spawn"] = "forkserver",
        step_seconds: float = 60.0,
        batch_size: Sequence[int] = (),
        seed: int | None = None,
        **emulator: Any,
    ) -> None:
        name = "AtariOptionPool"
        max_steps = whole_number(name, "max_steps", max_steps, least=1)
        settings = EmulatorSettings(game, **{"repeat_action_probability": 0.0, **emulator})
        gamma = real_number(name, "gamma", gamma, above=0.0, most=1.0)
        run = AtariRun(settings, worker, max_steps, gamma, bool(end_on_life_loss), bool(record))
        self._read_outs = tuple(read_outs)
        self.life_loss_penalty = real_number(name, "life_loss_penalty", life_loss_penalty)
        super().__init__(
            run,
            num_processes=num_processes,
            determinised=determinised,
            start_method=start_method,
            step_seconds=step_seconds,
            batch_size=batch_size,
            seed=seed,
        )
        self.game, self.action_names = run.emulator.game, run.emulator.action_names

    @property
    def frame_skip(self) -> int | tuple[int, int]:
        """Frames per step."""
        run: Any = self._run
        return run.emulator.settings.frame_skip  # type: ignore[no-any-return]

    @property
    def num_frames(self) -> int:
        """Frames emulated so far, by all processes and for all purposes."""
        run: Any = self._run
        own = int(run.emulator.num_frames)
        return own + (0 if self._processes is None else self._processes.work)

    def _entries(self) -> dict[Any, Any]:
        entries = dict(self._run.outputs)
        if "observation" in self._read_outs:
            entries["observation"] = ((128,), np.dtype(np.float32))
        if "ram" not in self._read_outs:
            del entries["ram"]
        return entries

    def _cut(self, rows: np.ndarray) -> np.ndarray:
        # Rows of an AtariRAMEnv may hold its random generator, which is not a planner's to know.
        return rows[..., : self._run.outputs["emulator_state"][0][0]]

    def _observed(self, out: dict[Any, np.ndarray], shape: torch.Size) -> TensorDict:
        if "reward" in out:
            out["reward"] -= np.float32(self.life_loss_penalty) * out["life_losses"]
        if "observation" in self._read_outs:  # by numpy: torch is slow where its code is not cached
            out["observation"] = out["ram"] / np.float32(255.0)
        if "ram" not in self._read_outs:
            del out["ram"]
        return super()._observed(out, shape)
