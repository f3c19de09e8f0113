"""The shorter verbs: list, completion, data, evaluate, play, report."""

from __future__ import annotations

import json
import os
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_hmcts.trainers.command_line.running import WRONG_WORDS, Failure, printing, told
from torchrl_hmcts.trainers.command_line.words import (
    no_bare_words,
    only_words,
    parse_config,
    split_words,
)
from torchrl_hmcts.trainers.experiments.dissertation import FIGURES
from torchrl_hmcts.trainers.experiments.ogbench.config import split_name
from torchrl_hmcts.trainers.experiments.registry import (
    ALL_EXPERIMENTS,
    DEMO,
    EXPERIMENTS,
    KITS,
    find_experiment,
    load_config,
    recognise,
)
from torchrl_hmcts.trainers.runs.config import (
    home,
    key_kinds,
    need_package,
    read_value,
    unknown_key,
)
from torchrl_hmcts.trainers.saving.files import finite, left_out
from torchrl_hmcts.trainers.saving.locking import is_locked
from torchrl_hmcts.trainers.saving.run_folder import (
    add_evaluation,
    is_run,
    machine,
    read_run,
    shown_word,
    versions,
)

if TYPE_CHECKING:
    from torchrl_hmcts.trainers.agent import HMCTS, Solution

# The keys of each verb, beside those of the experiment.
OWN = {
    "demo": (),
    "train": ("experiment", "kit", "resume", "log_level"),
    "evaluate": ("run", "log_level"),
    "play": ("run", "seed", "out", "ratio"),
    "report": ("figure", "out", "results"),
    "sweep": ("experiment", "trials", "objective", "storage", "prune", "out"),
    "data": ("id", "out", "seed", "episodes", "walker"),
    "list": (),
    "completion": (),
}
_SCRIPT = """\
{zsh}_hmcts() {{
    local word="${{COMP_WORDS[COMP_CWORD]}}" IFS=$'\\n'
    COMP_WORDBREAKS="${{COMP_WORDBREAKS//=}}"
    COMPREPLY=($(compgen -W "$(hmcts completion words "${{COMP_WORDS[@]:1}}")" -- "$word"))
    [[ ${{#COMPREPLY[@]}} -eq 0 ]] && COMPREPLY=($(compgen -f -- "$word"))
    [[ ${{COMPREPLY[0]}} == *= ]] && compopt -o nospace 2>/dev/null
    return 0
}}
complete -F _hmcts hmcts"""


def show(words: Sequence[str]) -> int:
    """List the experiments, the keys of one, or the figures; return the exit status."""
    name = words[0] if words else ""
    with told("list", *WRONG_WORDS):
        if len(words) > 1:
            raise ValueError(f"one name at most; got {' '.join(words)!r}.")
        if name in ("", "experiments"):
            print("experiments (their keys: hmcts list NAME):")
            print(summaries())
            print(f"\nkits (hmcts train kit=NAME): {', '.join(KITS)}")
            print("figures of the dissertation: hmcts list figures")
        elif name == "figures":
            print(figures())
        else:
            print(find_experiment(name, {**EXPERIMENTS, **ALL_EXPERIMENTS, **KITS}).describe())
    return 0


def summaries() -> str:
    """Return the experiments, a line each."""
    width = max(map(len, EXPERIMENTS))
    return "\n".join(f"  {name:<{width}}  {e.summary}" for name, e in EXPERIMENTS.items())


def figures() -> str:
    """Return the figures of the dissertation, and what ours are drawn from."""
    lines = []
    for figure in FIGURES.values():
        lines.append(f"  {figure.name:<9} {figure.shows}")
        lines += textwrap.wrap(
            f"ours: {figure.data}", 92, initial_indent=" " * 12, subsequent_indent=" " * 12
        )
    return "\n".join(lines)


def completion(words: Sequence[str]) -> int:
    """Print the script for a shell, or after ``words`` what may follow; return the exit status."""
    shell = words[0] if words else ""
    if shell == "words":
        print("\n".join(candidates(words[1:])))
    elif shell in ("bash", "zsh"):
        print(_SCRIPT.format(zsh="autoload -U bashcompinit && bashcompinit\n" * (shell == "zsh")))
    else:
        raise Failure('hmcts completion: say bash or zsh, e.g. eval "$(hmcts completion bash)".', 2)
    return 0


def candidates(words: Sequence[str]) -> list[str]:
    """Return the words that may stand in place of the last one."""
    if len(words) < 2:
        return list(OWN)
    verb, *rest = words
    given = dict(word.split("=", 1) for word in rest if "=" in word)
    key, equals, _ = rest[-1].partition("=")
    if equals:
        values = {"experiment": EXPERIMENTS, "kit": KITS}.get(key, ())
        return [f"{key}={value}" for value in values]
    if verb == "list":
        return [*ALL_EXPERIMENTS, "figures"]
    experiment = DEMO if verb == "demo" else EXPERIMENTS.get(given.get("experiment", ""))
    experiment = experiment or KITS.get(given.get("kit", ""))
    keys = key_kinds(experiment.config_class) if experiment else {}
    return [f"{key}=" for key in (*OWN.get(verb, ()), *keys)]


def data(words: Sequence[str]) -> int:
    """Record a dataset and write it as memory-mapped tensors; return the exit status."""
    with told("data", *WRONG_WORDS):
        own = only_words(words, OWN["data"])
        if "id" not in own:
            raise ValueError("say which dataset: id=NAME, e.g. id=pointmaze-giant-stitch-v0.")
        split_name(own["id"])
        seed, episodes = (read_value(key, own.get(key, "0"), "int") for key in ("seed", "episodes"))
        folder = Path(home(own.get("out", f"data/ogbench/{own['id']}")))
        need_package("ogbench")
    if folder.exists():
        raise Failure(
            f"hmcts data: {folder} exists already; remove it, or name another: out=DIR.", 1
        )
    print(f"hmcts data records {own['id']} in {folder} (minutes)", flush=True)
    with told("data", ValueError, OSError), printing(own.get("log_level", "info")):
        from torchrl_hmcts.trainers.experiments.ogbench.data import record, save
        from torchrl_hmcts.trainers.runs.console import counted

        found = record(
            own["id"],
            seed=seed,
            episodes=episodes,
            walker=own.get("walker", ""),
            progress=counted("record", "episodes"),
        )
        save(found, folder)
        print(f"{len(found):,} steps, {int(found['done'].sum()):,} episodes: {folder}")
    return 0


def evaluate(words: Sequence[str]) -> int:
    """Test a run's newest checkpoint again and add the figures to its ``evaluation.json``."""
    with told("evaluate", *WRONG_WORDS):
        own, rest = split_words(words, ["run"])
        no_bare_words(rest, "run")
        if "run" not in own:
            raise ValueError("say which run: run=DIR, the folder that a training wrote.")
        run = read_run(home(own["run"]))
    level = own.get("log_level", "info")
    with told("evaluate", *WRONG_WORDS), printing(level):
        print(f"hmcts evaluate tests the newest checkpoint of {run.path}", flush=True)
        experiment, saved = load_config(run)
        changed = parse_config(experiment, rest, saved, ["run", "log_level"])
        if changed.out != saved.out:
            raise ValueError("the figures are written into the folder of the run. Leave out= away.")
        before = vars(saved)
        changes = {key: value for key, value in vars(changed).items() if value != before[key]}
        for key in ("resume", "overwrite"):
            if key in changes:
                raise ValueError(f"{key} is for hmcts train; an evaluation changes no run.")
        experiment.check_evaluation()
        changed.check_inputs()
    if is_locked(run.path):
        print(f"{run.path} is still running: its newest checkpoint is tested.", file=sys.stderr)
    with told("evaluate", ValueError), printing(level):
        function = experiment.evaluation  # loads torch
        from torchrl_hmcts.trainers.runs.console import alive, figures_table

        with alive():
            results = function(changed)
        print(figures_table(results))
    evaluation: dict[str, Any] = {
        "changes": changes,
        "results": results,
        "command": " ".join(map(shown_word, ["hmcts", "evaluate", *words])),
        "versions": versions(),
        "machine": machine(),
    }
    with left_out("evaluation.json") as missing:
        print(f"Figures: {add_evaluation(run.path, evaluation)}")
    if missing:
        print(json.dumps(finite(results), indent=1))
    with left_out("index.html"):
        from torchrl_hmcts.trainers.figures.run_page import write_run_page

        print(f"With all others: {write_run_page(recognise(read_run(run.path)))}")
    return 0


def play(words: Sequence[str]) -> int:
    """Show an agent acting: in a window, on a page of its own, or in a film."""
    with told("play", *WRONG_WORDS):
        own = only_words(words, OWN["play"])
        if "run" not in own:
            raise ValueError("say which agent: run=DIR, the folder of a run or of HMCTS.save().")
        seed = read_value("seed", own.get("seed", "0"), "int")
        out = home(own["out"]) if "out" in own else ""
        if out and Path(out).suffix not in (".gif", ".mp4"):
            raise ValueError(f"out is a film: FILE.mp4 or FILE.gif; got {out!r}.")
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    has_display = sys.platform in ("darwin", "win32") or bool(display)
    with told("play", ValueError, FileNotFoundError), printing(own.get("log_level", "info")):
        print(f"hmcts play shows the agent of {own['run']}", flush=True)
        from torchrl_hmcts.trainers.agent import HMCTS
        from torchrl_hmcts.trainers.runs.console import alive, say

        with alive():
            experiment, config = load_config(read_run(home(own["run"])))
            if experiment.name == "atari":
                film = Path(out or Path(home(own["run"])) / "play.gif")
                print(f"{_show_atari(config, own, film)}\nFilm: {film}")
                return 0
            if "ratio" in own:
                raise ValueError("ratio is a key of Atari runs: simulated base steps per real one.")
            agent = HMCTS.load(home(own["run"]))
            print(agent)
            say("Planning and acting ...")
            if out:
                print(agent.play(seed, out=out))
                print(f"Film: {out}")
            elif has_display and hasattr(agent.config, "id"):
                print(agent.play(seed))
            else:
                folder = Path(home(own["run"])) / "play"
                folder.mkdir(exist_ok=True)
                solution = agent.play(seed, out=folder / "play.gif")
                print(solution)
                print(f"Page: {_write_page(agent, solution, folder, seed)}")
    return 0


def _show_atari(config: Any, own: dict[str, str], film: Path) -> str:
    """Write the film of an Atari run with the changes of the command; return what it shows."""
    from torchrl_hmcts.trainers.experiments.atari.run import show_atari

    if film.suffix == ".mp4":
        raise ValueError(f"out of an Atari run is a film FILE.gif; got {str(film)!r}.")
    kinds = {"seed": "int", "ratio": "float"}
    changes = {key: read_value(key, own[key], kind) for key, kind in kinds.items() if key in own}
    return show_atari(replace(config, resume=False, **changes), film)


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


def report(words: Sequence[str]) -> int:
    """Write the page of a run, of several compared, or a figure of the dissertation."""
    with told("report", *WRONG_WORDS):
        own, rest = split_words(words, OWN["report"])
        own |= {key: home(own[key]) for key in ("out", "results") if key in own}
        for word in rest:
            key, separator, _ = word.partition("=")
            if separator and not os.path.isdir(home(word)):
                raise ValueError(unknown_key(key, [*OWN["report"], "log_level"]))
        folders = [home(word) for word in rest]
        with printing(own.get("log_level", "info")):
            (_figure if "figure" in own else _pages)(own, folders)
    return 0


def _pages(own: dict[str, str], folders: list[str]) -> None:
    if "results" in own:
        raise ValueError("results=DIR is for figure=NAME.")
    if not folders:
        raise ValueError(
            "say which runs, e.g. hmcts report runs/one (or several, to compare them), or which "
            "figure of the dissertation, e.g. figure=3.6 (all: hmcts list figures)."
        )
    runs = [recognise(read_run(run)) for folder in folders for run in runs_in(folder)]
    from torchrl_hmcts.trainers.figures.run_page import write_comparison, write_run_page

    if len(runs) > 1:
        print(f"Page: {write_comparison(runs, own.get('out', 'runs/report'))}")
        return
    out = own.get("out")
    if out is not None and not out.lower().endswith((".html", ".htm")):
        out = str(Path(out) / "index.html")
    print(f"Page: {write_run_page(runs[0], out)}")


def runs_in(folder: str) -> list[str]:
    """Return a folder of a run, or the runs that a folder holds."""
    if is_run(folder):
        return [folder]
    inside = sorted(path.parent for path in Path(folder).glob("*/run.json"))
    inside += sorted(path.parent for path in Path(folder).glob("*/metrics.json"))
    return [str(path) for path in dict.fromkeys(inside)] or [folder]


def _figure(own: dict[str, str], folders: list[str]) -> None:
    from torchrl_hmcts.trainers.experiments.dissertation import MissingData, find_results
    from torchrl_hmcts.trainers.experiments.dissertation_figures import draw_all, draw_figure

    results = find_results(own.get("results"))
    out = Path(own.get("out", "figures"))
    if own["figure"] == "all":
        page, without = draw_all(folders, results, out)
        print(*without, f"Page: {page}", sep="\n")
        return
    try:
        path, caption = draw_figure(own["figure"], folders, results, out)
    except MissingData as error:
        raise Failure(f"hmcts report: {error}") from None
    print(f"{caption}\n{path}")
