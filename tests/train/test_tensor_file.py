"""Files of tensors: what `torch.save` writes is read, and files that would take much memory are refused."""

from __future__ import annotations

import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path

import pytest
import torch

from neilfpp_method.train.tensor_file import read_tensor_file


def test_tensors_and_plain_values_are_read(tmp_path: Path) -> None:
    kinds = (torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.bool)
    tensors = {str(kind): torch.ones(2, 3).to(kind) for kind in kinds}
    plain = {"step": 7, "share": 0.5, "name": "x", "none": None, "pair": (True, [1])}
    stored = {**plain, "tensors": OrderedDict(tensors), "weight": torch.nn.Parameter(torch.ones(2))}
    torch.save(stored, tmp_path / "a.pt")
    found = read_tensor_file(tmp_path / "a.pt")
    assert {name: found[name] for name in plain} == plain
    assert torch.equal(found["weight"], stored["weight"])
    for name, tensor in tensors.items():
        assert found["tensors"][name].dtype == tensor.dtype
        assert torch.equal(found["tensors"][name], tensor)


def test_the_state_of_a_training_is_read(tmp_path: Path) -> None:
    model = torch.nn.Sequential(torch.nn.Linear(2, 3), torch.nn.BatchNorm1d(3))
    optimizer = torch.optim.Adam(model.parameters())
    model(torch.ones(4, 2)).sum().backward()
    optimizer.step()
    torch.save([model.state_dict(), optimizer.state_dict(), torch.get_rng_state()], tmp_path / "a.pt")
    found = read_tensor_file(tmp_path / "a.pt")
    assert list(found[0]) == list(model.state_dict())
    assert torch.equal(found[2], torch.get_rng_state())


class Call:
    def __init__(self, function, *arguments) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self):
        return self.function, self.arguments


def write_pickle(path: Path, content: object, protocol: int) -> None:
    """Write a file of `torch.save` with this pickle and no tensors."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.pkl", pickle.dumps(content, protocol))
        archive.writestr("a/version", "3\n")


@pytest.mark.filterwarnings("error")
def test_code_is_not_run(tmp_path: Path) -> None:
    """From protocol 4 on, a pickle may assemble the name of a function from strings.

    Torch's warning about the protocol would be printed before the one line of a command.
    """
    crater = tmp_path / "crater"
    write_pickle(tmp_path / "a.pt", Call(Path.touch, crater), 4)
    with pytest.raises(pickle.UnpicklingError):
        read_tensor_file(tmp_path / "a.pt")
    assert not crater.exists()
    torch.load(tmp_path / "a.pt", weights_only=False)
    assert crater.exists()  # pickle itself runs the code


@pytest.mark.parametrize("call", [Call(bytearray, 1 << 40), Call(torch.UntypedStorage, 1 << 40)])
def test_a_call_that_makes_an_array_of_any_size_is_refused(tmp_path: Path, call: Call) -> None:
    write_pickle(tmp_path / "a.pt", call, 2)
    with pytest.raises(ValueError, match="it refers to"):
        read_tensor_file(tmp_path / "a.pt")


def test_compressed_members_are_refused(tmp_path: Path) -> None:
    """A thousandth of the size of the numbers that torch would unpack."""
    torch.save(torch.zeros(100_000), tmp_path / "a.pt")
    with (
        zipfile.ZipFile(tmp_path / "a.pt") as whole,
        zipfile.ZipFile(tmp_path / "b.pt", "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for member in whole.infolist():
            packed.writestr(member.filename, whole.read(member))
    assert len(torch.load(tmp_path / "b.pt", weights_only=True)) == 100_000
    with pytest.raises(ValueError, match="compressed"):
        read_tensor_file(tmp_path / "b.pt")


def test_members_that_share_bytes_are_refused(tmp_path: Path) -> None:
    """The directory of an archive may list the same bytes many times."""
    torch.save(torch.zeros(100_000), tmp_path / "a.pt")
    with zipfile.ZipFile(tmp_path / "a.pt", "a") as archive:
        archive.filelist += [archive.getinfo("a/data/0")] * 9
        archive.writestr("a/more", "")
    with pytest.raises(ValueError, match="larger than the file"):
        read_tensor_file(tmp_path / "a.pt")
