import pytest
import torch

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, HeadModel
from rgbavatar_ns.head.flame import load_flame
from rgbavatar_ns.synthetic.flame import write_synthetic_flame
from tests.avatar.small_head import front_camera, random_theta


@pytest.fixture(autouse=True)
def no_heads_named(monkeypatch):
    for name in ("RGBAVATAR_HEAD", "RGBAVATAR_FLAME"):
        monkeypatch.delenv(name, raising=False)


def _picture(avatar: Avatar) -> torch.Tensor:
    with torch.no_grad():
        return avatar.render(random_theta(avatar.layout, 1), front_camera(24)).image


def test_a_bundle_without_its_head_wants_the_very_file(make_avatar, tmp_path, monkeypatch):
    avatar = make_avatar(random=True)
    avatar.save(tmp_path / "me", with_head=False)
    held = (tmp_path / "me" / "avatar.safetensors").stat().st_size
    avatar.save(tmp_path / "whole")
    assert held < (tmp_path / "whole" / "avatar.safetensors").stat().st_size
    with pytest.raises(UserError, match=r"does not hold its head model 'small'.*RGBAVATAR_HEAD"):
        Avatar.load(tmp_path / "me")

    avatar.head.arrays.save(tmp_path / "head.npz")
    monkeypatch.setenv("RGBAVATAR_HEAD", str(tmp_path / "head.npz"))
    assert torch.equal(_picture(Avatar.load(tmp_path / "me")), _picture(avatar))

    monkeypatch.setenv("RGBAVATAR_HEAD", str(tmp_path / "gone.npz"))
    with pytest.raises(UserError, match=r"gone\.npz"):
        Avatar.load(tmp_path / "me")
    HeadArrays.embedded().save(tmp_path / "other.npz")
    monkeypatch.setenv("RGBAVATAR_HEAD", str(tmp_path / "other.npz"))
    with pytest.raises(UserError, match="'makehuman' found here is not the 'small'"):
        Avatar.load(tmp_path / "me")


def _avatar(head: HeadModel) -> Avatar:
    config = AvatarConfig(num_bases=0, uv_resolution=12)
    return Avatar(head, torch.zeros(head.num_identity), config)


def test_the_embedded_head_is_always_there(tmp_path):
    avatar = _avatar(HeadModel.embedded())
    avatar.save(tmp_path / "me", with_head=False)
    assert torch.equal(_picture(Avatar.load(tmp_path / "me")), _picture(avatar))


def test_flame_is_found_by_its_version_and_form(tmp_path, monkeypatch):
    pickle = write_synthetic_flame(tmp_path / "models")
    sizes = {"num_identity": 3, "num_expressions": 5}
    avatar = _avatar(HeadModel(load_flame(pickle, teeth_form="blocks", **sizes)))
    avatar.save(tmp_path / "me", with_head=False)
    with pytest.raises(UserError, match=r"FLAME 2020.*RGBAVATAR_FLAME"):
        Avatar.load(tmp_path / "me")
    monkeypatch.setenv("RGBAVATAR_FLAME", str(tmp_path / "models"))
    avatar.save(tmp_path / "whole")
    found, held = Avatar.load(tmp_path / "me"), Avatar.load(tmp_path / "whole")
    assert torch.equal(_picture(found), _picture(held))
    assert torch.allclose(_picture(found), _picture(avatar), atol=1e-4)
    monkeypatch.setenv("RGBAVATAR_FLAME", str(tmp_path / "nowhere"))
    with pytest.raises(UserError, match="nowhere"):
        Avatar.load(tmp_path / "me")


def test_a_digest_knows_every_number_and_survives_the_file(make_avatar, tmp_path):
    arrays = make_avatar().head.arrays
    arrays.save(tmp_path / "head.npz")
    assert HeadArrays.load(tmp_path / "head.npz").digest() == arrays.digest()
    changed = dict(vars(arrays), v_template=arrays.v_template + 1e-6)
    assert HeadArrays(**changed).digest() != arrays.digest()


def test_a_head_has_the_digest_that_bundles_of_before_name():
    assert HeadArrays.embedded().digest().startswith("e051afbf4dfe7848")
