"""Everything that a step reads goes with the avatar to its device; "meta" stands for any other."""

import torch

from rgbavatar_ns.avatar.avatar import Avatar


def test_all_tensors_go_along(make_avatar):
    avatar: Avatar = make_avatar(scale_with_triangle=True).to("meta")
    gaussians = vars(avatar._morphed_gaussians())
    places = {name: v.device.type for name, v in gaussians.items() if isinstance(v, torch.Tensor)}
    assert set(places.values()) == {"meta"}, places
    assert len(places) == len(gaussians) - 1  # all but the variant's name


def test_nothing_of_another_device_takes_part(make_avatar):
    """Mixing devices raises; a copy from main memory in each step would wait for the device."""
    for changes in ({}, {"carrier": "joints"}, {"pose_input": False}):
        avatar: Avatar = make_avatar(**changes).to("meta")
        theta = torch.zeros(2, avatar.layout.size, device="meta")
        assert avatar.weights(theta).device.type == "meta"
        assert avatar.carrier_vertices(theta).device.type == "meta"
