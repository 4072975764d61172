"""The table of optional methods agrees with the contract and with docs/hosts.md."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path

import pytest

from neilfpp_method.hosts import base
from neilfpp_method.hosts.capabilities import CAPABILITIES, Capability, markdown

DOCUMENT = Path(__file__).parents[2] / "docs" / "hosts.md"
REQUIRED = {"Host", "ImageHost", "RegularizedHits"}


def test_every_optional_part_of_the_contract_is_in_the_table_once():
    assert sorted(c.protocol.__name__ for c in CAPABILITIES) == sorted(set(base.__all__) - REQUIRED)


@pytest.mark.parametrize("capability", CAPABILITIES, ids=lambda c: c.method)
def test_a_row_names_the_method_of_the_protocol_and_its_user(capability: Capability):
    own = {*vars(capability.protocol), *capability.protocol.__annotations__}
    assert capability.method in own
    asks = inspect.getsource(importlib.import_module(f"neilfpp_method.{capability.module}"))
    assert capability.protocol.__name__ in asks


def test_the_table_of_the_docs_is_up_to_date():
    assert markdown() in DOCUMENT.read_text(), "python -m neilfpp_method.hosts.capabilities prints it"
