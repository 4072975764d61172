"""Where the runs of a tradeoff are trained: the options `--device` and `--slurm`."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping

import torch

from neilfpp_method.errors import UserError

__all__ = ["parse_devices", "parse_slurm", "visible_gpu"]

VISIBLE_DEVICES = "CUDA_VISIBLE_DEVICES"
"""Environment variable that selects the GPUs that a process sees."""
ONE_PROCESS = ("nodes", "ntasks_per_node", "tasks_per_node")
"""Slurm parameters that would start more than one process for a run."""
LIST_PARAMETERS = ("setup", "teardown", "srun_args")
"""Parameters of submitit that are lists."""


def parse_devices(text: str) -> tuple[str, ...]:
    """The devices of `--device`, such as `cuda:0,cuda:1`. A single one is not checked here.

    Raises:
        UserError: if one of several is unknown or missing, a GPU occurs twice, or CPUs and GPUs are mixed.
    """
    devices = tuple(word.strip() for word in text.split(","))
    if len(devices) == 1:
        return devices
    for device in devices:
        if not re.fullmatch(r"cpu|cuda:\d+", device):
            raise UserError(f"--device {text}: '{device}' is not a single device", "use cuda:0,cuda:1")
    gpus = [device for device in devices if device != "cpu"]
    if gpus and len(gpus) < len(devices):
        raise UserError(
            f"--device {text}: runs on a CPU and on a GPU cannot be compared by time", "use one kind"
        )
    if len(set(gpus)) < len(gpus):
        raise UserError(
            f"--device {text}: a GPU occurs twice, and two runs at a time would slow each other down",
            "name each GPU once",
        )
    for gpu in gpus:
        if int(gpu.removeprefix("cuda:")) >= torch.cuda.device_count():
            raise UserError(
                f"no device '{gpu}' here, there are {torch.cuda.device_count()} GPUs",
                "name GPUs from cuda:0 on, or use cpu",
            )
        visible_gpu(gpu)
    return devices


def visible_gpu(device: str) -> int:
    """The number of a GPU such as `cuda:1` for `CUDA_VISIBLE_DEVICES` of another process.

    Raises:
        UserError: if that variable of this process has names in place of numbers.
    """
    number = int(device.removeprefix("cuda:"))
    visible = os.environ.get(VISIBLE_DEVICES, "").replace(" ", "")
    if not visible:
        return number
    names = visible.split(",")
    if number >= len(names) or not names[number].isdigit():
        raise UserError(
            f"{device}: {VISIBLE_DEVICES} is {visible}", f"set {VISIBLE_DEVICES} to numbers that include it"
        )
    return int(names[number])


def parse_slurm(text: str) -> dict[str, object]:
    """The parameters of `--slurm`, such as `partition=gpu,gpus_per_node=1`; numbers and booleans are
    converted.

    Raises:
        UserError: if an entry has no value or occurs twice, or would start several processes.
    """
    found: dict[str, object] = {}
    for entry in text.split(","):
        name, equals, value = (part.strip() for part in entry.partition("="))
        if not (name and equals and value):
            raise UserError(f"--slurm {text}: '{entry}' is not NAME=VALUE", "use --slurm partition=gpu")
        name = name.replace("-", "_")
        if name in found:
            raise UserError(f"--slurm {text}: {name} occurs twice", "give it once")
        found[name] = _value(name, value)
    _check_one_process(found)
    return found


def _value(name: str, value: str) -> object:
    if name in LIST_PARAMETERS:
        return [value]
    if value in ("true", "false"):
        return value == "true"
    if name == "mem_gb" and re.fullmatch(r"\d+\.\d+", value):
        return float(value)
    return int(value) if re.fullmatch(r"\d+", value) else value


def _check_one_process(parameters: Mapping[str, object]) -> None:
    for name in ONE_PROCESS:
        if parameters.get(name, 1) != 1:
            raise UserError(f"--slurm: a run is one process, not {name}={parameters[name]}", "leave it out")
