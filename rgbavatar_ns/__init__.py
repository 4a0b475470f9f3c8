"""RGBAvatar as a nerfstudio plugin: reduced Gaussian blendshapes for head avatars."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rgbavatar_ns.avatar.avatar import Avatar

__version__ = "0.2.0"
__all__ = ["Avatar", "__version__"]


def __getattr__(name: str) -> Any:
    """Import `Avatar` on first use, so that importing the package stays light."""
    if name == "Avatar":
        from rgbavatar_ns.avatar.avatar import Avatar

        return Avatar
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
