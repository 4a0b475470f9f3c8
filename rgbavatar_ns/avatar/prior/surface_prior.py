"""A prior for what was never seen: it lies on the person's surface, closed, plain but for hair.

How much each Gaussian was seen decides how far it may leave the place, shape and colour that its
surroundings suggest. Ours: Adam moves what is hardly seen as fast as everything else, so that
without it a head turned beyond its film shatters (the paper names the limit, not a remedy).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.prior.covered import HeadSolid
from rgbavatar_ns.avatar.prior.discs import (
    LONGEST,
    disc_log_scale,
    flatten,
    log_overlap,
    narrow_ahead,
)
from rgbavatar_ns.avatar.prior.front import FrontSurface, shorten_overhanging
from rgbavatar_ns.avatar.prior.leash import Leash
from rgbavatar_ns.avatar.prior.mesh_field import MeshField, ramp
from rgbavatar_ns.avatar.prior.mouth import HiddenMouth
from rgbavatar_ns.avatar.prior.strands import Strands
from rgbavatar_ns.avatar.prior.virtual_views import VirtualViews
from rgbavatar_ns.drawing.compositing import ImagesRGBA, is_unfilmed
from rgbavatar_ns.head.rotations import conjugate_quats_wxyz, turn_back
from rgbavatar_ns.kernels import MorphedRenderer, PinholeCameras, weighted_color_average

EVERY = 40
"""Steps between two looks at what was seen; at first it is twice as often."""
_FIRST_STEP, _FIRST_PULL = 60, 160
"""Until the surface has closed everything is seen; then frames are looked at before any pull."""
_RATE = 0.4
"""Share of the way to the surface that an unseen Gaussian goes at a time."""
_DEPTH_RATE = 0.1
"""Share of the way to the surface, along the view of a film that is all front, of those that it
shows of a face: it does not tell how far before or behind they lie. Ours."""
_ASIDE_M = 3e-3, 1e-2
"""From what a face's Gaussian has gone across the view it may be seen, and is for sure."""
_ASTRAY = 2.0
"""Widths from its place at which what is hardly seen of a body is clear until it is back."""
_HARDLY_TURNED = 0.25
"""Of a film that is all front, from which on it does not tell what hangs before a throat."""
_FROM_FRONT = 0.8, 0.95
"""Forward parts of a film's view from which on it hardly tells how long a head's sides are."""
_STRAYS_M, _FLEETING = (2e-2, 3e-2), (0.2, 0.1)
"""From what a face's Gaussian has left its place it may stray, and does for sure, where so little
of what is seen of it is seen in front: from behind jaws and ears it paints collars and curtains."""
_FORGETS = 0.97
_SEEN_PX = 0.02
"""Pixels that a Gaussian covers in the frame that shows it best, at which it is half known; of a
body as many more as its discs are larger."""
_SHINES_PX = 2.0
"""Pixels covered through what lies before it at which its being wider half counts: backs shine a
little through every face, and much through the rim of hair, which wide ones would blur."""
_TURNED_AWAY, _FACING, _FRONTAL = -0.3, 0.0, 0.4
"""Cosines between normal and view: up to the first a Gaussian counts as not seen, from the second
as seen, else the back of a head is stretched until it paints the rim of its front; from the second
to the third its colour becomes clear, which at the rim is that of the neck behind."""
_CLEAR_PX = 0.1
"""Clear pixels at which its colour half tells that of its surroundings, and others that half tell
how thick it is."""
_SUNK, _SUNK_IN_CAVITY = 1.25, -0.6
"""How many of its widths a Gaussian's centre lies below the surface that it reaches to; those of
the mouth's cavity lie above it, or they come through the lips, which are thin."""
_CLOSED, _EMPTY = math.log(0.9 / 0.1), math.log(0.001 / 0.999)
_FAINT = math.log(0.01 / 0.99)
"""What is empty begins as: drawn still, so that frames to come may want it."""
_STIFFNESS, _REST, _ITERATIONS = 0.02, 1e-6, 30


class SurfacePrior(nn.Module):
    """Remembers how much each of N Gaussians was seen, and draws the unseen to the surface.

    Attributes:
        seen_px: pixels that each covered, from its own side and with none of the head before it, in
            the frame that showed it best, slowly forgotten.
        clear_px: the same from ever more in front, for what its colour tells of its surroundings.
        grazing_px: the same from ever more aside, which tells how thick it is.
        through_px: the same from whichever side: a matte that fades shows the far side's opacity.
        offset_m: how far the surface stands off the mesh at each, by the outlines of mattes.
        opacity_logit: of the surface: closed, but where mattes show background.
        leashed_position: where each one's neighbours would have it, in its tangent frame.
        leash_share: of the way there in a step; 0 until that is known.
        begun: whether the surface has been measured.
        views: from where nobody filmed.
    """

    seen_px: Float[Tensor, "N"]
    clear_px: Float[Tensor, "N"]
    grazing_px: Float[Tensor, "N"]
    through_px: Float[Tensor, "N"]
    offset_m: Float[Tensor, "N"]
    opacity_logit: Float[Tensor, "N"]
    leashed_position: Float[Tensor, "N 3"]
    leash_share: Float[Tensor, "N"]
    begun: Tensor

    def __init__(self, avatar: Avatar) -> None:
        super().__init__()
        num_gaussians = avatar.num_gaussians
        self.register_buffer("seen_px", torch.zeros(num_gaussians))
        self.register_buffer("clear_px", torch.zeros(num_gaussians))
        self.register_buffer("grazing_px", torch.zeros(num_gaussians))
        self.register_buffer("through_px", torch.zeros(num_gaussians))
        self.register_buffer("offset_m", torch.zeros(num_gaussians))
        self.register_buffer("opacity_logit", torch.full((num_gaussians,), _CLOSED))
        self.register_buffer("leashed_position", torch.zeros(num_gaussians, 3))
        self.register_buffer("leash_share", torch.zeros(num_gaussians))
        self.register_buffer("begun", torch.zeros((), dtype=torch.bool))
        self.views = VirtualViews(len(avatar.head.arrays.v_template), avatar.layout.size)
        self._parts_of: tuple[torch.device, _Parts] | None = None
        self._has_begun = False

    @property
    def has_begun(self) -> bool:
        """Whether the surface has been measured; else nothing is drawn to it."""
        self._has_begun = self._has_begun or bool(self.begun)
        return self._has_begun

    def begin(
        self,
        avatar: Avatar,
        theta: Float[Tensor, "B H"],
        cameras: PinholeCameras,
        images_rgba: ImagesRGBA,
    ) -> None:
        """Measure the surface by these frames, and put a fresh avatar's Gaussians on it."""
        # Here, so that timing steps on a bare machine needs no OpenCV.
        from rgbavatar_ns.avatar.prior.outline import measure_outline

        parts = self._parts(avatar)
        outline = measure_outline(avatar, parts.field, theta, cameras, _as_bytes(images_rgba))
        offset_m = parts.field.at_gaussians(outline.offset_m[:, None])[:, 0]
        self.offset_m.copy_(offset_m - _SUNK * avatar.initial_scale_m())
        self.opacity_logit.copy_(torch.where(outline.empty_gaussians > 0.5, _EMPTY, _CLOSED))
        self.views.begin(avatar, outline, theta, cameras)
        self.views.see(avatar, theta, cameras)
        self.begun.fill_(True)
        with torch.no_grad():
            position, opacity_logit = self.surface(avatar)
            avatar.blendshapes.position.copy_(position)
            avatar.blendshapes.log_scale.copy_(disc_log_scale(avatar))
            begun = opacity_logit.clamp(min=_FAINT)
            if parts.mouth is not None:
                # As clear as fresh ones, or what stands off the mesh, as glasses do, is learnt
                # late; but closed before the mouth, which would be painted through it.
                clearer = begun.minimum(avatar.blendshapes.opacity_logit)
                begun = torch.where(parts.mouth.before > 0.5, begun, clearer)
            avatar.blendshapes.opacity_logit.copy_(begun)

    def due(self, step: int) -> bool:
        """Whether to `look` before this step, counted from 0, and to `pull` after it."""
        every = EVERY if step >= _FIRST_PULL else EVERY // 2
        return step >= _FIRST_STEP and (step + 1) % every == 0 and self.has_begun

    @torch.no_grad()
    def look(
        self,
        avatar: Avatar,
        theta: Float[Tensor, "B H"],
        cameras: PinholeCameras,
        images_rgba: ImagesRGBA,
        renderer: MorphedRenderer | None = None,
        backend: str = "auto",
    ) -> None:
        """See what these frames show; `renderer` is theirs, where there is one already."""
        to_eye = self.views.see(avatar, theta, cameras)
        for known in (self.seen_px, self.clear_px, self.grazing_px, self.through_px):
            known.mul_(_FORGETS)
        if renderer is None:
            renderer = avatar.renderer(theta, cameras, backend=backend)
        filmed = (~is_unfilmed(images_rgba)).to(avatar.identity)[..., None]
        if renderer is not None:
            sums = renderer.weighted_color_average(filmed)
        else:
            sums = weighted_color_average(avatar.gaussians(theta), cameras, filmed, backend=backend)
        vertices, cameras = avatar.carrier_vertices(theta), cameras.to(avatar.identity)
        shown_px, facing = sums.weighted_sum[..., 0], _facing(avatar, vertices, cameras)
        parts = self._parts(avatar)
        mouth = parts.mouth
        if mouth is not None:
            # Also where expressions do not carry Gaussians they part the lips.
            shown_px = mouth.through_lips(shown_px, avatar.head(theta, avatar.identity), cameras)
        # Bodies do not turn with the head, and of the mouth its lips decide, where they are known.
        here_m = parts.at_rest_m(avatar.blendshapes.position)
        inset_m = (-self.offset_m).clamp(min=0)
        covered = parts.solid.covered(here_m, to_eye.to(facing), inset_m) * parts.outer
        seen, clear = (
            (1 - covered) * ramp(facing, *cosines)
            for cosines in ((_TURNED_AWAY, _FACING), (_FACING, _FRONTAL))
        )
        for known, share in (
            (self.through_px, torch.ones_like(facing)),
            (self.seen_px, seen),
            (self.clear_px, clear),
            (self.grazing_px, seen - clear),
        ):
            torch.maximum(known, (shown_px * share).amax(0), out=known)

    @torch.no_grad()
    def pull(self, avatar: Avatar, step: int) -> None:
        """Draw to the surface what no frame shows."""
        if step < _FIRST_PULL:
            return
        shapes, parts = avatar.blendshapes, self._parts(avatar)
        field, mouth, strands = parts.field, parts.mouth, parts.strands
        clear = self.clear_px.square() / (self.clear_px.square() + _CLEAR_PX**2)
        start, most = field.of_gaussians(shapes.color_feature, torch.ones_like(clear))
        told, confidence = field.of_gaussians(shapes.color_feature, clear)
        confidence = strands.known(confidence, most)
        if mouth is not None:
            told, confidence = mouth.guessed(told, confidence)
        color = field.continued(
            told,
            confidence,
            start,
            stiffness=_STIFFNESS * field.color_links,
            rest=_REST,
            iterations=_ITERATIONS,
        )
        colored_px = strands.colored_px(self.seen_px, self.clear_px, self.grazing_px)
        disc = disc_log_scale(avatar)
        half_px = parts.half_known_px
        pull, close, color_pull = (
            _RATE * half_px / (px + half_px) for px in (self.seen_px, self.through_px, colored_px)
        )
        home, opacity_logit = self.surface(avatar)
        fleeting = ramp(self.clear_px / self.seen_px.clamp(min=_SEEN_PX), *_FLEETING)
        strays = parts.skin * fleeting * ramp((shapes.position - home).norm(dim=1), *_STRAYS_M)
        pull = pull + (_RATE - pull) * strays
        # Below its end a body is not kept by being seen from behind, through what ends before it.
        astray = (shapes.position - home).norm(dim=1) > _ASTRAY * disc[:, :2].mean(1).exp()
        opacity_logit = torch.where(astray & field.body_gaussians, _EMPTY, opacity_logit)
        closes = torch.where((opacity_logit < 0) & field.body_gaussians, pull, close)
        frontal = clear * _CLEAR_PX / (self.grazing_px + _CLEAR_PX)
        flatten(shapes, field.normal_of_gaussians, disc, frontal)
        ahead, alone = self.views.seen_from()
        view = turn_back(field.rest_quats_wxyz, ahead.to(disc).expand(len(disc), 3))
        seen = (1 - pull / _RATE).clamp(min=0)
        unturned = alone.to(disc) * parts.narrow * seen
        flatten(shapes, view, disc, unturned, widths=LONGEST)
        # Gone aside, as chins that paint the neck, it has the surface before it that is there.
        here, there = parts.at_rest_m(shapes.position), parts.at_rest_m(home)
        before_m, front_m = parts.front.at(here), parts.front.at(there)
        # And what was hidden there, as below the chin, is not any more.
        aside = ramp((here - there)[:, :2].norm(dim=1), *_ASIDE_M)
        shown = aside if mouth is None else aside * (1 - mouth.behind)
        sunk_m = _SUNK * avatar.initial_scale_m()
        hidden_m = (front_m - there[:, 2] - sunk_m).clamp(min=0)
        before_m = (before_m - front_m + shown * hidden_m).nan_to_num()
        depth = ((home - shapes.position) * view).sum(1) + before_m * ahead[2].to(disc)
        shapes.position.add_((_DEPTH_RATE * unturned * depth)[:, None] * view)
        here = parts.at_rest_m(shapes.position)
        hangs = seen * ramp(alone.to(disc), 0.0, _HARDLY_TURNED)
        shares = parts.skin * hangs, parts.narrow * hangs
        # A film from aside shows how long sides are.
        cut = (shares[0] - shares[1]).clamp(min=0) * ramp(ahead[2].to(disc), *_FROM_FRONT)
        shares = (*shares, cut)
        shorten_overhanging(shapes, parts.front, here, field.rest_quats_wxyz, disc, shares)
        # As far as nothing shows it, nothing else closes the surface around it.
        through = _SHINES_PX / (self.through_px + _SHINES_PX)
        alone = (pull / _RATE * through).square()
        if mouth is not None:  # where what lies behind is dark too
            alone = alone * (1 - mouth.in_cavity)
        disc[:, :2] += alone[:, None] * log_overlap(avatar, field, self.views.surface_m)
        contrast = self.views.hair_contrast
        plain = strands.nape.colored(field.at_gaussians(color), color, contrast)
        upright = torch.zeros_like(shapes.rotation_wxyz)
        upright[:, 0] = 1
        rest = {
            "position": home,
            "rotation_wxyz": upright,
            "log_scale": disc,
            "opacity_logit": opacity_logit,
            "color_feature": strands.drawn(plain, contrast),
        }
        shares = {"opacity_logit": closes, "color_feature": color_pull}
        for name, target in rest.items():
            value, share = getattr(shapes, name), shares.get(name, pull)
            value.lerp_(target, share.view(-1, *[1] * (value.ndim - 1)))
        for name in ("basis_position", "basis_rotation_wxyz", "basis_color_feature"):
            if shapes.num_bases:
                fades = color_pull if name == "basis_color_feature" else pull
                getattr(shapes, name).mul_((1 - fades)[:, None])
        counts = shapes.opacity_logit.sigmoid() * seen
        self.leashed_position.copy_(parts.leash.smooth(shapes.position, home, counts))
        self.leash_share.copy_(parts.leash.share(avatar))

    @torch.no_grad()
    def hold(self, avatar: Avatar) -> None:
        """Draw to their neighbours, after every step, those that expressions would tear away."""
        position = avatar.blendshapes.position
        share = self.leash_share[:, None].to(position)
        position.lerp_(self.leashed_position.to(position), share)

    def surface(self, avatar: Avatar) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]:
        """Where each lies on the surface, in its tangent frame, and its opacity there, a logit."""
        parts, offset_m, opacity_logit = self._parts(avatar), self.offset_m, self.opacity_logit
        if parts.mouth is not None:  # which no outline tells of
            scale_m, mouth = avatar.initial_scale_m(), parts.mouth
            sunk = _SUNK + (_SUNK_IN_CAVITY - _SUNK) * mouth.in_cavity
            offset_m = (offset_m + _SUNK * scale_m) * (1 - mouth.behind) - sunk * scale_m
            opacity_logit = torch.where(mouth.backs, _EMPTY, opacity_logit)
        return offset_m[:, None] * parts.field.outwards, opacity_logit

    def _parts(self, avatar: Avatar) -> "_Parts":
        device = self.seen_px.device
        if self._parts_of is None or self._parts_of[0] != device:
            field = MeshField(avatar)
            strands, mouth = Strands.of(avatar, field), HiddenMouth.of(avatar, field)
            front, outer = FrontSurface.of(avatar, field), (~field.body_gaussians).to(field.rest_m)
            self._parts_of = (
                device,
                _Parts(
                    field,
                    mouth,
                    Leash(avatar, field),
                    strands,
                    narrow_ahead(field) * (1 - strands.haired),
                    (1 - strands.haired) * ~field.body_gaussians,
                    front,
                    HeadSolid.of(avatar, field, front),
                    torch.zeros_like(outer) if mouth is None else outer * (1 - mouth.behind),
                    field.at_gaussians(field.rest_m),
                    _SEEN_PX * _body_sizes(avatar, field),
                ),
            )
        return self._parts_of[1]


@dataclass(frozen=True)
class _Parts:
    """What the prior knows of an avatar's head, the same in every look."""

    field: MeshField
    mouth: HiddenMouth | None
    leash: Leash
    strands: Strands
    narrow: Float[Tensor, "N"]
    """1 where the film's view says nothing of how far Gaussians reach along it."""
    skin: Float[Tensor, "N"]
    """1 of a head where no hair is."""
    front: FrontSurface
    solid: HeadSolid
    outer: Float[Tensor, "N"]
    """1 of a head, 0 of the body and within the mouth; 0 of all where no mouth is known."""
    rest_m: Float[Tensor, "N 3"]
    """Each one's place on the mesh at rest."""
    half_known_px: Float[Tensor, "N"]
    """Pixels covered at which each is half known."""

    def at_rest_m(self, position: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Where positions in tangent frames are on the head at rest, in its axes."""
        back = conjugate_quats_wxyz(self.field.rest_quats_wxyz)
        return self.rest_m + turn_back(back, position)


def _body_sizes(avatar: Avatar, field: MeshField) -> Float[Tensor, "N"]:
    """How many times larger a body's discs are than a head's, 1 elsewhere: a corner shows neither.

    Ours, because discs hid beyond the picture's end, where nothing is asked of them, but for a
    quarter of a pixel, and hung there as specks below the body.
    """
    area = disc_log_scale(avatar)[:, :2].sum(1)
    usual = area[~field.body_gaussians].median()
    return torch.where(field.body_gaussians, (area - usual).exp().clamp(min=1), 1.0)


def _facing(
    avatar: Avatar, vertices: Float[Tensor, "B V 3"], cameras: PinholeCameras
) -> Float[Tensor, "B N"]:
    """Cosine of the angle between the surface's normal at each Gaussian and its way to the eye."""
    mesh = avatar.anchors.triangles(with_rest_length=False)
    corners = vertices[:, mesh["triangle_vertices"]]
    first, second, third = corners.unbind(2)
    normal = torch.linalg.cross(second - first, third - first)
    pose = cameras.world_to_camera.to(first)
    to_eye = -(pose[:, :3, :3].mT @ pose[:, :3, 3:]).mT - first
    lengths = normal.square().sum(-1) * to_eye.square().sum(-1)
    cosine = (normal * to_eye).sum(-1) * lengths.clamp(min=1e-30).rsqrt()
    return cosine[:, mesh["triangle_of"]]


def _as_bytes(images_rgba: ImagesRGBA) -> UInt8[Tensor, "B height width 4"]:
    if images_rgba.dtype == torch.uint8:
        return images_rgba
    return (images_rgba.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
