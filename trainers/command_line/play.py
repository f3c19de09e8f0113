"""``hmcts play run=DIR``."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_hmcts.trainers.command_line.running import WRONG_WORDS, printing, told
from torchrl_hmcts.trainers.command_line.words import only_words
from torchrl_hmcts.trainers.runs.config import home, read_value

if TYPE_CHECKING:
    from torchrl_hmcts.trainers.agent import HMCTS, Solution

_CHANGES = (("seed", "int"), ("ratio", "float"))  # of an Atari run
_KEYS = ("run", "seed", "out", "ratio")


def play(words: Sequence[str]) -> int:
    """Show an agent acting: in a window, on a page of its own, or in a film."""
    with told("play", *WRONG_WORDS):
        own = only_words(words, _KEYS)
        if "run" not in own:
            raise ValueError("say which agent: run=DIR, the folder of a run or of HMCTS.save().")
        seed = read_value("seed", own.get("seed", "0"), "int")
        out = home(own["out"]) if "out" in own else ""
        if out and Path(out).suffix not in (".gif", ".mp4"):
            raise ValueError(f"out is a film: FILE.mp4 or FILE.gif; got {out!r}.")
    with told("play", ValueError, FileNotFoundError), printing(own.get("log_level", "info")):
        print(f"hmcts play shows the agent of {own['run']}", flush=True)
        from torchrl_hmcts.trainers.agent import HMCTS
        from torchrl_hmcts.trainers.runs.console import alive, say

        with alive():
            if (atari := _atari_config(own)) is not None:
                from torchrl_hmcts.trainers.experiments.atari.run import show_atari

                if out.endswith(".mp4"):
                    raise ValueError(f"out of an Atari run is a film FILE.gif; got {out!r}.")
                film = Path(out or Path(home(own["run"])) / "play.gif")
                print(show_atari(atari, film))
                print(f"Film: {film}")
                return 0
            if "ratio" in own:
                raise ValueError("ratio is a key of Atari runs: simulated base steps per real one.")
            agent = HMCTS.load(home(own["run"]))
            print(agent)
            say("Planning and acting ...")
            if out:
                print(agent.play(seed, out=out))
                print(f"Film: {out}")
            elif _has_display() and hasattr(agent.config, "id"):
                print(agent.play(seed))
            else:
                folder = Path(home(own["run"])) / "play"
                folder.mkdir(exist_ok=True)
                solution = agent.play(seed, out=folder / "play.gif")
                print(solution)
                print(f"Page: {_write_page(agent, solution, folder, seed)}")
    return 0


def _atari_config(own: dict[str, str]) -> Any:
    """Return the configuration of an Atari run with the changes of the command, else None."""
    from torchrl_hmcts.trainers.experiments.registry import load_config
    from torchrl_hmcts.trainers.saving.run_folder import read_run

    experiment, config = load_config(read_run(home(own["run"])))
    if experiment.name != "atari":
        return None
    changes = {key: read_value(key, own[key], kind) for key, kind in _CHANGES if key in own}
    return replace(config, resume=False, **changes)


def _has_display() -> bool:
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _write_page(agent: HMCTS, solution: Solution, folder: Path, seed: int) -> Path:
    """Write the page of an episode: the film, the search, the figures."""
    from torchrl_hmcts.trainers.figures.maps import plot_search
    from torchrl_hmcts.trainers.figures.pages import Section, Table, picture, write_sections
    from torchrl_hmcts.trainers.figures.pictures import Pictures

    pictures = Pictures(folder)
    pictures.captions["play.gif"] = "The episode."
    drawing = agent.kit.map(agent.kit.make_env("test"))
    if drawing is not None and agent.planner.has_searched:
        with pictures.one("search.png", agent.kit.captions["search.png"]) as path:
            plot_search(drawing, agent.planner.last_search, path)
    rows = [
        ("solved", solution.solved),
        ("reward", solution.reward),
        ("base steps", solution.base_steps),
        ("options", solution.num_options),
        ("simulated base steps", solution.simulated_steps),
        ("seconds of planning", round(solution.plan_seconds, 2)),
    ]
    shown = [
        picture(folder / name, words, embed=False) for name, words in pictures.captions.items()
    ]
    sections = [
        Section(words=[repr(agent)], pictures=shown),
        Section("Figures", tables=[Table(rows)]),
    ]
    file = folder / "index.html"
    write_sections(file, f"An episode, seed {seed}", sections)
    return file
