"""The Arcade Learning Environment's emulator with a state that can be set exactly.

ALE 0.12 leaves two things out of a state, and both are put right here. (1) Whether the emulator
gave the last frame up before the program had ended it: the next frame then continues instead of
beginning again. Qbert does so in a few per cent of its frames. The processor's status tells it; the
emulator is made to give up, or to end, one frame of its own before the state is restored. (2) The
action that is held where actions are sticky: it is sent, in a frame of its own, until it is held.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchrl_hmcts.checks import real_number, whole_number
from torchrl_hmcts.envs.atari.states import EmulatorStates

NO_OP_STARTS = 30
"""Most frames of doing nothing at the beginning, where nothing else differs between episodes."""
_NO_OP = 0
_SKIP_BYTES = (16, 16, 4, 1)  # of the parts of the generator that draws the frames of a step


@dataclass(frozen=True)
class EmulatorSettings:
    """Settings of an emulator, checked once and taken whole by all that have one.

    Args:
        game (str): as in Gymnasium, ``"SpaceInvaders"``; ``"space_invaders"`` and
            ``"ALE/SpaceInvaders-v5"`` are understood.
        noop_max, start_actions and all others: as in :class:`AtariRAMEnv`.

    Raises:
        ValueError: if there is no such game, or an argument is out of range.
    """

    game: str
    frame_skip: int | tuple[int, int] = 4
    repeat_action_probability: float = 0.25
    full_action_space: bool = False
    noop_max: int | range | None = None
    start_actions: int = 0
    max_frames: int = 108_000
    mode: int | None = None
    difficulty: int | None = None

    def __post_init__(self) -> None:
        name, skip = find_game(self.game)[0], self.frame_skip
        if isinstance(skip, Sequence) and not isinstance(skip, str):
            if len(skip) != 2 or not 1 <= skip[0] < skip[1]:
                raise ValueError(
                    f"{name}: a frame_skip of two numbers is drawn from the first, at least 1, up "
                    f"to the second, which is excluded; got {tuple(skip)}. E.g. (2, 5)."
                )
            for number in skip:
                whole_number(name, "frame_skip", number, least=1)
            object.__setattr__(self, "frame_skip", tuple(skip))
        else:
            whole_number(name, "frame_skip", skip, least=1)
        if isinstance(self.noop_max, range):
            if not self.noop_max or min(self.noop_max) < 0:
                raise ValueError(f"{name}: noop_max has numbers from 0 on; got {self.noop_max}.")
        elif self.noop_max is not None:
            whole_number(name, "noop_max", self.noop_max)
        whole_number(name, "start_actions", self.start_actions)
        whole_number(name, "max_frames", self.max_frames, least=1)
        probability = "repeat_action_probability"
        real_number(name, probability, self.repeat_action_probability, least=0.0, most=0.999)

    @property
    def sticky(self) -> bool:
        """True if actions stick."""
        return self.repeat_action_probability > 0.0

    @property
    def noops(self) -> range:
        """Numbers of frames of doing nothing, of which an episode's is drawn; empty for none."""
        if isinstance(self.noop_max, range):
            return self.noop_max
        most = self.noop_max
        if most is None:
            most = 0 if self.sticky else NO_OP_STARTS
        return range(1, most + 1)


class AtariEmulator:
    """One emulator, stepped by action indices, whose state can be read and set.

    Args:
        settings (EmulatorSettings): the game, and how it is played.

    Raises:
        ImportError: if ale-py is not installed.
        ValueError: if the game has not such a mode or difficulty.
        OSError: if the game's file is missing or damaged.
    """

    def __init__(self, settings: EmulatorSettings) -> None:
        ale_py = _import_ale()
        self.settings = settings
        self.game, rom = find_game(settings.game)
        self.frame_skip, self.noops = settings.frame_skip, settings.noops
        self.sticky, full = settings.sticky, settings.full_action_space
        # ALE keeps the probability in single precision, and compares it with a double.
        self._probability = float(np.float32(settings.repeat_action_probability))
        self._skips: np.random.Generator | None = None  # draws the frames of a step
        if isinstance(self.frame_skip, tuple):
            self._skips = np.random.default_rng(0)
        self._state_type = ale_py.ALEState
        ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
        self.ale = ale_py.ALEInterface()
        self.ale.setFloat("repeat_action_probability", settings.repeat_action_probability)
        self.ale.setInt("max_num_frames_per_episode", min(settings.max_frames, 2**31 - 1))
        self.num_frames = 0
        """Frames emulated since construction, also those that set a state."""
        self.ale.setInt("random_seed", 0)
        self.ale.loadROM(_rom_path(rom))
        self._set_switches(settings.mode, settings.difficulty)
        self.ale.reset_game()
        actions = self.ale.getLegalActionSet() if full else self.ale.getMinimalActionSet()
        self._actions = [int(action.value) for action in actions]
        self.action_names = [str(action.name) for action in actions]
        """Names of the actions, e.g. ``"RIGHTFIRE"``."""
        self.num_actions = len(self._actions)
        raw = self._serialize()
        self.states = EmulatorStates(raw, self.game)
        """Turns states into rows of bytes and back."""
        self.screen_is_stale = False
        self._drawing: AtariEmulator | None = None
        self._sent = self._held = _NO_OP
        self._twister: Any = np.random.MT19937(0)  # ALE's own generator, followed draw by draw
        self._follow(EmulatorStates.rng_of(self._serialize(include_rng=True)))
        self._first = self.states.encode(raw, _NO_OP)
        # States from which one frame ends, or does not end, as the program wants.
        self._endless = self._state_type(self.states.endless(raw))
        for _ in range(60):
            if not self.states.is_partial(raw):
                break
            self._frame(_NO_OP)
            raw = self._serialize()
        self._ending = self._state_type(raw)
        self._partial: bool | None = self.states.is_partial(raw)  # None: not known

    def __getstate__(self) -> dict[str, Any]:
        row = self.state(include_rng=True)
        return {"settings": self.settings, "row": row, "num_frames": self.num_frames}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["settings"])  # type: ignore[misc]
        self.set_state(state["row"])
        self.num_frames = state["num_frames"]

    def _set_switches(self, mode: int | None, difficulty: int | None) -> None:
        for name, value, offered in (
            ("mode", mode, self.ale.getAvailableModes()),
            ("difficulty", difficulty, self.ale.getAvailableDifficulties()),
        ):
            if value is not None and value not in offered:
                raise ValueError(f"{self.game}: {name} is one of {list(offered)}; got {value}.")
        if mode is not None:
            self.ale.setMode(mode)
        if difficulty is not None:
            self.ale.setDifficulty(difficulty)

    # ---------------------------------------------------------------- playing

    def reset(self, generator: np.random.Generator, seed: int | None = None) -> None:
        """Begin an episode, with some frames of doing nothing and some random actions.

        The state is that of a console just switched on, which later resets of ALE do not give in
        all games.

        Args:
            generator: draws the seed, the number of frames and the actions, and from then on the
                frames of a step where these vary.
            seed: of the emulator, 32 bits. Default: drawn.
        """
        while True:
            if seed is None:
                seed = int(generator.integers(2**31))
            key = np.random.RandomState(seed & 0xFFFFFFFF).get_state(legacy=False)["state"]
            rng = np.append(key["key"], np.uint32(key["pos"])).astype(np.uint32)
            self._restore(self._first, rng if self.sticky else None)
            if self._skips is not None:
                self._skips = generator
            if self.noops:
                for _ in range(self.noops[int(generator.integers(len(self.noops)))]):
                    self._frame(_NO_OP)
            for _ in range(self.settings.start_actions):
                self.act(int(generator.integers(self.num_actions)))
            if not self.ale.game_over():
                return
            seed = None

    def act(self, action: int) -> tuple[int, int]:
        """Take an action, by its index, for ``frame_skip`` frames, or as many as are drawn.

        Returns:
            The game's reward, and the lives that were lost.
        """
        if not 0 <= action < self.num_actions:
            raise ValueError(
                f"{self.game} has the actions 0 to {self.num_actions - 1}; got {action}."
            )
        ale, code = self.ale, self._actions[action]
        lives, reward, frames = ale.lives(), 0, 0
        for _ in range(self._frames_of_step()):
            if self.sticky:
                self._stick(code)
            reward += ale.act(code)
            frames += 1
            if ale.game_over():
                break
        self._moved(code, frames)
        lost = lives - ale.lives()
        return reward, lost if lost > 0 else 0

    def _frames_of_step(self) -> int:
        skip = self.frame_skip
        return skip if isinstance(skip, int) else int(self._skips.integers(*skip))  # type: ignore[union-attr]

    def _frame(self, code: int) -> None:
        if self.sticky:
            self._stick(code)
        self.ale.act(code)
        self._moved(code, 1)

    def _stick(self, code: int) -> None:
        """Follow ALE's draws of a frame, one for each player."""
        if self._twister.random_raw(2)[0] / 2.0**32 >= self._probability:
            self._held = code

    def _moved(self, code: int, frames: int) -> None:
        self._sent = code
        self.num_frames += frames
        self._partial = None
        self.screen_is_stale = False

    # ---------------------------------------------------------------- state

    @property
    def width_with_rng(self) -> int:
        """Bytes of a state with all random generators."""
        return self.states.width_with_rng + (0 if self._skips is None else sum(_SKIP_BYTES))

    def state(self, *, include_rng: bool = False) -> np.ndarray:
        """Return the state, uint8 ``[states.width]``, with the generators ``[width_with_rng]``.

        With the generators, the held action is the true one; without, the one that was sent last,
        which is all that an agent can know.
        """
        raw = self._serialize()
        self._partial = self.states.is_partial(raw)
        if not include_rng:
            return self.states.encode(raw, self._sent)
        rng = EmulatorStates.rng_of(self._serialize(include_rng=True))
        row = self.states.encode(raw, self._held if self.sticky else self._sent, rng)
        if self._skips is None:
            return row
        state = self._skips.bit_generator.state
        words = (*state["state"].values(), state["uinteger"], state["has_uint32"])
        text = b"".join(
            n.to_bytes(size, "little") for n, size in zip(words, _SKIP_BYTES, strict=True)
        )
        return np.concatenate([row, np.frombuffer(text, np.uint8)])

    def set_state(self, row: np.ndarray, seed: int | None = None) -> None:
        """Continue from a state.

        Args:
            row: as :meth:`state` returned it, of this or another emulator of the game.
            seed: of the generators from here on. Default: what is in the row, or else the
                generators continue where they stand.
        """
        if self._skips is not None:
            row = self._set_skips(row, seed)
        rng = self.states.rng(row)
        if self.sticky and seed is not None:
            key: Any = np.random.MT19937(seed).state["state"]
            rng = np.append(key["key"], np.uint32(key["pos"])).astype(np.uint32)
        self._restore(row, rng)

    def _set_skips(self, row: np.ndarray, seed: int | None) -> np.ndarray:
        """Set what draws the frames of a step to a seed or a row; return the rest of the row."""
        if len(row) == self.width_with_rng:
            cuts = np.split(row[self.states.width_with_rng :], np.cumsum(_SKIP_BYTES[:-1]))
            state, inc, uinteger, has = (int.from_bytes(cut.tobytes(), "little") for cut in cuts)
            words: Any = {"state": {"state": state, "inc": inc}, "uinteger": uinteger}
            self._skips = np.random.Generator(np.random.PCG64())
            self._skips.bit_generator.state = {"bit_generator": "PCG64", "has_uint32": has} | words
            row = row[: self.states.width_with_rng]
        if seed is not None:
            self._skips = np.random.default_rng(seed)
        return row

    def _restore(self, row: np.ndarray, rng: np.ndarray | None) -> None:
        raw, held = self.states.decode(row), self.states.held(row)
        partial = self.states.is_partial(raw)
        # Where a frame was given up the picture is half drawn: always from its beginning.
        if partial or self._partial is not False or (self.sticky and self._held != held):
            self._prepare(partial, held)
        if rng is not None:
            raw = self.states.with_rng(raw, rng)
            self._follow(rng)
        self.ale.restoreState(self._state_type(raw))
        self._sent, self._partial, self.screen_is_stale = held, partial, True

    def _prepare(self, partial: bool, held: int) -> None:
        """Bring into the wanted condition what a restored state does not say."""
        while True:
            self.ale.restoreState(self._endless if partial else self._ending)
            self._frame(held)
            if not self.sticky or self._held == held:
                return

    def _follow(self, rng: np.ndarray) -> None:
        key = {"key": rng[:-1], "pos": int(rng[-1])}
        self._twister.state = {"bit_generator": "MT19937", "state": key}

    def _serialize(self, *, include_rng: bool = False) -> bytes:
        return bytes(self.ale.cloneState(include_rng=include_rng).serialize())

    # ---------------------------------------------------------------- looking

    def read_ram(self, out: np.ndarray) -> None:
        """Write the RAM into ``out``, uint8 ``[128]``."""
        self.ale.getRAM(out)

    @property
    def lives(self) -> int:
        """Lives left; 0 in games that have none."""
        return int(self.ale.lives())

    @property
    def episode_frame(self) -> int:
        """Frames since the beginning of the episode."""
        return int(self.ale.getEpisodeFrameNumber())

    @property
    def terminated(self) -> bool:
        """True if the game is over."""
        return bool(self.ale.game_over(with_truncation=False))

    @property
    def truncated(self) -> bool:
        """True if the episode has had its ``max_frames``."""
        return bool(self.ale.game_truncated())

    def screen(self) -> np.ndarray:
        """Return the picture on the screen, uint8 ``[210, 160, 3]``."""
        picture: np.ndarray = self.ale.getScreenRGB()
        return picture

    def draw(self, row: np.ndarray) -> np.ndarray:
        """Return the picture of a state, uint8 ``[210, 160, 3]``, drawn by another emulator.

        A state has no picture: it is that of one frame later, in which nothing is done.
        """
        if self._drawing is None:
            plain = replace(self.settings, frame_skip=1, repeat_action_probability=0.0)
            self._drawing = AtariEmulator(plain)
        self._drawing.set_state(row)
        self._drawing.act(0)
        return self._drawing.screen()


# Games for two, of which ALE ends the whole process when they are loaded for one player.
_FOR_TWO = {"combat", "joust", "maze_craze", "warlords"}


def find_game(game: str) -> tuple[str, str]:
    """Return a game's name as in Gymnasium and the name of its file, or raise a ValueError."""
    roms = _import_ale().roms.get_all_rom_ids()
    names = {rom.title().replace("_", ""): rom for rom in roms if rom not in _FOR_TWO}
    asked = str(game).removeprefix("ALE/").removesuffix("-v5")
    plain = {name.lower(): name for name in names}
    word = asked.replace("_", "").replace(" ", "").lower()
    found = plain.get(word)
    if word in {rom.replace("_", "") for rom in _FOR_TWO}:
        raise ValueError(
            f"{game!r} is a game for two players only; ale-py plays it for two or more. Choose one "
            f"of the {len(names)} games for one player, e.g. Breakout, Pong, Seaquest."
        )
    if found is None:
        near = difflib.get_close_matches(word, list(plain), 3, 0.4)
        hint = ", ".join(plain[name] for name in near) or "e.g. Breakout, Pong, Seaquest"
        raise ValueError(f"ale-py has no game {game!r}. Nearest: {hint}; it has {len(names)}.")
    return found, names[found]


def _rom_path(rom: str) -> Any:
    """Return a game's file, which ale-py has checked: of a bad one it ends the process."""
    try:
        return _import_ale().roms.get_rom_path(rom)
    except OSError as error:
        raise OSError(
            f"ale-py's file of the game {rom} is missing or damaged ({error}). Install it again, "
            "`pip install --force-reinstall ale-py`, or correct the folder in ALE_ROMS_DIR."
        ) from error


def _import_ale() -> Any:
    try:
        import ale_py
        import ale_py.roms
    except ImportError as error:
        raise ImportError(
            "Atari games need the package ale-py, which brings the games along: "
            "pip install 'torchrl_hmcts[atari]' (or: pip install ale-py)."
        ) from error
    return ale_py
