import pytest
import torch

from rgbavatar_ns.avatar.model import image_loss
from rgbavatar_ns.avatar.model.image_loss import LPIPSLoss, l1_loss
from rgbavatar_ns.errors import UserError


def test_l1_by_hand():
    image = torch.zeros(1, 1, 2, 3)
    target = torch.tensor([[[[0.1, -0.2, 0.3], [0.0, 0.0, 0.6]]]])
    assert l1_loss(image, target).item() == pytest.approx(1.2 / 6)


def test_lpips_without_its_weights_names_the_remedy(monkeypatch):
    def offline(*_args, **_options):
        raise OSError("Name or service not known")

    monkeypatch.setattr("torch.hub.load_state_dict_from_url", offline)
    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", offline)
    loss = LPIPSLoss()
    with pytest.raises(UserError, match=r"LPIPS \(vgg\) is unavailable.*internet"):
        loss(torch.rand(1, 32, 32, 3), torch.rand(1, 32, 32, 3))


def test_lpips_uses_its_network_on_unit_range_images(monkeypatch):
    built = []

    class Squared(torch.nn.Module):
        def forward(self, first, second, normalize):
            assert normalize
            assert first.shape == (2, 3, 4, 5)
            return ((first - second) ** 2).mean((1, 2, 3))

    def build(net):
        built.append(net)
        return Squared()

    monkeypatch.setattr(image_loss, "_build_lpips_network", build)
    loss, image = LPIPSLoss(), torch.full((2, 4, 5, 3), 0.5, requires_grad=True)
    assert built == []
    value = loss(image, torch.zeros(2, 4, 5, 3))
    loss(image, torch.zeros(2, 4, 5, 3))
    assert built == ["vgg"]
    assert value.item() == pytest.approx(0.25)
    value.backward()
    assert image.grad is not None
    torch.testing.assert_close(image.grad, torch.full_like(image, 1 / image.numel()))
