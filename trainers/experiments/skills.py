"""The whole agent over any kit: learn skills, plan over them, execute the plans, show it all."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule
from torchrl.record.loggers import Logger

from torchrl_hmcts.modules import (
    SkillDiscriminator,
    SkillDynamics,
    SkillEncoder,
    SkillPolicy,
    SpectralLinear,
)
from torchrl_hmcts.objectives import SkillObjective
from torchrl_hmcts.planners import MCTSPlanner
from torchrl_hmcts.trainers.collectors import make_ray_collector
from torchrl_hmcts.trainers.diayn import Curves, DIAYNTrainer
from torchrl_hmcts.trainers.evaluation import Results
from torchrl_hmcts.trainers.experiments.curve_tests import CurveTests
from torchrl_hmcts.trainers.experiments.kits import (
    OBJECTIVE,
    Kit,
    LearnedSkills,
    Trial,
    make_kit,
)
from torchrl_hmcts.trainers.experiments.managers import (
    learn_manager,
    load_manager,
    save_manager,
)
from torchrl_hmcts.trainers.experiments.settings import BATCH_STEPS, SkillsConfig
from torchrl_hmcts.trainers.hmcts import HMCTSTrainer
from torchrl_hmcts.trainers.parts import build, merged, named
from torchrl_hmcts.trainers.runs import console
from torchrl_hmcts.trainers.runs.config import ExperimentError
from torchrl_hmcts.trainers.runs.loggers import make_logger
from torchrl_hmcts.trainers.runs.run import Run, open_run
from torchrl_hmcts.trainers.saving.run_folder import read_run
from torchrl_hmcts.trainers.saving.worker_file import load_networks, save_worker
from torchrl_hmcts.trainers.skills.rounds import RoundRecords
from torchrl_hmcts.transforms import OptionRecorder, OptionTransform, SkillReward

_REWARD_SCALES = {"METRAEncoderLoss": 3.0, "LSDEncoderLoss": 10.0, "SkillDynamicsLoss": 0.5}


def run_skills(config: SkillsConfig) -> dict[str, Any]:
    """Run the agent over the kit of a configuration; return its figures, as in ``metrics.json``.

    Times are in seconds, steps in base steps.

    Reference:
        Dissertation, chapter 4 (tree search over skills), on the mazes of chapters 3 and 4.
    """
    with open_run(config) as run:
        return _run(run.config.sized(), run)


def _run(config: SkillsConfig, run: Run) -> dict[str, Any]:
    torch.set_num_threads(1)  # the networks are small: threads would only get in each other's way
    kit = make_kit(config)
    if found := kit.describe():
        print(textwrap.fill(found, console.WIDTH))
    begin = time.perf_counter()
    logger = make_logger(config)
    learned = learn(
        kit,
        save_dir=run.checkpoints,
        logger=logger,
        resume=run.resumes,
        progress=partial(
            console.Bar, desc="learn", unit=kit.unit.split()[-1], scale=config.frames_per_step
        ),
    )
    if learned.loss is not None:
        save_worker(run.path, learned.loss, learned.worker_step)
    if config.manager == "learned":
        kit.prepare(learned.worker)
        console.say("Learning prior and value of the options from searches ...")
        network = learn_manager(
            kit,
            kit.make_simulator(learned.worker, "train"),
            searches=config.manager_searches,
            iterations=4,
            updates=200,
            save_dir=run.checkpoints / "manager",
            resume=run.resumes,
            progress=partial(console.Bar, desc="learn"),
        )
        save_manager(run.path, network)
        kit.manager = kit.manager_for(network, "test")
    train_seconds = time.perf_counter() - begin
    trial = solve(kit, learned.worker, progress=True)
    metrics: dict[str, Any] = {
        "seed": config.seed,
        "train_seconds": round(train_seconds, 2),
        **kit.metrics(learned, trial),
        **kit.extras(learned.worker),
    }
    metrics["seconds"] = round(time.perf_counter() - begin, 2)
    run.write_curves(kit.curves(learned), kit.curve_steps)
    with run.finish(metrics, config, title=kit.title) as pictures:
        console.say("Drawing ...")
        kit.draw(pictures, learned, trial)
        logger.log_pictures(run.path, pictures.captions)
    logger.close()
    print(kit.table(metrics))
    return metrics


def evaluate_skills(config: SkillsConfig) -> dict[str, Any]:
    """Solve test starts with the worker of a run, whose folder is ``out``; changed keys change it.

    Returns figures of plans that are executed open-loop, one trial per start (``"test"``), and
    those of the kit's further tests.

    Reference:
        Dissertation, figure 4.10.
    """
    torch.set_num_threads(1)
    kit = make_kit(config.sized())
    checkpoint, worker = "", kit.given_worker()
    if worker is None:
        loss = make_loss(kit)
        checkpoint = load_networks(loss, config.out).name
        worker = SkillPolicy(loss.actor_network, deterministic=True)
    if config.manager == "learned":
        network = load_manager(kit, config.out, lambda: kit.make_simulator(worker, "train"))
        if network is None:
            raise ExperimentError(f"{config.out} holds no manager; leave manager=learned out.")
        kit.manager = kit.manager_for(network, "test")
    return {
        "checkpoint": checkpoint,
        "test": kit.figures(solve(kit, worker, progress=True)),
        **kit.extras(worker),
    }


# ---------------------------------------------------------------- learning


def learn(
    kit: Kit,
    *,
    save_dir: str | Path | None = None,
    progress: Callable[..., Any] | None = None,
    logger: Logger | None = None,
    resume: bool = False,
) -> LearnedSkills:
    """Train a worker by the configuration of the kit.

    Args:
        kit: whose env it learns in.
        save_dir: folder of the checkpoints. Default: none are written.
        progress: makes a progress bar, e.g. ``tqdm.tqdm``. Default: nothing is printed.
        logger: of TorchRL; gets the training's values and, as ``test_solved`` and ``test_frames``,
            those of the tests on the way. Default: none.
        resume: continue from the newest checkpoint in ``save_dir``.

    Reference:
        Dissertation, algorithm 3 and figures 4.6 to 4.10.

    Example:
        >>> from torchrl_hmcts.trainers import DemoConfig, make_kit
        >>> learn(make_kit(DemoConfig(options="actions"))).steps  # given options need no training
        0
    """
    config = kit.config
    begin = time.process_time()
    if config.worker:
        return load_skills(kit, config.worker)
    given = kit.given_worker()
    if given is not None:
        return LearnedSkills(given, None, {}, RoundRecords(), 0, 0, 0, 0.0)
    frames = config.train_steps * config.frames_per_step
    if progress is not None:
        console.say(f"Learning {config.num_skills} skills in {frames:,} {kit.unit} ...")
    loss = make_loss(kit)
    common = {"save_dir": save_dir, "progress": progress, "logger": logger, "seed": config.seed}
    common |= {"total_frames": config.train_steps, **config.trainer}
    make_trainer = _make_hmcts if config.algorithm == "hmcts" else _make_diayn
    trainer: Any = make_trainer(kit, loss, common)
    tests = CurveTests(trainer, kit, _curve_interval(config)) if config.curve_points else None
    kept = [key for key in config.KEPT if key != "toy"]
    trainer.run_settings.update({name: getattr(config, name) for name in kept})
    if resume and save_dir is not None:
        trainer.load(save_dir)
    trainer.train()
    step = trainer.collected_frames
    if tests is not None and config.keep == "best":
        step = tests.restore_best()
    return LearnedSkills(
        SkillPolicy(loss.actor_network, deterministic=True),
        loss,
        Curves(trainer.history),
        RoundRecords() if tests is None else tests.records,
        trainer.collected_frames,
        step,
        len(trainer.records) if isinstance(trainer, HMCTSTrainer) else 0,
        round(time.process_time() - begin, 1),
    )


def load_skills(kit: Kit, folder: str | Path) -> LearnedSkills:
    """Read the skills of a run or an agent."""
    loss = make_loss(kit)
    try:
        path = load_networks(loss, folder)
    except (ValueError, FileNotFoundError) as error:
        config = read_run(folder).config
        if config.get("options", "learned") != "learned":
            raise ExperimentError(
                f"{folder} holds an agent whose options are given (options={config['options']}), "
                "not learned: it has no skills. Pass the folder of one that has learned."
            ) from None
        if isinstance(error, FileNotFoundError):
            raise
        words = [
            f"{key} was {config[key]} and is {getattr(kit.config, key)} here."
            for key in ("num_skills", "hidden")
            if key in config and config[key] != getattr(kit.config, key, None)
        ]
        theirs, ours = config.get("id"), getattr(kit.config, "id", None)
        if theirs != ours:
            words.append(
                f"The skills of {folder} were learned in {theirs or 'another kit'}; their networks "
                f"do not fit {ours or 'this kit'}."
            )
        raise ExperimentError(" ".join([str(error), *words])) from None
    worker = SkillPolicy(loss.actor_network, deterministic=True)
    step = int("".join(filter(str.isdigit, path.stem)) or 0)
    return LearnedSkills(worker, loss, {}, RoundRecords(), step, step, 0, 0.0)


def make_loss(kit: Kit) -> Any:
    """Build actor, critics and objective of the worker.

    The actor sees the kit's ``worker_keys``; DIAYN's discriminator the displacement since the skill
    began, other objectives the place; DIAYN's critics the displacement too.
    """
    loss = kit.make_loss()
    if loss is None:
        loss = _make_loss(kit)
    kit.note(loss)
    return loss


def _make_loss(kit: Kit) -> Any:
    config, env = kit.config, kit.make_training_env(1)
    node = merged(OBJECTIVE, config.objective)
    keywords = dict(config.loss)
    if keywords.pop("num_skills", None) not in (None, config.num_skills):
        raise ValueError("The number of skills is num_skills, not loss.num_skills.")
    chosen = keywords.pop("_component_", None)
    critic_keys = list(kit.worker_keys)
    if node != OBJECTIVE:
        keywords["objective"] = make_objective(kit, env, node)
    if node["_component_"] == OBJECTIVE["_component_"]:
        critic_keys.append(config.objective_key or "displacement")
        keywords["discriminator_keys"] = critic_keys[-1:]
    return DIAYNTrainer.make_loss(
        env,
        config.num_skills,
        loss_class=None if chosen is None else named(chosen),
        in_keys=kit.worker_keys,
        critic_keys=critic_keys,
        seed=config.seed,
        **keywords,
    )


def make_objective(kit: Kit, env: EnvBase, node: Mapping[str, Any]) -> SkillObjective:
    """Build a skill objective with the network that it learns."""
    name, number = node["_component_"].rpartition(".")[2], kit.config.num_skills
    spec = env.full_observation_spec_unbatched
    key = kit.config.objective_key or kit.place_key
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(kit.config.seed)
        if name == "SkillDiscriminatorLoss":
            key = kit.config.objective_key or "displacement"
            network: Any = SkillDiscriminator(int(spec[key].shape[-1]), number, in_keys=[key])
        elif name == "SkillDynamicsLoss":
            size = int(spec[key].shape[-1])
            network = SkillDynamics(size, size, number, in_keys=[key], target_key=key)
        else:
            linear = SpectralLinear if name == "LSDEncoderLoss" else torch.nn.Linear
            network = SkillEncoder(spec[key].shape[-1], number, in_keys=[key], linear=linear)
    first = {"SkillDiscriminatorLoss": "discriminator", "SkillDynamicsLoss": "dynamics"}
    objective: SkillObjective = build(**node, **{first.get(name, "encoder"): network})
    return objective


def _curve_interval(config: SkillsConfig) -> int:
    return max(BATCH_STEPS, config.train_steps // config.curve_points)


def _make_diayn(kit: Kit, loss: LossModule, keywords: dict[str, Any]) -> DIAYNTrainer:
    config = kit.config
    own: dict[str, Any] = {
        "frames_per_batch": BATCH_STEPS,
        "updates_per_batch": config.updates_per_batch,
        "make_collector": make_ray_collector if config.collector == "ray" else Collector,
    }
    if config.curve_points:
        own["save_trainer_interval"] = _curve_interval(config)
    scale = _REWARD_SCALES.get(type(loss.objective).__name__)
    if scale is not None:
        own["reward"] = SkillReward(loss.objective, intrinsic_coeff=scale)
    own |= kit.trainer_part(loss)
    path = kit.parts()["trainer"]["_component_"]
    return build(path, env=kit.make_training_env(), loss_module=loss, **{**own, **keywords})


def _make_hmcts(kit: Kit, loss: LossModule, keywords: dict[str, Any]) -> HMCTSTrainer:
    config = kit.config
    own: dict[str, Any] = {
        "rounds": config.rounds or 2**31,  # or ended by total_frames
        "c_p": config.c_p,
        "dataset": config.dataset or None,
        "num_init_samples": config.init_options,
        "retrain_interval": config.retrain_interval,
        "option_steps": config.option_steps,
        "make_options": partial(OptionTransform, gamma=config.gamma),
        "make_recorder": partial(OptionRecorder, position_key=kit.place_key),
        "make_planner": kit.make_round_planner,
        "updates_per_step": config.updates_per_step,
    }
    make_env = partial(kit.make_env, "train")
    return HMCTSTrainer(make_env, loss, **{**own, **keywords})


# ---------------------------------------------------------------- planning and acting


def solve(kit: Kit, worker: TensorDictModuleBase, *, progress: bool = False) -> Trial:
    """Plan in the simulator and execute the plan in another instance: one trial per test start.

    Args:
        kit: of the experiment.
        worker: executes the options.
        progress: say what is done, and show a bar. Default False.

    Example:
        >>> from torchrl_hmcts.trainers import DemoConfig, make_kit
        >>> kit = make_kit(DemoConfig(options="actions", option_steps=20, mazes=2))
        >>> solve(kit, kit.given_worker()).results.solved.tolist()
        [True, True]
    """
    say: Callable[[str], Any] = console.say if progress else lambda words: None
    kit.prepare(worker)
    config = kit.config
    starts = kit.starts("test", config.mazes)
    planner = kit.make_planner(kit.make_simulator(worker))
    say("Compiling the search (a moment; about half a minute the first time) ...")
    begin = time.perf_counter()
    kit.make_planner(kit.make_simulator(worker)).plan(starts[:1])
    compile_seconds = time.perf_counter() - begin
    say(f"Solving {config.mazes} {kit.start_name} ...")
    cpu = time.process_time()
    results = _solve(kit, worker, planner, starts, progress)
    again, other = np.flatnonzero(~results.found), kit.second_try()
    if other is None:
        again = again[:0]
    elif len(again):  # nothing has been executed there yet
        second_planner = other.make_planner(other.make_simulator(worker))
        some = starts[torch.from_numpy(again)]
        second = _solve(other, worker, second_planner, some, progress)
        results = with_second_search(results, again, second)
    seconds = time.process_time() - cpu
    return Trial(starts, planner, results, len(again), compile_seconds, seconds)


def _solve(
    kit: Kit,
    worker: TensorDictModuleBase,
    planner: MCTSPlanner,
    starts: TensorDictBase,
    progress: bool,
) -> Results:
    """Plan and act from a group of starts after the other."""
    real = kit.make_real(worker)
    parts: list[Results] = []
    unit = kit.start_name.split()[0]
    bar = console.Bar(len(starts), desc="solve", unit=unit) if progress else None
    for some in starts.split(kit.group):
        parts.append(kit.act(planner, real, some))
        if bar is not None:
            bar.set_postfix(refresh=False, solved=int(sum(part.solved.sum() for part in parts)))
            bar.update(len(some))
    if bar is not None:
        bar.close()
    return Results.concatenate(parts)


def with_second_search(first: Results, again: np.ndarray, second: Results) -> Results:
    """Return results where the starts ``again`` have those of a second search, at both costs."""
    columns = {k: v.copy() for k, v in vars(first).items()}
    for name in ("simulated_steps", "expansions", "simulations"):
        columns[name][again] += getattr(second, name)
    for name in ("found", "solved", "plan_options", "episode_steps"):
        columns[name][again] = getattr(second, name)
    return Results(**columns)
