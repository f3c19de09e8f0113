"""``hmcts evaluate run=DIR key=value ...``."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

from torchrl_hmcts.trainers.command_line.running import WRONG_WORDS, printing, told
from torchrl_hmcts.trainers.command_line.words import no_bare_words, parse_config, split_words
from torchrl_hmcts.trainers.experiments.registry import load_config, recognise
from torchrl_hmcts.trainers.runs.config import home
from torchrl_hmcts.trainers.saving.files import finite, left_out
from torchrl_hmcts.trainers.saving.locking import is_locked
from torchrl_hmcts.trainers.saving.run_folder import (
    add_evaluation,
    machine,
    read_run,
    shown_word,
    versions,
)


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
    written = False
    with left_out("evaluation.json"):
        print(f"Figures: {add_evaluation(run.path, evaluation)}")
        written = True
    if not written:
        print(json.dumps(finite(results), indent=1))
    with left_out("index.html"):
        from torchrl_hmcts.trainers.figures.run_page import write_run_page

        print(f"With all others: {write_run_page(recognise(read_run(run.path)))}")
    return 0
