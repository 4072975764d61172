"""Backward passes with rounded products: where they are, and what they cost in accuracy."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from neilfpp_method.kernels.process import rounded_products
from neilfpp_method.presets import preset
from neilfpp_method.schedule import Stage, active_losses, weigh
from neilfpp_method.train.loop import seed_step, train
from tests.data.make_capture import make_capture
from tests.scenes import sphere_batch, sphere_model
from tests.train.small_runs import small_config, small_training


@pytest.mark.parametrize(("setting", "expected"), [("exact", "highest"), ("rounded", "medium")])
def test_products_are_rounded_in_backward_passes_alone(tmp_path: Path, setting: str, expected: str):
    capture = make_capture(tmp_path / "sphere")
    training = small_training(capture, tmp_path / "run", small_config(material_steps=1, joint_steps=1, gradients=setting))
    forward, backward = set(), set()
    honest = training.model.losses

    def losses(batch, stage):
        terms = honest(batch, stage)
        forward.add(torch.get_float32_matmul_precision())
        for term in terms.values():
            if term.values.requires_grad:
                term.values.register_hook(lambda gradient: backward.add(torch.get_float32_matmul_precision()))
        return terms

    training.model.losses = losses
    train(training)
    assert forward == {"highest"}
    assert backward == {expected}


def gradient(rounded: bool) -> dict[str, torch.Tensor]:
    """The gradient of a joint step of the paper's networks, by field."""
    config = preset("paper-mlp")
    config = dataclasses.replace(
        config,
        shading=dataclasses.replace(config.shading, train_samples=16, hit_share=0.2),
        volume=dataclasses.replace(config.volume, beta_init=0.02),
    )
    model = sphere_model(config).train()
    model.freeze_for(Stage.JOINT)
    seed_step(0, 0)
    loss = weigh(model.losses(sphere_batch(16), Stage.JOINT), active_losses(Stage.JOINT, config)).loss
    with rounded_products(rounded):
        loss.backward()
    return {
        name: torch.cat([p.grad.flatten() for p in parameters if p.grad is not None])
        for name, parameters in model.parameter_groups().items()
        if name != "beta"
    }


def test_a_rounded_gradient_points_where_the_exact_one_does():
    exact, rounded = gradient(False), gradient(True)
    for name, right in exact.items():
        cosine = torch.nn.functional.cosine_similarity(rounded[name].double(), right.double(), dim=0)
        assert cosine > 0.999, name
        assert (rounded[name].norm() / right.norm()).item() == pytest.approx(1.0, abs=0.02), name
