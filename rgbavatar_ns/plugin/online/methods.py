"""The methods that train while the frames arrive: `rgbavatar-online` and its variants."""

import sys
from dataclasses import replace

from nerfstudio.plugins.types import MethodSpecification

from rgbavatar_ns.plugin.methods import paper_model, preset, tiny_model
from rgbavatar_ns.plugin.online import datamanager, pipeline, sources, trainer
from rgbavatar_ns.plugin.online.datamanager import OnlineDataManagerConfig
from rgbavatar_ns.plugin.online.pipeline import OnlinePipelineConfig
from rgbavatar_ns.plugin.online.trainer import OnlineTrainerConfig

# As in `plugin.methods`.
for _module in (datamanager, pipeline, sources, trainer):
    _earlier = _module.__name__.replace("plugin.online.", "plugin.online_")
    sys.modules.setdefault(_earlier, _module)

rgbavatar_online = MethodSpecification(
    config=preset(OnlineTrainerConfig, "rgbavatar-online", steps_per_save=500),
    description="rgbavatar from a stream, new frames first, and 500 steps after it.",
)

rgbavatar_paper_online = MethodSpecification(
    config=preset(
        OnlineTrainerConfig,
        "rgbavatar-paper-online",
        pipeline=OnlinePipelineConfig(
            # A stream may go on to show what was not seen yet.
            model=replace(paper_model(), hide_unseen=False),
            datamanager=OnlineDataManagerConfig(new_first=False),
        ),
        steps_after_stream=0,
        final_learning_rate_factor=1.0,
        steps_per_save=500,
    ),
    description="rgbavatar-paper from a stream, with which it ends.",
)

rgbavatar_online_tiny = MethodSpecification(
    config=preset(
        OnlineTrainerConfig,
        "rgbavatar-online-tiny",
        # A CPU takes too few steps a frame for the paper's .7: old frames would be seen too seldom.
        # .3 brings .4 dB on held-out frames at 8 images a frame (docs/online.md).
        pipeline=OnlinePipelineConfig(
            model=tiny_model(), datamanager=OnlineDataManagerConfig(local_share=0.3)
        ),
        steps_per_save=500,
    ),
    description="rgbavatar-online with fewer Gaussians: real time on a CPU.",
)
