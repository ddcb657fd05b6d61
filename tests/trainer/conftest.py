"""A scene of ten 32x24 views, shared by the tests of the reference trainer."""

from __future__ import annotations

import dataclasses

import pytest

from skipgs_plug.trainer import Scene, TrainConfig, Trainer
from skipgs_plug.trainer.scene import BLACK
from skipgs_plug.trainer.synthetic import make_scene


@pytest.fixture(scope="session")
def tiny_scene() -> Scene:
    return make_scene(n_views=10, width=32, height=24, n_points=160)


@pytest.fixture
def opaque_scene(tiny_scene: Scene) -> Scene:
    """The same photographs, in which no colour is known to lie behind the scene."""
    return dataclasses.replace(tiny_scene, background=BLACK)


@pytest.fixture
def tiny_config() -> TrainConfig:
    # Milestones are given for 30,000 iterations. Here, densification ends at 30, and the SH degree rises every 10.
    return TrainConfig(max_steps=60, refine_every=4, sh_degree_interval=5000)


@pytest.fixture
def trainer(tiny_scene: Scene, tiny_config: TrainConfig) -> Trainer:
    return Trainer(tiny_config, tiny_scene)
