"""The command ``hmcts``."""

from __future__ import annotations

import importlib
import io
import os
import sys
from collections.abc import Callable, Sequence

from torchrl_hmcts import __version__
from torchrl_hmcts.trainers.command_line.running import Failure
from torchrl_hmcts.trainers.command_line.verbs import summaries
from torchrl_hmcts.trainers.command_line.words import LOG_LEVEL_HELP
from torchrl_hmcts.trainers.experiments.registry import DEMO
from torchrl_hmcts.trainers.runs.config import unknown_key

_DEMO = f"""\
Train skills in the training mazes of Waterworld, then solve test mazes by planning over them.

needs   the extra `train`; about a minute of one CPU core
writes  metrics.json, pictures, a GIF and index.html to the folder `out`; without out= to runs/demo,
        or the next of runs/demo_2, ... that holds no run

keys and defaults:
{{keys}}
  {LOG_LEVEL_HELP}"""

_TRAIN = f"""\
Train and test one experiment, or the agent over a kit of your choice with parts of your choice.

    hmcts train experiment=labmaze seed=1 out=runs/labmaze_1
    hmcts train resume=runs/labmaze_1                      continues it, with the saved config
    hmcts train experiment=labmaze seed=1 out=runs/labmaze_1 resume=true train_frames=80000
                                                           continues it for longer
    hmcts train kit=labmaze objective=metra planner/tree_policy=puct planner.novelty.radius=0.5
                                                           with other parts, by their names
    hmcts train -m kit=waterworld seed=0,1,2 objective=diayn,lsd
                                                           every combination, a run each

A folder that holds a run is refused, unless resume= or overwrite=true is given. Without out= the
run goes to runs/NAME, or the next of runs/NAME_2, ... that holds none.

needs   the extra `train` (`atari` for Atari); minutes to hours; Ctrl-C and SIGTERM save, and the
        command that continues the run is printed
writes  run.json, metrics.json, curves.csv, log/, pictures, checkpoints/ and index.html to `out`

experiments (their keys: hmcts list NAME):
{{experiments}}

  {LOG_LEVEL_HELP}"""

_EVALUATE = f"""\
Test the newest checkpoint of a run again, finished or stopped, with other starts or settings.

    hmcts evaluate run=runs/labmaze_1 seed=7 size=15 mazes=40

needs   the run's folder, with run.json (or metrics.json) and checkpoints/
writes  evaluation.json into that folder, one entry per choice of keys, and its page again

Keys are those of the run's experiment (hmcts list NAME); those not given are as in the run.
  {LOG_LEVEL_HELP}"""

_PLAY = f"""\
Show an agent acting: one episode, planned and executed in an env of its own.

    hmcts play run=runs/gym            in a window; without a display on a page in runs/gym/play
    hmcts play run=runs/gym seed=3 out=episode.mp4
    hmcts play run=runs/atari ratio=0 out=episode.gif   an Atari agent, here without search

needs   a folder that `hmcts train kit=...`, `hmcts demo` or HMCTS.save() wrote
writes  nothing, or play/ in that folder, or the film (FILE.mp4 and FILE.gif)

  {LOG_LEVEL_HELP}"""

_REPORT = f"""\
Write a page: of one run, of several runs compared, or a figure of the dissertation.

    hmcts report runs/one                     index.html in runs/one, finished or not
    hmcts report runs/one out=page.html       the same in one file that can be sent
    hmcts report runs/a_0 runs/a_1 runs/b_0   runs/report/index.html: groups by config, means over
                                              seeds with least and largest, bootstrap intervals
    hmcts report runs                         the same of all runs in the folder
    hmcts report figure=3.6                   figures/figure_3.6.png, from measured results
    hmcts report figure=4.10 runs/labmaze_*   the same from your own runs
    hmcts report figure=all                   all whose data are there, and a page of them

needs   folders that `hmcts demo` or `hmcts train` wrote; for figures also docs/results of the
        repository (results=DIR if it is elsewhere)
writes  static pages that need no network; out=DIR or out=FILE.html says where

figures: hmcts list figures
  {LOG_LEVEL_HELP}"""

_SWEEP = f"""\
Search for good values of an experiment's keys with Optuna.

    hmcts sweep experiment=labmaze num_skills=[3,4,6] option_frames=40..200:20 trials=20
    hmcts sweep experiment=waterworld_a3c learning_rate=1e-4..1e-2:log trials=10 total_frames=200000

  key=[a,b,c]      one of these            key=low..high       between them, both included
  key=low..high:N  in steps of N           key=low..high:log   evenly in the logarithm
  key=value        the same in all trials

  experiment=NAME  which one (hmcts list)          trials=20        how many, finished ones included
  objective=NAME   figure in metrics.json, e.g. test.solved; -NAME: less is better
  out=DIR          folder (default runs/sweep_NAME)
  storage=URL      any storage of Optuna's, e.g. a database that several machines share; then start
                   the same command on each (default: a journal file in the folder)
  prune=false      let trials that lag behind run to their end
  {LOG_LEVEL_HELP}

needs   the extra `scale`; each trial takes what a run takes
writes  trial_0000/ ... (folders of runs), sweep.json, importances.png and index.html to the
        folder; the same command continues it, a trial that was stopped first, also where the folder
        was moved"""

_DATA = f"""\
Record the episodes of a dataset as OGBench's script does, with draws of our own.

    hmcts data id=pointmaze-giant-stitch-v0                in data/ogbench/pointmaze-giant-stitch-v0
    hmcts data id=pointmaze-giant-stitch-v0 seed=1 out=DIR episodes=100
    hmcts data id=antmaze-teleport-navigate-v0 walker=RUN  RUN: a folder of hmcts train kit=ant

needs   the extra `gym`; a million steps take two minutes (points), a quarter of an hour (ants) or
        an hour (puzzles)
writes  memory-mapped tensors (observation, action, done), which TorchRL's storages read

  {LOG_LEVEL_HELP}"""

_LIST = "List the experiments; the keys of one with their defaults and meaning; or the figures."

_COMPLETION = """\
Print a script that makes Tab complete verbs, experiments, kits and keys.

    eval "$(hmcts completion bash)"        in ~/.bashrc
    eval "$(hmcts completion zsh)"         in ~/.zshrc"""

_VERBS = {
    "demo": ("learn four skills and solve random mazes (about a minute)", _DEMO, "train:demo"),
    "train": ("run an experiment, or continue one", _TRAIN, "train:train"),
    "evaluate": ("test a run again with other settings", _EVALUATE, "verbs:evaluate"),
    "play": ("show an agent acting", _PLAY, "verbs:play"),
    "report": ("write the page of runs, or draw a figure", _REPORT, "verbs:report"),
    "sweep": ("search for good values of an experiment's keys", _SWEEP, "sweep:sweep"),
    "data": ("record the episodes of an OGBench dataset", _DATA, "verbs:data"),
    "list": ("list experiments, their keys, or figures", _LIST, "verbs:show"),
    "completion": ("print what makes Tab complete", _COMPLETION, "verbs:completion"),
}
_ABOUT = """
Hierarchical Monte Carlo tree search over learned skills. Each verb has a --help of its own; hmcts
--version says which this is.
"""
_WORDS = {"list": "NAME", "report": "DIR|key=value", "completion": "SHELL"}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit status: 2 after wrong words, 1 after other errors."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # in a locale without UTF-8
    given = sys.argv[1:] if argv is None else argv
    verb, *words = given or ["--help"]
    if verb in ("-h", "--help"):
        lines = [f"  {name:<11} {summary}" for name, (summary, *_) in _VERBS.items()]
        print("usage: hmcts VERB [key=value ...]", _ABOUT, *lines, sep="\n")
        return 0 if given else 2
    if verb == "--version":
        print(f"hmcts {__version__}")
        return 0
    if verb not in _VERBS:
        print(f"hmcts: {unknown_key(verb, _VERBS, 'verb')}", file=sys.stderr)
        return 2
    _, text, place = _VERBS[verb]
    if {"-h", "--help"} & set(words):
        text = text.replace("{keys}", DEMO.describe() if "{keys}" in text else "")
        text = text.replace("{experiments}", summaries())
        print(f"usage: hmcts {verb} [{_WORDS.get(verb, 'key=value')} ...]\n\n{text}")
        return 0
    dashes = [word for word in words if word[:1] == "-" and (verb, word) != ("train", "-m")]
    if dashes:
        key, _, value = dashes[0].lstrip("-").replace("-", "_").partition("=")
        loose = [word for word in words if "=" not in word and word[:1] != "-"]
        value = value or next(iter(loose), "VALUE")
        print(f"hmcts {verb}: keys are written without dashes: {key}={value}", file=sys.stderr)
        return 2
    module, _, name = place.partition(":")
    run: Callable[[Sequence[str]], int] = getattr(
        importlib.import_module(f"torchrl_hmcts.trainers.command_line.{module}"), name
    )
    try:
        status = run(words)
        sys.stdout.flush()
    except Failure as error:
        print(error, file=sys.stderr)
        return error.status
    except KeyboardInterrupt:  # in what is no run, e.g. `hmcts report`
        print(f"\nhmcts {verb}: stopped.", file=sys.stderr)
        return 130
    except BrokenPipeError:  # e.g. `hmcts list figures | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return status


if __name__ == "__main__":
    sys.exit(main())
