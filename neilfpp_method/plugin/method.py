"""The methods `neilfpp` and `neilfpp-mesh` of `ns-train`."""

from __future__ import annotations

from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from neilfpp_method.model import EVAL_RAYS
from neilfpp_method.plugin.datamanager import CaptureDataManagerConfig
from neilfpp_method.plugin.dataparser import CaptureParserConfig
from neilfpp_method.plugin.model import FieldAdamConfig, NeilfMethodConfig
from neilfpp_method.schedule import GEOMETRY, MATERIAL, total_steps
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import fixed_geometry, preset
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["neilfpp", "neilfpp_mesh"]


def trainer(name: str, settings: NeilfConfig) -> TrainerConfig:
    """The configuration of nerfstudio's trainer that corresponds to settings of this package."""
    loop = settings.train
    return TrainerConfig(
        method_name=name,
        max_num_iterations=total_steps(loop),
        steps_per_save=loop.checkpoint_every,
        steps_per_eval_image=loop.checkpoint_every,
        pipeline=VanillaPipelineConfig(
            datamanager=CaptureDataManagerConfig(
                dataparser=CaptureParserConfig(),
                train_num_rays_per_batch=loop.rays,
                eval_num_rays_per_batch=loop.rays,
            ),
            model=NeilfMethodConfig(neilf=settings, eval_num_rays_per_chunk=EVAL_RAYS),
        ),
        # Learning rates come from `pipeline.model.neilf.optimizer` and are set in each step.
        optimizers={
            field: {"optimizer": FieldAdamConfig(name=field), "scheduler": None}
            for field in sorted(GEOMETRY | MATERIAL)
        },
        viewer=ViewerConfig(num_rays_per_chunk=EVAL_RAYS),
        vis="viewer",
    )


neilfpp = MethodSpecification(
    trainer("neilfpp", changed(preset("fast"), {"train.pose_fits": 0})),
    "NeILF++: geometry, material and incident light by inter-reflectable light fields.",
)
neilfpp_mesh = MethodSpecification(
    trainer("neilfpp-mesh", fixed_geometry(preset("fast"))),
    "NeILF++ on a given mesh: material and incident light.",
)
