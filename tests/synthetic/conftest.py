import pytest
import torch

from rgbavatar_ns.synthetic import DemoConfig, DemoPerson

SIZE = 96


@pytest.fixture(scope="session")
def person() -> DemoPerson:
    return DemoPerson.of(DemoConfig(image_size=SIZE))


@pytest.fixture(scope="session")
def person_without_glasses() -> DemoPerson:
    return DemoPerson.of(DemoConfig(image_size=SIZE, glasses=False))


@pytest.fixture(scope="session")
def person_without_wrinkles() -> DemoPerson:
    return DemoPerson.of(DemoConfig(image_size=SIZE, wrinkles=0.0))


@pytest.fixture(scope="session")
def theta_of(person):
    """Theta from expression coefficients by name and other fields as lists."""
    layout, names = person.head.layout, person.head.arrays.expression_names

    def make(expression: dict[str, float] | None = None, **fields: list[float]) -> torch.Tensor:
        theta = layout.join({name: torch.tensor(value) for name, value in fields.items()} | zero)
        for name, value in (expression or {}).items():
            theta[names.index(name)] = value
        return theta

    zero = {"expression": torch.zeros(len(names))}
    return make
