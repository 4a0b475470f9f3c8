import pytest
import torch

from rgbavatar_ns.head import HeadModel


@pytest.fixture(scope="session")
def head() -> HeadModel:
    return HeadModel.embedded(dtype=torch.float64)
