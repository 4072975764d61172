"""Shapes are checked in the first calls of a test and in a share of the later ones."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from beartype import beartype
from jaxtyping import Float, TypeCheckError
from torch import Tensor

from neilfpp_method.shading.frame import dot
from tests.shape_checks import EVERY, FIRST, jaxtyped, start_test

WRONG = torch.zeros(2, 2)


@jaxtyped(typechecker=beartype)
def twice(x: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    return 2 * x


@jaxtyped(typechecker=beartype)
@dataclass
class Values:
    x: Float[Tensor, " N"]


def is_checked(function) -> bool:
    try:
        function(WRONG)
    except TypeCheckError:
        return True
    return False


@pytest.mark.parametrize("function", [twice, Values])
def test_which_calls_are_checked(function):
    calls = range(1, 2 * FIRST + 1)
    expected = [call <= FIRST or call % EVERY == 0 for call in calls]
    assert [is_checked(function) for _ in calls] == expected
    start_test()
    assert is_checked(function)


def test_functions_of_the_package_are_checked():
    with pytest.raises(TypeCheckError):
        dot(torch.zeros(2, 3), torch.zeros(4))
