import pytest
import roma
import torch

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.methods.gaussianavatars import GaussianAvatars
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.avatar.training.optimizer_states import unsupported_reason
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import ThetaField, ThetaLayout

from .small_head import NUM_EXPRESSION, front_camera, random_theta, small_head, small_identity

VARIANTS = ("normalized", "raw", "orthonormal")


def covariances(gaussians):
    """R diag(s^2) R^T of every Gaussian, by another library (roma, xyzw)."""
    quats_xyzw = gaussians.quats_wxyz.roll(-1, -1)
    rotation = roma.unitquat_to_rotmat(quats_xyzw / quats_xyzw.norm(dim=-1, keepdim=True))
    scaled = rotation * gaussians.scales[..., None, :]
    return scaled @ scaled.mT


@pytest.mark.parametrize("variant", VARIANTS)
def test_rigid_head_motion_moves_gaussians_rigidly(make_avatar, variant):
    avatar = make_avatar(random=True, dtype=torch.float64, tangent_variant=variant)
    layout = avatar.layout
    still = random_theta(layout, 2, dtype=torch.float64)
    still[:, layout.slice("rotation")] = 0
    still[:, layout.slice("translation")] = 0
    moved = still.clone()
    moved[:, layout.slice("rotation")] = torch.tensor([0.3, -0.8, 0.2], dtype=torch.float64)
    moved[:, layout.slice("translation")] = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    psi = torch.randn(2, 3, dtype=torch.float64)
    before, after = avatar.gaussians(still, psi), avatar.gaussians(moved, psi)

    # The motion as the mesh makes it: rotation about the root joint, then translation.
    rotation = roma.rotvec_to_rotmat(moved[0, layout.slice("rotation")])
    vertices = [avatar.head(theta, avatar.identity) for theta in (still, moved)]
    offset = vertices[1][:, :1] - vertices[0][:, :1] @ rotation.T
    torch.testing.assert_close(after.means, before.means @ rotation.T + offset)
    # Skinning weights are float32 and sum to one within 1e-7, so the head itself is not stiffer.
    torch.testing.assert_close(
        covariances(after), rotation @ covariances(before) @ rotation.T, atol=1e-11, rtol=1e-6
    )
    torch.testing.assert_close(after.colors, before.colors)


def test_untrained_gaussians_lie_on_the_mesh(make_avatar):
    avatar = make_avatar(dtype=torch.float64)
    theta = random_theta(avatar.layout, 2, dtype=torch.float64)
    vertices = avatar.head(theta, avatar.identity)
    triangle, weights = avatar.anchors.triangle_index, avatar.anchors.barycentric.double()
    corners = vertices[:, avatar.head.faces[triangle].long()]
    expected = torch.einsum("bncx,nc->bnx", corners, weights)
    torch.testing.assert_close(avatar.gaussians(theta).means, expected)
    # A position residual along the frame's third axis leaves the surface along its normal.
    with torch.no_grad():
        avatar.blendshapes.position[:, 2] = 1e-3
    a, b, c = corners.unbind(2)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a, dim=-1), dim=-1)
    torch.testing.assert_close(avatar.gaussians(theta).means, expected + 1e-3 * normal)


def test_quaternions_turn_the_third_axis_onto_the_normal(make_avatar):
    for variant in VARIANTS:
        avatar = make_avatar(dtype=torch.float64, tangent_variant=variant)
        theta = random_theta(avatar.layout, 1, dtype=torch.float64)
        quats = avatar.gaussians(theta).quats_wxyz
        third = roma.unitquat_to_rotmat(quats.roll(-1, -1))[..., 2]
        with torch.no_grad():
            base = avatar.gaussians(theta).means
            avatar.blendshapes.position[:, 2] = 1.0
            normal = avatar.gaussians(theta).means - base
        torch.testing.assert_close(third, normal)


def test_scales_and_opacities_are_shared_by_the_batch(make_avatar):
    avatar = make_avatar(random=True)
    gaussians = avatar.gaussians(random_theta(avatar.layout, 3))
    assert gaussians.means.shape == (3, avatar.num_gaussians, 3)
    assert gaussians.scales.shape == (1, avatar.num_gaussians, 3)
    assert gaussians.opacities.shape == (1, avatar.num_gaussians)


def test_scale_follows_the_triangle_only_when_asked(make_avatar):
    fixed = make_avatar(dtype=torch.float64)
    following = make_avatar(dtype=torch.float64, scale_with_triangle=True)
    rest = torch.zeros(1, fixed.layout.size, dtype=torch.float64)
    torch.testing.assert_close(following.gaussians(rest).scales, fixed.gaussians(rest).scales)
    # Bending the sheet stretches its triangles by the ratio of side lengths at most.
    bent = random_theta(fixed.layout, 1, dtype=torch.float64)
    ratio = following.gaussians(bent).scales / fixed.gaussians(bent).scales
    vertices = [following.head(theta, following.identity)[0] for theta in (rest, bent)]
    corners = [posed[following.head.faces].unbind(1) for posed in vertices]
    areas = [torch.linalg.cross(b - a, c - a, dim=-1).norm(dim=-1) for a, b, c in corners]
    expected = (areas[1] / areas[0]).sqrt()[following.anchors.triangle_index]
    torch.testing.assert_close(ratio, expected[None, :, None].expand_as(ratio))


def test_scale_from_texel_spacing_is_half_the_distance_of_neighbours(make_avatar):
    avatar = make_avatar(dtype=torch.float32, uv_resolution=40, scale_from_texel_spacing=True)
    means = avatar.gaussians(torch.zeros(1, avatar.layout.size)).means[0].detach()
    nearest = (torch.cdist(means, means) + 10 * torch.eye(len(means))).amin(1)
    ratio = avatar.blendshapes.log_scale.exp()[:, 0].detach() / nearest
    assert 0.4 < ratio.median() < 0.7


def test_batched_render_equals_a_loop(make_avatar):
    avatar = make_avatar(random=True)
    theta, camera = random_theta(avatar.layout, 3), front_camera(24)
    background = torch.rand(3, 3)
    batch = avatar.render(theta, camera, background)
    assert batch.alpha.amax() > 0.5
    for b in range(3):
        one = avatar.render(theta[b : b + 1], camera, background[b : b + 1])
        torch.testing.assert_close(batch.image[b], one.image[0], atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(batch.alpha[b], one.alpha[0], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", ["mlp", "linear"])
def test_every_parameter_gets_a_gradient(make_avatar, kind):
    avatar = make_avatar(random=True, weight_network=kind)
    theta = random_theta(avatar.layout, 2)
    rendered = avatar.render(theta, front_camera(24), torch.rand(2, 3), differentiable=True)
    (rendered.image * torch.rand(rendered.image.shape)).sum().backward()
    for name, parameters in avatar.parameter_groups().items():
        for parameter in parameters:
            assert parameter.grad is not None, name
            assert torch.isfinite(parameter.grad).all(), name
            assert parameter.grad.abs().max() > 0, name
    grouped = {id(p) for group in avatar.parameter_groups().values() for p in group}
    assert grouped == {id(p) for p in avatar.parameters()}


def test_gradients_match_finite_differences(make_avatar):
    avatar = make_avatar(random=True, dtype=torch.float64, uv_resolution=2, num_bases=1)
    theta = random_theta(avatar.layout, 1, dtype=torch.float64).requires_grad_()
    shapes = avatar.blendshapes

    def attributes(theta, *_):
        gaussians = avatar.gaussians(theta)
        return gaussians.means, gaussians.quats_wxyz, gaussians.colors, gaussians.scales

    inputs = (theta, shapes.position, shapes.rotation_wxyz, shapes.log_scale)
    bases = (shapes.basis_position, shapes.basis_rotation_wxyz)
    assert torch.autograd.gradcheck(attributes, (*inputs, *bases), atol=1e-6)


def test_without_bases_there_are_no_basis_groups(make_avatar):
    avatar = make_avatar(num_bases=0)
    groups = {"position", "rotation", "log_scale", "opacity", "color"}
    assert set(avatar.parameter_groups()) == groups
    theta = random_theta(avatar.layout, 2)
    assert avatar.weights(theta).shape == (2, 0)
    assert avatar.render(theta, front_camera(16)).image.shape == (2, 16, 16, 3)


def test_building_depends_on_the_seed_alone(make_avatar):
    first = make_avatar(seed=3)
    torch.manual_seed(99)
    same, other = make_avatar(seed=3), make_avatar(seed=4)
    theta = random_theta(first.layout, 2)
    assert torch.equal(first.weights(theta), same.weights(theta))
    assert not torch.equal(first.weights(theta), other.weights(theta))


def test_theta_of_another_size_is_refused_with_the_layout(make_avatar):
    avatar = make_avatar()
    with pytest.raises(UserError, match=rf"theta has 5 values.*'small'.*{avatar.layout.size}"):
        avatar.gaussians(torch.zeros(1, 5))
    with pytest.raises(UserError, match="expression 4"):
        avatar.weights(torch.zeros(1, 5))


@pytest.mark.usefixtures("unchecked_types")
def test_theta_without_its_batch_is_told_with_the_shape_that_is_wanted(make_avatar):
    avatar, camera = make_avatar(), front_camera(8)
    size = avatar.layout.size
    for shape in ((size,), (1, 1, size), ()):
        theta = torch.zeros(shape)
        for differentiable in (False, True):
            with pytest.raises(UserError, match=rf"but a batch is wanted: \[B, {size}\]"):
                avatar.render(theta, camera, differentiable=differentiable)
        with pytest.raises(UserError, match=r"theta\[None\]"):
            avatar.weights(theta)
        with pytest.raises(UserError, match=r"theta\[None\]"):
            avatar.render(theta, camera, to_be_seen=True)


@pytest.mark.parametrize("differentiable", [False, True])
def test_an_empty_batch_is_told(make_avatar, differentiable):
    rival = GaussianAvatars(small_head(), small_identity())
    for avatar in (make_avatar(), rival):
        theta, camera = torch.zeros(2, avatar.layout.size), front_camera(8)
        for given, cameras in ((theta[:0], camera), (theta, camera.select([]))):
            with pytest.raises(ValueError, match=r"leading dimension 0\. Pass at least 1"):
                avatar.render(given, cameras, differentiable=differentiable)


def test_theta_goes_to_the_avatars_device(make_avatar):
    avatar = make_avatar().to("meta")
    assert avatar.checked(torch.zeros(2, avatar.layout.size)).device.type == "meta"


def test_theta_that_is_not_finite_is_refused(make_avatar):
    avatar = make_avatar()
    theta = torch.zeros(2, avatar.layout.size)
    for value in (torch.nan, torch.inf):
        theta[1, 3] = value
        with pytest.raises(UserError, match="NaN or infinite"):
            avatar.render(theta, front_camera(8))


def test_another_layout_is_refused_naming_both(make_avatar):
    avatar = make_avatar()
    avatar.require_layout(small_head().layout, "This dataset")
    other = ThetaLayout(
        (ThetaField("expression", 50, "linear"), ThetaField("jaw", 3, "axis_angle"))
    )
    with pytest.raises(UserError, match=r"clip\.json.*53 values.*expression 50.*expression 4"):
        avatar.require_layout(other, "clip.json")


@pytest.mark.parametrize(
    "change",
    [
        {"num_bases": -1},
        {"uv_resolution": 0},
        {"initial_opacity": 1.0},
        {"initial_scale_m": 0.0},
        {"weight_network": "deep"},
        {"tangent_variant": "flat"},
    ],
)
def test_settings_out_of_range_are_refused(change):
    # Set afterwards, since the tests' type checks would refuse some of them first.
    ((name, value),) = change.items()
    config = AvatarConfig()
    object.__setattr__(config, name, value)
    with pytest.raises(UserError, match=name.replace("_", ".")):
        config.__post_init__()


# Everything that a step reads goes with the avatar to its device; "meta" stands for any other.


def test_all_tensors_go_along(make_avatar):
    avatar = make_avatar(scale_with_triangle=True).to("meta")
    gaussians = vars(avatar._morphed_gaussians())
    places = {name: v.device.type for name, v in gaussians.items() if isinstance(v, torch.Tensor)}
    assert set(places.values()) == {"meta"}, places
    assert len(places) == len(gaussians) - 1  # all but the variant's name


def test_nothing_of_another_device_takes_part(make_avatar):
    """Mixing devices raises; a copy from main memory in each step would wait for the device."""
    for changes in ({}, {"carrier": "joints"}, {"pose_input": False}):
        avatar = make_avatar(**changes).to("meta")
        theta = torch.zeros(2, avatar.layout.size, device="meta")
        assert avatar.weights(theta).device.type == "meta"
        assert avatar.carrier_vertices(theta).device.type == "meta"


def _changed(layout, theta, name):
    other = theta.clone()
    other[:, layout.slice(name)] += 0.3
    return other


def test_joints_carry_gaussians_past_expressions_but_not_past_the_jaw(make_avatar):
    avatar = make_avatar(random=True, dtype=torch.float64, carrier="joints")
    mesh = make_avatar(random=True, dtype=torch.float64)
    theta = random_theta(avatar.layout, 2, dtype=torch.float64)
    psi = torch.randn(2, 3, dtype=torch.float64)
    means = avatar.gaussians(theta, psi).means
    smiling = _changed(avatar.layout, theta, "expression")
    torch.testing.assert_close(avatar.gaussians(smiling, psi).means, means, rtol=0, atol=0)
    for name in ("jaw", "rotation", "translation"):
        moved = avatar.gaussians(_changed(avatar.layout, theta, name), psi).means
        assert not torch.allclose(moved, means)
    neutral = theta.clone()
    neutral[:, avatar.layout.slice("expression")] = 0
    same = mesh.gaussians(neutral, psi).means
    torch.testing.assert_close(avatar.gaussians(neutral, psi).means, same)
    assert not torch.allclose(mesh.gaussians(smiling, psi).means, mesh.gaussians(theta, psi).means)


def test_without_a_network_the_first_expressions_are_the_weights(make_avatar):
    avatar = make_avatar(random=True, weight_network="none", num_bases=3)
    theta = random_theta(avatar.layout, 4)
    expressions = theta[:, avatar.layout.slice("expression")]
    torch.testing.assert_close(avatar.weights(theta), expressions[:, :3], rtol=0, atol=0)
    groups = avatar.parameter_groups()
    assert "weight_network" not in groups
    assert groups["basis_color"][0].shape[0] == 3


def test_more_bases_than_expressions_need_a_network():
    config = AvatarConfig(num_bases=NUM_EXPRESSION + 1, weight_network="none", uv_resolution=8)
    with pytest.raises(UserError, match=f"has {NUM_EXPRESSION}"):
        Avatar(small_head(), small_identity(), config)


def test_the_fused_step_trains_both(make_avatar):
    for variant in ({"carrier": "joints"}, {"weight_network": "none"}):
        avatar = make_avatar(random=True, **variant)
        before = {name: p.detach().clone() for name, p in avatar.named_parameters()}
        parameters = [p for group in avatar.parameter_groups().values() for p in group]
        optimizer = torch.optim.Adam(parameters, lr=1e-2)
        assert unsupported_reason(avatar, [optimizer]) is None
        images = torch.randint(0, 256, (2, 16, 16, 4), dtype=torch.uint8)
        step = FusedStep(avatar, [optimizer])
        loss = step(random_theta(avatar.layout, 2), front_camera(16), images, torch.zeros(2, 3))
        if loss is None:
            pytest.skip("no compiled extension")
        moved = [n for n, p in avatar.named_parameters() if not torch.equal(p, before[n])]
        assert {"blendshapes.position", "blendshapes.basis_color_feature"} <= set(moved)


def test_what_shows_in_no_picture_is_left_out_and_pictures_stay(make_avatar, tmp_path):
    avatar = make_avatar(random=True)
    with torch.no_grad():
        avatar.blendshapes.opacity_logit[::3] = -7.0  # alpha .0009, below 1/255
    avatar.widen_film_range(random_theta(avatar.layout, 4))
    smaller = avatar.without_undrawn()
    assert smaller.num_gaussians == avatar.num_gaussians - len(range(0, avatar.num_gaussians, 3))
    theta = random_theta(avatar.layout, 3)
    expected = avatar.render(theta, front_camera()).image
    assert expected.max() > 0.3
    assert torch.equal(smaller.render(theta, front_camera()).image, expected)
    smaller.save(tmp_path / "me")
    assert torch.equal(Avatar.load(tmp_path / "me").render(theta, front_camera()).image, expected)
    assert smaller.without_undrawn().num_gaussians == smaller.num_gaussians
