"""Asynchronous training: what learners do, and what happens when one of them, or all, must end.

Letters: B environments, T steps of a segment.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_trainers import Bars, make_networks, weights
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.checkpoint import CheckpointError
from torchrl.envs import EnvBase, GymEnv
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import A2CLoss
from torchrl.record import CSVLogger

from torchrl_hmcts.objectives import A3CLoss
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers import A3CTrainer, LearnerError, SharedRMSprop
from torchrl_hmcts.trainers.a3c.actor_learner import ActorLearner

LENGTH, B, T = 5, 4, 5
SEGMENT = B * T


def make_env() -> EnvBase:
    return ChainEnv(LENGTH, batch_size=[B])


def make_loss(**settings: Any) -> A3CLoss:
    return A3CLoss(*make_networks(LENGTH), gamma=0.9, **settings)


def make_trainer(
    loss: A2CLoss | None = None, env: Callable[[], EnvBase] = make_env, **settings: Any
) -> A3CTrainer:
    """A trainer in this process, or with learners that start at once after the first."""
    settings = {"total_frames": 10 * SEGMENT, "num_learners": 0, **settings}
    settings = {"optimizer": "adam", "lr": 0.05, "start_method": "forkserver", **settings}
    return A3CTrainer(env, make_loss() if loss is None else loss, segment_steps=T, **settings)


@pytest.mark.parametrize("kind", [TanhNormal, IndependentNormal])
def test_continuous_actions_are_learned_from(kind: Any) -> None:
    torch.manual_seed(0)
    outputs = nn.Sequential(nn.Linear(3, 2), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(outputs, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=kind,
        distribution_kwargs={"low": -2.0, "high": 2.0} if kind is TanhNormal else {},
    )
    loss = A3CLoss(actor, ValueOperator(nn.Linear(3, 1), in_keys=["observation"]))
    before = [p.detach().clone() for p in loss.parameters()]
    history = make_trainer(loss, lambda: GymEnv("Pendulum-v1"), total_frames=50).train()
    assert all(not p.equal(old) for p, old in zip(loss.parameters(), before, strict=True))
    assert np.isfinite([history[f"loss_{name}"] for name in ("objective", "critic")]).all()


def right_everywhere(policy: Any) -> float:
    td = policy(ChainEnv(LENGTH).reset().expand(LENGTH).clone().set("state", torch.arange(LENGTH)))
    return float((td["action"][: LENGTH - 1] == 1).float().mean())


class NaNAfter(ChainEnv):
    """A chain whose rewards are no numbers from some step on."""

    def __init__(self, steps: int) -> None:
        super().__init__(LENGTH, batch_size=[B])
        self.steps = steps

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = super()._step(tensordict)
        self.steps -= 1
        return out.set("reward", out["reward"] * (1.0 if self.steps >= 0 else float("nan")))


class TestInThisProcess:
    def test_a_chain_is_solved(self) -> None:
        trainer = make_trainer(total_frames=150 * SEGMENT)
        trainer.train()
        assert right_everywhere(trainer.policy()) == 1.0
        value = trainer.loss_module.critic_network_params["module", "weight"].flatten()
        best = [0.9 ** (LENGTH - 2 - s) for s in range(LENGTH - 1)]
        assert value[: LENGTH - 1].tolist() == pytest.approx(best, abs=0.2)

    def test_two_runs_of_a_seed_are_the_same_bit_for_bit_and_those_of_two_seeds_are_not(
        self,
    ) -> None:
        ends = []
        for seed in (3, 3, 4):
            trainer = make_trainer(seed=seed)
            trainer.train()
            ends.append(weights(trainer))
        assert torch.equal(ends[0], ends[1])
        assert not torch.equal(ends[0], ends[2])

    def test_the_first_update_is_the_gradient_of_the_first_segment(self) -> None:
        """SGD: the parameters move by lr times the clipped gradient, which is computed here."""
        loss = make_loss()
        trainer = make_trainer(
            loss,
            total_frames=SEGMENT,
            optimizer=lambda p: torch.optim.SGD(p, lr=0.5),
            clip_norm=0.01,
            lr_schedule="constant",
        )
        before = weights(trainer)
        learner = ActorLearner(trainer.settings, trainer.shared, 0)
        segment = learner.collect()
        assert segment.shape == (B, T)
        own = make_loss()
        own.load_state_dict(loss.state_dict())
        out = own(segment)
        sum(out[key] for key in out.keys() if key.startswith("loss")).backward()
        gradient = torch.cat([p.grad.flatten() for p in own.parameters()])
        assert gradient.norm() > 0.01
        trainer.train()
        step = -0.5 * 0.01 * gradient / gradient.norm()
        torch.testing.assert_close(weights(trainer) - before, step, atol=1e-6, rtol=1e-3)

    def test_the_history_counts_frames_updates_and_finished_episodes(self) -> None:
        """Action 1 always: episodes of 4 steps and return 1, the first ends at T = 4 B."""
        loss = make_loss()
        with torch.no_grad():
            loss.actor_network_params["module", "0", "module", "weight"].copy_(
                torch.tensor([-50.0, 50.0]).expand(LENGTH, 2)
            )
        trainer = make_trainer(loss, total_frames=4 * SEGMENT, lr=0.0, log_interval=2 * SEGMENT)
        history = trainer.train()
        assert history["frames"] == [2 * SEGMENT, 4 * SEGMENT]
        assert history["learner_0_frames"] == history["frames"]
        assert history["updates"] == [2, 4]
        assert history["episodes"] == [2 * B, 5 * B]  # after 10 and 20 steps of each
        assert history["episode_return"] == [1.0, 1.0]
        assert history["episode_length"] == [4.0, 4.0]
        assert history["entropy"] == pytest.approx([0.0, 0.0], abs=1e-6)
        assert history["seconds"] == sorted(history["seconds"])
        assert set(history) >= {"loss_objective", "loss_critic", "loss_entropy", "grad_norm", "lr"}

    @pytest.mark.parametrize(
        ("schedule", "expected"),
        [("linear", [0.75, 0.5, 0.25, 0.0]), ("constant", [1.0] * 4), (np.cos, None)],
    )
    def test_the_learning_rate_follows_the_schedule(self, schedule: Any, expected: Any) -> None:
        trainer = make_trainer(
            total_frames=4 * SEGMENT, lr=1.0, lr_schedule=schedule, log_interval=SEGMENT
        )
        expected = [np.cos(i / 4) for i in range(1, 5)] if expected is None else expected
        assert trainer.train()["lr"] == pytest.approx(expected)
        # Used last: that of T before the fourth segment.
        used = trainer.optimizer.param_groups[0]["lr"]
        assert used == pytest.approx({"linear": 0.25, "constant": 1.0}.get(schedule, np.cos(0.75)))

    def test_evaluation_gets_a_copy_that_training_does_not_change(self) -> None:
        seen: list[tuple[Any, Tensor]] = []

        def evaluate(policy: Any) -> dict[str, float]:
            parameters = torch.cat([p.flatten() for p in policy.parameters()])
            seen.append((policy, parameters.clone()))
            assert not parameters.requires_grad
            return {"calls": len(seen)}

        trainer = make_trainer(evaluate=evaluate, eval_interval=4 * SEGMENT)
        history = trainer.train()
        assert history["eval_frames"] == [4 * SEGMENT, 8 * SEGMENT, 10 * SEGMENT]
        assert history["eval_calls"] == [1, 2, 3]
        for policy, then in seen:
            assert torch.equal(torch.cat([p.flatten() for p in policy.parameters()]), then)
        assert not torch.equal(seen[0][1], seen[1][1])

    def test_stop_when_ends_the_run_with_the_parameters_that_were_evaluated(self) -> None:
        trainer = make_trainer(
            evaluate=lambda policy: {"x": float(next(policy.parameters()).sum())},
            eval_interval=3 * SEGMENT,
            stop_when=lambda metrics: True,
        )
        history = trainer.train()
        assert history["eval_frames"] == [3 * SEGMENT]
        assert history["eval_x"] == [float(next(trainer.policy().parameters()).sum())]

    def test_a_gradient_that_is_not_finite_is_refused(self) -> None:
        loss = make_loss()
        trainer = make_trainer(loss, lambda: NaNAfter(2 * T))
        with pytest.raises(FloatingPointError, match=f"nan.*after {2 * SEGMENT} frames.*not appl"):
            trainer.train()
        assert torch.isfinite(weights(trainer)).all()
        assert trainer.frames == 2 * SEGMENT

    @pytest.mark.parametrize("functional", [True, False])
    def test_torchrls_a2c_loss_can_be_trained_too(self, functional: bool) -> None:
        loss = A2CLoss(*make_networks(LENGTH), functional=functional)
        trainer = make_trainer(loss)
        before = weights(trainer)
        history = trainer.train()
        assert not torch.equal(weights(trainer), before)
        assert np.isfinite(history["loss_critic"]).all()
        assert len(list(trainer.policy().parameters())) == 1

    def test_values_reach_the_logger_and_progress_the_end(self, tmp_path: Path) -> None:
        logger, bars = CSVLogger("run", log_dir=str(tmp_path)), Bars()
        make_trainer(logger=logger, log_interval=5 * SEGMENT, progress=bars).train()
        rows = (tmp_path / "run" / "scalars" / "frames.csv").read_text().split()
        assert [float(row.split(",")[-1]) for row in rows] == [5 * SEGMENT, 10 * SEGMENT]
        assert [(bar.n, bar.total, bar.closed) for bar in bars] == [(200, 200, True)]
        assert "return" in bars[0].figures


class TestCheckpoints:
    def test_a_resumed_run_goes_on_with_counters_state_and_curves(self, tmp_path: Path) -> None:
        first = make_trainer(total_frames=10 * SEGMENT, save_dir=tmp_path, log_interval=2 * SEGMENT)
        done = first.train()
        second = make_trainer(
            make_loss(entropy_coeff=0.02), total_frames=15 * SEGMENT, log_interval=2 * SEGMENT
        )
        assert not torch.equal(weights(first), weights(second))
        second.load(tmp_path)
        assert torch.equal(weights(first), weights(second))
        assert second.frames == 10 * SEGMENT
        assert second.seconds == pytest.approx(first.seconds, abs=0.5)
        assert second.history == done
        for a, b in zip(*(t.loss_module.parameters() for t in (first, second)), strict=True):
            old, new = first.optimizer.state[a], second.optimizer.state[b]
            assert list(old) == list(new)
            assert all(torch.equal(old[key], new[key]) for key in old)
            assert all(entry.is_shared() for entry in new.values())
        history = second.train()
        assert history["frames"] == [SEGMENT * i for i in (2, 4, 6, 8, 10, 12, 14, 15)]
        assert history["updates"][-1] == 15
        # The rate falls to 0 at the new end: 2/3 of the way are done.
        assert history["lr"][5] == pytest.approx(0.05 * (1 - 12 / 15))
        assert history["learner_0_frames"][-1] == 5 * SEGMENT

    def test_a_resumed_run_does_not_repeat_the_first_ones_episodes(self, tmp_path: Path) -> None:
        actions = []
        for frames in (0, 10 * SEGMENT):
            trainer = make_trainer()
            learner = ActorLearner(trainer.settings, trainer.shared, 0, frames)
            actions.append(learner.collect()["action"])
        assert not torch.equal(*actions)

    def test_what_cannot_be_loaded_or_saved_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=f"no checkpoint in '{tmp_path}'"):
            make_trainer().load(tmp_path)
        with pytest.raises(ValueError, match="Pass save_dir"):
            make_trainer().save()
        make_trainer(save_dir=tmp_path, optimizer="adam").train()
        with pytest.raises(CheckpointError, match=r"\['exp_avg', .*SharedRMSprop, has \['square"):
            make_trainer(optimizer="rmsprop").load(tmp_path)


ENDLESS: dict[str, Any] = {"total_frames": 10**9, "num_learners": 2, "eval_interval": SEGMENT}


class TestProcesses:
    def test_one_learner_in_a_process_does_what_it_does_in_this_one(self) -> None:
        here, there = make_trainer(seed=7), make_trainer(seed=7, num_learners=1)
        here.train()
        there.train()
        assert torch.equal(weights(here), weights(there))

    def test_two_learners_train_one_set_of_parameters(self) -> None:
        trainer = make_trainer(total_frames=150 * SEGMENT, num_learners=2, optimizer="rmsprop")
        history = trainer.train()
        frames = [history[f"learner_{i}_frames"][-1] for i in range(2)]
        assert min(frames) > 0
        assert sum(frames) == history["frames"][-1] == trainer.frames
        assert 150 * SEGMENT <= trainer.frames <= 151 * SEGMENT
        assert history["updates"][-1] * SEGMENT == trainer.frames
        assert right_everywhere(trainer.policy()) == 1.0
        assert history["episode_length"][-1] < 8.0

    def test_a_learners_exception_ends_the_run_with_a_checkpoint_its_name_and_its_traceback(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        def configure(loss: A3CLoss, learner: int) -> None:
            if learner == 1:
                raise RuntimeError("the maze is on fire")

        trainer = make_trainer(**ENDLESS, configure_learner=configure, save_dir=tmp_path)
        with pytest.raises(LearnerError, match="Learner 1 of 2 failed") as caught:
            trainer.train()
        # Some releases of cloudpickle hide a local function's file, and with it the line itself.
        assert "in configure\n" in str(caught.value)
        assert "RuntimeError: the maze is on fire" in str(caught.value)
        assert caught.value.learner == 1
        assert trainer.learners.running == []
        assert make_trainer().load(tmp_path).frames == trainer.frames
        assert f"saved at {trainer.frames} frames. Continue with" in capsys.readouterr().err

    def test_a_killed_learner_is_noticed_soon(self) -> None:
        killed_at: list[float] = []

        def kill_the_first(policy: Any) -> dict[str, float]:
            if not killed_at:
                os.kill(trainer.learners.running[0][0].pid, signal.SIGKILL)
                killed_at.append(time.monotonic())
            return {}

        trainer = make_trainer(**ENDLESS, evaluate=kill_the_first)
        with pytest.raises(LearnerError, match="Learner 0 of 2 was killed by SIGKILL") as caught:
            trainer.train()
        assert caught.value.exitcode == -signal.SIGKILL
        assert time.monotonic() - killed_at[0] < 8.0  # on a busy machine; idle, under 1

    def test_ctrl_c_stops_all_saves_and_says_how_to_continue(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        pids: list[int] = []

        def interrupt(policy: Any) -> dict[str, float]:
            pids.extend(process.pid for process, _ in trainer.learners.running)
            for pid in pids:  # a terminal sends it to all
                os.kill(pid, signal.SIGINT)
            time.sleep(0.2)
            assert all(process.exitcode is None for process, _ in trainer.learners.running)
            signal.raise_signal(signal.SIGINT)
            return {}

        trainer = make_trainer(**ENDLESS, evaluate=interrupt, save_dir=tmp_path)
        # A shell without job control has its background processes ignore Ctrl-C.
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            with pytest.raises(KeyboardInterrupt):
                trainer.train()
        finally:
            signal.signal(signal.SIGINT, before)
        assert len(pids) == 2
        assert not any(alive(pid) for pid in pids)
        message = f"saved at {trainer.frames} frames. Continue with trainer.load({str(tmp_path)!r})"
        assert message in capsys.readouterr().err
        assert make_trainer().load(tmp_path).frames == trainer.frames > 0

    def test_learners_end_when_their_parent_is_killed(self, tmp_path: Path) -> None:
        script = textwrap.dedent(f"""
            import sys
            sys.path.insert(0, {str(Path(__file__).parent)!r})
            from {Path(__file__).stem} import make_trainer
            def show(policy):
                print(*(p.pid for p, _ in trainer.learners.running), flush=True)
                return {{}}
            if __name__ == "__main__":
                trainer = make_trainer(total_frames=10**9, num_learners=2, start_method="fork",
                                       evaluate=show, eval_interval=1)
                trainer.train()
        """)
        (tmp_path / "script.py").write_text(script)
        with subprocess.Popen(
            [sys.executable, tmp_path / "script.py"], stdout=subprocess.PIPE, text=True
        ) as parent:
            assert parent.stdout is not None
            pids = [int(word) for word in parent.stdout.readline().split()]
            parent.kill()
        assert len(pids) == 2
        deadline = time.monotonic() + 10.0
        while any(alive(pid) for pid in pids) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not any(alive(pid) for pid in pids)


def alive(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_the_code_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = Path(__file__).parents[1] / "docs" / "algorithms" / "a3c.md"
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL)
    assert len(blocks) == 3
    monkeypatch.chdir(tmp_path)  # it writes checkpoints
    namespace: dict[str, Any] = {}
    for block in blocks:
        exec(compile(block, str(page), "exec"), namespace)


class TestConstruction:
    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"total_frames": 0}, "total_frames >= 1; got 0"),
            ({"num_learners": -1}, "num_learners >= 0; got -1"),
            ({"log_interval": 0}, "log_interval >= 1; got 0"),
            ({"clip_norm": 0.0}, "clip_norm > 0.*0.0"),
            ({"optimizer": "sgd"}, r"optimizer to be one of \['adam', 'rmsprop'\]; got 'sgd'"),
            ({"lr_schedule": "cosine"}, "lr_schedule to be one of.*'cosine'"),
            ({"start_method": "thread"}, "start_method to be one of.*'thread'"),
            ({"stop_when": lambda metrics: True}, "pass evaluate too"),
            (
                {"optimizer": SharedRMSprop([nn.Parameter(torch.ones(1))])},
                "1 of the optimiser's 1 parameters are not",
            ),
            ({"loss": make_loss(reduction="none")}, "reduction='none'"),
            ({"loss": nn.Linear(1, 1)}, "Linear has none"),
        ],
    )
    def test_what_makes_no_sense_is_refused(self, settings: dict[str, Any], message: str) -> None:
        with pytest.raises((ValueError, TypeError), match=message):
            make_trainer(**settings)

    def test_what_make_env_returns_is_checked(self) -> None:
        with pytest.raises(TypeError, match=r"EnvBase; it returned int"):
            make_trainer(env=lambda: 3).train()  # type: ignore[arg-type, return-value]

    def test_an_optimiser_can_be_given_with_groups_of_its_own(self) -> None:
        loss = make_loss()
        groups = [
            {"params": list(loss.actor_network_params.parameters()), "lr": 0.0},
            {"params": list(loss.critic_network_params.parameters()), "lr": 0.1},
        ]
        before = {name: p.detach().clone() for name, p in loss.named_parameters()}
        make_trainer(loss, optimizer=SharedRMSprop(groups)).train()
        for name, parameter in loss.named_parameters():
            assert torch.equal(parameter, before[name]) == name.startswith("actor")
