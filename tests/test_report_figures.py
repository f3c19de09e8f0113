"""The dissertation's figures by name."""

from __future__ import annotations

import json
import re
from pathlib import Path

import imageio.v3 as iio
import pytest

from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.experiments import dissertation_figures
from torchrl_hmcts.trainers.experiments.dissertation import FIGURES, find_figure, find_results
from torchrl_hmcts.trainers.experiments.registry import EXPERIMENTS
from torchrl_hmcts.trainers.figures.atari_scores import (
    TABLE_5_1,
    TABLE_A_1,
    best_baseline,
)

ASKED = (
    "3.1 3.2 3.4 3.5 3.6 4.4 4.5 4.6 4.7 4.8 4.9 4.10 5.1 5.2 5.3 5.4 5.5 5.6 5.7 table5.1".split()
)


def write_json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def write_atari(path: Path, game: str, seed: int, protocol: str = "deterministic") -> str:
    config = {"seed": seed, "out": "x"}
    write_json(path / "run.json", {"experiment": "atari", "config": config})
    scores = {"score_max": 100.0 + seed, "score_mean": 50.0 + 10 * seed, "frames": 4_000}
    write_json(path / "metrics.json", {"game": game, "protocol": protocol, "seed": seed, **scores})
    rows = [f"{t},{n},{t / 100 + seed}" for t in (0, 500, 1_000) for n in ("score", "score_max")]
    (path / "curves.csv").write_text("step,name,value\n" + "\n".join(rows) + "\n")
    return str(path)


def test_every_figure_of_the_dissertation_that_shows_data_has_a_name() -> None:
    assert list(FIGURES) == ASKED
    for figure in FIGURES.values():
        assert figure.shows
        assert figure.data
        assert callable(getattr(dissertation_figures, figure.draws))


def test_the_list_says_what_each_shows_and_what_ours_is_drawn_from(capsys) -> None:
    assert main(["list", "figures"]) == 0
    printed = capsys.readouterr().out
    for figure in FIGURES.values():
        assert figure.shows in printed


def test_the_commands_that_make_the_data_name_experiments_that_exist() -> None:
    for figure in FIGURES.values():
        for command in figure.commands:
            for name in re.findall(r"experiment=(\w+)", command):
                assert name in {*EXPERIMENTS, "atari"}


@pytest.mark.parametrize("name", ["3.6", "figure 3.6", "Figure_3.6"])
def test_a_figure_is_found_by_its_number(name: str) -> None:
    assert find_figure(name).name == "3.6"


def test_an_unknown_figure_is_refused_with_the_nearest(capsys) -> None:
    assert main(["report", "figure=4.1"]) == 2
    assert "Did you mean: 4." in capsys.readouterr().err


@pytest.mark.parametrize("name", ["3.1", "3.4", "3.5", "4.4"])
def test_a_figure_that_needs_no_data_is_drawn_afresh(tmp_path, capsys, name: str) -> None:
    assert main(["report", f"figure={name}", f"out={tmp_path}"]) == 0
    file = tmp_path / f"figure_{name}.png"
    assert iio.imread(file).std() > 10  # something is on it
    assert str(file) in capsys.readouterr().out


def test_curves_of_chapter_3_come_from_measured_results(tmp_path, capsys) -> None:
    curve = {"training_steps": [0, 9], "solved_share": [0.0, 1.0], "episode_steps": [99, 9]}
    agents = {"goal-based agent": [{"curve": curve}, {"curve": curve}], "expert": [{}]}
    write_json(tmp_path / "results" / "goals" / "goal_agent.json", {"agents": agents})
    words = [f"results={tmp_path}/results", f"out={tmp_path}"]
    assert main(["report", "figure=3.6", *words]) == 0
    printed = capsys.readouterr().out
    assert "goal-based agent: 2 seed(s) of docs/results" in printed
    assert "no data of A3C without goals" in printed
    assert "hmcts train experiment=waterworld_a3c seed=0 out=runs/a3c_0" in printed
    assert (tmp_path / "figure_3.6.png").stat().st_size > 5_000


@pytest.mark.parametrize("name", ["3.6", "4.6", "4.10", "5.2", "table5.1"])
def test_without_data_the_commands_that_make_them_are_said(tmp_path, capsys, name: str) -> None:
    (tmp_path / "results").mkdir()
    words = [f"results={tmp_path}/results", f"out={tmp_path}"]
    assert main(["report", f"figure={name}", *words]) == 1
    error = capsys.readouterr().err
    assert "hmcts train experiment=" in error
    assert f"hmcts report figure={name} runs/" in error


def test_losses_of_chapter_4_come_from_runs(tmp_path, capsys) -> None:
    folders = []
    for seed in (0, 1):
        run = tmp_path / f"run{seed}"
        config = {"seed": seed, "algorithm": "diayn"}
        write_json(run / "run.json", {"experiment": "labmaze", "config": config})
        rows = [f"loss_actor,{64 * i},{i * (seed + 1)}" for i in range(100)]
        (run / "curves.csv").write_text("curve,training_frames,value\n" + "\n".join(rows) + "\n")
        folders.append(str(run))
    assert main(["report", "figure=4.6", *folders, f"out={tmp_path}"]) == 0
    assert "2 seed(s)" in capsys.readouterr().out
    assert main(["report", "figure=4.7", *folders, f"out={tmp_path}"]) == 1  # no such curve


@pytest.mark.parametrize("name", ["4.6", "4.7", "4.8", "4.9"])
def test_losses_of_chapter_4_come_from_measured_results(tmp_path, capsys, name: str) -> None:
    assert main(["report", f"figure={name}", f"out={tmp_path}"]) == 0
    assert "1 seed(s) of docs/results" in " ".join(capsys.readouterr().out.split())
    assert (tmp_path / f"figure_{name}.png").stat().st_size > 5_000


def test_scores_of_a_game_are_drawn_from_runs_and_from_results(tmp_path, capsys) -> None:
    runs = [write_atari(tmp_path / f"r{s}", "Breakout", s) for s in (0, 1)]
    assert main(["report", "figure=5.2", *runs, f"out={tmp_path}/a"]) == 0
    assert main(["report", "figure=5.4", *runs, f"out={tmp_path}/a"]) == 1
    curve = {"step": [0, 1_000], "value": [0.0, 3.0]}
    row = {"game": "Pong", "protocol": "sticky", "seed": 0, "score_max": 3.0, "score_mean": 1.0}
    row["curves"] = {"score": curve, "score_max": curve}
    write_json(tmp_path / "results" / "atari" / "pong.json", [row])
    words = [f"results={tmp_path}/results", f"out={tmp_path}/b"]
    capsys.readouterr()
    assert main(["report", "figure=5.4", *words]) == 0
    assert "Pong" in capsys.readouterr().out


def test_table_5_1_has_ours_beside_the_sources_and_the_baselines(tmp_path) -> None:
    runs = [write_atari(tmp_path / f"r{s}", "Breakout", s) for s in (0, 1, 2)]
    runs.append(write_atari(tmp_path / "sticky", "Breakout", 0, "sticky"))
    assert main(["report", "figure=table5.1", *runs, f"out={tmp_path}"]) == 0
    lines = (tmp_path / "table5.1.md").read_text().splitlines()
    assert "ours, deterministic: mean" in lines[0]
    assert "ours, sticky: mean" in lines[0]
    (breakout,) = (line for line in lines if line.startswith("| Breakout"))
    cells = [cell.strip() for cell in breakout.strip("|").split("|")]
    assert cells[:4] == ["Breakout", "464", "3, 30", "131.5 deepq"]
    assert cells[4].startswith("60 50 to 70")  # 50, 60, 70
    assert cells[5:8] == ["100 to 102", "rules", "3"]
    page = (tmp_path / "table5.1.html").read_text()
    assert "Table A.1" in page
    assert "trpo_mpi" in page
    # (60 - 1.7) / (30.5 - 1.7), the mean of three seeds, beside one seed under sticky actions
    rows = [re.sub("<[^>]+>", " ", row).split() for row in page.split("</tr>")]
    assert [row for row in rows if row[1:2] == ["mean"]] == [
        ["deterministic", "mean", "2.02", "1.68", "to", "2.37", "1"],
        ["sticky", "mean", "1.68", "a", "game", "has", "one", "seed", "1"],
    ]


def test_the_sources_numbers_fit_each_other() -> None:
    # The dissertation names the best baseline of each game in its text and in Table A.1.
    assert {game: best_baseline(game)[0] for game in TABLE_5_1} == {
        "BeamRider": "acktr", "Breakout": "deepq", "Enduro": "deepq", "SpaceInvaders": "acer",
        "Qbert": "ppo2_mpi", "Seaquest": "ppo2_mpi", "Pong": "deepq",
    }  # fmt: skip
    assert all(set(row) == set(TABLE_5_1) for row in TABLE_A_1.values())


def test_all_figures_make_one_page_that_says_what_is_missing(tmp_path, capsys, monkeypatch) -> None:
    few = {name: FIGURES[name] for name in ("3.1", "5.2", "table5.1")}
    monkeypatch.setattr(dissertation_figures, "FIGURES", few)
    run = write_atari(tmp_path / "r", "Pong", 0)
    assert main(["report", "figure=all", run, f"out={tmp_path}/all"]) == 0
    page = (tmp_path / "all" / "index.html").read_text()
    assert page.count("<img") == 1
    assert 'href="table5.1.html"' in page
    assert "experiment=atari game=Breakout" in page
    assert "5.2: there is no run of Breakout" in capsys.readouterr().out


def test_the_repositorys_results_are_found(monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    found = find_results()
    assert found is None or (found / "README.md").is_file()
    with pytest.raises(ValueError, match="is no folder"):
        find_results("nowhere")
