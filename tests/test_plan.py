"""The plan: each rule decides both ways on a made-up capture, and what the user says stays."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from ball_head import ball_head
from tiny import tiny_config, tiny_head

from mgavatar.camera import look_at
from mgavatar.capture.subject import Frame, Subject
from mgavatar.config import FitConfig, from_dict, resolve
from mgavatar.fitting.plan import Decision, plan
from mgavatar.head.model import HeadModel
from mgavatar.head.params import HeadParams
from mgavatar.presets import to_toml

EVERYTHING = {
    "geometry": {"subdivisions": "auto", "pose_offsets": "auto", "learn_jaw": "auto", "learn_eyes": "auto"},
    "appearance": {
        "colors": "auto",
        "color_net": {"levels": "auto", "max_resolution": "auto", "view_frame": "auto"},
        "offset_net": {"enabled": "auto", "resolution": "auto"},
    },
}
SIZE = 200
"""Width and height of the images. The cameras are 1 m from a ball with a radius of 0.1 m: a pixel is 1 / ``focal``."""


def made_up(
    *,
    cameras: Sequence[float] = (-40.0, 0.0, 40.0),
    focal: float = 500.0,
    n_timesteps: int = 3,
    held_out: int = 0,
    **params: Any,
) -> Subject:
    """A capture without images: the ball, seen from ``cameras`` [deg] at 1 m; rotations of ``params`` are in degrees.

    Each of ``params`` holds a row for every timestep, others are zero. The last ``held_out`` timesteps are for tests.
    """
    widths = {"expr": 3, "rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3}
    rows = {name: np.zeros((n_timesteps, width), np.float32) for name, width in widths.items()}
    for name, values in params.items():
        scale = np.pi / 180.0 if name.endswith(("pose", "rotation")) else 1.0
        rows[name] += (scale * np.asarray(values)).astype(np.float32)
    frames: dict[str, list[Frame]] = {"train": [], "val": [], "test": []}
    for step in range(n_timesteps):
        for index, angle in enumerate(np.radians(cameras)):
            place = np.array([np.sin(angle), 0.0, np.cos(angle)])
            camera = look_at(place, np.zeros(3), focal=focal, width=SIZE, height=SIZE)
            split = "train" if step < n_timesteps - held_out else "test"
            frames[split].append(Frame(Path("none.png"), None, camera, index, step))
    return Subject(
        root=Path("made-up"),
        frames={name: tuple(each) for name, each in frames.items()},  # type: ignore[misc]
        params=HeadParams(shape=np.zeros(4, np.float32), **rows),
        timestep_ids=tuple(range(n_timesteps)),
        background=np.ones(3, np.float32),
        ground_truth=None,
    )


def turned(axis: int, *angles: float, width: int = 3) -> np.ndarray:
    """A rotation vector [deg] about an axis for each timestep."""
    rows = np.zeros((len(angles), width))
    rows[:, axis] = angles
    return rows


def value(config: FitConfig, key: str) -> Any:
    """What stands at a dotted key."""
    found: Any = config
    for name in key.split("."):
        found = getattr(found, name)
    return found


def decided(key: str, subject: Subject, head: HeadModel | None = None, **more: Any) -> tuple[Any, str]:
    """What a plan for everything makes of a key, and what it says about it."""
    config = from_dict(EVERYTHING, FitConfig)
    for name, given in more.items():
        part = getattr(config.appearance, name)
        changed = dataclasses.replace(part, **given) if isinstance(given, dict) else given
        config = dataclasses.replace(config, appearance=dataclasses.replace(config.appearance, **{name: changed}))
    resolved, decisions = plan(config, head or tiny_head(), subject)
    said = [str(decision) for decision in decisions if decision.key == key]
    return value(resolved, key), said[0] if said else ""


def test_nothing_is_left_open_and_everything_is_said():
    """No ``auto`` reaches what is built or stored; each line names its flag."""
    resolved, decisions = plan(from_dict(EVERYTHING, FitConfig), tiny_head(), made_up(jaw_pose=turned(0, 0, 5, 9)))
    assert "auto" not in to_toml(resolved)
    keys = [f"{section}.{key}" for section in EVERYTHING for key in dataclasses.asdict(resolved)[section]]
    assert {decision.key for decision in decisions} >= {"geometry.subdivisions", "appearance.colors"} & set(keys)
    assert len(decisions) == 10
    for decision in decisions:
        assert value(resolved, decision.key) == decision.value
        assert re.search(r"\d|held|still", decision.reason), decision
        assert str(decision).endswith(f"(--{decision.key.replace('_', '-')})")


def test_what_the_user_says_stays():
    """A value of the user's is kept, whatever the capture, and not talked about."""
    subject = made_up(cameras=(0.0,), n_timesteps=1)
    config = tiny_config(geometry={"subdivisions": 2})
    assert plan(config, tiny_head(), subject) == (resolve(config), ())
    table = {"geometry": {"subdivisions": "auto", "pose_offsets": True}}
    resolved, decisions = plan(from_dict(table, FitConfig), tiny_head(), subject)
    assert [decision.key for decision in decisions] == ["geometry.subdivisions"]
    assert resolved.geometry.pose_offsets is True
    assert dataclasses.asdict(resolved.appearance) == dataclasses.asdict(FitConfig().appearance)


def test_a_plan_is_resolved_for_good():
    """A plan of a plan changes nothing: a resumed fit has the configuration that the run wrote down."""
    subject = made_up(expr=[[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    resolved, _ = plan(from_dict(EVERYTHING, FitConfig), tiny_head(), subject)
    assert plan(resolved, tiny_head(), subject) == (resolved, ())


def test_a_decision_in_words():
    """The reason with the flag that undoes it."""
    text = str(Decision("geometry.learn_jaw", False, "jaw held: it never turns"))
    assert text == "jaw held: it never turns (--geometry.learn-jaw)"


@pytest.mark.parametrize(
    ("focal", "size", "times", "words"),
    [
        (500.0, 8192, 1, "one subdivision: edges of {:.1f} px"),
        (70.0, 8192, 1, "edges of {:.1f} px"),
        (65.0, 8192, 0, "no subdivision: edges of {:.1f} px are not worth splitting"),
        (500.0, 20, 0, "edges of {:.1f} px"),
    ],
)
def test_subdivision_goes_by_what_the_images_show(focal, size, times, words):
    """A coarse head is subdivided where its edges are long in the images that the fit will see."""
    found, said = decided("geometry.subdivisions", made_up(focal=focal), max_image_size=size)
    edge = trimesh.creation.icosphere(subdivisions=1, radius=0.1).edges_unique_length.mean()
    assert found == times
    assert words.format(edge * focal * min(1.0, size / SIZE)) in said


def test_a_fine_head_is_not_subdivided():
    """However large it is in the images."""
    fine = ball_head(trimesh.creation.icosphere(subdivisions=6, radius=0.1), n_shape=1, n_expr=1)
    uvs = dataclasses.replace(fine, vt=tiny_head().vt, ft=np.zeros_like(fine.faces))
    found, said = decided("geometry.subdivisions", made_up(focal=1e5), uvs)
    assert found == 0
    assert f"{len(fine.v_template)} vertices" in said


@pytest.mark.parametrize("name", ["neck_pose", "jaw_pose", "eyes_pose"])
@pytest.mark.parametrize(("angle", "on"), [(5.0, True), (4.1, True), (3.9, False), (0.0, False)])
def test_pose_offsets_are_for_poses_that_vary(name, angle, on):
    """Two degrees either side of the mean, of whichever joint; the last of six numbers counts as the first does."""
    width = 6 if name == "eyes_pose" else 3
    found, said = decided("geometry.pose_offsets", made_up(**{name: turned(width - 1, 7, 7 + angle, 7, width=width)}))
    low = made_up(n_timesteps=2, **{name: turned(width - 1, 7, 7 + angle, width=width)})
    assert decided("geometry.pose_offsets", low)[0] is on
    assert found is (angle * 2 / 3 > 2.0)
    assert f"{angle * 2 / 3:.1f} deg" in said


def test_only_training_timesteps_count():
    """A jaw that opens in the test alone cannot be learned from."""
    pose = turned(0, 0, 0, 20)
    for key in ("geometry.pose_offsets", "geometry.learn_jaw", "appearance.offset_net.enabled"):
        assert decided(key, made_up(jaw_pose=pose, held_out=1))[0] is False
        assert decided(key, made_up(jaw_pose=pose))[0] is True


@pytest.mark.parametrize(("key", "name"), [("geometry.learn_jaw", "jaw_pose"), ("geometry.learn_eyes", "eyes_pose")])
def test_joints_that_were_not_tracked_are_held(key, name):
    """Constant, whatever the value, is held; a third of a degree is learned. Another joint's motion changes nothing."""
    width = 6 if name == "eyes_pose" else 3
    other = {"neck_pose": turned(1, 0, 10, 20)}
    assert decided(key, made_up(**{name: turned(0, 8, 8, 8, width=width)}, **other))[0] is False
    assert decided(key, made_up(**{name: turned(width - 1, 8, 8.5, 8, width=width)}, **other))[0] is True


def test_static_captures_have_no_offset_net():
    """One timestep; or several in which nothing but the head as a whole moves."""
    key = "appearance.offset_net.enabled"
    assert decided(key, made_up(n_timesteps=1)) == (
        False,
        "no OffsetNet: one timestep (--appearance.offset-net.enabled)",
    )
    still = {"rotation": turned(1, 0, 10, 20), "translation": [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]}
    assert decided(key, made_up(**still))[0] is False
    assert decided(key, made_up(expr=[[0, 0, 0], [2, 0, 0], [0, 0, 0]]))[0] is True
    assert decided(key, made_up(neck_pose=turned(1, 0, 1, 0)))[0] is True
    assert decided(key, made_up(neck_pose=turned(1, 0, 0.3, 0)))[0] is False


def test_expressions_count_as_far_as_they_are_seen():
    """The same motion, in images with pixels of 2 mm and of 0.02 mm; the reason says how many pixels it is."""
    head = tiny_head()
    subjects = [made_up(focal=focal, expr=[[0, 0, 0], [0.01, 0, 0], [0, 0, 0]]) for focal in (500.0, 50_000.0)]
    first = head.shapedirs[:, :, head.n_shape]
    motion = 0.01 * 2 / 3 * np.linalg.norm(first, axis=1).max()
    answers = [decided("appearance.offset_net.enabled", subject) for subject in subjects]
    assert [found for found, _ in answers] == [motion * 500.0 > 0.5, motion * 50_000.0 > 0.5] == [False, True]
    assert f"expressions move {motion * 50_000.0:.1f} px" in answers[1][1]


@pytest.mark.parametrize(
    ("cameras", "turns", "colors", "frame"),
    [
        ((-40.0, 0.0, 40.0), (0, 0, 0), "color_net", "canonical"),
        ((-12.0, 0.0, 12.0), (0, 0, 0), "color_net", "canonical"),
        ((-8.0, 0.0, 8.0), (0, 0, 0), "color_net", "none"),
        ((-1.0, 1.0), (0, 0, 0), "sh", "none"),
        ((25.0,), (0, 0, 0), "sh", "none"),
        ((0.0,), (-20, 0, 20), "color_net", "canonical"),
        ((0.0,), (-5, 0, 5), "color_net", "none"),
        ((0.0, 180.0), (0, 0, 0), "color_net", "canonical"),
    ],
)
@pytest.mark.parametrize("joint", ["rotation", "neck_pose"])
def test_colours_go_by_the_spread_of_directions(cameras, turns, colors, frame, joint):
    """Cameras and head motion together: what counts is where the head is seen from, in its own frame."""
    subject = made_up(cameras=cameras, **{joint: turned(1, *turns)})
    assert decided("appearance.colors", subject)[0] == colors
    found, said = decided("appearance.color_net.view_frame", subject)
    assert found == frame
    assert bool(said) is (colors == "color_net")


def test_a_camera_that_turns_with_the_head_has_one_direction():
    """The head turns by 30 degrees and the camera follows: nothing of the head is seen from another side."""
    subject = made_up(cameras=(0.0, 30.0), n_timesteps=2, rotation=turned(1, 0, 30))
    follows = tuple(frame for frame in subject.frames["train"] if frame.camera_id == frame.timestep)
    subject = dataclasses.replace(subject, frames={**subject.frames, "train": follows})
    resolved, _ = plan(from_dict(EVERYTHING, FitConfig), tiny_head(), subject)
    assert resolved.appearance.colors == "sh"
    assert resolved.appearance.sh.degree == 0


def test_one_colour_a_gaussian_only_where_the_plan_says_so():
    """Harmonics that the user asks for keep their degree."""
    subject = made_up(cameras=(0.0,))
    resolved, _ = plan(from_dict({"appearance": {"colors": "sh"}}, FitConfig), tiny_head(), subject)
    assert resolved.appearance.sh.degree == FitConfig().appearance.sh.degree == 3
    resolved, _ = plan(from_dict(EVERYTHING, FitConfig), tiny_head(), made_up())
    assert resolved.appearance.sh.degree == 3


@pytest.mark.parametrize(
    ("focal", "cells", "levels"), [(500.0, 110, 7), (250.0, 55, 5), (50.0, 16, 1), (1e6, 4096, 16)]
)
def test_hash_cells_are_as_fine_as_pixels(focal, cells, levels):
    """The ball's box is 0.22 m with its margin; a pixel is 1 / focal; levels grow by at most 1.45, as the paper's."""
    assert decided("appearance.color_net.max_resolution", made_up(focal=focal))[0] == pytest.approx(cells, abs=1)
    found, said = decided("appearance.color_net.levels", made_up(focal=focal))
    assert found == levels
    assert f"{levels} hash levels" in said


@pytest.mark.parametrize(("given", "levels"), [(4096, 16), (512, 11), (16, 1)])
def test_hash_levels_follow_a_given_resolution(given, levels):
    """The paper's 16 levels are what its 16 to 4096 cells ask for."""
    assert decided("appearance.color_net.levels", made_up(), color_net={"max_resolution": given})[0] == levels


@pytest.mark.parametrize(
    ("focal", "size", "side"), [(200.0, 64, 35), (450.0, 64, 80), (600.0, 128, 106), (2000.0, 256, 354)]
)
def test_uv_maps_have_about_a_texel_a_pixel(focal, size, side):
    """A ball of radius 0.1 m covers pi (0.1 focal)^2 pixels; the next of 64, 128 and 256 is taken."""
    found, said = decided("appearance.offset_net.resolution", made_up(focal=focal, jaw_pose=turned(0, 0, 9, 0)))
    assert found == size
    stated = int(re.search(r"(\d+) x", said)[1])
    assert stated == pytest.approx(side, rel=0.05)  # the mesh is smaller than the ball around it


def test_what_takes_no_part_is_resolved_without_a_word():
    """Maps of a network that is left out, levels of a grid that is not there, rates of a stage that is switched off."""
    config = from_dict(EVERYTHING, FitConfig)
    config = dataclasses.replace(config, geometry=dataclasses.replace(config.geometry, enabled=False))
    resolved, decisions = plan(config, tiny_head(), made_up(cameras=(0.0,), n_timesteps=1))
    assert "auto" not in to_toml(resolved)
    assert [decision.key for decision in decisions] == [
        "geometry.subdivisions",
        "appearance.colors",
        "appearance.offset_net.enabled",
    ]


def test_head_tuning_is_told_what_it_holds():
    """Jaw and eyes matter to it even without a geometry stage; offsets by pose do not."""
    config = from_dict(EVERYTHING | {"appearance": {"head_tuning": {"enabled": True}}}, FitConfig)
    config = dataclasses.replace(config, geometry=dataclasses.replace(config.geometry, enabled=False))
    _, decisions = plan(config, tiny_head(), made_up())
    assert [decision.key for decision in decisions] == [
        "geometry.subdivisions",
        "geometry.learn_jaw",
        "geometry.learn_eyes",
    ]


def test_a_head_without_expressions():
    """There is nothing to move it."""
    ball = tiny_head()
    plain = dataclasses.replace(ball, shapedirs=ball.shapedirs[:, :, : ball.n_shape], n_expr=0)
    assert decided("appearance.offset_net.enabled", made_up(expr=np.eye(3)), plain)[0] is False
