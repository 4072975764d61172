"""Provenance of a run: command line, versions and hardware."""

from __future__ import annotations

import os
import platform
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

__all__ = ["processor_name", "provenance"]

PACKAGES = (
    "neilfpp-method",
    "torch",
    "lightning-fabric",
    "numpy",
    "opencv-contrib-python-headless",
    "OpenEXR",
    "trimesh",
    "scikit-image",
)
"""Packages whose versions are recorded."""


def provenance() -> dict[str, Any]:
    """Command line, versions and hardware, for the record of a run."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed as a package"
    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return {
        "command": sys.argv,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": processor_name(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "gpus": gpus,
        "packages": versions,
    }


def processor_name() -> str:
    """Model name of the processor."""
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
