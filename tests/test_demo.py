"""The command line and the demo, at toy size."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.experiments.settings import DemoConfig
from torchrl_hmcts.trainers.runs.config import parse_overrides

TIMES = ("seconds", "config", "versions")


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> tuple[Path, dict]:
    out = tmp_path_factory.mktemp("demo")
    assert main(["demo", "seed=3", f"out={out}", "toy=true"]) == 0
    return out, json.loads((out / "metrics.json").read_text())


def without_times(metrics: dict) -> dict:
    return {k: v for k, v in metrics.items() if not any(t in k for t in TIMES)}


def test_the_demo_writes_its_metrics_and_pictures(demo):
    out, metrics = demo
    names = (
        "seed mazes solved train_base_steps train_seconds plan_seconds_median plan_seconds_p95 "
        "plan_base_steps_median expansions_median episode_base_steps_median "
        "episode_base_steps_over_shortest"
    ).split()
    assert set(names) <= set(metrics)
    assert metrics["seed"] == 3
    assert metrics["mazes"] == 3
    page = (out / "index.html").read_text()
    for name in ("losses.png", "skills.png", "search.png", "episode.gif"):
        assert (out / name).stat().st_size > 1000, name
        assert f'src="{name}"' in page


def test_the_same_seed_gives_the_same_figures(demo, tmp_path):
    _, first = demo
    assert main(["demo", "seed=3", f"out={tmp_path}", "toy=true"]) == 0
    second = json.loads((tmp_path / "metrics.json").read_text())
    np.testing.assert_equal(without_times(second), without_times(first))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["seed"], "no key=value"),
        (["mazes=many"], "many"),
        (["mazes=0"], "mazes must be at least 1; got 0"),
        (["novelty_radius=0"], "novelty_radius must be above 0; got 0.0"),
        (["gamma=1.5"], r"gamma must be in \(0, 1\]; got 1.5"),
        (["option_steps=-5"], "option_steps must be at least 1; got -5"),
    ],
)
def test_a_bad_value_is_refused_by_name(words, message):
    with pytest.raises(ValueError, match=message):
        parse_overrides(DemoConfig, words)


def test_more_mazes_than_the_test_split_has_are_refused(tmp_path, capsys):
    assert main(["demo", "mazes=343", f"out={tmp_path}"]) == 2
    assert "342" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made_is_named_before_any_work(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["demo", f"out={tmp_path}/file/run"]) == 1
    captured = capsys.readouterr()
    assert "Choose another folder with out=DIR" in captured.err
    assert "Learning" not in captured.out


def test_keys_may_be_written_as_those_of_a_hydra_group() -> None:
    assert parse_overrides(DemoConfig, ["env.seed=3", "out=x"]) == DemoConfig(seed=3, out="x")
    with pytest.raises(ValueError, match=r"Unknown key 'sede'.*seed"):
        parse_overrides(DemoConfig, ["env.sede=3"])
