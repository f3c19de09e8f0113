"""LabMazeEnv: movement by hand, items and their timing, states, TorchRL's contracts, bad input."""

from __future__ import annotations

import math
import re
from functools import lru_cache
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.envs import LAB_ACTIONS, LabMazeEnv
from torchrl_hmcts.envs.lab.read_outs import READ_OUTS

FORWARD, BACK, LEFT, RIGHT, LOOK_LEFT, LOOK_RIGHT, _, _, NOTHING = range(9)
STATE_KEYS = ["maze_index", "position", "velocity", "turned", "level"]
HALL = ["*" * 30, "*P" + " " * 27 + "*", "*" * 30]  # 28 cells to the east
ROOM = ["*******", "*     *", "*     *", "*  P  *", "*     *", "*     *", "*******"]
START = (150.0, 150.0)


def make_env(maze=HALL, **kwargs):
    return LabMazeEnv([maze], **kwargs)


def play(env, td, actions):
    """The ("next") tensordicts of a list of actions."""
    steps = []
    for action in actions:
        td = env._step(td.copy().set("action", torch.as_tensor(action).expand(td.shape)))
        steps.append(td)
    return steps


def native(look=0, pitch=0, strafe=0, move=0, fire=0, jump=0, crouch=0):
    return torch.tensor([look, pitch, strafe, move, fire, jump, crouch])


def play_native(env, td, actions):
    steps = []
    for action in actions:
        td = env._step(td.copy().set("action", action))
        steps.append(td)
    return steps


class TestMovement:
    def test_speeds_from_rest_are_the_recorded_ones(self):
        """Recorded from the engine with its own clock, whose first frames last 14, 17, 17 ms."""
        env = make_env(clock="exact")
        speeds = [td["velocity"][0].item() for td in play(env, env.make_state(0, START), [0] * 10)]
        assert speeds == [45.0, 89.0, 133.0, 167.0, 204.0, 238.0, 268.0, 295.0, 319.0, 320.0]

    def test_the_first_frames_by_hand(self):
        env = make_env()
        first, second, third = play(env, env.make_state(0, START), [FORWARD] * 3)
        assert first["velocity"].tolist() == [51.0, 0.0]  # 3200 * 0.016 = 51.2
        assert first["position"][0].item() == pytest.approx(150 + 51.2 * 0.016, abs=1e-4)
        # Friction takes 100 * 6 * 0.016 = 9.6 below 100 units per second: 51 - 9.6 + 51.2 = 92.6.
        assert second["velocity"].tolist() == [93.0, 0.0]
        assert third["velocity"].tolist() == [135.0, 0.0]  # 93 - 9.6 + 51.2 = 134.6

    def test_steady_speed_covers_five_units_a_frame(self):
        env = make_env()
        steps = play(env, env.make_state(0, START), [FORWARD] * 100)
        assert all(td["velocity"].tolist() == [320.0, 0.0] for td in steps[12:])
        way = steps[99]["position"][0] - steps[49]["position"][0]
        assert way.item() == pytest.approx(50 * 5.12, abs=1e-2)

    def test_released_at_top_speed_it_stops_after_forty_units(self):
        env = make_env(clock="exact")
        run = play(env, env.make_state(0, START), [FORWARD] * 60)[-1]
        stop = play(env, run, [NOTHING] * 30)
        frames = next(i for i, td in enumerate(stop) if not td["velocity"].any()) + 1
        assert frames == 22
        way = stop[-1]["position"][0] - run["position"][0]
        assert way.item() == pytest.approx(40.5, abs=0.5)

    @pytest.mark.parametrize("heading", [0.0, 90.0, 180.0, 37.0])
    @pytest.mark.parametrize(
        ("strafe", "move", "angle"),
        [(0, 1, 0), (0, -1, 180), (1, 0, -90), (-1, 0, 90), (1, 1, -45), (-1, -1, 135)],
    )
    def test_keys_push_in_their_direction_with_the_same_strength(
        self, heading, strafe, move, angle
    ):
        env = make_env(ROOM, actions=None)
        (td,) = play_native(
            env, env.make_state(0, (350.0, 350.0), heading), [native(strafe=strafe, move=move)]
        )
        radians = math.radians(heading + angle)
        expected = torch.tensor([math.cos(radians), math.sin(radians)]) * 51.2
        torch.testing.assert_close(td["velocity"], expected, atol=0.51, rtol=0)
        moved = (td["position"] - 350.0).norm().item()
        assert moved == pytest.approx(51.2 * 0.016, abs=1e-3)

    def test_looking_turns_at_once_and_without_inertia(self):
        env = make_env(actions=None)
        td = env.make_state(0, START, heading=90.0)
        right, left, none = play_native(env, td, [native(look=10), native(look=-512), native()])
        degrees = [
            math.degrees(math.atan2(*td["heading"].flip(-1).tolist())) for td in (right, left, none)
        ]
        assert degrees[0] == pytest.approx(90 - 1.056, abs=0.006)
        assert degrees[1] == pytest.approx(90 - 1.056 + 54.0672, abs=0.006)
        assert degrees[2] == degrees[1]

    def test_pitch_stops_short_of_straight_down_and_does_not_move(self):
        env = make_env(actions=None)
        steps = play_native(env, env.make_state(0, START), [native(pitch=100)] * 10)
        assert [td["turned"][1].item() for td in steps[:2]] == pytest.approx(
            [10.56, 21.12], abs=1e-4
        )
        assert steps[-1]["turned"][1].item() == 87.890625
        assert steps[-1]["position"].tolist() == list(START)

    def test_fire_jump_and_crouch_are_ignored(self):
        env = make_env(actions=None)
        td = env.make_state(0, START)
        plain, other = (
            play_native(env, td, [a] * 5)[-1] for a in (native(move=1), native(0, 0, 0, 1, 1, 1, 1))
        )
        assert (plain == other).all()

    def test_discrete_actions_are_native_ones_by_name(self):
        env, own = make_env(ROOM), make_env(ROOM, actions=None)
        td = env.make_state(0, (350.0, 350.0), 20.0, velocity=(100.0, -50.0))
        for i, action in enumerate(LAB_ACTIONS.values()):
            (a,) = play(env, td, [i])
            (b,) = play_native(own, td, [native(*action)])
            assert (a == b).all()

    def test_more_friction_is_slower_only_without_keys(self):
        for friction, lost in ((6.0, 31), (6.3, 32), (12.0, 61)):  # 320 * friction * 0.016
            env = make_env(friction=friction)
            td = env.make_state(0, START, velocity=(320.0, 0.0))
            assert play(env, td, [NOTHING])[-1]["velocity"][0].item() == 320 - lost

    @pytest.mark.parametrize(("fps", "msec"), [(60, 16), (57, 17), (30, 32), (20, 48), (15, 64)])
    def test_frames_last_as_the_engine_rounds_them(self, fps, msec):
        env = make_env(fps=fps)
        assert env.frame_msec == msec
        td = play(env, env.make_state(0, START, velocity=(320.0, 0.0)), [FORWARD])[-1]
        assert td["position"][0].item() == pytest.approx(150 + 0.32 * msec, abs=1e-3)

    def test_the_exact_clock_ticks_14_and_17_milliseconds(self):
        env = make_env(clock="exact")
        steps = play(env, env.make_state(0, START, velocity=(320.0, 0.0)), [FORWARD] * 200)
        x = torch.stack([td["position"][0] for td in steps]).double()
        msec = ((x[1:] - x[:-1]) / 0.32).round()
        assert set(msec.tolist()) == {14.0, 17.0}
        assert msec.mean().item() == pytest.approx(16, abs=0.1)
        assert msec[:3].tolist() == [17.0, 17.0, 14.0]  # after the 14 of the first frame


class TestWalls:
    def test_head_on_it_stops_an_eighth_of_a_unit_off_the_wall(self):
        """The wall is a unit thick, the player reaches 15 units: 100 - 1 - 15 - 0.125."""
        env = make_env(["****", "*P *", "****"])
        td = play(env, env.make_state(0, START), [FORWARD] * 60)[-1]
        assert td["position"].tolist() == pytest.approx([300 - 16.125, 150.0], abs=2e-3)
        assert not td["velocity"].any()

    def test_along_a_wall_it_keeps_the_speed_along_it(self):
        env = make_env()
        td = play(env, env.make_state(0, START, heading=45.0), [FORWARD] * 120)[-1]
        assert td["position"][1].item() == pytest.approx(200 - 16.125, abs=2e-3)
        assert td["velocity"][0] > 220  # cos 45 of the top speed and more: friction is shared
        assert abs(td["velocity"][1]) <= 1

    def test_a_convex_corner_lacks_a_notch_of_one_unit(self):
        """Walls stand in the open cells: at the pillar's corner neither covers the other's unit."""
        env = make_env(["*****", "*   *", "* * *", "*P  *", "*****"])
        # Westwards just south of the pillar's south face: 16 units free it, 15 do not.
        for below, stops in ((200.0 - 15.5, True), (200.0 - 16.2, False)):
            td = env.make_state(0, (350.0, below), heading=180.0)
            td = play(env, td, [FORWARD] * 30)[-1]
            assert (td["position"][0] > 300.0) == stops
        # The pillar's east face ends at y = 200: a player below 200 - 15 passes its corner, where
        # the south face begins only at x = 300.
        td = env.make_state(0, (316.125, 150.0), heading=90.0, velocity=(0.0, 320.0))
        assert play(env, td, [FORWARD] * 20)[-1]["position"][1] > 250.0

    def test_a_corner_holds_it(self):
        env = make_env(ROOM)
        td = play(env, env.make_state(0, (350.0, 350.0), heading=45.0), [FORWARD] * 200)[-1]
        assert td["position"].tolist() == pytest.approx([600 - 16.125] * 2, abs=3e-3)

    @settings(max_examples=10)
    @given(st.integers(0, 10**6), st.integers(1, 12), st.sampled_from(["constant", "exact"]))
    def test_random_players_never_enter_a_wall(self, seed, hold, clock):
        env = pool_env(clock)
        env.set_seed(seed)
        generator = torch.Generator().manual_seed(seed)
        td = env.reset(TensorDict(batch_size=[64]))
        solid = torch.from_numpy(env.layout.walls)
        for _ in range(80 // hold):
            look = torch.randint(-60, 61, (64, 1), generator=generator)
            keys = torch.randint(-1, 2, (64, 2), generator=generator)
            rest = torch.zeros((64, 4), dtype=torch.int64)
            action = torch.cat((look, rest[:, :1], keys, rest[:, :3]), 1)
            for _ in range(hold):
                td = env._step(td.set("action", action))
                assert clearance(solid, td).min() > 0.1
                assert td["velocity"].abs().max() < 500


def clearance(solid, td):
    """Between each player's box and the nearest wall surface [n], comparing with every cell.

    A wall cell, grown by the unit of its walls but for the corners: a cross of two boxes.
    """
    rows, columns = solid.shape[1:]
    row, column = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    centers = torch.stack((column, rows - 1 - row), -1).reshape(-1, 2) * 100.0 + 50.0
    delta = (td["position"].double().unsqueeze(-2) - centers).abs()  # [n, cells, 2]
    walls = solid[td["maze_index"]].flatten(1)
    apart = []
    for half in (torch.tensor([66.0, 65.0]), torch.tensor([65.0, 66.0])):
        apart.append((delta - half).amax(-1).masked_fill(~walls, math.inf).amin(-1))
    return torch.minimum(*apart)


@lru_cache
def pool_env(clock):
    return LabMazeEnv(
        maze_seeds=range(30), actions=None, clock=clock, terminate_on_goal=False, seed=0
    )


class TestItems:
    @pytest.mark.parametrize(
        ("offset", "picked"),
        [
            ((-50.0, 0.0), True),
            ((-50.5, 0.0), False),
            ((44.0, 0.0), True),
            ((44.5, 0.0), False),
            ((0.0, 36.0), True),
            ((0.0, -36.0), True),
            ((0.0, 36.5), False),
            ((0.0, -36.5), False),
        ],
    )
    def test_an_item_is_reached_farther_from_the_west(self, offset, picked):
        env = make_env(["*******", "*     *", "*     *", "*  A P*", "*     *", "*******"])
        td = env.make_state(0, (350.0 + offset[0], 250.0 + offset[1]))
        (after,) = play(env, td, [NOTHING])
        assert (after["reward"].item() == 1.0) == picked

    def test_an_apple_pays_once_in_the_frame_after_it_is_touched(self):
        env = make_env(["********", "*P A A *", "********"], read_outs=["apples"])
        td = env.make_state(0, START)
        assert td["apples"].nonzero().flatten().tolist() == [8 + 3, 8 + 5]
        steps = play(env, td, [FORWARD] * 100)
        paid = [i for i, td in enumerate(steps) if td["reward"].item() == 1.0]
        assert len(paid) == 2
        assert sum(td["reward"].item() for td in steps) == 2.0
        for i, item in zip(paid, (350.0, 550.0), strict=True):
            assert steps[i - 2]["position"][0] < item - 50 <= steps[i - 1]["position"][0]
        assert [steps[i]["apples"].sum().item() for i in (paid[0] - 1, *paid)] == [2.0, 1.0, 0.0]

    def test_the_goal_pays_ten_and_ends_the_episode(self):
        env = make_env(["*****", "*P G*", "*****"])
        steps = play(env, env.make_state(0, START), [FORWARD] * 60)
        end = next(i for i, td in enumerate(steps) if td["done"])
        assert [td["reward"].item() for td in steps[: end + 1]] == [0.0] * end + [10.0]
        assert steps[end]["terminated"]
        assert not steps[end]["truncated"]
        assert steps[end - 1]["position"][0] >= 300 > steps[end - 2]["position"][0]
        # Stepped on, it stays where it is and gives nothing.
        assert (steps[-1] == steps[end].clone().set("reward", torch.zeros(1))).all()

    def test_rewards_can_be_others(self):
        env = make_env(["********", "*P A  G*", "********"], apple_reward=0.0, goal_reward=1.0)
        steps = play(env, env.make_state(0, START), [FORWARD] * 120)
        assert [td["reward"].item() for td in steps if td["reward"]] == [1.0]
        assert steps[-1]["terminated"]
        assert steps[-1]["level"][1] == 0  # the apple is picked all the same

    def test_in_the_stock_level_the_goal_brings_the_player_elsewhere(self):
        env = make_env(["******", "*PA G*", "*P  P*", "******"], terminate_on_goal=False)
        steps = play(env, env.make_state(0, (150.0, 250.0)), [FORWARD] * 80)
        end = next(i for i, td in enumerate(steps) if td["reward"] == 10)
        assert not steps[end]["done"]
        assert steps[end]["level"][1] == 0  # no apple is left
        again = steps[end + 1]
        assert again["level"][1] == 1
        assert not again["velocity"].any()
        assert again["position"].tolist() in env.layout.spawn[0].tolist()
        assert again["reward"].item() == 0.0
        assert steps[end + 2]["velocity"].any()  # the first action that moves it

    def test_the_new_place_is_part_of_the_state_and_covers_all(self):
        env = make_env(["******", "*PP G*", "*P  P*", "******"], terminate_on_goal=False)
        td = env.make_state(0, torch.tensor([450.0, 250.0]).expand(2000, 2))
        td["level"][:, 4] = torch.randint(2**32, (2000,))
        runs = [play(env, td, [NOTHING] * 2)[-1] for _ in range(2)]
        assert (runs[0] == runs[1]).all()
        place = (runs[0]["position"] * torch.tensor([1.0, 7.0])).sum(-1).unique(return_counts=True)
        assert place[1].tolist() == pytest.approx([500] * 4, abs=100)
        assert runs[0]["level"][:, 0].unique().numel() > 1900

    def test_frames_of_a_step_end_at_the_goal(self):
        maze = ["********", "*P A  G*", "********"]
        one, ten = (make_env(maze, num_steps=k) for k in (1, 10))
        steps = play(one, one.make_state(0, START), [FORWARD] * 100)
        td = ten.make_state(0, START)
        total = 0.0
        while not td["done"]:
            (td,) = play(ten, td, [FORWARD])
            total += td["reward"].item()
        end = next(i for i, td in enumerate(steps) if td["done"])
        assert total == 11.0
        assert (td.select(*STATE_KEYS) == steps[end].select(*STATE_KEYS)).all()
        assert td["level"][3].item() == end + 1

    def test_the_time_limit_truncates(self):
        env = make_env(max_frames=25, num_steps=10)
        steps = play(env, env.make_state(0, START), [FORWARD] * 4)
        assert [td["truncated"].item() for td in steps] == [False, False, True, True]
        assert not any(td["terminated"] for td in steps)
        assert [td["level"][3].item() for td in steps] == [10, 20, 25, 25]
        assert (steps[2]["position"] == steps[3]["position"]).all()


class TestReadOuts:
    def test_they_say_where_the_player_is(self):
        maze = ["*******", "*A    *", "*    G*", "*P    *", "*******"]
        env = LabMazeEnv([maze], read_outs=READ_OUTS)
        td = env.make_state(0, (250.0, 175.0), heading=90.0, velocity=(32.0, 160.0))
        assert td["tile_position"].tolist() == [2.5, 1.75]
        assert td["heading"].tolist() == pytest.approx([0.0, 1.0], abs=1e-4)
        assert td["body_velocity"].tolist() == pytest.approx([0.5, -0.1], abs=1e-4)  # left: west
        assert td["goal"].tolist() == [5.5, 2.5]
        assert td["map"].reshape(5, 7).tolist() == [[float(c == "*") for c in r] for r in maze]
        assert td["apples"].nonzero().flatten().tolist() == [8]
        near = td["walls_nearby"].reshape(5, 5)
        assert near.tolist() == [
            [1, 0, 0, 0, 0],
            [1, 0, 0, 0, 0],
            [1, 0, 0, 0, 0],
            [1, 1, 1, 1, 1],
            [1, 1, 1, 1, 1],
        ]
        parts = ["tile_position", "heading", "body_velocity", "goal", "map", "apples"]
        assert (td["observation"] == torch.cat([td[key] for key in parts])).all()

    def test_without_a_goal_it_is_nowhere(self):
        assert make_env().reset()["goal"].tolist() == [-1.0, -1.0]

    def test_only_those_asked_for_are_written(self):
        env = make_env(read_outs=["map"])
        assert set(env.reset().keys()) - {"done", "terminated", "truncated"} == {
            *STATE_KEYS,
            "map",
        }

    def test_render_shows_player_goal_and_apples(self):
        env = make_env(["*****", "*P A*", "*   *", "*G  *", "*****"])
        image = env.render(env.make_state(0, (150.0, 350.0)), tile_pixels=32)

        def pixel(x, y):
            return image[8 + int(y * 32), 8 + int(x * 32)].tolist()

        assert pixel(1.5, 1.5) == [37, 99, 235]
        assert pixel(1.5, 3.5) == [22, 163, 74]
        assert pixel(3.5, 1.5) == [213, 17, 120]
        assert pixel(2.5, 2.5) == [255, 255, 255]
        assert pixel(0.5, 0.5) == [24, 24, 27]
        assert pixel(1.8, 1.5) == [37, 99, 235]  # it looks to the east
        assert pixel(1.2, 1.5) == [255, 255, 255]


class TestReset:
    def test_players_start_at_rest_on_spawn_points_facing_anywhere(self):
        env = LabMazeEnv(maze_seeds=range(3), seed=0)
        td = env.reset(TensorDict(batch_size=[3000]))
        assert td["maze_index"].bincount().tolist() == pytest.approx([1000] * 3, abs=150)
        spawn = {(m, *p) for m in range(3) for p in env.layout.spawn[m].tolist() if p[0] > 0}
        where = zip(td["maze_index"].tolist(), td["position"].tolist(), strict=True)
        seen = {(m, *p) for m, p in where}
        assert seen == spawn
        assert not td["velocity"].any()
        assert not td["turned"].any()
        quarter = td["level"][:, 0] // 16384
        assert quarter.bincount().tolist() == pytest.approx([750] * 4, abs=120)
        assert td["heading"].norm(dim=-1).tolist() == pytest.approx([1.0] * 3000)


class TestState:
    def test_made_states_have_what_a_reset_has(self):
        env = LabMazeEnv(maze_seeds=[1, 2], read_outs=READ_OUTS)
        td = env.make_state([0, 1], START, heading=[0.0, -90.0], frame=[3, 4])
        assert set(td.keys()) == set(env.reset().keys())
        assert td["level"][:, 3].tolist() == [3, 4]
        assert td["heading"][1].tolist() == pytest.approx([0.0, -1.0], abs=1e-6)
        for key, spec in env.observation_spec.items():
            assert spec.expand(td[key].shape).is_in(td[key]), key
        assert (env.reset(td.clone(), set_state=True) == td).all()


class TestTorchRL:
    def test_the_stock_level_is_an_argument_away(self):
        env = LabMazeEnv(maze_seeds=[1], rows=15, columns=15, terminate_on_goal=False, actions=None)
        assert env.layout.walls.shape == (1, 15, 15)
        assert env.max_frames == 10_800
        assert env.action_spec.shape == (7,)
        check_env_specs(env)


class TestBadInput:
    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"mazes": []}, "at least one maze"),
            ({"mazes": [["***", "*P*", "***"], ["****", "*PP*", "****"]]}, "one size"),
            ({"mazes": [["***", "*x*", "***"]]}, r"the letters \['x'\]"),
            ({"mazes": [["****", "*GG*", "****"]]}, "2 goals and 0 spawn"),
            ({"num_steps": 0}, "num_steps >= 1; got 0"),
            ({"max_frames": 0}, "max_frames >= 1"),
            ({"fps": 1000}, "fps >= 15 and <= 240; got 1000"),
            ({"friction": 0.0}, "friction >= 1.0"),
            ({"friction": math.nan}, "friction .* got nan"),
            ({"clock": "sundial"}, "'sundial'"),
            ({"clock_phase": (99, 0)}, r"clock_phase\[0\] .* got 99"),
            ({"read_outs": ["pixels"]}, r"read-outs .* got \['pixels'\]"),
            ({"read_outs": ["goal", "goal"]}, "at most once"),
            ({"actions": {}}, "At least one action"),
            ({"actions": {"run": (0, 0, 0, 2)}}, "'run' = .* out of range"),
            ({"actions": {"run": (0, 0, 1)}}, "'run' must be four integers"),
        ],
    )
    def test_bad_arguments_are_refused_at_construction(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            LabMazeEnv(**{"maze_seeds": [1], **arguments})

    @pytest.mark.parametrize(
        ("key", "value", "message"),
        [
            ("position", [math.nan, 150.0], '"position" = nan is not finite'),
            ("velocity", [0.0, math.inf], '"velocity" = inf is not finite'),
            ("velocity", [641.0, 0.0], '"velocity" = 641.0 is out of range: -640 to 640'),
            ("turned", [400.0, 0.0], '"turned" = 400.0 is out of range'),
            ("position", [50.0, 150.0], r"\(50, 150\) is not in an open cell of maze 0"),
            ("position", [-5.0, 150.0], r"\(-5, 150\) is not in an open cell"),
            ("position", [150.0, 5000.0], "is not in an open cell"),
            ("position", [115.9, 150.0], r"\(115.9, 150\) is in or behind a wall.*spawn"),
            ("position", [150.0, 184.5], "is in or behind a wall"),
            ("maze_index", 1, '"maze_index" = 1 is out of range: 0 to 0'),
            ("level", [0, 0, 0, 10_801, 0, 0, 0], r'"level"\[..., 3\] = 10801 is out of range'),
            ("level", [70_000, 0, 0, 0, 0, 0, 0], r'"level"\[..., 0\] = 70000'),
        ],
    )
    def test_a_bad_state_is_refused_with_its_value(self, key, value, message):
        env = make_env()
        td = env.make_state(0, START)
        td[key] = torch.tensor(value)
        with pytest.raises(ValueError, match=message):
            env.reset(td, set_state=True)

    def test_what_is_no_place_or_heading_is_refused(self):
        env = make_env()
        with pytest.raises(ValueError, match="position must be .* pairs"):
            env.make_state(0, (1.0, 2.0, 3.0))
        with pytest.raises(ValueError, match="heading must be finite"):
            env.make_state(0, START, math.nan)

    @pytest.mark.parametrize(
        ("key", "value"),
        [
            ("action", 9),
            ("action", -1),
            ("maze_index", 5),
            ("position", [math.nan, 0.0]),
            ("position", [1e9, 0.0]),
            ("velocity", [0.0, math.nan]),
        ],
    )
    def test_a_step_from_nonsense_is_refused_with_its_value(self, key, value):
        env = make_env()
        td = env.make_state([0, 0], START).set("action", torch.zeros(2, dtype=torch.int64))
        td[key][1] = torch.tensor(value)
        with pytest.raises(ValueError, match="cannot step element 1: action"):
            env.step(td)

    def test_a_native_action_out_of_range_is_refused(self):
        env = make_env(actions=None)
        td = env.make_state(0, START).set("action", native(look=513))
        with pytest.raises(ValueError, match=r"action \[513, 0, .* the engine's seven"):
            env.step(td)


def test_the_blocks_of_its_page_run():
    page = (Path(__file__).parents[1] / "docs" / "lab_maze.md").read_text()
    namespace = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(block, "docs/lab_maze.md", "exec"), namespace)
