"""All methods that this plugin brings, by the names that nerfstudio's commands know them by."""

from nerfstudio.plugins.types import MethodSpecification

from rgbavatar_ns.plugin import methods, rivals
from rgbavatar_ns.plugin.online import methods as online_methods
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainerConfig


def presets() -> dict[str, RGBAvatarTrainerConfig]:
    """The config of each method; to be copied before it is changed."""
    found: dict[str, RGBAvatarTrainerConfig] = {}
    for module in (methods, online_methods, rivals):
        for value in vars(module).values():
            if isinstance(value, MethodSpecification):
                config = value.config
                assert isinstance(config, RGBAvatarTrainerConfig)
                assert config.method_name is not None
                found[config.method_name] = config
    return found
