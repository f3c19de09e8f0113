"""The worker of chapter 5: a network that reads the RAM.

Letters: H width of a layer, A actions, Z options.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_hmcts.checks import instance, whole_number
from torchrl_hmcts.envs.gym.shared_network import SharedNetwork, choose


class SharedMLP(SharedNetwork):
    r"""A network with shared layers and a head per option, its weights shared with all processes.

    .. math:: \pi(a \mid s, z) = \mathrm{softmax}_a(W_z h(s) + b_z), \qquad h = \mathrm{ReLU}(...)

    reads RAM / 255. One forward pass for one state takes a few microseconds; a module of torch
    needs ten times that. :meth:`load` writes new weights, which the processes use from their next
    step on: no copies, no messages, no locks (a step taken meanwhile may see some of both).

    Args:
        num_options (int): Z.
        num_actions (int): A.
        hidden (sequence of int): widths H of the shared layers. Default: three of 128.
        deterministic (bool): take the most probable action instead of a sample. Default False.

    Raises:
        ValueError: if a size is not positive, or the weights loaded have other shapes.
        OSError: if there is too little shared memory.

    Reference:
        Dissertation, chapter 5: the Atari worker.

    Example:
        >>> import numpy as np
        >>> import torch
        >>> from torchrl_hmcts.envs import SharedMLP
        >>> from torchrl_hmcts.modules import SkillMLP
        >>> network = SkillMLP(128, out_features=4, num_skills=3, hidden=(128, 128, 128))
        >>> worker = SharedMLP(num_options=3, num_actions=4, deterministic=True)
        >>> worker.load(network.parameters())
        >>> ram = np.arange(128, dtype=np.uint8)
        >>> with torch.no_grad():
        ...     logits = network(torch.from_numpy(ram) / 255.0, torch.tensor(1))
        >>> worker.act(ram, 1, np.random.default_rng(0)) == int(logits.argmax())
        True
    """

    def __init__(
        self,
        num_options: int,
        num_actions: int,
        *,
        hidden: Sequence[int] = (128, 128, 128),
        deterministic: bool = False,
    ) -> None:
        name = "SharedMLP"
        self.num_options = whole_number(name, "num_options", num_options, least=1)
        self.num_actions = whole_number(name, "num_actions", num_actions, least=1)
        if self.num_options * self.num_actions > 2**24:
            raise ValueError(
                f"{name} has room for 2**24 outputs; got num_options={num_options} and "
                f"num_actions={num_actions}."
            )
        instance(name, "hidden", hidden, tuple, list)
        widths = [whole_number(name, "every hidden width", width, least=1) for width in hidden]
        instance(name, "deterministic", deterministic, bool)
        self.deterministic = deterministic
        super().__init__(128, self.num_actions, self.num_options, widths)

    def act(self, ram: np.ndarray, option: int, generator: np.random.Generator) -> int:
        """Return an action drawn from the option's policy, or the most probable one."""
        draw = -1.0 if self.deterministic else generator.random()
        head = self._heads[option]
        return int(choose(ram, self._array, self._sizes, head, self._logits, draw, 255.0))
