"""What the pages and commands of a run say is so."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.diayn import DIAYNTrainer
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_training_env
from torchrl_hmcts.trainers.experiments.settings import DemoConfig
from torchrl_hmcts.trainers.figures.run_page import write_run_page
from torchrl_hmcts.trainers.runs.run import open_run
from torchrl_hmcts.trainers.saving.files import read_json, write_json
from torchrl_hmcts.trainers.saving.run_folder import end_record, read_run
from torchrl_hmcts.trainers.saving.worker_file import find_worker, load_networks, save_worker


def finish(out: Path, metrics: dict[str, Any], **captions: str) -> str:
    with open_run(DemoConfig(out=str(out))) as run:
        with run.finish(metrics, title="A run") as pictures:
            pictures.captions.update(captions)
        return (run.path / "index.html").read_text(encoding="utf-8")


def lead(page: str) -> str:
    return re.findall('<p class="lead">(.*?)</p>', page)[0]


def test_the_page_of_a_finished_run_says_finished(tmp_path: Path) -> None:
    page = finish(tmp_path, {"solved": 3})
    assert '<td class="text">finished</td>' in page
    assert "running" not in page
    assert "not finished" not in page


@pytest.mark.parametrize("status", ["stopped", "failed", "interrupted"])
def test_the_page_of_a_run_that_ended_otherwise_says_how(tmp_path: Path, status: str) -> None:
    error = {"stopped": KeyboardInterrupt, "failed": ZeroDivisionError}.get(status, SystemExit)

    def end() -> None:
        with open_run(DemoConfig(out=str(tmp_path))) as run:
            assert "not finished (running)" in lead(write_run_page(read_run(run.path)).read_text())
            raise error

    with pytest.raises(error):
        end()
    if status == "interrupted":  # by SIGKILL: nobody noted it
        record = read_json(tmp_path / "run.json")
        write_json(tmp_path / "run.json", {**record, "status": "running"}, checksum=True)
    assert f"not finished ({status})" in lead(write_run_page(read_run(tmp_path)).read_text())


def test_a_failure_after_the_end_leaves_the_run_finished(tmp_path: Path) -> None:
    def end() -> None:
        with open_run(DemoConfig(out=str(tmp_path))) as run:
            with run.finish({"solved": 1}, title=""):
                pass
            raise OSError("the disk is full")

    with pytest.raises(OSError, match="full"):
        end()
    assert read_run(tmp_path).status == "finished"


def test_a_run_that_is_extended_is_not_finished_until_it_is(tmp_path: Path) -> None:
    finish(tmp_path, {"solved": 1})
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "checkpoint-000000000064.torchrl").write_text("")
    with open_run(DemoConfig(out=str(tmp_path), resume=True)) as run:
        assert not read_run(run.path).finished
        end_record(run.path, "stopped")
    assert read_run(tmp_path).finished


@pytest.mark.parametrize(
    ("unsolved", "count", "which"), [([2], "1", "2"), ([0, 3], "2", "0, 3"), ([], "0", "-")]
)
def test_unsolved_is_a_count_and_the_indices_are_called_so(
    tmp_path: Path, unsolved: list[int], count: str, which: str
) -> None:
    page = finish(tmp_path, {"test": {"mazes": 4, "unsolved": unsolved}})
    cells = re.sub(r"<[^>]*>", " ", page)
    assert re.search(rf"unsolved\s+{count}\s", cells)
    assert re.search(rf"indices of the unsolved mazes\s+{which}\s", cells)


def make_loss(seed: int) -> Any:
    return DIAYNTrainer.make_loss(make_training_env(copies=1), 4, seed=seed)


def test_the_worker_of_a_run_is_one_file_named_with_its_step(tmp_path: Path) -> None:
    finish(tmp_path, {"solved": 1})
    for step in (4_096, 1_024):  # of another resume an earlier one may be the best
        loss = make_loss(step)
        save_worker(tmp_path, loss, step)
    assert [p.name for p in (tmp_path / "worker").iterdir()] == ["worker-000000001024.torchrl"]
    read = make_loss(0)
    assert load_networks(read, tmp_path) == find_worker(tmp_path)
    for name, value in loss.state_dict().items():
        assert torch.equal(read.state_dict()[name], value), name


def test_a_run_that_has_not_finished_shows_its_newest_checkpoint(tmp_path: Path, capsys) -> None:
    from torchrl_hmcts.trainers.saving.checkpoints import DurableRotation, plain_checkpoint

    with open_run(DemoConfig(out=str(tmp_path))) as run:
        save_worker(run.path, make_loss(0), 64)  # of an earlier end; the run is being extended
        rotation = DurableRotation(run.checkpoints)
        newest = rotation.save(plain_checkpoint(loss_module=make_loss(1)), step=128)
        assert find_worker(run.path) == newest
        with run.finish({"solved": 1}, title=""):
            pass
    assert find_worker(tmp_path).name == "worker-000000000064.torchrl"
    find_worker(tmp_path).write_bytes(b"damaged")
    assert find_worker(tmp_path) == newest
    assert "worker-000000000064.torchrl is damaged (" in capsys.readouterr().err


class TestReports:
    """Reports replace their own files, and nobody else's."""

    @pytest.fixture
    def runs(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
        monkeypatch.chdir(tmp_path)
        for name in ("a", "b"):
            finish(tmp_path / name, {"solved": 1})
        return ["a", "b"]

    @pytest.mark.parametrize(
        ("words", "file"),
        [
            (["a", "out=page.html"], "page.html"),
            (["a", "b"], "runs/report/index.html"),
            (["a", "b", "out=both.html"], "both.html"),
            (["figure=3.1"], "figures/figure_3.1.png"),
        ],
    )
    def test_a_file_of_somebody_else_stays(
        self, runs: list[str], capsys: Any, words: list[str], file: str
    ) -> None:
        path = Path(file)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"<html>my own</html>")
        assert main(["report", *words]) == 2
        assert f"{file} exists and was not written by hmcts report" in capsys.readouterr().err
        assert path.read_bytes() == b"<html>my own</html>"
        path.unlink()
        assert main(["report", *words]) == main(["report", *words]) == 0  # its own it replaces

    @pytest.mark.parametrize(
        "words", [["a", "b", "out=a"], ["a", "out=b"], ["figure=all", "out=a"]]
    )
    def test_the_page_of_a_run_stays(self, runs: list[str], capsys: Any, words: list[str]) -> None:
        before = [Path(name, "index.html").read_bytes() for name in runs]
        assert main(["report", *words]) == 2
        assert re.search("page of another run|the folder of a run", capsys.readouterr().err)
        assert [Path(name, "index.html").read_bytes() for name in runs] == before


class TestEvaluations:
    def test_what_is_not_finite_is_null(
        self, tmp_path: Path, monkeypatch: Any, capsys: Any
    ) -> None:
        finish(tmp_path, {"solved": 1})
        monkeypatch.setattr(
            "torchrl_hmcts.trainers.experiments.skills.evaluate_skills",
            lambda config: {"test": {"frames": float("nan"), "solved": np.int64(3)}},
        )
        capsys.readouterr()
        assert main(["evaluate", f"run={tmp_path}", "seed=2"]) == 0
        printed = capsys.readouterr().out
        assert "nan" not in printed
        assert re.search(r"test: solved +3\n", printed)
        text = (tmp_path / "evaluation.json").read_text()
        assert '"frames": null' in text
        assert '"solved": 3' in text
        json.loads(text, parse_constant=pytest.fail)

    def test_a_run_that_still_trains_is_tested_and_it_is_said(
        self, tmp_path: Path, monkeypatch: Any, capsys: Any
    ) -> None:
        monkeypatch.setattr(
            "torchrl_hmcts.trainers.experiments.skills.evaluate_skills", lambda config: {}
        )
        with open_run(DemoConfig(out=str(tmp_path))):
            assert main(["evaluate", f"run={tmp_path}"]) == 0
        assert "is still running: its newest checkpoint is tested" in capsys.readouterr().err

    @pytest.mark.parametrize("word", ["resume=true", "overwrite=true"])
    def test_keys_that_change_a_run_are_refused(
        self, tmp_path: Path, capsys: Any, word: str
    ) -> None:
        finish(tmp_path, {"solved": 1})
        assert main(["evaluate", f"run={tmp_path}", word]) == 2
        assert "is for hmcts train" in capsys.readouterr().err
