import copy
from functools import partial

import pytest
import torch
from torch import nn

from rgbavatar_ns.avatar.methods.gaussian_rows import GaussianRows, forget_moments
from rgbavatar_ns.errors import UserError

from .splats import PARAMETERS, Splats, adam, all_equal, everything, learn, moments

SOURCE = torch.tensor([11, 0, 3, 3, 7, 1, 11, 2, 4, 5, 6, 6, 6, 8])
OPTIMIZERS = {
    "fused": lambda p: torch.optim.Adam(p, lr=0.01, fused=True),
    "foreach": lambda p: torch.optim.Adam(p, lr=0.01, foreach=True),
    "plain": lambda p: torch.optim.Adam(p, lr=0.01, foreach=False),
    "amsgrad": lambda p: torch.optim.AdamW(p, lr=0.01, amsgrad=True),
    "momentum": lambda p: torch.optim.SGD(p, lr=0.01, momentum=0.9),
}


@pytest.mark.parametrize("kind", OPTIMIZERS)
def test_taking_rows_commutes_with_a_step(kind):
    first, second = Splats(), Splats()
    names = list(PARAMETERS)
    one, two = (OPTIMIZERS[kind]([s.rows[n] for n in names]) for s in (first, second))
    for splats, optimizer in ((first, one), (second, two)):
        learn(splats, optimizer, 3)
    generator = torch.Generator().manual_seed(7)
    gradients = {n: torch.randn(first.rows[n].shape, generator=generator) for n in names}
    # The fused loops round the last few numbers of a tensor in another way than those before.
    tolerance = 1e-6 if kind == "fused" else 0
    same = partial(torch.testing.assert_close, rtol=tolerance, atol=0)

    for name in names:
        first.rows[name].grad = gradients[name]
    one.step()
    first.rows.take(SOURCE, [one])

    second.rows.take(SOURCE, [two])
    for name in names:
        second.rows[name].grad = gradients[name][SOURCE]
    two.step()

    for name in first.rows.names:
        same(first.rows[name], second.rows[name])
    for name in names:
        states = one.state[first.rows[name]], two.state[second.rows[name]]
        assert states[0].keys() == states[1].keys()
        for key in states[0]:
            same(states[0][key], states[1][key])


def test_all_that_has_rows_is_taken_and_nothing_else():
    splats = Splats()
    optimizer = adam(splats)
    learn(splats, optimizer, 2)
    before = {name: splats.rows[name].detach().clone() for name in splats.rows.names}
    remembered = {n: [m.clone() for m in moments(optimizer, splats.rows[n])] for n in PARAMETERS}
    network = [v.clone() for v in splats.network.parameters()]
    in_network = [m.clone() for p in splats.network.parameters() for m in moments(optimizer, p)]
    fresh = torch.arange(len(SOURCE)) >= 9

    splats.rows.take(SOURCE, [optimizer], fresh)

    assert splats.rows.count == len(SOURCE)
    assert set(splats.rows.names) == {
        *PARAMETERS,
        "triangle_of",
        "statistics.gradient_sum",
        "statistics.times_seen",
    }
    for name, value in before.items():
        assert torch.equal(splats.rows[name], value[SOURCE]), name
    for name, values in remembered.items():
        for value, now in zip(values, moments(optimizer, splats.rows[name])):
            assert torch.equal(now[:9], value[SOURCE[:9]])
            assert not now[9:].any()
    assert all_equal(network, list(splats.network.parameters()))
    assert all_equal(
        in_network, [m for p in splats.network.parameters() for m in moments(optimizer, p)]
    )


def test_parameters_stay_the_same_objects_and_train_on_while_an_old_graph_lives():
    splats = Splats()
    optimizer = adam(splats)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.5)
    parameters = list(splats.parameters())

    def loss() -> torch.Tensor:
        return sum((splats.rows[name].square().sum() for name in PARAMETERS), torch.zeros(()))

    old_loss = loss()
    old_loss.backward()
    optimizer.step()
    splats.rows.take(SOURCE, [optimizer])
    assert all(parameter.grad is None for parameter in splats.parameters() if len(parameter) == 14)

    new_loss = loss()
    optimizer.zero_grad()
    new_loss.backward()
    before = splats.position.detach().clone()
    assert torch.equal(splats.position.grad, 2 * before)
    optimizer.step()
    schedule.step()

    assert [id(p) for p in splats.parameters()] == [id(p) for p in parameters]
    assert [id(g["params"][0]) for g in optimizer.param_groups] == [id(p) for p in parameters]
    assert all(p.is_leaf and p.requires_grad and p.dtype == torch.float32 for p in parameters)
    assert not torch.equal(before, splats.position)
    assert old_loss.grad_fn is not None


def test_a_checkpoint_of_another_number_continues_as_the_uninterrupted_run():
    splats = Splats()
    optimizer = adam(splats)
    learn(splats, optimizer, 2)
    splats.rows.take(SOURCE, [optimizer])
    learn(splats, optimizer, 2, seed=1)
    splats.statistics.times_seen += 3
    stored = {f"method.{name}": value.clone() for name, value in splats.state_dict().items()}
    stored_optimizer = copy.deepcopy(optimizer.state_dict())
    learn(splats, optimizer, 2, seed=2)

    other = Splats(seed=5)
    resumed = adam(other)
    other.rows.fit_to(stored, "method.")
    other.load_state_dict({name.removeprefix("method."): v for name, v in stored.items()})
    resumed.load_state_dict(stored_optimizer)
    learn(other, resumed, 2, seed=2)

    assert other.rows.count == len(SOURCE)
    assert all_equal(everything(splats, optimizer), everything(other, resumed))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda s: s.pop("color"), "has no Gaussians' color"),
        (lambda s: s.update(color=torch.zeros(10**9, 2, 0)), "color are stored in another size"),
        (lambda s: s.update(color=torch.zeros(())), "has no Gaussians' color"),
        (lambda s: s.update(color="red"), "has no Gaussians' color"),
        (lambda s: s.update(color=torch.zeros(0, 2, 3)), "has no Gaussians' color"),
        (lambda s: s.update(color=s["color"][:5]), "color has 5"),
    ],
)
def test_stored_rows_that_do_not_fit_together_are_told(change, told):
    splats = Splats()
    stored = dict(splats.state_dict())
    change(stored)
    before = [value.clone() for value in splats.state_dict().values()]
    with pytest.raises(UserError, match=told):
        splats.rows.fit_to(stored)
    assert all_equal(before, list(splats.state_dict().values()))


def test_what_is_not_stored_gets_rows_too():
    splats = Splats()
    splats.register_buffer("barycentric", torch.ones(12, 3), persistent=False)
    rows = GaussianRows(splats, (*splats.rows.names, "barycentric"))
    rows.fit_to({name: value[:7] for name, value in splats.state_dict().items()})
    assert splats.barycentric.shape == (7, 3)
    assert "barycentric" not in splats.state_dict()


def test_names_that_are_no_rows_are_refused():
    splats = Splats()
    with pytest.raises(ValueError, match=r"no colour\. It has position"):
        GaussianRows(splats, ["colour"])
    splats.extra = nn.Parameter(torch.zeros(3))
    with pytest.raises(ValueError, match="position has 12, extra has 3"):
        GaussianRows(splats, ["position", "extra"])
    with pytest.raises(ValueError, match="differ"):
        GaussianRows(splats, [])


def test_a_tensor_named_twice_is_taken_once():
    splats = Splats()
    rows = GaussianRows(splats, ["triangle_of", "statistics", "statistics.times_seen"])
    rows.take(torch.tensor([1, 2]), [])
    assert splats.triangle_of.tolist() == [1, 2]


def test_the_rows_of_a_copied_module_are_the_copys():
    splats = Splats()
    other = copy.deepcopy(splats)
    other.rows.take(SOURCE, [])
    assert other.rows.count == len(other.position) == len(SOURCE)
    assert splats.rows.count == len(splats.position) == 12


def test_moments_are_forgotten_column_by_column():
    splats = Splats()
    optimizer = adam(splats)
    learn(splats, optimizer, 2)
    before = everything(splats, optimizer)
    kept = [m[:, 2:].clone() for m in moments(optimizer, splats.position)]
    forget_moments(splats.position, [optimizer], slice(0, 2))
    for value, now in zip(kept, moments(optimizer, splats.position)):
        assert torch.equal(now[:, 2:], value)
        assert not now[:, :2].any()
    changed = [not torch.equal(a, b) for a, b in zip(before, everything(splats, optimizer))]
    assert sum(changed) == 2
    forget_moments(nn.Parameter(torch.zeros(3)), [optimizer])
