"""Nerfstudio's models as hosts: a model whose outputs are known, and the real NeuS and nerfacto."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest
import torch
import trimesh
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.fields import sdf_field
from nerfstudio.models.base_model import Model, ModelConfig
from nerfstudio.scripts.exporter import ExportPointCloud
from nerfstudio.utils import external
from torch import nn
from torch.nn.functional import normalize

from neilfpp_method.data.views import Normalization
from neilfpp_method.effects import review
from neilfpp_method.errors import UserError
from neilfpp_method.hosts import proxy
from neilfpp_method.hosts.nerfstudio import NerfstudioHost
from neilfpp_method.plugin import foreign
from neilfpp_method.plugin import steps as plugin_steps
from neilfpp_method.plugin.foreign import build_foreign
from neilfpp_method.schedule import Stage
from neilfpp_method.structures import RayBatch
from neilfpp_method.train.optimizer import seed_step
from neilfpp_method.train.run import run_folder
from tests.data.make_capture import make_capture
from tests.scenes import sphere_batch
from tests_nerfstudio.runs import checkpoint, ns_train, small_settings, trainer_config, weights


@pytest.fixture(autouse=True)
def few_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measurements with few rays: NeuS takes half a minute for 512 rays on a busy core."""
    monkeypatch.setattr(proxy, "EXPLORING_BATCHES", 1)
    monkeypatch.setattr(proxy, "EXPLORING_RAYS", 16)
    monkeypatch.setattr(plugin_steps, "CHECKED_PIXELS", 16)
    monkeypatch.setattr(review, "LIGHT_PIXELS", 16)


CENTER, RADIUS = torch.tensor([4.0, -2.0, 1.0]), 1.5
DRAWN = 0.5


class Ball(Model):
    """A ball around CENTER with normals and a single grey value; a ray that misses it has no weight."""

    def populate_modules(self) -> None:
        self.gray = nn.Parameter(torch.tensor(DRAWN))
        self.fixed = nn.Parameter(torch.zeros(1), requires_grad=False)

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {"fields": [self.gray, self.fixed]}

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, torch.Tensor]:
        start = ray_bundle.origins - CENTER
        b = (start * ray_bundle.directions).sum(-1, keepdim=True)
        root = b**2 - start.square().sum(-1, keepdim=True) + RADIUS**2
        hit = (root > 0).float()
        distance = -b - root.clamp_min(0).sqrt()
        normal = hit * (start + distance * ray_bundle.directions) / RADIUS
        return {
            "rgb": self.gray.expand_as(normal),
            "accumulation": hit,
            "depth": distance / ray_bundle.metadata["directions_norm"],
            "normal": 0.3 * normal,
        }


class ColorCodedBall(Ball):
    """Outputs like those of nerfacto: normals as colours, and a depth without gradient in addition to the
    expected depth.
    """

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, torch.Tensor]:
        outputs = super().get_outputs(ray_bundle)
        outputs["expected_depth"], outputs["depth"] = outputs["depth"], outputs["depth"] + 1.0
        outputs["normals"] = (normalize(outputs.pop("normal"), dim=-1) + 1.0) / 2.0
        return outputs


def ball(kind: type[Model] = Ball) -> Model:
    return kind(ModelConfig(), SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])), num_train_data=1)


def rays() -> RayBatch:
    """Rays towards the scene's origin from three sides, and one that misses everything."""
    origins = torch.tensor([[0.0, 0.0, 3.0], [2.0, 1.0, 0.5], [-1.0, 2.0, -2.0], [0.0, 0.0, 3.0]])
    targets = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.1, 0.1], [0.2, 0.0, 0.0], [9.0, 0.0, 3.0]])
    return RayBatch(origins, normalize(targets - origins, dim=-1))


@pytest.mark.parametrize("kind", [Ball, ColorCodedBall])
def test_hits_are_in_the_scene_frame(kind: type[Model]) -> None:
    # In the scene frame the ball is the sphere of radius RADIUS / 3 about the origin.
    host = NerfstudioHost(ball(kind), frame=Normalization(3.0, tuple(CENTER.tolist())))
    hits = host.render(rays())
    hit = slice(0, 3)
    torch.testing.assert_close(hits.position[hit].norm(dim=-1), torch.full((3,), RADIUS / 3.0))
    torch.testing.assert_close(hits.normal[hit], normalize(hits.position[hit], dim=-1), atol=1e-5, rtol=0)
    along = (hits.position[hit] - rays().origins[hit]) / (hits.position[hit] - rays().origins[hit]).norm(
        dim=-1
    )[:, None]
    torch.testing.assert_close(along, rays().directions[hit], atol=1e-5, rtol=0)
    assert hits.opacity.tolist() == [1.0, 1.0, 1.0, 0.0]
    assert not hits.normal[3].any()
    assert hits.is_hit(0.8).tolist() == [True, True, True, False]


def test_rendered_colors_become_linear_radiance() -> None:
    # sRGB 0.5 is ((0.5 + 0.055) / 1.055) ** 2.4 = 0.2140 linear.
    assert NerfstudioHost(ball()).render(rays()).color[0, 0].item() == pytest.approx(0.2140, abs=1e-4)
    linear = NerfstudioHost(ball(), response="linear", radiance_scale=4.0)
    assert linear.render(rays()).color[0, 0].item() == pytest.approx(2.0)


def test_gradients_reach_only_the_trained_parameters() -> None:
    host = NerfstudioHost(ball())
    host.render(rays()).color.sum().backward()
    assert host.model.gray.grad.abs() > 0
    assert host.parameter_groups()["geometry"] == [host.model.gray]


@pytest.mark.parametrize(
    ("outputs", "remedy"),
    [
        ("rgb", "renders a color"),
        ("accumulation", "sum of its weights"),
        ("depth", "depth"),
        ("normal", "predict_normals"),
    ],
)
def test_a_missing_output_is_named_with_its_remedy(outputs: str, remedy: str) -> None:
    class Without(Ball):
        def get_outputs(self, ray_bundle: RayBundle) -> dict[str, torch.Tensor]:
            return {name: value for name, value in super().get_outputs(ray_bundle).items() if name != outputs}

    with pytest.raises(UserError, match=f"Without gives no output.*'{outputs}'.*{remedy}"):
        NerfstudioHost(ball(Without)).render(rays())


# ------------------------------------------------------------------------------------- hosts that people have

ARGUMENTS = {
    "scene_box": SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])),
    "num_train_data": 1,
    "metadata": {},
    "device": "cpu",
    "grad_scaler": None,
    "seed_points": None,
}


def test_the_initial_sphere_of_neus_is_rendered() -> None:
    torch.manual_seed(0)
    host = NerfstudioHost(build_foreign("neus", ARGUMENTS).model).eval()
    hits = host.render(
        RayBatch(torch.tensor([[0.0, 0.0, 3.0], [0.0, 3.0, 0.0]]), torch.tensor([[0, 0, -1.0], [0, -1.0, 0]]))
    )
    # NeuS is a blurred sphere at first: the hit lies before its centre, and the normal looks back along the
    # ray.
    assert (hits.position.norm(dim=-1) < 1.0).all()
    assert ((hits.normal * torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])).sum(-1) > 0.9).all()
    torch.testing.assert_close(hits.normal.norm(dim=-1), torch.ones(2))


@pytest.mark.parametrize(("name", "own"), [("neus", "eikonal"), ("nerfacto", "interlevel")])
def test_own_losses_are_computed_if_the_host_is_trained(name: str, own: str) -> None:
    torch.manual_seed(0)
    host = NerfstudioHost(build_foreign(name, ARGUMENTS).model, own_losses=True).train()
    batch = sphere_batch(8)
    term = host.render_regularized(batch, {"volume"}).terms["own"].mean()
    term.backward()
    assert term.isfinite()
    assert term > 0.0, own
    assert any(p.grad is not None and p.grad.any() for p in host.parameters())
    with torch.no_grad():
        assert not host.render_regularized(batch, {"volume"}).terms
    assert not host.eval().render_regularized(batch, {"volume"}).terms


def test_the_weight_of_a_hosts_own_losses_is_a_setting(tmp_path: Path) -> None:
    config = trainer_config(make_capture(tmp_path), tmp_path, small_settings(), host="neus")
    config.pipeline.datamanager.data = tmp_path

    def losses(weight: float) -> dict[str, float]:
        config.pipeline.model.host_losses = weight
        pipeline = config.pipeline.setup(device="cpu")
        seed_step(0, 0)
        return {name: loss.item() for name, loss in pipeline.get_train_loss_dict(0)[1].items()}

    usual, half, none = losses(1.0), losses(0.5), losses(0.0)
    assert usual["own"] > 0.0
    assert half == pytest.approx({**usual, "own": 0.5 * usual["own"]})
    assert "own" not in none
    assert none["eikonal"] > 0.0, "ours stands in for it"


@pytest.mark.parametrize(
    ("name", "words"), [("splatfacto", "not render all"), ("tensorf", "not render all"), ("vrml", "no such")]
)
def test_what_cannot_be_a_host_is_refused(name: str, words: str) -> None:
    with pytest.raises(UserError, match=rf"no host '{name}': .*{words}.*nerfacto, .*, neus-facto$"):
        build_foreign(name, ARGUMENTS)


def test_the_hosts_are_the_methods_that_can_render_and_train_as_hosts(monkeypatch) -> None:
    def works(name: str) -> bool:
        try:
            host = NerfstudioHost(build_foreign(name, ARGUMENTS).model, own_losses=True).train()
            own = host.render_regularized(sphere_batch(4), {"volume"}).terms["own"].mean()
        except (AssertionError, ImportError, KeyError, OSError, UserError):
            # Besides missing outputs: semantics and depths that are not there, and kernels for a GPU.
            return False
        return bool(own.isfinite())

    rendering = [
        name
        for name, method in method_configs.items()
        if isinstance(method.pipeline.datamanager, VanillaDataManagerConfig)
    ]
    hosts = foreign.HOSTS
    monkeypatch.setattr(foreign, "HOSTS", rendering)
    assert [name for name in rendering if works(name)] == [name for name in rendering if name in hosts]
    assert set(hosts) <= set(rendering)


def test_a_host_without_its_hash_grid_is_refused(monkeypatch) -> None:
    monkeypatch.setattr(sdf_field, "tcnn", external.tcnn)
    monkeypatch.setattr(external, "TCNN_EXISTS", False)
    for found, remedy in ((False, "needs a CUDA device"), (True, "install it")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda found=found: found)
        with pytest.raises(UserError, match=rf"host neus needs tiny-cuda-nn .*; .*{remedy}.*nerfacto"):
            build_foreign("neus", ARGUMENTS)


@pytest.mark.parametrize("name", ["neus", "nerfacto"])
def test_the_stages_run_on_a_method_of_nerfstudio(name: str, tmp_path: Path) -> None:
    settings = small_settings(sdf_steps=2, material_steps=4, joint_steps=1)
    settings = dataclasses.replace(settings, shading=dataclasses.replace(settings.shading, hit_share=0.05))
    data = make_capture(tmp_path / "capture", size=(8, 6), test=(0, 1))
    ends = []
    for stage, steps in ((Stage.SDF_INIT, 2), (Stage.MATERIAL_INIT, 6), (Stage.JOINT, 7)):
        config = trainer_config(data, tmp_path / stage.value, settings, host=name)
        config.max_num_iterations = steps
        run = ns_train(config)
        assert checkpoint(run)["step"] == steps - 1
        ends.append(weights(run))

    def moved(before: dict, after: dict, prefix: str) -> bool:
        return any(not torch.equal(before[key], after[key]) for key in before if key.startswith(prefix))

    first, second, third = ends
    # Material init does not change the host; the joint stage trains both.
    assert not moved(first, second, "host.inner.model.field")
    assert moved(first, second, "brdf.")
    assert moved(first, second, "light.log_radiance"), "a map is solved for, as on our own hosts"
    assert moved(second, third, "host.inner.model.field")
    assert moved(second, third, "brdf.")
    boxes = [key for key in first if key.endswith("field.aabb")]
    assert boxes
    assert all(torch.equal(first[key], third[key]) for key in boxes), "what the model never trains stays"
    kept = checkpoint(run)["pipeline"]
    assert kept["_model.proxy.points._extra_state"]["filled"] > 0, "rays between surfaces go to a proxy"
    assert kept["_model.proxy._extra_state"]["steps"] == 7


def test_a_foreign_host_logs_the_proxy_and_unsupported_commands(tmp_path: Path, capsys) -> None:
    settings = small_settings(sdf_steps=1, material_steps=1, joint_steps=0)
    data = make_capture(tmp_path / "capture", size=(8, 6), test=(0, 1))
    run = ns_train(trainer_config(data, tmp_path / "run", settings, host="neus"))
    # The log puts the place in the code at the end of the first line of a message.
    said = " ".join(re.sub(r"\S+\.py:\d+", "", capsys.readouterr().out).split())
    assert "a proxy of its surface that is built from the training rays" in said
    assert "no run folder for the neilfpp commands: the host neus belongs to nerfstudio" in said
    with pytest.raises(UserError, match="no run folder neilfpp/ beside it"):
        run_folder(run / "config.yml")
    ExportPointCloud(
        run / "config.yml", tmp_path, num_points=20, num_rays_per_batch=64, remove_outliers=False
    ).main()
    assert len(trimesh.load(tmp_path / "point_cloud.ply").vertices) >= 20
