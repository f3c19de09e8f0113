"""``hmcts sweep experiment=NAME key=[a,b] key=low..high trials=N``."""

from __future__ import annotations

import contextlib
import io
import shlex
import sys
from collections.abc import Sequence
from typing import Any

from torchrl_hmcts.trainers.command_line.running import WRONG_WORDS, printing, told
from torchrl_hmcts.trainers.command_line.words import no_bare_words, parse_config, split_words
from torchrl_hmcts.trainers.experiments.registry import EXPERIMENTS, find_experiment
from torchrl_hmcts.trainers.runs.config import read_value
from torchrl_hmcts.trainers.saving.files import left_out, write_json
from torchrl_hmcts.trainers.saving.run_folder import shown_word
from torchrl_hmcts.trainers.saving.stopping import Stopped, signals_handled

_OWN = ("experiment", "trials", "objective", "storage", "prune", "out")


def sweep(words: Sequence[str]) -> int:
    """Run trials until as many as asked for are finished, and write the page of the sweep."""
    with told("sweep", *WRONG_WORDS):
        own, rest = split_words(words, _OWN)
        no_bare_words(rest)
        if "experiment" not in own:
            raise ValueError(
                f"say which experiment, e.g. experiment={next(iter(EXPERIMENTS))} "
                "(all: hmcts list)."
            )
        experiment = find_experiment(own["experiment"])
        folder = own.get("out", f"runs/sweep_{experiment.name}{'_toy' * ('toy=true' in rest)}")
        level = own.get("log_level", "info")
        with printing(level):
            print(f"hmcts sweep experiment={experiment.name} starts\n  output  {folder}")
            print(f"  watch   hmcts report {shlex.quote(folder)}   (the trials so far)", flush=True)
        from torchrl_hmcts.trainers.runs.sweep import Sweep, optuna, parse_space

        own_words = optuna.logging.INFO if level == "debug" else optuna.logging.WARNING
        optuna.logging.set_verbosity(own_words)
        space, fixed = parse_space(experiment.config_class, rest)
        others = [*_OWN, "log_level"]
        config = parse_config(experiment, [*fixed, f"out={folder}"], others=others)
        trials = read_value("trials", own.get("trials", "20"), "int")
        if trials < 1:
            raise ValueError(f"trials must be a whole number above 0; got {own['trials']!r}.")
        objective = own.get("objective", experiment.objective)
        if not objective:
            raise ValueError("say what to improve, e.g. objective=test.solved.")
        experiment.check_figure(objective.removeprefix("-"))
        prune = read_value("prune", own.get("prune", "true"), "bool")
        plan = Sweep(
            experiment.name,
            experiment,
            config,
            space,
            objective,
            experiment.progress if prune else "",
            own.get("storage"),
        )
        study = plan.study()  # before any trial: says what is wrong with storage or folder
    line = ["hmcts", "sweep", *words]
    from torchrl_hmcts.trainers.runs.console import alive

    # Each trial is reported; what the trials say is for those who ask for it.
    quiet = contextlib.redirect_stdout(io.StringIO())
    try:
        with (
            told("sweep", ValueError),
            signals_handled(),
            printing(level),
            alive(),
            contextlib.nullcontext() if level == "debug" else quiet,
        ):
            study = plan.start(trials, lambda _, trial: _report(trial, objective))
    except KeyboardInterrupt as error:
        _page(plan, study, line)
        print(
            "\nhmcts sweep: stopped. Finished trials are kept, one under way will be continued. "
            f"Continue with: {shlex.join(line)}",
            file=sys.stderr,
        )
        return error.status if isinstance(error, Stopped) else 130
    print(_page(plan, study, line))
    return 0


def _report(trial: Any, objective: str) -> None:
    """Print a line about a trial that has ended."""
    value = "given up" if trial.value is None else f"{objective} = {trial.value:.4g}"
    value = f"refused: {trial.user_attrs['refused']}" if "refused" in trial.user_attrs else value
    keys = " ".join(f"{key}={shown}" for key, shown in trial.params.items())
    print(f"trial {trial.number}: {keys}: {value}", file=sys.stderr, flush=True)


def _page(plan: Any, study: Any, line: Sequence[str]) -> str:
    """Write the results of a sweep; return a sentence on the best trial."""
    from torchrl_hmcts.trainers.figures.sweep_page import best_words, write_sweep_page
    from torchrl_hmcts.trainers.runs.sweep import importances, trial_rows

    rows, shares = trial_rows(study), importances(study)
    content = {"study": study.study_name, "objective": plan.objective}
    with left_out("sweep.json"):
        content |= {"trials": rows, "importances": shares}
        write_json(plan.folder / "sweep.json", content)
    page = plan.folder / "index.html"
    with left_out("index.html"):
        write_sweep_page(
            plan.folder,
            study=study,
            experiment=plan.name,
            objective=plan.objective,
            rows=rows,
            importances=shares,
            command=" ".join(map(shown_word, line)),
        )
    if not rows or rows[0]["value"] is None:
        return f"No trial has finished. Page: {page}"
    return f"{best_words(rows, plan.objective)}\nPage: {page}"
