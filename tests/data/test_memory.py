"""Free memory according to the system and its control groups, and the error if something does not fit."""

from __future__ import annotations

from pathlib import Path

import pytest

from neilfpp_method.data import memory
from neilfpp_method.data.memory import available_memory, check_memory
from neilfpp_method.errors import UserError

GIB = 2**30


@pytest.fixture(autouse=True)
def _no_limit_of_its_own(monkeypatch) -> None:
    monkeypatch.setattr(memory.resource, "getrlimit", lambda kind: (memory.resource.RLIM_INFINITY,) * 2)


def system(root: Path, free: int, group: str = "") -> Path:
    (root / "self").mkdir(parents=True)
    (root / "meminfo").write_text(f"MemTotal: 99999999 kB\nMemAvailable: {free // 1024} kB\n")
    (root / "self" / "cgroup").write_text(f"0::/{group}\n")
    return root


def group(folder: Path, limit: int | str, used: int, inactive: int = 0) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "memory.max").write_text(f"{limit}\n")
    (folder / "memory.current").write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"anon 5\ninactive_file {inactive}\n")


def test_without_groups_the_system_decides(tmp_path: Path) -> None:
    assert available_memory(system(tmp_path / "proc", 6 * GIB), tmp_path / "none") == 6 * GIB


def test_the_narrowest_group_decides(tmp_path: Path) -> None:
    proc = system(tmp_path / "proc", 20 * GIB, "outer/inner")
    group(tmp_path / "groups" / "outer", 8 * GIB, 3 * GIB, inactive=GIB)
    group(tmp_path / "groups" / "outer" / "inner", "max", 2 * GIB)
    assert available_memory(proc, tmp_path / "groups") == 6 * GIB
    group(tmp_path / "groups" / "outer" / "inner", 3 * GIB, 2 * GIB)
    assert available_memory(proc, tmp_path / "groups") == GIB


def test_groups_of_version_1(tmp_path: Path) -> None:
    proc, folder = system(tmp_path / "proc", 20 * GIB), tmp_path / "groups" / "memory"
    folder.mkdir(parents=True)
    (folder / "memory.limit_in_bytes").write_text(str(4 * GIB))
    (folder / "memory.usage_in_bytes").write_text(str(3 * GIB))
    (folder / "memory.stat").write_text(f"total_inactive_file {GIB}\n")
    assert available_memory(proc, tmp_path / "groups") == 2 * GIB
    (folder / "memory.limit_in_bytes").write_text(str(2**63 - 4096))  # no limit
    assert available_memory(proc, tmp_path / "groups") == 20 * GIB


def test_other_systems_report_nothing(tmp_path: Path) -> None:
    assert available_memory(tmp_path / "none", tmp_path / "none") is None


def test_a_limit_of_the_process(tmp_path: Path, monkeypatch) -> None:
    proc = system(tmp_path / "proc", 20 * GIB)
    (proc / "self" / "status").write_text(f"Name: python\nVmSize: {GIB // 1024} kB\n")
    monkeypatch.setattr(memory.resource, "getrlimit", lambda kind: (3 * GIB, 3 * GIB))
    assert available_memory(proc, tmp_path / "none") == 2 * GIB


def test_too_little_memory_is_an_error_of_one_line() -> None:
    check_memory(GIB, "the pixels", "take fewer", free=GIB)
    with pytest.raises(UserError) as told:
        check_memory(5 * GIB, "the pixels", "take fewer", free=2 * GIB)
    assert str(told.value) == "the pixels need about 5.4 GB of memory, and 2.1 GB are free; take fewer"
