"""What a head is taken for where the film does not show it: closed, plain, and of its outline."""

from rgbavatar_ns.avatar.prior.surface_prior import SurfacePrior
from rgbavatar_ns.avatar.prior.virtual_views import NUM_VIEWS, VirtualViews

__all__ = ["NUM_VIEWS", "SurfacePrior", "VirtualViews"]
