"""Sweeps: what may vary, trials as runs of their own, going on, giving up early, importances."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.pool import NullPool

from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.experiments.registry import EXPERIMENTS, Experiment
from torchrl_hmcts.trainers.experiments.settings import DemoConfig
from torchrl_hmcts.trainers.runs.config import RunConfig
from torchrl_hmcts.trainers.saving.locking import folder_locked
from torchrl_hmcts.trainers.saving.run_folder import start_record

optuna = pytest.importorskip("optuna")
sweeps = pytest.importorskip("torchrl_hmcts.trainers.runs.sweep")


@dataclass
class ParabolaConfig(RunConfig):
    """An experiment without any training: y = -(x - 3)^2, z does nothing."""

    out: str = "runs/parabola"
    """Folder."""
    x: float = 0.0
    """Where."""
    z: int = 1
    """Nothing."""
    steps: int = 3
    """Values logged on the way."""
    logger: str = "csv"
    """As elsewhere."""


RUNS: list[ParabolaConfig] = []


def run_parabola(config: ParabolaConfig) -> dict[str, Any]:
    from torchrl_hmcts.trainers.runs.loggers import make_logger

    print("a trial talks")
    RUNS.append(config)
    y = -((config.x - 3.0) ** 2)
    logger = make_logger(config)
    for step in range(config.steps):
        logger.log_scalar("on_the_way", y, step=step)
    logger.close()
    metrics = {"test": {"y": y, "cost": -y}}
    (Path(config.out) / "metrics.json").write_text(json.dumps(metrics))
    return metrics


@pytest.fixture(autouse=True)
def parabola(monkeypatch: pytest.MonkeyPatch) -> None:
    """The parabola among the experiments."""
    RUNS.clear()
    found = Experiment("parabola", "", "", "", objective="test.y", progress="on_the_way")
    monkeypatch.setitem(EXPERIMENTS, "parabola", found)
    both = {"config_class": ParabolaConfig, "function": run_parabola}
    for name, value in both.items():
        original = getattr(Experiment, name)

        def chosen(self: Experiment, value: Any = value, original: Any = original) -> Any:
            return value if self.name == "parabola" else original.fget(self)

        monkeypatch.setattr(Experiment, name, property(chosen))


def sweep(out: Path, *words: str) -> int:
    return main(["sweep", "experiment=parabola", f"out={out}", *words])


def told(out: Path) -> dict[str, Any]:
    return json.loads((out / "sweep.json").read_text())


def test_what_varies_is_typed_as_lists_and_ranges() -> None:
    words = [
        "num_skills=[3, 4,6]",
        "gamma=0.9..0.99",
        "option_steps=10..50:20",
        "novelty_radius=0.1..10:log",
        "out=x",
    ]
    space, fixed = sweeps.parse_space(DemoConfig, words)
    assert space == {
        "num_skills": optuna.distributions.CategoricalDistribution((3, 4, 6)),
        "gamma": optuna.distributions.FloatDistribution(0.9, 0.99),
        "option_steps": optuna.distributions.IntDistribution(10, 50, step=20),
        "novelty_radius": optuna.distributions.FloatDistribution(0.1, 10.0, log=True),
    }
    assert fixed == ["out=x"]


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("gamma=[0.9]", "leaves nothing to choose"),
        ("gamma=[0.9,high]", "high"),
        ("gamma=2..1", "leaves nothing to choose"),
        ("gamma=0..1:log", "gamma=0..1:log: "),
        ("mazes=1..2.5", "no range of whole numbers"),
        ("mazes=1..9:20", "leaves nothing to choose"),
    ],
)
def test_what_makes_no_sense_is_refused(word: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sweeps.parse_space(DemoConfig, [word])


def test_a_sweep_finds_the_best_and_each_trial_is_a_run(tmp_path, capsys) -> None:
    assert sweep(tmp_path, "x=0..6", "z=[1,2]", "trials=12", "seed=5") == 0
    found = told(tmp_path)
    assert len(found["trials"]) == 12
    best = found["trials"][0]
    assert best["value"] == max(t["value"] for t in found["trials"] if t["value"] is not None)
    assert abs(best["params"]["x"] - 3.0) < 1.0
    assert all(config.seed == 5 for config in RUNS)
    run = json.loads((tmp_path / best["folder"] / "run.json").read_text())
    assert run["config"]["x"] == best["params"]["x"]
    assert run["status"] in ("finished", "given up")
    printed = capsys.readouterr().out
    assert "a trial talks" not in printed
    assert "Best of 12 trials: test.y = " in printed


def test_each_trial_is_a_line(tmp_path, capsys) -> None:
    assert sweep(tmp_path, "x=3..3.1", "trials=2", "prune=false") == 0
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(" x=")[0] for line in lines] == ["trial 0:", "trial 1:"]
    assert all(": test.y = -0.00" in line for line in lines)


def test_the_key_that_matters_has_the_larger_importance_and_a_picture(tmp_path) -> None:
    assert sweep(tmp_path, "x=0..6", "z=[1,2]", "trials=14", "prune=false") == 0
    shares = told(tmp_path)["importances"]
    assert shares["x"] > shares["z"]
    assert sum(shares.values()) == pytest.approx(1.0)
    page = (tmp_path / "index.html").read_text()
    for picture in ("importances.png", "trials.png"):
        assert f'src="{picture}"' in page
        assert (tmp_path / picture).stat().st_size > 1_000


def test_the_same_command_goes_on(tmp_path) -> None:
    words = ("x=[1,2,3]", "prune=false")
    assert sweep(tmp_path, *words, "trials=3") == 0
    first = {t["trial"]: t["value"] for t in told(tmp_path)["trials"]}
    assert sweep(tmp_path, *words, "trials=5") == 0
    both = {t["trial"]: t["value"] for t in told(tmp_path)["trials"]}
    assert len(RUNS) == 5
    assert both.items() >= first.items()
    assert sweep(tmp_path, *words, "trials=5") == 0
    assert len(RUNS) == 5  # nothing left to do


def test_ctrl_c_says_how_to_go_on(tmp_path, capsys, monkeypatch) -> None:
    def interrupted(config: ParabolaConfig) -> dict[str, Any]:
        if len(RUNS) == 2:
            raise KeyboardInterrupt
        return run_parabola(config)

    monkeypatch.setattr(Experiment, "function", property(lambda self: interrupted))
    assert sweep(tmp_path, "x=[1,2,3]", "trials=4") == 130
    assert "Continue with: hmcts sweep experiment=parabola" in capsys.readouterr().err
    monkeypatch.setattr(Experiment, "function", property(lambda self: run_parabola))
    assert sweep(tmp_path, "x=[1,2,3]", "trials=4") == 0
    states = [t["state"] for t in told(tmp_path)["trials"]]
    assert states.count("complete") == 4
    assert states.count("fail") == 1


def test_a_trial_that_lags_behind_is_given_up(tmp_path) -> None:
    words = ("x=[3,100]", "trials=12")
    assert sweep(tmp_path, *words) == 0
    rows = told(tmp_path)["trials"]
    given_up = [t for t in rows if t["state"] == "given up"]
    assert given_up
    assert all(t["params"]["x"] == 100.0 for t in given_up)
    run = json.loads((tmp_path / given_up[0]["folder"] / "run.json").read_text())
    assert run["status"] == "given up"


@pytest.mark.parametrize("storage", ["", "storage=sqlite:///{out}/trials.db"])
def test_a_sweep_continues_where_its_folder_was_moved(tmp_path, storage: str) -> None:
    def words(out: Path) -> list[str]:
        return ["x=[1,2]", "prune=false", *([storage.format(out=out)] if storage else [])]

    first, moved = tmp_path / "first", tmp_path / "moved"
    assert sweep(first, *words(first), "trials=2") == 0
    first.rename(moved)
    before = {path: path.read_bytes() for path in moved.glob("trial_*/run.json")}
    assert sweep(moved, *words(moved), "trials=2") == 0
    assert len(RUNS) == 2
    assert sweep(moved, *words(moved), "trials=3") == 0
    assert len(told(moved)["trials"]) == 3
    assert all(path.read_bytes() == content for path, content in before.items())


@pytest.mark.parametrize("torn", ['{"op_code": 5, "wor', '{"op_code": 5, "wor\n', "\xff\n"])
def test_a_journal_torn_by_a_kill_is_mended(tmp_path, capsys, torn: str) -> None:
    assert sweep(tmp_path, "x=[1,2]", "trials=2") == 0
    journal = tmp_path / "journal.log"
    whole = journal.read_bytes()
    journal.write_bytes(whole + torn.encode("latin-1"))
    assert sweep(tmp_path, "x=[1,2]", "trials=3") == 0
    assert len(RUNS) == 3
    assert "its last line is not whole" in capsys.readouterr().err
    assert journal.read_bytes().startswith(whole)
    assert (tmp_path / "journal.log.damaged").read_bytes() == whole + torn.encode("latin-1")


def test_a_trial_never_writes_into_a_folder_that_exists(tmp_path) -> None:
    mine = tmp_path / "trial_0000" / "metrics.json"
    mine.parent.mkdir()
    mine.write_text("{}")
    (tmp_path / "journal.log").touch()
    assert sweep(tmp_path, "x=[1,2]", "trials=1") == 0
    assert told(tmp_path)["trials"][0]["folder"] == "trial_0000_2"
    assert mine.read_text() == "{}"


def test_a_figure_that_is_not_finite_is_null_and_last(tmp_path, monkeypatch) -> None:
    def run(config: ParabolaConfig) -> dict[str, Any]:
        run_parabola(config)
        return {"test": {"y": float("nan") if config.x < 2 else config.x}}

    monkeypatch.setattr(Experiment, "function", property(lambda self: run))
    for out, objective in (("up", "test.y"), ("down", "-test.y")):
        words = ("x=[1,2,3]", "trials=6", f"objective={objective}", "prune=false")
        assert sweep(tmp_path / out, *words) == 0
        text = (tmp_path / out / "sweep.json").read_text()
        values = [row["value"] for row in json.loads(text, parse_constant=pytest.fail)["trials"]]
        numbers = [value for value in values if value is not None]
        assert values == [*sorted(numbers, reverse=out == "up"), *[None] * (6 - len(numbers))]
        assert 0 < len(numbers) < 6


@pytest.mark.parametrize("alive", [False, True])
def test_a_trial_whose_process_died_is_continued_in_its_folder(tmp_path, alive: bool) -> None:
    assert sweep(tmp_path, "x=1..9", "trials=1") == 0
    journal = optuna.storages.journal.JournalFileBackend(str(tmp_path / "journal.log"))
    storage = optuna.storages.JournalStorage(journal)
    trial = optuna.load_study(study_name=None, storage=storage).ask()
    x = trial.suggest_float("x", 1.0, 9.0)
    trial.set_user_attr("folder", "trial_0001")
    folder = tmp_path / "trial_0001"
    folder.mkdir()
    start_record("parabola", ParabolaConfig(out=str(folder), x=x), [])
    with folder_locked(folder) if alive else nullcontext():
        assert sweep(tmp_path, "x=1..9", "trials=2") == 0
    last = RUNS[-1]
    assert len(RUNS) == 2
    assert (last.out == str(folder), last.x == x, last.resume) == (not alive,) * 3
    states = sorted(row["state"] for row in told(tmp_path)["trials"])
    assert states == ["complete", "complete", "running or interrupted" if alive else "fail"]
    assert sweep(tmp_path, "x=1..9", "trials=2") == 0  # nothing is left to continue or to do
    assert len(RUNS) == 2


def test_no_value_is_drawn_twice_by_a_sweep_that_continues(tmp_path) -> None:
    for trials in (2, 4):
        assert sweep(tmp_path, "x=0..6", f"trials={trials}", "prune=false") == 0
    assert len({config.x for config in RUNS}) == 4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["z=[1,2]"], "holds another sweep: space"),
        (["x=[1,2]", "steps=5"], "holds another sweep: fixed {}"),
        (["x=[1,2]", "objective=-test.cost"], "holds another sweep: objective test.y"),
    ],
)
def test_trials_of_other_settings_are_not_mixed(tmp_path, capsys, words, message) -> None:
    assert sweep(tmp_path, "x=[1,2]", "trials=1") == 0
    before = (tmp_path / "sweep.json").read_bytes()
    assert sweep(tmp_path, *words, "trials=2") == 2
    assert message in capsys.readouterr().err
    assert (tmp_path / "sweep.json").read_bytes() == before
    assert len(RUNS) == 1


def test_the_folder_of_a_run_is_refused(tmp_path, capsys) -> None:
    (tmp_path / "metrics.json").write_text("{}")
    assert sweep(tmp_path, "x=[1,2]", "trials=1") == 2
    assert "holds files that are not a sweep's (metrics.json)" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.json"]


def test_any_storage_of_optunas_will_do(tmp_path) -> None:
    url = f"sqlite:///{tmp_path}/trials.db"
    assert sweep(tmp_path, "x=[1,2]", "trials=2", f"storage={url}") == 0
    storage = optuna.storages.RDBStorage(url, engine_kwargs={"poolclass": NullPool})
    study = optuna.load_study(study_name=f"parabola-{tmp_path.name}", storage=storage)
    assert len(study.trials) == 2
    assert not (tmp_path / "journal.log").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trials=2"], "nothing varies"),
        (["x=[1,2]", "trials=none"], "whole number; got 'none'"),
        (["x=[1,2]", "trials=1", "objective=test.w"], "no figure 'test.w'. It has: test.cost"),
        (["x=[1,2]", "trails=3"], "Unknown key 'trails'. Did you mean: trials"),
        (["y=[1,2]"], "Unknown key 'y'"),
        (["x"], "no key=value"),
        (["seed=-3..3"], "seed must be 0 to 4294967295; got -3"),
        (["seed=[0,-1]"], "seed must be 0 to 4294967295; got -1"),
        (["seed=0..1e20"], "seed must be 0 to 4294967295; got 1"),
        (["x=0..inf"], "leaves nothing to choose"),
        (["x=[1,2]", "trials=0"], "whole number above 0; got '0'"),
        (["x=[1,2]", "trials=1.5"], "whole number; got '1.5'"),
        (["x=[1,2]", "storage=trials.db"], "storage=trials.db cannot be opened"),
        (["x=[1,2]", "storage=sqlite:////nowhere/trials.db"], "cannot be opened"),
    ],
)
def test_what_a_sweep_cannot_do_is_said(tmp_path, capsys, words, message) -> None:
    assert sweep(tmp_path, *words) == 2
    assert message in capsys.readouterr().err
