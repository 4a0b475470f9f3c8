"""The head and the weight network of an avatar as compiled loops take them."""

from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.config import AvatarConfig
from rgbavatar_ns.avatar.model.weight_network import WeightNetwork
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import PosingParameters


def posing_parameters(
    head: HeadModel,
    identity: Float[Tensor, "I"],
    film_range: tuple[Float[Tensor, "H"], Float[Tensor, "H"]],
    network: WeightNetwork | None,
    config: AvatarConfig,
) -> PosingParameters:
    """What `Avatar.weights` and `Avatar.carrier_vertices` compute with."""
    layout = head.layout
    expression = layout.slice("expression")
    if network is None:
        start = expression.start
        features = [(slice(start, start + config.num_bases), False)]
    else:
        read = layout.feature_parts(config.pose_input, config.translation_input)
        features = [(layout.slice(name), turned) for name, turned in read]
    layers = () if network is None else network.linear_layers()
    low, high = film_range
    return PosingParameters(
        **head.loop_arrays(identity),
        expression=expression,
        eyelids=layout.slice("eyelids") if "eyelids" in layout else slice(0, 0),
        translation=layout.slice("translation"),
        by_joints_alone=config.carrier == "joints",
        low=low,
        high=high,
        features=tuple(features),
        layers=tuple((layer.weight, layer.bias) for layer in layers),
    )
