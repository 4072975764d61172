"""The processes of a training: one per device, on one machine or on several."""

from __future__ import annotations

import logging
import os

import torch
from lightning_fabric import Fabric
from lightning_fabric.strategies import DDPStrategy

from neilfpp_method.errors import UserError

__all__ = ["launch"]


def launch(device: torch.device, devices: int, nodes: int) -> Fabric:
    """Start the processes of the training.

    Args:
        device: where to compute.
        devices: processes per machine.
        nodes: machines; with more than one, torchrun must have started this process on each.

    Raises:
        UserError: if the numbers do not fit the machine, or what torchrun started.
    """
    if devices < 1:
        raise UserError(f"--devices is {devices}", "set it to 1 or more")
    if nodes < 1:
        raise UserError(f"--nodes is {nodes}", "set it to 1 or more")
    _check_torchrun(devices, nodes)
    if device.type == "cuda" and devices > (torch.cuda.device_count() if device.index is None else 1):
        raise UserError(
            f"--device {device} has fewer than {devices} GPUs",
            "use --device cuda, and --devices up to the number of GPUs",
        )
    # Its hint on GPUs, to multiply matrices in TF32, would roughen the normals of the surface.
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    fabric = Fabric(
        accelerator=device.type,
        devices=devices if device.index is None else [device.index],
        num_nodes=nodes,
        strategy=DDPStrategy(find_unused_parameters=True) if devices * nodes > 1 else "auto",
    )
    fabric.launch()
    return fabric


def _check_torchrun(devices: int, nodes: int) -> None:
    """Check that torchrun, if it started this process, started as many as the options say.

    Raises:
        UserError: if it did not, or if there are several nodes and no torchrun.
    """
    started = int(os.environ.get("WORLD_SIZE", "1")) if "TORCHELASTIC_RUN_ID" in os.environ else None
    if started is None and nodes > 1:
        raise UserError(
            f"--nodes {nodes}: one command starts the processes of one machine only",
            "start it with torchrun on each machine (docs/machines.md)",
        )
    if started is not None and started != devices * nodes:
        raise UserError(
            f"torchrun started {started} processes, and --devices {devices} --nodes {nodes} make "
            f"{devices * nodes}",
            "set --devices to torchrun's --nproc-per-node and --nodes to its --nnodes",
        )
