"""Five people's errands, each a script in an empty folder with only what the pages say."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

# What each is to do: most lines it may need, the script, and what it prints at its end.
ERRANDS = {
    "first plan in a maze": (
        5,
        """
        from torchrl_hmcts import MCTSPlanner
        from torchrl_hmcts.envs import GridworldMazeEnv
        env = GridworldMazeEnv(seed=0)
        plan = MCTSPlanner(env).plan(env.reset())
        print("found", plan.found.item())
        """,
        "found True",
    ),
    "own Gymnasium id": (
        5,
        """
        import my_envs
        from torchrl_hmcts import HMCTS
        agent = HMCTS("Corridor-v0")
        print("solved", agent.solve(seed=0).solved)
        """,
        "solved True",
    ),
    "another loss in TorchRL's SACTrainer": (
        12,  # of a script that trains SAC, those marked are added or changed
        """
        import torch
        from torchrl.collectors import Collector
        from torchrl.data import LazyTensorStorage, ReplayBuffer
        from torchrl.objectives import SoftUpdate
        from torchrl.trainers.algorithms import SACTrainer
        from torchrl_hmcts.trainers import DIAYNTrainer, make_training_env  # changed
        from torchrl_hmcts.transforms import SkillReward  # changed

        env = make_training_env(num_skills=4)  # changed
        loss = DIAYNTrainer.make_loss(env)  # changed
        reward = SkillReward(loss.objective)  # changed
        trainer = SACTrainer(
            collector=Collector(
                env,
                loss.actor_network,
                frames_per_batch=64,
                total_frames=128,
                auto_register_policy_transforms=False,  # changed
            ),
            total_frames=128,
            frame_skip=1,
            optim_steps_per_batch=1,
            loss_module=loss,
            optimizer=torch.optim.Adam(loss.parameters()),
            replay_buffer=ReplayBuffer(
                storage=LazyTensorStorage(1000),
                transform=reward,  # changed
                batch_size=64,
            ),
            batch_size=64,
            target_net_updater=SoftUpdate(loss, tau=0.05),
            progress_bar=False,
            enable_logging=False,  # changed
        )
        trainer.train()
        """,
        "",
    ),
    "a tree policy of one's own": (
        10,
        """
        from torchrl_hmcts import MCTSPlanner
        from torchrl_hmcts.envs import GridworldMazeEnv
        def least_tried(node):
            untried = node.option_visits == 0
            return node.option_values + 1e6 * untried + 0.1 / (1 + node.option_visits)
        env = GridworldMazeEnv(seed=0)
        plan = MCTSPlanner(env, tree_policy=least_tried).plan(env.reset())
        print("found", plan.found.item())
        """,
        "found True",
    ),
    "load and play a trained agent": (
        3,
        """
        from torchrl_hmcts import HMCTS
        agent = HMCTS.load("agent")
        print("solved", agent.play(seed=0, out="play.gif").solved)
        """,
        "solved True",
    ),
}  # fmt: skip
MY_ENVS = """
import gymnasium


class Corridor(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0.0, 19.0, (1,))
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return self.observation_space.low + self.place, {}

    def step(self, action):
        self.place = min(19, max(0, self.place + 2 * int(action) - 1))
        solved = self.place == 19
        return self.observation_space.low + self.place, float(solved), solved, False, {}


gymnasium.register("Corridor-v0", Corridor)
"""


@pytest.mark.parametrize("name", ERRANDS)
def test_an_errand_needs_few_lines(name: str, tmp_path: Path) -> None:
    most, script, said = ERRANDS[name]
    script = textwrap.dedent(script).strip()
    lines = script.splitlines()
    assert max(map(len, lines)) <= 100
    assert len([line for line in lines if "# changed" in line] or lines) <= most
    (tmp_path / "my_envs.py").write_text(MY_ENVS)
    (tmp_path / "errand.py").write_text(script)
    if name.startswith("load"):
        from torchrl_hmcts import HMCTS

        agent = HMCTS("MountainCar-v0", option_steps=14, num_skills=3)
        agent.learn(1024, progress=False).save(tmp_path / "agent")
    command = [sys.executable, "errand.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    last = (done.stdout.splitlines() or [""])[-1]
    assert said in last
    if name.startswith("load"):
        assert (tmp_path / "play.gif").stat().st_size > 1000
